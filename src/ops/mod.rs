//! Ops: one struct in one file each, with shape rule, forward pass, gradient, and gradient-check cases side by side.
//!
//! Everything differentiable is a method of [`Var`](crate::tensor::Var), defined in the file of its op. To add an op:
//! write its file, and its line in [`registry`]. Nothing else knows it.
//!
//! | family | ops |
//! |---|---|
//! | [`elementwise`] | one number at a time: activations, arithmetic with broadcasting, choices, dropout |
//! | [`reduce`] | along dimensions: sums, extremes, running sums, variances, the softmax family |
//! | [`movement`] | elements brought elsewhere: reshaping, joining, picking, sorting |
//! | [`product`] | matrix products, linear layers, cross products |
//! | [`normalise`] | batch and layer normalisation |
//! | [`conv`] | convolutions: general, depthwise, transposed, of an enlarged image |
//! | [`attention`] | factorised attention and its relative positions |
//! | [`image`] | pooling, resizing, padding, sampling |
//! | [`depth`] | the loss of self-supervised depth: geometry, warping, photometric error, smoothness |
//!
//! The contract stands in `op` (what an op is), `apply` (the one function that makes a node of it), [`case`] (what its
//! gradient is checked on) and [`registry`].

mod apply;
pub mod case;
mod op;
pub mod registry;

pub mod attention;
pub mod conv;
pub mod depth;
pub mod elementwise;
pub mod image;
pub mod movement;
pub mod normalise;
pub mod product;
pub mod reduce;
mod support;

pub use apply::{apply, apply1};
pub use case::{Case, Input};
pub use conv::conv2d::Conv2d;
pub use conv::depthwise::DepthwiseConv2d;
pub use conv::transpose::ConvTranspose2d;
pub use op::{Checked, CustomOp, Needs, Op, Registered, ShapeError};
pub use support::epilogue::Activation;
pub use support::tile::Tile;
