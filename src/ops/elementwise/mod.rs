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

pub mod activation;
pub mod binary;
pub mod dropout;
pub mod pow;
pub mod select;
pub mod unary;
