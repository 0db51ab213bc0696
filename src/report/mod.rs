//! Pictures of depth: colour maps, overlays.

pub mod colormap;
pub mod overlay;
