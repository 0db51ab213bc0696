//! MonoViT (Zhao et al., 3DV 2022, 2208.03543): self-supervised monocular depth, as the paper tells it.

pub mod attention;
pub mod camera_height;
pub mod config;
pub mod decoder;
pub mod encoder;
pub mod evaluation;
pub mod loss;
pub mod metrics;
mod model;
pub mod pose;
pub mod run;
pub mod shake;
pub mod start;
pub mod trainer;
pub mod weights;

pub use config::{Ablation, Config, Preset};
pub use model::MonoVit;
pub use trainer::{OptimConfig, StepReport, Trainer};
