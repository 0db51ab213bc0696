//! Pictures of depth: colour maps, overlays, maps of points; plots.

pub mod colormap;
pub mod map;
pub mod overlay;
pub mod plot;
