//! One number at a time: activations, arithmetic with broadcasting, choices, dropout.
//!
//! | op family | idea |
//! |---|---|
//! | [`unary`] | functions of one number: each is a line for its value and a line for its derivative |
//! | [`activation`] | more activations: softplus, SiLU, leaky ReLU, ... |
//! | [`binary`] | arithmetic of two tensors, with broadcasting |
//! | [`pow`] | powers |
//! | [`select`] | one of two values, as a condition says |
//! | [`dropout`] | dropout and DropPath |
//!
//! # What f32 gets
//!
//! Errors against the exact function over all of f32 (every exponent, both signs, dense around zeros and bends), in units
//! in the last place of the result; infinities give the limits, and NaN stays NaN. A derivative that is computed from the
//! rounded result is exact to an absolute error where it nears its limit. `tests/precision.rs` holds every row.
//!
//! | function | value | derivative | or, absolute |
//! |---|---|---|---|
//! | `relu`, `relu6`, `abs` | exact | exact | |
//! | `leaky_relu` | 0.5 | exact | |
//! | `sqrt` | 0.5 | 1.5 | |
//! | `reciprocal` | 0.5 | 2.5 | |
//! | `square` | 0.5 | exact | |
//! | `log` | 1 | 1 | |
//! | `exp` | 1 | 1 | |
//! | `elu` | 1.5 | 1 | 9e-8 |
//! | `softplus`, `log_sigmoid` | 2 | 2.5 | |
//! | `tanh` | 2 | 2 | 2e-7 |
//! | `sigmoid` | 2.5 | 2.5 | 9e-8 |
//! | `hardswish` | 2.5 | 1 | 2e-7 |
//! | `silu` | 3 | 3 | 4e-8 |
//! | `hardsigmoid` | 3 | 0.5 | |
//! | `gelu` | 5 | 5 | 2e-7 |
//!
//! Results below 1e-36 may lose some of the last places of the subnormals.

pub mod activation;
pub mod binary;
pub mod dropout;
pub mod pow;
pub mod select;
pub mod unary;
