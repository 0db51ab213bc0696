//! MonoViT: the networks, the losses, the training loop and the evaluation.

pub mod metrics;
