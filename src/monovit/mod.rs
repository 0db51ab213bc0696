//! MonoViT (Zhao et al., 3DV 2022, 2208.03543): self-supervised monocular depth, as the paper tells it.
//!
//! | in the paper | in the code |
//! |---|---|
//! | encoder: stem, patch embeddings, joint CNN and transformer layers | [`encoder`] |
//! | factorised attention, convolutional relative position | [`crate::ops`], called by [`encoder`] |
//! | nested decoder with channel attention, heads at four scales | [`decoder`] |
//! | pose network (ResNet-18 on two frames) | [`pose`] |
//! | view synthesis: disparity to depth, warp | [`crate::ops`], called by [`loss`] |
//! | photometric error (SSIM and L1), minimum over sources, auto-mask | [`loss`] |
//! | edge-aware smoothness; the total over four scales | [`loss`] |
//! | sizes of the networks; switches of the ablation study | [`config`] |
//!
//! [`crate::networks`] puts encoder, decoder and pose network together, and holds those that the paper compares with.

pub mod config;
pub mod decoder;
pub mod encoder;
pub mod loss;
pub mod pose;
pub mod supervision;

pub use config::{Ablation, Config, Preset};
