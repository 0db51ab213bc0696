//! Ops: one struct in one file each, with shape rule, forward pass, gradient, and gradient-check cases side by side.
//!
//! Everything differentiable is a method of [`Var`](crate::tensor::Var), defined in the file of its op. To add an op:
//! write its file, and its line in [`registry`]. Nothing else knows it.

mod apply;
pub mod case;
mod op;
pub mod registry;
pub mod trace;

pub mod batch_norm;
pub mod binary;
pub mod conv_relative_position;
pub mod factorised_attention;
pub mod layer_norm;
pub mod linear;
pub mod matmul;
mod per_head;
pub mod reduce;
pub mod shape_ops;
pub mod softmax;
pub mod unary;

pub use apply::{apply, apply1};
pub use case::{Case, Input};
pub use op::{Checked, CustomOp, Needs, Op, Registered, ShapeError};
