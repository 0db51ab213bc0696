//! Colour maps, overlays, plots, and what a run leaves behind.

pub mod colormap;
pub mod depth_png;
pub mod npy;
pub mod overlay;
