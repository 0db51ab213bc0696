//! parallax: deep learning from scratch on the CPU, and MonoViT trained end to end on it.
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

pub use error::{Error, Result};
