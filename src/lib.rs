//! parallax: deep learning from scratch on the CPU, and MonoViT trained end to end on it.
#![deny(missing_docs)]
#![deny(unsafe_code)]

pub mod data;
mod error;
pub mod gradcheck;
pub mod ops;
pub mod random;
pub mod report;
pub mod tensor;

pub use error::{Error, Result};
