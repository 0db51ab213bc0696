//! Products: matrices, linear layers, vectors of three.
//!
//! | op family | idea |
//! |---|---|
//! | [`matmul`] | matrix products, batched |
//! | [`linear`] | x W + b, with an activation |
//! | [`cross`] | cross products |

pub mod cross;
pub mod linear;
pub mod matmul;
