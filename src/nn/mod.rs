//! Parameters by path, the modules that use them, initialisation, and whether a file of weights fits a model.
//!
//! A module is plain data: its sizes and the [`ParamId`]s of its parameters. The numbers live in [`Params`], under the
//! names of the public checkpoints; a [`Context`] brings both together for one forward pass. [`fit`] compares what is in
//! a [file of tensors](crate::formats) with a model's parameters.

mod context;
mod conv;
mod fit;
mod fold;
mod init;
mod linear;
mod norm;
mod params;
mod resnet;

pub use context::Context;
pub use conv::{Conv, ConvBn, ConvStart, DepthwiseConv, Joined, Normalised};
pub use fit::{Fit, Mismatch, Named, Report, Skipped, fit};
pub use fold::Folded;
pub use init::{Init, Start};
pub use linear::Linear;
pub use norm::{BatchNorm, LayerNorm};
pub use params::{Builder, Layout, Param, ParamId, Params};
pub(crate) use params::{Identity, same_model};
pub use resnet::{ResNet, ResNetLayers};
