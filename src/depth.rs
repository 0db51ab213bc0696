//! Depth, in its units.

/// A map of metric depth (camera z, metres), row-major, 0 where nothing is known.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthMap {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// `height * width` depths in metres; 0 means unknown.
    pub metres: Vec<f32>,
}
