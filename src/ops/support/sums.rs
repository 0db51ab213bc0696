//! Sums: of a row, of the rows of a matrix, of partial sums. Each has an order of its own that depends on shapes alone, so
//! that the bits are the same for any number of threads.

use super::put::put_rounded;
use crate::tensor::gemm::Rows;
use crate::tensor::{Accum, Float, GradSink, Tensor, parallel, regime};

/// Sums in blocks, and the blocks in pairs: the error grows with the logarithm of the length.
pub(in crate::ops) fn pairwise_sum<T: Float>(x: &[T]) -> T {
    let block = regime::size(256);
    if x.len() <= block {
        // Eight sums side by side, which vectorise.
        let mut sums = [T::ZERO; 8];
        let (eights, rest) = x.as_chunks::<8>();
        for eight in eights {
            for (s, &x) in sums.iter_mut().zip(eight) {
                *s += x;
            }
        }
        return sums.into_iter().sum::<T>() + rest.iter().copied().sum::<T>();
    }
    let (left, right) = x.split_at((x.len() / 2).next_multiple_of(block));
    pairwise_sum(left) + pairwise_sum(right)
}

/// The sum of the rows of a matrix, in blocks that are then summed in pairs.
pub(in crate::ops) fn sum_rows<T: Float>(out: &mut [T], x: &[T]) {
    T::dispatch(
        #[inline(always)]
        || sum_rows_here(out, x),
    );
}

#[inline(always)]
fn sum_rows_here<T: Float>(out: &mut [T], x: &[T]) {
    let block = regime::size(64);
    if let [sum] = out {
        *sum = pairwise_sum(x);
        return;
    }
    let (cols, rows) = (out.len(), x.len() / out.len());
    out.fill(T::ZERO);
    if rows <= block {
        // Four rows at a time: each addition to `out` waits for the one before.
        let mut fours = x.chunks_exact(4 * cols);
        for four in &mut fours {
            let (first, last) = four.split_at(2 * cols);
            let (a, b) = first.split_at(cols);
            let (c, d) = last.split_at(cols);
            let rows = a.iter().zip(b).zip(c.iter().zip(d));
            out.iter_mut().zip(rows).for_each(|(s, ((&a, &b), (&c, &d)))| *s += (a + b) + (c + d));
        }
        for row in fours.remainder().chunks_exact(cols) {
            out.iter_mut().zip(row).for_each(|(s, &x)| *s += x);
        }
        return;
    }
    let (left, right) = x.split_at((rows / 2).next_multiple_of(block) * cols);
    sum_rows(out, left);
    let mut other = vec![T::ZERO; cols];
    sum_rows(&mut other, right);
    out.iter_mut().zip(other).for_each(|(s, x)| *s += x);
}

/// Adds up partial sums in order.
pub(in crate::ops) fn sum_into<T: Float>(out: &mut [T], accum: Accum, parts: &[Tensor<T>]) {
    let chunk = regime::size(1 << 14);
    let work = out.len() * parts.len();
    parallel::for_each_chunk(out, chunk, work, |i, out| {
        let range = i * chunk..i * chunk + out.len();
        let mut parts = parts.iter().map(|part| &part.data()[range.clone()]);
        T::dispatch(
            #[inline(always)]
            || {
                if accum == Accum::Replace {
                    match parts.next() {
                        Some(first) => out.copy_from_slice(first),
                        None => out.fill(T::ZERO),
                    }
                }
                for part in parts {
                    out.iter_mut().zip(part).for_each(|(s, &x)| *s += x);
                }
            },
        );
    });
}

/// The sum of the rows of `g`, or added to what is there: the gradient of a bias. In blocks of rows.
pub(in crate::ops) fn bias_gradient<T: Float>(out: &mut [T], accum: Accum, g: Rows<T>) {
    let block = regime::size(256);
    assert_eq!(out.len(), g.cols, "a bias for each channel");
    if out.is_empty() {
        return;
    }
    let blocks = parallel::map(g.rows.div_ceil(block), g.rows * g.cols, |i| {
        let rows = g.rows(i * block, block.min(g.rows - i * block));
        Tensor::build([g.cols], |sum| {
            sum.fill(T::ZERO);
            for row in rows.data.chunks(rows.row_stride).take(rows.rows) {
                sum.iter_mut().zip(&row[..g.cols]).for_each(|(s, &g)| *s += g);
            }
        })
    });
    sum_into(out, accum, &blocks);
}

/// Hands over the gradient of a parameter, summed in f64.
pub(in crate::ops) fn add_sums<T: Float>(sink: &mut GradSink<T>, i: usize, sums: &[f64]) {
    sink.accumulate(i, |out, accum| put_rounded(out, accum, sums.iter().copied()));
}

/// Elements summed side by side.
const LANES: usize = 16;

/// The sum of `f` over two rows, in [`LANES`] partial sums.
#[inline(always)]
pub(in crate::ops) fn sum_of_pairs<T: Float>(a: &[T], b: &[T], f: impl Fn(T, T) -> T) -> T {
    let mut sums = [T::ZERO; LANES];
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    for (a, b) in a.iter().zip(b) {
        for (s, (&a, &b)) in sums.iter_mut().zip(a.iter().zip(b)) {
            *s += f(a, b);
        }
    }
    for (s, (&a, &b)) in sums.iter_mut().zip(a_rest.iter().zip(b_rest)) {
        *s += f(a, b);
    }
    let mut half = LANES / 2;
    while half > 0 {
        let (left, right) = sums.split_at_mut(half);
        left.iter_mut().zip(right).for_each(|(l, &mut r)| *l += r);
        half /= 2;
    }
    sums[0]
}
