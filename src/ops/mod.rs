//! Ops: one struct in one file each, with shape rule, forward pass, gradient, and gradient-check cases side by side.
//!
//! Everything differentiable is a method of [`Var`](crate::tensor::Var), defined in the file of its op. To add an op:
//! write its file, and its line in [`registry`]. Nothing else knows it.

mod apply;
pub mod case;
mod op;
pub mod registry;

pub mod activation;
pub mod batch_norm;
pub mod binary;
mod blocks;
pub mod concat;
pub mod conv2d;
pub mod conv_relative_position;
pub mod conv_transpose2d;
pub mod cross;
pub mod cross_entropy;
pub mod cumulative;
pub mod depthwise_conv2d;
pub mod disparity_to_depth;
pub mod dropout;
pub mod factorised_attention;
pub mod flip;
mod fused;
pub mod gather;
pub mod grid_sample;
pub mod index_select;
mod indices;
pub mod layer_norm;
pub mod linear;
pub mod log_softmax;
pub mod log_sum_exp;
pub mod matmul;
pub mod min_reprojection;
pub mod norm;
mod per_head;
pub mod photometric;
pub mod pool2d;
pub mod pose;
pub mod pow;
pub mod prod;
pub mod reduce;
pub mod reflect_pad;
pub mod repeat;
pub mod resize_bilinear;
pub mod rotation;
pub mod scatter_add;
pub mod select;
pub mod shape_ops;
pub mod slice;
pub mod smoothness;
pub mod softmax;
pub mod sort;
pub mod ssim;
pub mod top_k;
pub mod unary;
pub mod upsample_nearest;
pub mod upsampled_conv2d;
pub mod variance;
pub mod warp;

pub use crate::tensor::trace;
pub use apply::{apply, apply1};
pub use case::{Case, Input};
pub use conv_transpose2d::ConvTranspose2d;
pub use conv2d::Conv2d;
pub use depthwise_conv2d::DepthwiseConv2d;
pub use fused::Activation;
pub use op::{Checked, CustomOp, Needs, Op, Registered, ShapeError};
