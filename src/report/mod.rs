//! Colour maps, overlays, depth PNG, NumPy arrays, point clouds: what is made of depth and left behind as files.

pub mod colormap;
pub mod depth_png;
pub mod npy;
pub mod overlay;
pub mod ply;
