//! The one way to write a gradient where it belongs, or add it to what is there.

use crate::tensor::{Accum, Float};

/// Writes each number to its place, or adds it. To be called inside [`dispatch`](crate::tensor::simd::dispatch).
#[inline(always)]
pub(in crate::ops) fn put<'a, T: Float>(accum: Accum, terms: impl Iterator<Item = (&'a mut T, T)>) {
    match accum {
        Accum::Replace => terms.for_each(|(d, x)| *d = x),
        Accum::Add => terms.for_each(|(d, x)| *d += x),
    }
}
