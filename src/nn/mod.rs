//! Parameters by path, the modules that use them, initialisation, and checkpoints.
//!
//! A module is plain data: its sizes and the [`ParamId`]s of its parameters. The numbers live in [`Params`], under the
//! names of the public checkpoints; a [`Context`] brings both together for one forward pass.

pub mod checkpoint;
mod context;
mod conv;
mod fold;
mod init;
mod linear;
mod norm;
mod params;

pub use context::Context;
pub use conv::{Conv, ConvBn, ConvStart, DepthwiseConv, Normalised};
pub use fold::Folded;
pub use init::{Init, Start};
pub use linear::Linear;
pub use norm::{BatchNorm, LayerNorm};
pub use params::{Builder, Layout, Param, ParamId, Params};
