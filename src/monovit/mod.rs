//! MonoViT (Zhao et al., 3DV 2022, 2208.03543): self-supervised monocular depth, as the paper tells it.

pub mod config;
pub mod decoder;
pub mod encoder;
pub mod loss;
mod model;
pub mod pose;
pub mod setup;

pub use config::{Ablation, Config, Preset};
pub use model::MonoVit;
pub use setup::Setup;
