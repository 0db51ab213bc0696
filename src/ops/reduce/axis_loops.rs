//! What ops along a run of dimensions share: the tensor cut in blocks, and the loops over them.
//!
//! A block is what lies under one index of the dimensions before the run: a matrix with as many rows as the run is long,
//! and a column for each index of the dimensions after it. A reduction leaves one number for each column of each block.
//! Along the last dimension a block has a single column, which is contiguous.

use crate::ops::support::axes::cut;
use crate::ops::support::put::put;
use crate::ops::support::sums::sum_rows;
use crate::tensor::pool::Buffer;
use crate::tensor::{Accum, Float, Shape, parallel, regime};

/// A shape cut in three by a run of dimensions.
#[derive(Clone, Copy, Debug)]
pub(in crate::ops) struct Blocks {
    /// How many blocks.
    pub outer: usize,
    /// Rows of a block.
    pub run: usize,
    /// Columns of a block.
    pub inner: usize,
}

/// Elements handed to a thread at a time, about.
const CHUNK: usize = 1 << 13;

impl Blocks {
    /// Along the dimensions `first..first + count`.
    pub fn of(shape: &Shape, first: usize, count: usize) -> Self {
        let [outer, run, inner] = cut(shape, first, count);
        Blocks { outer, run, inner }
    }

    /// Which of the two loops over a block is taken: `last_axis` or `inner_axis`.
    pub fn algo(&self) -> &'static str {
        if self.inner == 1 { "last_axis" } else { "inner_axis" }
    }

    /// Elements of a block.
    pub fn len(&self) -> usize {
        self.run * self.inner
    }

    /// One block of `x`.
    pub fn block<'a, T>(&self, o: usize, x: &'a [T]) -> &'a [T] {
        &x[o * self.len()..][..self.len()]
    }

    /// The rows of one block of `x`. There has to be a column.
    pub fn rows<'a, T>(&self, o: usize, x: &'a [T]) -> std::slice::ChunksExact<'a, T> {
        self.block(o, x).chunks_exact(self.inner)
    }

    /// Columns of all blocks.
    pub fn columns(&self) -> usize {
        self.outer * self.inner
    }

    /// Calls `f(block, piece, scratch)` for each piece of `out`, one for each block, on all threads. `scratch` is so many
    /// stale elements.
    fn for_each_piece<T: Float>(
        &self,
        out: &mut [T],
        piece: usize,
        scratch: usize,
        f: impl Fn(usize, &mut [T], &mut [T]) + Sync + Send,
    ) {
        if piece == 0 {
            return;
        }
        let group = regime::size((CHUNK / self.len().max(1)).max(1));
        let work = 8 * self.outer * self.len();
        parallel::for_each_chunk(out, group * piece, work, |i, out| {
            let mut scratch = Buffer::stale(scratch);
            T::dispatch(
                #[inline(always)]
                || {
                    for (k, out) in out.chunks_exact_mut(piece).enumerate() {
                        f(i * group + k, out, &mut scratch);
                    }
                },
            );
        });
    }

    /// Calls `f(block, out, scratch)` for each block of `out`; `scratch` is so many stale elements.
    pub fn for_each<T: Float>(
        &self,
        out: &mut [T],
        scratch: usize,
        f: impl Fn(usize, &mut [T], &mut [T]) + Sync + Send,
    ) {
        self.for_each_piece(out, self.len(), scratch, f);
    }

    /// `out = f(x, c)` (or added to it) for every element and the number of its column.
    pub fn map<T: Float, C: Copy + Sync + Send>(
        &self,
        out: &mut [T],
        accum: Accum,
        x: &[T],
        columns: &[C],
        f: impl Fn(T, C) -> T + Sync + Send,
    ) {
        self.for_each(
            out,
            0,
            #[inline(always)]
            |o, out, _| map(out, accum, self.block(o, x), &columns[o * self.inner..][..self.inner], &f),
        );
    }

    /// The sum of `f(x, c)` over every column, in pairs.
    pub fn sum<T: Float, C: Copy + Sync + Send>(
        &self,
        x: &[T],
        columns: &[C],
        f: impl Fn(T, C) -> T + Sync + Send,
    ) -> Buffer<T> {
        let mut sums = Buffer::stale(self.columns());
        self.for_each_piece(
            &mut sums,
            self.inner,
            self.len(),
            #[inline(always)]
            |o, sums, terms| {
                let x = self.block(o, x);
                map(terms, Accum::Replace, x, &columns[o * self.inner..][..self.inner], &f);
                sum_rows(sums, terms);
            },
        );
        sums
    }

    /// `f(.. f(f(start, x1, c), x2, c) .., xn, c)` of every column.
    pub fn fold<T: Float, C: Copy + Sync + Send>(
        &self,
        x: &[T],
        columns: &[C],
        start: T,
        f: impl Fn(T, T, C) -> T + Sync + Send,
    ) -> Buffer<T> {
        let mut folded = Buffer::stale(self.columns());
        self.for_each_piece(
            &mut folded,
            self.inner,
            0,
            #[inline(always)]
            |o, folded, _| {
                let (x, columns) = (self.block(o, x), &columns[o * self.inner..][..self.inner]);
                folded.fill(start);
                if let ([y], [c]) = (&mut *folded, columns) {
                    *y = x.iter().fold(*y, |y, &x| f(y, x, *c));
                    return;
                }
                for x in x.chunks_exact(self.inner) {
                    folded.iter_mut().zip(x.iter().zip(columns)).for_each(|(y, (&x, &c))| *y = f(*y, x, c));
                }
            },
        );
        folded
    }
}

/// One block of [`Blocks::map`].
#[inline(always)]
fn map<T: Float, C: Copy>(out: &mut [T], accum: Accum, x: &[T], columns: &[C], f: &impl Fn(T, C) -> T) {
    if let [c] = *columns {
        return put(accum, out.iter_mut().zip(x.iter().map(|&x| f(x, c))));
    }
    for (out, x) in out.chunks_exact_mut(columns.len()).zip(x.chunks_exact(columns.len())) {
        put(accum, out.iter_mut().zip(x.iter().zip(columns).map(|(&x, &c)| f(x, c))));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Many small blocks, a few large ones and a single one; with the edges of what a thread gets at a time.
    #[test]
    fn every_block_is_visited_once_whatever_its_size() {
        let shapes =
            [[CHUNK + 1, 1, 1], [CHUNK / 3 + 1, 3, 1], [CHUNK / 6, 2, 3], [3, CHUNK - 1, 1], [2, 70, 130], [1, 5, 7]];
        for [outer, run, inner] in shapes {
            let blocks = Blocks::of(&Shape::new(&[outer, run, inner]), 1, 1);
            let x: Vec<f64> = (0..outer * run * inner).map(|i| (i % 17) as f64).collect();
            let c: Vec<f64> = (0..outer * inner).map(|i| (i % 5) as f64).collect();
            let of = |i: usize| c[i / (run * inner) * inner + i % inner];
            let (mut mapped, mut sums) = (vec![0.0; x.len()], vec![0.0; c.len()]);
            for (i, x) in x.iter().enumerate() {
                mapped[i] = x * of(i) + 1.0;
                sums[i / (run * inner) * inner + i % inner] += x * of(i);
            }
            for threads in [1, 2] {
                parallel::with_threads(threads, || {
                    let mut out = vec![1.0; x.len()];
                    blocks.map(&mut out, Accum::Add, &x, &c, |x, c| x * c);
                    assert_eq!(out, mapped, "{blocks:?}");
                    assert_eq!(*blocks.sum(&x, &c, |x, c| x * c), *sums, "{blocks:?}");
                    assert_eq!(*blocks.fold(&x, &c, 0.0, |sum, x, c| sum + x * c), *sums, "{blocks:?}");
                });
            }
        }
    }

    #[test]
    fn columns_of_nothing_keep_the_start() {
        let blocks = Blocks::of(&Shape::new(&[2, 0, 3]), 1, 1);
        assert_eq!(*blocks.sum(&[], &[0.0f32; 6], |x: f32, _| x), [0.0; 6]);
        assert_eq!(*blocks.fold(&[], &[(); 6], 1.0f32, |y, x, _| y * x), [1.0; 6]);
        assert!(Blocks::of(&Shape::new(&[2, 3, 0]), 1, 1).fold(&[], &[(); 0], 1.0f32, |y, x, _| y * x).is_empty());
    }
}
