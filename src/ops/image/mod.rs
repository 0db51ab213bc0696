//! Pictures: pooling, resizing, padding, sampling.
//!
//! | op family | idea |
//! |---|---|
//! | [`pool2d`] | maxima and means of windows |
//! | [`resize_bilinear`] | bilinear resizing |
//! | [`upsample_nearest`] | enlarging by repetition |
//! | [`reflect_pad`] | mirrored borders |
//! | [`grid_sample`] | bilinear sampling at given places |

pub mod grid_sample;
pub mod pool2d;
pub mod reflect_pad;
pub mod resize_bilinear;
pub mod upsample_nearest;
