//! How the sum over pixels that makes the gradient of a weight is cut for threads: the weight in blocks, each of which
//! belongs to one chunk of work, and the pixels in partial sums only where they are many. How depends on shapes alone.
//!
//! A partial sum is zeroed, added to and added up: three more passes over as much memory as the weight has. For a
//! large weight and few pixels that is most of the work; a block of the weight needs none of it.

use std::ops::Range;

use super::put::{begin_sum, put, put_run};
use crate::tensor::pool::Buffer;
use crate::tensor::register_tile::Gram;
use crate::tensor::{Accum, Float, parallel, regime};

/// A block of a weight `[k, n]`, and the rows of pixels that are summed for it.
pub(in crate::ops) struct Block {
    pub(in crate::ops) k: Range<usize>,
    pub(in crate::ops) n: Range<usize>,
    pub(in crate::ops) rows: Range<usize>,
}

/// How the gradient of a weight is cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::ops) struct Cuts {
    k: usize,
    n: usize,
    rows: usize,
    /// Rows of a block, of k.
    k_step: usize,
    /// Columns of a block, of n.
    n_step: usize,
    /// Partial sums, and the rows of pixels of each.
    parts: usize,
    row_step: usize,
}

/// The numbers of a weight small enough for partial sums that never leave the cache.
const SMALL: usize = 1 << 16;
/// Pixels of a partial sum of a small weight; of a large one.
const PIXELS: [usize; 2] = [1 << 10, 1 << 13];
/// The most partial sums of a weight.
const MOST: usize = 128;
/// Products of a chunk: enough for some tens of microseconds.
const PRODUCTS: usize = 1 << 20;
/// The least numbers of a block: what is read for it is used as often as the sides of a block are long.
const AREA: usize = 64 * 64;
/// Chunks for which blocks are made smaller, down to this area and to so many products of a chunk.
const CHUNKS: usize = 96;
const LEAST_AREA: usize = 16 * 64;
const LEAST_PRODUCTS: usize = 1 << 17;
/// The most columns of a block.
const COLUMNS: usize = 128;

impl Cuts {
    /// Those of a weight `[k, n]`, summed over `rows` rows of `width` pixels.
    pub(in crate::ops) fn new([k, n]: [usize; 2], rows: usize, width: usize) -> Self {
        let small = k * n <= regime::size(SMALL);
        let pixels = regime::size(PIXELS[usize::from(!small)]);
        let parts = (rows * width).div_ceil(pixels.max(1)).clamp(1, regime::size(MOST)).min(rows.max(1));
        let row_step = rows.div_ceil(parts).max(1);
        let parts = rows.div_ceil(row_step).max(1);
        let pixels = (row_step * width).max(1);
        // Smaller blocks where there would be few, as long as each is worth handing over.
        let shared = (k * n * parts / CHUNKS).max(LEAST_AREA).max(LEAST_PRODUCTS / pixels);
        let area =
            if small && parts >= regime::size(MOST) / 2 { k * n } else { AREA.max(PRODUCTS / pixels).min(shared) };
        // Columns evenly, in whole panels of registers; what remains of the area are rows.
        let panels = n.div_ceil(n.div_ceil(COLUMNS).max(1)).next_multiple_of(32);
        let n_step = regime::size(if n <= COLUMNS { n.max(1) } else { panels });
        let k_step = regime::size((area / n_step).clamp(8, k.max(8)) / 8 * 8);
        Cuts { k, n, rows, k_step, n_step, parts, row_step }
    }

    /// The rows of a part.
    fn rows_of(&self, part: usize) -> Range<usize> {
        (part * self.row_step).min(self.rows)..((part + 1) * self.row_step).min(self.rows)
    }

    /// `out`, or what is added to it: the sum of what `add` adds to a block, a dense matrix, of all its pixels.
    pub(in crate::ops) fn sum<T: Float>(
        &self,
        out: &mut [T],
        accum: Accum,
        add: impl Fn(&Block, &mut [T]) + Sync + Send,
    ) {
        let (k, n) = (self.k, self.n);
        if k * n == 0 {
            return;
        }
        // Each part has a place of its own; of one part, that is the result's.
        let mut sums = (self.parts > 1).then(|| Buffer::<T>::stale(self.parts * k * n));
        let (target, in_place) = match &mut sums {
            Some(sums) => (&mut sums[..], Accum::Replace),
            None => (&mut *out, accum),
        };
        let columns = n.div_ceil(self.n_step);
        let mut pieces = Vec::new();
        for (part, target) in target.chunks_mut(k * n).enumerate() {
            for (i, rows) in target.chunks_mut(self.k_step * n).enumerate() {
                let height = rows.len() / n;
                let mut blocks: Vec<Vec<&mut [T]>> = (0..columns).map(|_| Vec::with_capacity(height)).collect();
                if columns == 1 {
                    blocks[0].push(rows);
                } else {
                    for row in rows.chunks_mut(n) {
                        blocks.iter_mut().zip(row.chunks_mut(self.n_step)).for_each(|(block, run)| block.push(run));
                    }
                }
                for (j, runs) in blocks.into_iter().enumerate() {
                    let k = i * self.k_step..i * self.k_step + height;
                    let n = j * self.n_step..n.min((j + 1) * self.n_step);
                    pieces.push((Block { k, n, rows: self.rows_of(part) }, runs));
                }
            }
        }
        let work = 2 * k * n * self.rows;
        parallel::for_each_piece(pieces, work, |(block, mut runs)| {
            if let [whole] = &mut runs[..] {
                begin_sum(whole, in_place);
                return add(&block, whole);
            }
            let width = block.n.len();
            let mut sum = Buffer::filled(block.k.len() * width, T::ZERO);
            add(&block, &mut sum);
            for (run, sum) in runs.into_iter().zip(sum.chunks_exact(width)) {
                put_run(in_place, run, sum);
            }
        });
        if let Some(sums) = sums {
            sum_parts(out, accum, &sums);
        }
    }
}

/// Adds up partial sums that lie one after the other, in order.
fn sum_parts<T: Float>(out: &mut [T], accum: Accum, parts: &[T]) {
    let (chunk, length) = (regime::size(1 << 12), out.len());
    parallel::for_each_chunk(out, chunk, parts.len(), |i, out| {
        T::dispatch(
            #[inline(always)]
            || {
                begin_sum(out, accum);
                for part in parts.chunks_exact(length) {
                    put(Accum::Add, out.iter_mut().zip(part[i * chunk..].iter().copied()));
                }
            },
        );
    });
}

/// Where the rows of pixels lie whose products are summed: `k` of the weight is `k / run` times a row of A and
/// `k % run` a number in it.
pub(in crate::ops) struct Pixels<A, B> {
    /// Numbers of a row of the weight that follow each other in A.
    pub(in crate::ops) run: usize,
    /// Pixels of a row, and the numbers from one to the next in A and in B.
    pub(in crate::ops) width: usize,
    /// Whether the last pixel of a row is followed by the first of the next one, in A and in B.
    pub(in crate::ops) gapless: bool,
    pub(in crate::ops) a_step: usize,
    pub(in crate::ops) b_step: usize,
    /// `a(k / run, row)`, and `b(k / run, row)`.
    pub(in crate::ops) a: A,
    pub(in crate::ops) b: B,
}

/// Pixels whose sums stay in registers: what they read stays in the cache, and sums of sums round less.
const TOGETHER: usize = 512;

impl<'a, T: Float, A: Fn(usize, usize) -> &'a [T], B: Fn(usize, usize) -> &'a [T]> Pixels<A, B> {
    /// Adds the products of a block's pixels to a dense matrix.
    pub(in crate::ops) fn add(&self, block: &Block, sum: &mut [T]) {
        let (height, width) = (block.k.len(), block.n.len());
        if self.width == 0 || height * width == 0 {
            return;
        }
        // Registers are filled along the rows of a sum: of few columns, the transpose is cheaper.
        let run = self.run.min(height);
        if width * run.div_ceil(16) < run * width.div_ceil(16) {
            let mut turned = Buffer::filled(sum.len(), T::ZERO);
            self.add_grams::<true>(block, &mut turned);
            for (row, i) in sum.chunks_exact_mut(width).zip(0..) {
                put(Accum::Add, row.iter_mut().zip(turned[i..].iter().step_by(height).copied()));
            }
        } else {
            self.add_grams::<false>(block, sum);
        }
    }

    fn add_grams<const TURNED: bool>(&self, block: &Block, sum: &mut [T]) {
        let (height, width) = (block.k.len(), block.n.len());
        let together = (regime::size(TOGETHER) / self.width).max(1);
        for rows in regime::blocks(block.rows.clone(), together) {
            let mut at = block.k.start;
            while at < block.k.end {
                let (of, from) = (at / self.run, at % self.run);
                let count = (self.run - from).min(block.k.end - at);
                let (firsts, pixels) = match self.gapless {
                    true => (rows.start..rows.start + 1, rows.len() * self.width),
                    false => (rows.clone(), self.width),
                };
                let terms = firsts.map(|row| {
                    let (a, b) = (&(self.a)(of, row)[from..], &(self.b)(of, row)[block.n.start..]);
                    if TURNED { (b, a) } else { (a, b) }
                });
                let terms: Vec<_> = terms.collect();
                let first = at - block.k.start;
                let gram = if TURNED {
                    let (a_step, b_step) = (self.b_step, self.a_step);
                    let (out, out_step) = (&mut sum[first..], height);
                    Gram { out, out_step, rows: width, cols: count, terms: &terms, count: pixels, a_step, b_step }
                } else {
                    let (a_step, b_step) = (self.a_step, self.b_step);
                    let (out, out_step) = (&mut sum[first * width..], width);
                    Gram { out, out_step, rows: count, cols: width, terms: &terms, count: pixels, a_step, b_step }
                };
                gram.run();
                at += count;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sixty_four_threads_have_something_to_do_wherever_there_is_much_of_it() {
        // Windows and channels of the small network at 96x320 and a batch of 4, with the pixels of each.
        for ([k, n], rows, width) in [
            ([9 * 64, 64], 4 * 24, 80),
            ([9 * 216, 216], 4 * 12, 40),
            ([9 * 288, 288], 4 * 6, 20),
            ([216, 864], 480, 1),
            ([288, 1152], 120, 1),
        ] {
            let cuts = Cuts::new([k, n], rows, width);
            let chunks = cuts.parts * k.div_ceil(cuts.k_step) * n.div_ceil(cuts.n_step);
            assert!(chunks >= 40, "{k}x{n} over {rows} rows of {width}: {chunks} chunks, {cuts:?}");
        }
    }

    #[test]
    fn every_product_is_added_once_whatever_the_blocks() {
        let numbers = |n: usize| (0..n).map(|i| ((i * 7919) % 101) as f64 - 50.0).collect::<Vec<f64>>();
        for (k, n, rows, width) in [(18, 5, 7, 3), (3, 40, 4, 6), (6, 1, 1, 2), (4, 3, 0, 2)] {
            let (run, groups) = (k / 3, 3);
            let (a, b) = (numbers(groups * rows * width * run), numbers(rows * width * n));
            let expected = |i: usize| -> f64 {
                let (k, n_at) = (i / n, i % n);
                let term = |p: usize| a[(k / run * rows * width + p) * run + k % run] * b[p * n + n_at];
                (0..rows * width).map(term).sum()
            };
            for largest in [1, 2, 3, 8, usize::MAX] {
                regime::shrink(largest, || {
                    let cuts = Cuts::new([k, n], rows, width);
                    let pixels = Pixels {
                        run,
                        width,
                        gapless: false,
                        a_step: run,
                        b_step: n,
                        a: |of: usize, row: usize| &a[(of * rows + row) * width * run..],
                        b: |_: usize, row: usize| &b[row * width * n..],
                    };
                    for (accum, start) in [(Accum::Replace, f64::NAN), (Accum::Add, 2.0)] {
                        let mut out = vec![start; k * n];
                        cuts.sum(&mut out, accum, |block, sum| pixels.add(block, sum));
                        let start = if accum == Accum::Add { start } else { 0.0 };
                        for (i, &found) in out.iter().enumerate() {
                            assert_eq!(found, start + expected(i), "{k}x{n}, {i}, pieces of {largest}");
                        }
                    }
                });
            }
        }
    }
}
