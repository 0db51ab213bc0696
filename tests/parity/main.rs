//! Against PyTorch reference values, in f64.

mod ops;
mod reference;
