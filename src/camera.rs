//! Cameras.

use serde::{Deserialize, Serialize};

/// Pinhole intrinsics in units of the image size, so that they hold at any resolution:
/// `u = fx * W * x/z + cx * W`, `v = fy * H * y/z + cy * H`, pixel centres at whole numbers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    /// Focal length over the width.
    pub fx: f64,
    /// Focal length over the height.
    pub fy: f64,
    /// Principal point over the width.
    pub cx: f64,
    /// Principal point over the height.
    pub cy: f64,
}

impl Intrinsics {
    /// The published constants for KITTI: fx 0.58 W, fy 1.92 H, the centre in the middle.
    pub const KITTI: Intrinsics = Intrinsics { fx: 0.58, fy: 1.92, cx: 0.5, cy: 0.5 };
}
