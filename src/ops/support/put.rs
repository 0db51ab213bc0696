//! The one way to write a gradient where it belongs, or add it to what is there.

use crate::tensor::simd::copy_run;
use crate::tensor::{Accum, Float};

/// Writes each number to its place, or adds it. To be called inside [`dispatch`](crate::tensor::simd::dispatch).
#[inline(always)]
pub(in crate::ops) fn put<'a, T: Float>(accum: Accum, terms: impl Iterator<Item = (&'a mut T, T)>) {
    match accum {
        Accum::Replace => terms.for_each(|(d, x)| *d = x),
        Accum::Add => terms.for_each(|(d, x)| *d += x),
    }
}

/// Writes a run of numbers to its place, or adds it.
#[inline(always)]
pub(in crate::ops) fn put_run<T: Float>(accum: Accum, out: &mut [T], x: &[T]) {
    match accum {
        Accum::Replace => copy_run(out, x),
        Accum::Add => put(accum, out.iter_mut().zip(x.iter().copied())),
    }
}

/// Makes a place ready for what is going to be added to it: zeroed, or with what is there.
#[inline(always)]
pub(in crate::ops) fn begin_sum<T: Float>(out: &mut [T], accum: Accum) {
    match accum {
        Accum::Replace => out.fill(T::ZERO),
        Accum::Add => {}
    }
}

/// Writes numbers that were computed in f64 to their places, or adds them.
pub(in crate::ops) fn put_rounded<T: Float>(out: &mut [T], accum: Accum, values: impl IntoIterator<Item = f64>) {
    put(accum, out.iter_mut().zip(values.into_iter().map(T::of)));
}
