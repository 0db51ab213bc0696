//! parallax: deep learning from scratch on the CPU, and MonoViT trained end to end on it.
#![deny(missing_docs)]
#![deny(unsafe_code)]

pub mod data;
mod error;
pub mod files;
pub mod gradcheck;
pub mod monovit;
pub mod nn;
pub mod ops;
pub mod optim;
pub mod random;
pub mod report;
pub mod tensor;
#[cfg(test)]
mod test_support;

pub use error::{Error, Result};
