//! Ops: one struct in one file each, with shape rule, forward pass, gradient, and gradient-check cases side by side.
//!
//! Everything differentiable is a method of [`Var`](crate::tensor::Var), defined in the file of its op. To add an op:
//! write its file, and its line in [`registry`]. Nothing else knows it.

mod apply;
pub mod case;
mod op;
pub mod registry;
pub mod trace;

pub mod binary;
pub mod concat;
pub mod depthwise_conv2d;
pub mod linear;
pub mod matmul;
pub mod pool2d;
pub mod reduce;
pub mod reflect_pad;
pub mod resize_bilinear;
pub mod shape_ops;
pub mod slice;
pub mod unary;
pub mod upsample_nearest;

pub use apply::{apply, apply1};
pub use case::{Case, Input};
pub use op::{Checked, CustomOp, Needs, Op, Registered, ShapeError};
