//! parallax: deep learning from scratch on the CPU, and MonoViT trained end to end on it.
#![deny(missing_docs)]
#![deny(unsafe_code)]

pub mod data;
pub mod report;
mod error;

pub use error::{Error, Result};
