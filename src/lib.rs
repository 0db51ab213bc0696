//! parallax: deep learning from scratch on the CPU, and MonoViT trained end to end on it.
//!
//! | to | look at |
//! |---|---|
//! | compute gradients | [`tensor`]: tensors, variables, the tape; [`ops`]: what can be done with them, by family |
//! | build and train a network | [`nn`]: parameters and modules; [`optim`]: AdamW, schedules |
//! | prove a gradient, of any function | [`gradcheck`] |
//! | read the paper beside its code | [`monovit`]: encoder, decoder, pose network, loss |
//! | put another depth network together | [`networks`]: encoders and decoders by name |
//! | train depth | [`train`]: the recipe, the run; [`data`], [`street`]: where frames come from |
//! | predict and measure depth | [`eval`]: predictor, metrics, attention; [`depth`], [`camera`]: its units |
//! | read and write files | [`formats`]; [`weights`]: published and other weights |
//!
//! A gradient:
//!
//! ```
//! use parallax::tensor::{Tape, Tensor};
//!
//! let tape = Tape::new();
//! let x = tape.leaf(Tensor::from_vec([3], vec![1.0f64, 2.0, 3.0]));
//! let y = (&x * &x).sum_all();
//! assert_eq!(y.backward().get(&x).unwrap().data(), [2.0, 4.0, 6.0]);
//! ```
//!
//! Training and prediction are one call each: [`train::train`],
//! [`Predictor::depth_of`](eval::predictor::Predictor::depth_of). Where to read next: `examples/digits.rs`, a network that
//! reads digits; `src/ops/README.md`, what an op consists of; ARCHITECTURE.md, why it is built this way.
//!
//! # Debug builds
//!
//! Kernels are compiled in this crate, once. Cargo compiles dependencies of a debug build without optimisation unless the
//! program's own `Cargo.toml` says otherwise:
//!
//! ```toml
//! [profile.dev.package."*"]
//! opt-level = 3
//! codegen-units = 1
//! ```
#![deny(missing_docs)]
#![deny(unsafe_code)]

pub mod camera;
pub mod data;
pub mod depth;
mod error;
pub mod eval;
pub mod formats;
pub mod gradcheck;
pub mod monovit;
pub mod networks;
pub mod nn;
pub mod ops;
pub mod optim;
pub mod random;
pub mod report;
pub mod street;
pub mod tensor;
#[cfg(test)]
mod test_support;
pub mod train;
pub mod weights;

pub use error::{Error, Result, printable};
