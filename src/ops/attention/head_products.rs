//! Products head by head, on tokens whose channels lie head-major: the two shapes of product that attention consists
//! of.
//!
//! A head is a handful of channels, too few for a general matrix product: it packs and pads for longer than it
//! multiplies. Heads of up to [`LANES`] channels are instead computed in windows of [`LANES`] neighbouring channels,
//! which reach into the next head; what is computed for it is not kept.

use crate::tensor::gemm::{Rows, RowsMut, gemm};
use crate::tensor::pool::Buffer;
use crate::tensor::{Accum, Float};

/// The channels of a window.
pub(in crate::ops) const LANES: usize = 16;

/// Heads, and channels a head.
#[derive(Clone, Copy, Debug)]
pub(in crate::ops) struct Heads {
    pub heads: usize,
    pub c: usize,
}

impl Heads {
    pub fn channels(self) -> usize {
        self.heads * self.c
    }

    /// Whether windows are used.
    pub fn narrow(self) -> bool {
        self.c <= LANES && self.channels() >= LANES
    }

    /// A c x c matrix for every head, from the same stored row by row, times a factor: transposed if so wished, and
    /// padded to windows where those are used.
    pub fn matrices<T: Float>(self, dense: &[T], transposed: bool, factor: T) -> Buffer<T> {
        let c = self.c;
        let columns = if self.narrow() { LANES } else { c };
        let mut out = Buffer::stale(self.channels() * columns);
        for (out, dense) in out.chunks_exact_mut(c * columns).zip(dense.chunks_exact(c * c)) {
            for (i, out) in out.chunks_exact_mut(columns).enumerate() {
                out.fill(T::ZERO);
                for (j, out) in out.iter_mut().take(c).enumerate() {
                    *out = factor * if transposed { dense[j * c + i] } else { dense[i * c + j] };
                }
            }
        }
        out
    }

    /// `out [tokens, heads * c] = x matrix`, head by head.
    pub fn product<T: Float>(self, out: &mut [T], x: Rows<T>, matrices: &[T]) {
        let (c, channels) = (self.c, self.channels());
        if !self.narrow() {
            for h in 0..self.heads {
                let matrix = Rows::dense(&matrices[h * c * c..][..c * c], c, c);
                let out = RowsMut::columns(out, x.rows, channels, h * c, c);
                gemm(out, Accum::Replace, columns(x, h * c, c), matrix, T::ONE);
            }
            return;
        }
        let (matrices, _) = matrices.as_chunks::<LANES>();
        T::dispatch(
            #[inline(always)]
            || {
                let mut at = 0;
                for x in x.data.chunks(x.row_stride).take(x.rows) {
                    for (x, matrix) in x[..channels].chunks_exact(c).zip(matrices.chunks_exact(c)) {
                        let mut sums = [T::ZERO; LANES];
                        for (&x, row) in x.iter().zip(matrix) {
                            sums.iter_mut().zip(row).for_each(|(s, &m)| *s = x.mul_add(m, *s));
                        }
                        // The excess is overwritten by the next head; at the very end there is no room for it.
                        match out[at..].first_chunk_mut::<LANES>() {
                            Some(window) => *window = sums,
                            None => out[at..].iter_mut().zip(sums).for_each(|(o, s)| *o = s),
                        }
                        at += c;
                    }
                }
            },
        );
    }

    /// `out [heads * c, c] = a^T b`, head by head: the sum over the tokens of the outer products.
    pub fn outer<T: Float>(self, out: &mut [T], a: Rows<T>, b: Rows<T>) {
        let (c, channels) = (self.c, self.channels());
        for (h, out) in out.chunks_exact_mut(c * c).enumerate() {
            if !self.narrow() {
                gemm(RowsMut::dense(out, c, c), Accum::Replace, columns(a, h * c, c).t(), columns(b, h * c, c), T::ONE);
                continue;
            }
            // The last windows begin early, so as not to end beyond the row.
            let window = (h * c).min(channels - LANES);
            let skip = h * c - window;
            let mut i = 0;
            while i < c {
                let (from, out) = (h * c + i, &mut out[i * c..]);
                i += match c - i {
                    4.. => group::<T, 4>(out, a, from, b, window, skip, c),
                    3 => group::<T, 3>(out, a, from, b, window, skip, c),
                    2 => group::<T, 2>(out, a, from, b, window, skip, c),
                    _ => group::<T, 1>(out, a, from, b, window, skip, c),
                };
            }
        }
    }
}

/// Some columns of a matrix.
fn columns<T>(m: Rows<T>, first: usize, cols: usize) -> Rows<T> {
    Rows { data: if m.rows == 0 { &[] } else { &m.data[first..] }, rows: m.rows, cols, row_stride: m.row_stride }
}

/// G rows of the sum of outer products; gives G. Up to four stay in registers.
fn group<T: Float, const G: usize>(
    out: &mut [T],
    a: Rows<T>,
    from: usize,
    b: Rows<T>,
    window: usize,
    skip: usize,
    c: usize,
) -> usize {
    let mut result = [[T::ZERO; LANES]; G];
    T::dispatch(
        #[inline(always)]
        || {
            // Sums that live outside the closure would be stored to memory at every step.
            let mut sums = result;
            let rows = a.data.chunks(a.row_stride).zip(b.data.chunks(b.row_stride)).take(a.rows);
            for (a, b) in rows {
                let (Some(a), Some(b)) = (a[from..].first_chunk::<G>(), b[window..].first_chunk::<LANES>()) else {
                    unreachable!("a group of channels and a window lie within the row");
                };
                for (sums, &a) in sums.iter_mut().zip(a) {
                    sums.iter_mut().zip(b).for_each(|(s, &b)| *s = a.mul_add(b, *s));
                }
            }
            result = sums;
        },
    );
    for (out, sums) in out.chunks_exact_mut(c).zip(&result) {
        out.copy_from_slice(&sums[skip..skip + c]);
    }
    G
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_agree_with_the_sums_they_stand_for() {
        for (heads, c) in [(2, 8), (8, 6), (3, 7), (1, 16), (16, 1), (3, 17), (2, 3)] {
            let (h, rows) = (Heads { heads, c }, 5);
            let (n, stride) = (h.channels(), h.channels() + 3);
            let number = |i: usize| ((i * 37) % 19) as f64 - 9.0;
            let a: Vec<f64> = (0..rows * stride).map(number).collect();
            let b: Vec<f64> = (0..rows * stride).map(|i| number(i + 5)).collect();
            let view = |m| Rows::columns(m, rows, stride, 2, n);
            let mut outer = vec![f64::NAN; n * c];
            h.outer(&mut outer, view(&a), view(&b));
            for (k, &x) in outer.iter().enumerate() {
                let (i, j) = (k / c, k / (c * c) * c + k % c);
                let expected: f64 = (0..rows).map(|r| a[r * stride + 2 + i] * b[r * stride + 2 + j]).sum();
                assert_eq!(x, expected, "{heads} heads of {c}, element {k}");
            }
            for transposed in [false, true] {
                let mut product = vec![f64::NAN; rows * n];
                h.product(&mut product, view(&a), &h.matrices(&outer, transposed, 2.0));
                for (k, &x) in product.iter().enumerate() {
                    let (r, j, head) = (k / n, k % c, k % n / c);
                    let m = |i: usize, j: usize| outer[(head * c + i) * c + j];
                    let expected: f64 = (0..c)
                        .map(|i| a[r * stride + 2 + head * c + i] * 2.0 * if transposed { m(j, i) } else { m(i, j) })
                        .sum();
                    assert_eq!(x, expected, "{heads} heads of {c}, element {k}");
                }
            }
        }
    }
}
