//! Tensors and the tape: what an op needs, and nothing that knows a particular op.
//!
//! | file | idea |
//! |---|---|
//! | [`shape`] | extents, row-major strides, broadcasting |
//! | `compiled` | kernels compiled once, for both element types |
//! | [`float`] | `f32` to train in, `f64` to check in |
//! | [`pool`] | buffers that are reused, not allocated |
//! | `data` | [`Tensor`]: a shape over shared memory |
//! | [`tape`] | the record of a computation, and its reversal |
//! | `recompute` | parts that run once more in the backward pass, and keep nothing |
//! | [`var`] | [`Var`]: a tensor that a tape may track |
//! | [`gradients`] | where gradients are accumulated and read |
//! | [`gemm`] | matrix products (faer) |
//! | `register_tile` | products whose operands stay where they lie: convolutions, linear layers |
//! | `bf16` | the same of numbers rounded to 8 bits, for inference |
//! | [`parallel`] | threads, with the same bits for any number of them |
//! | [`simd`] | run-time choice of instruction set |
//! | [`profile`] | what ran, and how long |

mod bf16;
mod compiled;
mod data;
pub mod float;
pub mod gemm;
pub mod gemm_small;
pub mod gradients;
pub mod parallel;
pub mod pool;
pub mod profile;
mod recompute;
pub mod regime;
pub(crate) mod register_tile;
pub mod shape;
pub mod simd;
pub mod tape;
pub mod var;

pub use bf16::Precision;
pub(crate) use bf16::rounded as bf16_bits;
pub use compiled::Signature;
pub use data::Tensor;
pub use float::Float;
pub use gemm::Accum;
pub use gradients::{GradSink, Gradients, Upstream};
pub use recompute::recompute;
pub use shape::Shape;
pub use tape::Tape;
pub use var::Var;
