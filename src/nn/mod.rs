//! Parameters by path, the modules that use them, initialisation, and files of weights.
//!
//! [`TensorFile`] opens any file of named tensors ([`checkpoint`]: safetensors, [`pth`]: PyTorch's own, [`npz`]: NumPy's);
//! [`fit`] compares what is in it with a model's parameters.
//!
//! A module is plain data: its sizes and the [`ParamId`]s of its parameters. The numbers live in [`Params`], under the
//! names of the public checkpoints; a [`Context`] brings both together for one forward pass.

pub mod checkpoint;
mod context;
mod conv;
mod fit;
mod fold;
mod init;
mod linear;
mod norm;
pub mod npz;
mod params;
pub mod pth;
mod stored;
mod tensor_file;

pub use context::Context;
pub use conv::{Conv, ConvBn, ConvStart, DepthwiseConv, Joined, Normalised};
pub use fit::{Fit, Mismatch, Named, Report, Skipped, fit};
pub use fold::Folded;
pub use init::{Init, Start};
pub use linear::Linear;
pub use norm::{BatchNorm, LayerNorm};
pub use params::{Builder, Layout, Param, ParamId, Params};
pub use stored::{Dtype, StoredTensor};
pub use tensor_file::TensorFile;
