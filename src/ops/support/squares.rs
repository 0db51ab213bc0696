//! Squares of pixels, each of which saw the same pixel of a smaller image: the sum of what they have.

use super::put::{begin_sum, put};
use crate::tensor::{Accum, Float, parallel};

/// The sum of each square of `s` x `s` pixels of g, for an image of `w` squares a row with `c` channels.
pub(in crate::ops) fn sum_squares<T: Float>(out: &mut [T], accum: Accum, g: &[T], [w, c]: [usize; 2], s: usize) {
    let row = w * s * c;
    if g.is_empty() {
        return;
    }
    parallel::for_each_unit(out, w * c, g.len(), |i, out| {
        let g = &g[i * s * row..][..s * row];
        T::dispatch(
            #[inline(always)]
            || {
                if s == 2 {
                    let (top, bottom) = g.split_at(row);
                    return sum_pairs(out, accum, top, bottom, c);
                }
                begin_sum(out, accum);
                for g in g.chunks_exact(row) {
                    for (d, g) in out.chunks_exact_mut(c).zip(g.chunks_exact(s * c)) {
                        for g in g.chunks_exact(c) {
                            d.iter_mut().zip(g).for_each(|(d, &g)| *d += g);
                        }
                    }
                }
            },
        );
    });
}

/// The sum of each square of 2 x 2 pixels of two rows.
#[inline(always)]
fn sum_pairs<T: Float>(out: &mut [T], accum: Accum, top: &[T], bottom: &[T], c: usize) {
    for ((d, a), b) in out.chunks_exact_mut(c).zip(top.chunks_exact(2 * c)).zip(bottom.chunks_exact(2 * c)) {
        let ((a0, a1), (b0, b1)) = (a.split_at(c), b.split_at(c));
        let terms = d.iter_mut().zip(a0.iter().zip(a1)).zip(b0.iter().zip(b1));
        put(accum, terms.map(|((d, (&a, &b)), (&e, &f))| (d, (a + b) + (e + f))));
    }
}
