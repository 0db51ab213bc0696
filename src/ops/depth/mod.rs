//! The paper's loss: from a disparity and a motion to the photometric error.
//!
//! | op family | idea |
//! |---|---|
//! | [`disparity_to_depth`] | depth from sigmoid disparity |
//! | [`rotation`] | rotation matrices from axis and angle |
//! | [`pose`] | transforms from axis, angle and translation |
//! | [`warp`] | a source picture seen from the target, by back-projection, motion and projection |
//! | [`ssim`] | structural dissimilarity |
//! | [`photometric`] | SSIM and L1 together |
//! | [`min_reprojection`] | the least error of several sources, with auto-masking |
//! | [`smoothness`] | edge-aware smoothness of disparity |

pub mod disparity_to_depth;
pub mod min_reprojection;
pub mod photometric;
pub mod pose;
pub mod rotation;
pub mod smoothness;
pub mod ssim;
pub mod warp;
