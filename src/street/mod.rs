//! The embedded street: a driving world made from a seed, at any size, with exact depth, poses and intrinsics.
//!
//! It stands in for a recorded dataset where there is none: a training run starts with no download, and every claim
//! about geometry can be checked, since the truth is known. `build` says what stands where (with `houses` and `props`) and fills a `world`, `camera` how the
//! car moves, `shape` where rays meet solids, `surface`, `weather` and `light` what they look like there; `render` puts it
//! into pictures, `sequence` is one drive, `rendered`, `endless` and `export` hand drives out. `wide` is a second, more varied world of the same parts. The world's frame has x right, y down, z along the street, in metres; the first
//! camera is at its origin, and the road at y = 1.65.

mod build;
mod camera;
mod draw;
mod endless;
pub mod export;
mod houses;
mod light;
mod props;
mod render;
mod rendered;
mod sequence;
mod shape;
mod surface;
mod texture;
mod weather;
mod wide;
mod world;

pub use camera::Pose;
pub use endless::{Endless, SHOWN};
pub use rendered::{Street, StreetConfig, WorldKind};
#[cfg(test)]
pub(crate) use {camera::winding, draw::Draw};
