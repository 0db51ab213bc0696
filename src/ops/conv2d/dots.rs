//! Convolution to a single channel: dot products along the runs of the window.
//!
//! A product fills vector registers along the channels of its result. Where there is but one, the channels of the image
//! fill them, which lie side by side as well, and are added up at the end.

use pulp::{Simd, WithSimd};

use super::direct::for_each_band;
use super::geometry::Geometry;
use super::parts::Part;
use crate::ops::fused::Finish;
use crate::tensor::simd::dispatch_vector;
use crate::tensor::{Accum, Float, parallel};

/// Channels from which on that pays.
pub(super) const MANY: usize = 8;

/// `out = conv(x, w)` for one channel, or added to what is there; and finished.
pub(super) fn convolve<T: Float>(
    out: &mut [T],
    accum: Accum,
    g: &Geometry,
    x: &[Part<T>],
    w: &[T],
    finish: &Finish<T>,
) {
    let (width, tile) = (g.out[1], g.tile());
    let (step, run) = (g.stride[1] * g.channels, g.kernel[1] * g.channels);
    let work = 2 * g.rows() * width * g.patch();
    parallel::for_each_chunk(out, tile * width, work, |i, out| {
        let first = i * tile;
        let mut rest = &mut *out;
        for_each_band(g, x, first..first + rest.len() / width, |band, _, rows| {
            for r in 0..rows.len() {
                let (out, others) = std::mem::take(&mut rest).split_at_mut(width);
                rest = others;
                let lines: Vec<&[T]> = (0..g.kernel[0]).map(|ky| band.line(g, r, ky)).collect();
                dispatch_vector(Dots { out, accum, lines: &lines, step, run, w });
            }
        });
        finish.run(out);
    });
}

/// A row of outputs: of each, the sum over some lines of the products of a run and its weights.
struct Dots<'a, T> {
    out: &'a mut [T],
    accum: Accum,
    lines: &'a [&'a [T]],
    /// From an output's run to the next one's.
    step: usize,
    run: usize,
    /// `[lines, run]`.
    w: &'a [T],
}

impl<T: Float> WithSimd for Dots<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let lanes = T::lanes::<S>();
        for (ox, out) in self.out.iter_mut().enumerate() {
            let mut sums = T::splat(simd, T::ZERO);
            for (line, w) in self.lines.iter().zip(self.w.chunks_exact(self.run)) {
                let x = &line[ox * self.step..][..self.run];
                let (mut x, mut w) = (x.chunks_exact(lanes), w.chunks_exact(lanes));
                for (x, w) in x.by_ref().zip(w.by_ref()) {
                    sums = T::fma(simd, T::load(simd, x), T::load(simd, w), sums);
                }
                if !x.remainder().is_empty() {
                    let (x, w) = (T::load_part(simd, x.remainder()), T::load_part(simd, w.remainder()));
                    sums = T::fma(simd, x, w, sums);
                }
            }
            let sum = T::vector_sum(simd, sums);
            *out = if self.accum == Accum::Add { *out + sum } else { sum };
        }
    }
}
