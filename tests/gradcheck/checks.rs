//! What every case of every op must pass: the library's own list, which ops from elsewhere are held to as well. The suite
//! runs all of it over the registry, and again over gradients that are wrong on purpose, to see which check notices.

pub use parallax::gradcheck::{CHECKS, Subject};
