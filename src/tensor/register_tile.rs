//! Matrix products whose operands stay where they lie: a tile of the result is held in registers while it is summed.
//!
//! A general product ([`gemm`](super::gemm)) copies both operands into an order of its own first. Convolutions need no
//! such copy: the window of an output pixel is, for each of its rows, one run of numbers in the image, and the windows
//! of its neighbours are the same run a step further on. A number of the left operand is spread over a vector and
//! multiplied with two vectors of the right one, for ten rows of the result at once (or with one, for twenty rows), so
//! that none of twenty sums waits for its last addition. Every sum is made in one order, whatever the tile and the
//! instruction set.

use pulp::{Simd, WithSimd};

use super::gemm::Accum;
use super::pool::Buffer;
use super::simd::copy_run;
use super::{Float, Precision, Signature, bf16, parallel, regime, simd};

/// Vectors side by side in a tile of the result.
const VECTORS: usize = 2;
/// The most terms summed one after the other: rounding errors grow with the length of a sum, so long ones are sums of
/// sums.
const LONGEST: usize = 256;

/// Rows of the left operand from which on a copy of the right one pays: each ten of them read it once.
const MANY: usize = 160;

/// The right operand of a product.
pub(crate) struct Panels<'a, T: Float> {
    data: Data<'a, T>,
    rows: usize,
    cols: usize,
    lanes: usize,
}

/// How the right operand lies.
enum Data<'a, T: Float> {
    /// Cut into panels of [`VECTORS`] vectors of columns, one panel after the other, the last one filled up with zeros.
    Packed(Buffer<T>),
    /// Row by row, in whole vectors.
    Dense(&'a [T]),
    /// Panels as well, of pairs of rows in bf16.
    Pairs(Buffer<f32>),
}

impl<'a, T: Float> Panels<'a, T> {
    /// A dense matrix, which `uses` rows are to be multiplied with. In bf16 every line of those has an even number of
    /// columns ([`Precision::of_lines`]); f64 stays what it is.
    pub(crate) fn dense(matrix: &'a [T], rows: usize, cols: usize, uses: usize, precision: Precision) -> Self {
        let lanes = simd::lanes::<T>();
        if precision == Precision::Bf16 && size_of::<T>() == size_of::<f32>() {
            return Self::pairs(matrix, rows, cols);
        }
        if uses < regime::size(MANY) && cols.is_multiple_of(lanes) {
            return Panels { data: Data::Dense(&matrix[..rows * cols]), rows, cols, lanes };
        }
        Self::pack(rows, cols, |first, width, step, panel| {
            for (out, row) in panel.chunks_exact_mut(step).zip(matrix.chunks_exact(cols)) {
                copy_run(&mut out[..width], &row[first..first + width]);
            }
        })
    }

    fn pairs(matrix: &[T], rows: usize, cols: usize) -> Self {
        let lanes = simd::lanes::<T>();
        let mut data = Buffer::<f32>::stale(rows / 2 * cols.next_multiple_of(lanes));
        let work = data.len();
        if rows > 0 {
            parallel::for_each_chunk(&mut data, VECTORS * lanes * rows / 2, work, |k, panel| {
                let step = 2 * panel.len() / rows;
                T::dispatch(
                    #[inline(always)]
                    || bf16::pack(panel, matrix, cols, k * VECTORS * lanes, step),
                );
            });
        }
        Panels { data: Data::Pairs(data), rows, cols, lanes }
    }

    /// The transpose of a dense `[cols, rows]` matrix.
    pub(crate) fn transposed(matrix: &[T], rows: usize, cols: usize) -> Self {
        Self::pack(rows, cols, |first, width, step, panel| {
            for (j, column) in matrix.chunks_exact(rows).skip(first).take(width).enumerate() {
                panel[j..].iter_mut().step_by(step).zip(column).for_each(|(p, &c)| *p = c);
            }
        })
    }

    /// Columns of the matrix.
    pub(crate) fn cols(&self) -> usize {
        self.cols
    }

    /// `fill(first, width, step, panel)` writes `width` columns from `first` on into rows of `step` numbers.
    #[inline(always)]
    fn pack(rows: usize, cols: usize, fill: impl Fn(usize, usize, usize, &mut [T]) + Sync + Send) -> Self {
        let lanes = simd::lanes::<T>();
        let wide = VECTORS * lanes;
        let mut data = Buffer::stale(rows * cols.next_multiple_of(lanes));
        let work = data.len() / 4;
        if rows > 0 {
            parallel::for_each_chunk(&mut data, wide * rows, work, |k, panel| {
                let (first, step) = (k * wide, panel.len() / rows);
                let width = step.min(cols - first);
                T::dispatch(
                    #[inline(always)]
                    || {
                        if width < step {
                            panel.fill(T::ZERO);
                        }
                        fill(first, width, step, panel);
                    },
                );
            });
        }
        Panels { data: Data::Packed(data), rows, cols, lanes }
    }
}

/// Some columns of a left operand: row p is `data[p * step..][..run]`.
#[derive(Clone, Copy)]
pub(crate) struct Line<'a, T> {
    pub(crate) data: &'a [T],
    pub(crate) step: usize,
    pub(crate) run: usize,
}

/// `out = A B`, or added to what is there: the columns of A are those of the lines, one line after the other.
///
/// `out` has rows of as many numbers as B has columns, `out_step` apart.
pub(crate) struct Product<'a, T: Float> {
    pub(crate) out: &'a mut [T],
    pub(crate) out_step: usize,
    pub(crate) accum: Accum,
    pub(crate) lines: &'a [Line<'a, T>],
    pub(crate) panels: &'a Panels<'a, T>,
}

/// The kernel for a right operand in bf16.
struct OfPairs;

impl Signature for OfPairs {
    type Of<T: Float> = fn(&mut Product<'_, T>, &[f32]);
}

impl<T: Float> Product<'_, T> {
    /// Computes it.
    ///
    /// # Panics
    /// If a line is too short, or B has not as many rows as A has columns.
    pub(crate) fn run(mut self) {
        let Panels { rows, cols, .. } = *self.panels;
        let columns: usize = self.lines.iter().map(|line| line.run).sum();
        assert_eq!(rows, columns, "rows of the right operand");
        if cols == 0 || self.out.is_empty() {
            return;
        }
        if rows == 0 {
            if self.accum == Accum::Replace {
                self.out.chunks_mut(self.out_step).for_each(|row| row[..cols].fill(T::ZERO));
            }
            return;
        }
        match &self.panels.data {
            Data::Pairs(panels) => {
                T::pick::<OfPairs>(bf16::product, |_, _| unreachable!("only f32 is packed in bf16"))(&mut self, panels)
            }
            _ => T::dispatch_vector(self),
        }
    }

    #[inline(always)]
    fn panels<S: Simd, const DENSE: bool>(&mut self, simd: S) {
        let lanes = self.panels.lanes;
        let end = self.panels.cols.next_multiple_of(lanes);
        let mut first = 0;
        // Of 16 registers, ten sums and the factors leave some to spare; of 32, twenty.
        while first + VECTORS * lanes <= end {
            match S::REGISTER_COUNT {
                0..32 => self.panel::<S, 5, VECTORS, DENSE>(simd, first),
                _ => self.panel::<S, 10, VECTORS, DENSE>(simd, first),
            }
            first += VECTORS * lanes;
        }
        if first < end {
            match S::REGISTER_COUNT {
                0..32 => self.panel::<S, 10, 1, DENSE>(simd, first),
                _ => self.panel::<S, 20, 1, DENSE>(simd, first),
            }
        }
    }

    #[inline(always)]
    fn panel<S: Simd, const P: usize, const N: usize, const DENSE: bool>(&mut self, simd: S, first: usize) {
        // What lies behind the last row's numbers may be missing.
        let rows = (self.out.len() + self.out_step - self.panels.cols) / self.out_step;
        let panel = match &self.panels.data {
            Data::Packed(data) => &data[first * self.panels.rows..][..self.panels.rows * N * T::lanes::<S>()],
            Data::Dense(matrix) => &matrix[first..],
            Data::Pairs(_) => unreachable!("taken by another kernel"),
        };
        let mut at = 0;
        while at + P <= rows {
            self.tile::<S, P, N, DENSE>(simd, panel, at, first);
            at += P;
        }
        if P > 10 && at + 10 <= rows {
            self.tile::<S, 10, N, DENSE>(simd, panel, at, first);
            at += 10;
        }
        while at + 4 <= rows {
            self.tile::<S, 4, N, DENSE>(simd, panel, at, first);
            at += 4;
        }
        while at < rows {
            self.tile::<S, 1, N, DENSE>(simd, panel, at, first);
            at += 1;
        }
    }

    #[inline(always)]
    fn tile<S: Simd, const P: usize, const N: usize, const DENSE: bool>(
        &mut self,
        simd: S,
        panel: &[T],
        at: usize,
        first: usize,
    ) {
        let width = if DENSE { self.panels.cols } else { N * T::lanes::<S>() };
        let mut sums = [[T::splat(simd, T::ZERO); N]; P];
        let (mut terms, mut accum) = (0, self.accum);
        let mut above = 0;
        for Line { data, step, run } in self.lines.iter().copied() {
            for from in (0..run).step_by(LONGEST) {
                let count = LONGEST.min(run - from);
                if terms + count > LONGEST {
                    self.settle(simd, at, first, sums, accum);
                    sums = [[T::splat(simd, T::ZERO); N]; P];
                    (terms, accum) = (0, Accum::Add);
                }
                terms += count;
                let mut a: [&[T]; P] = [&[]; P];
                for (p, a) in a.iter_mut().enumerate() {
                    *a = &data[(at + p) * step + from..][..count];
                }
                let b = &panel[(above + from) * width..];
                // The same twice: only where it is known that rows follow each other is nothing checked in the loop.
                if DENSE {
                    for (j, b) in (0..count).zip(b.chunks(width)) {
                        multiply(simd, &mut sums, a, j, &b[..N * T::lanes::<S>()]);
                    }
                } else {
                    for (j, b) in b[..count * width].chunks_exact(width).enumerate() {
                        multiply(simd, &mut sums, a, j, b);
                    }
                }
            }
            above += run;
        }
        self.settle(simd, at, first, sums, accum);
    }

    /// Writes a tile to where it belongs, or adds it.
    #[inline(always)]
    fn settle<S: Simd, const P: usize, const N: usize>(
        &mut self,
        simd: S,
        at: usize,
        first: usize,
        sums: [[T::V<S>; N]; P],
        accum: Accum,
    ) {
        let (lanes, cols) = (T::lanes::<S>(), self.panels.cols);
        if first + N * lanes <= cols {
            // Known once for all rows, which leaves nothing to decide between the stores.
            let out = &mut self.out[at * self.out_step + first..];
            for (p, sums) in sums.into_iter().enumerate() {
                let out = &mut out[p * self.out_step..][..N * lanes];
                for (q, sum) in sums.into_iter().enumerate() {
                    settle(simd, &mut out[q * lanes..][..lanes], sum, accum);
                }
            }
            return;
        }
        let out = self.out[at * self.out_step..].chunks_mut(self.out_step);
        for (out, sums) in out.zip(sums) {
            let out = &mut out[..cols];
            for (q, &sum) in sums.iter().enumerate() {
                settle(simd, &mut out[first + q * lanes..], sum, accum);
            }
        }
    }
}

/// Writes a vector, or adds it, as far as there is room.
#[inline(always)]
fn settle<T: Float, S: Simd>(simd: S, out: &mut [T], sum: T::V<S>, accum: Accum) {
    let lanes = T::lanes::<S>();
    if out.len() >= lanes {
        let sum = if accum == Accum::Add { T::vector_add(simd, T::load(simd, out), sum) } else { sum };
        T::store(simd, out, sum);
    } else {
        let sum = if accum == Accum::Add { T::vector_add(simd, T::load_part(simd, out), sum) } else { sum };
        T::store_part(simd, out, sum);
    }
}

/// Adds the products of a row of the panel, and of what it meets in each row of the left operand.
#[inline(always)]
fn multiply<T: Float, S: Simd, const P: usize, const N: usize>(
    simd: S,
    sums: &mut [[T::V<S>; N]; P],
    a: [&[T]; P],
    j: usize,
    b: &[T],
) {
    let mut row = [T::splat(simd, T::ZERO); N];
    for (q, row) in row.iter_mut().enumerate() {
        *row = T::load(simd, &b[q * T::lanes::<S>()..]);
    }
    for p in 0..P {
        let x = T::splat(simd, a[p][j]);
        for q in 0..N {
            sums[p][q] = T::fma(simd, x, row[q], sums[p][q]);
        }
    }
}

impl<T: Float> WithSimd for Product<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        match self.panels.data {
            Data::Packed(_) | Data::Pairs(_) => self.panels::<S, false>(simd),
            Data::Dense(_) => self.panels::<S, true>(simd),
        }
    }
}

/// `out += A^T B`: each of the terms has `count` rows of A, `a[i * a_step..][..rows]`, and as many of B,
/// `b[i * b_step..][..cols]`. `out` has `rows` rows of `out_step` numbers, of which the first `cols` are meant.
pub(crate) struct Gram<'a, T: Float> {
    pub(crate) out: &'a mut [T],
    pub(crate) out_step: usize,
    pub(crate) rows: usize,
    pub(crate) cols: usize,
    pub(crate) terms: &'a [(&'a [T], &'a [T])],
    pub(crate) count: usize,
    pub(crate) a_step: usize,
    pub(crate) b_step: usize,
}

impl<T: Float> Gram<'_, T> {
    /// Computes it.
    ///
    /// # Panics
    /// If a slice is too short.
    pub(crate) fn run(self) {
        if self.rows * self.cols * self.count > 0 {
            T::dispatch_vector(self);
        }
    }

    #[inline(always)]
    fn columns<S: Simd, const P: usize, const N: usize, const PART: bool>(&mut self, simd: S, first: usize) {
        let mut at = 0;
        while at + P <= self.rows {
            self.tile::<S, P, N, PART>(simd, at, first);
            at += P;
        }
        while at + 4 <= self.rows {
            self.tile::<S, 4, N, PART>(simd, at, first);
            at += 4;
        }
        while at < self.rows {
            self.tile::<S, 1, N, PART>(simd, at, first);
            at += 1;
        }
    }

    /// `PART`: the last of the vectors is not full.
    #[inline(always)]
    fn tile<S: Simd, const P: usize, const N: usize, const PART: bool>(&mut self, simd: S, at: usize, first: usize) {
        let lanes = T::lanes::<S>();
        let width = if PART { self.cols - first } else { N * lanes };
        let mut sums = [[T::splat(simd, T::ZERO); N]; P];
        for (a, b) in self.terms {
            for i in 0..self.count {
                let a = &a[i * self.a_step + at..][..P];
                let b = &b[i * self.b_step + first..][..width];
                let mut row = [T::splat(simd, T::ZERO); N];
                for (q, row) in row.iter_mut().enumerate() {
                    let b = &b[q * lanes..];
                    *row = if PART && q + 1 == N { T::load_part(simd, b) } else { T::load(simd, b) };
                }
                for p in 0..P {
                    let x = T::splat(simd, a[p]);
                    for q in 0..N {
                        sums[p][q] = T::fma(simd, x, row[q], sums[p][q]);
                    }
                }
            }
        }
        for (p, sums) in sums.iter().enumerate() {
            let out = &mut self.out[(at + p) * self.out_step + first..][..width];
            for (q, &sum) in sums.iter().enumerate() {
                settle(simd, &mut out[q * lanes..], sum, Accum::Add);
            }
        }
    }
}

impl<T: Float> WithSimd for Gram<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let lanes = T::lanes::<S>();
        let mut first = 0;
        while first < self.cols {
            let left = self.cols - first;
            // Channels come in multiples of eight more often than of ten.
            if left >= VECTORS * lanes {
                match S::REGISTER_COUNT {
                    0..32 => self.columns::<S, 4, VECTORS, false>(simd, first),
                    _ => self.columns::<S, 8, VECTORS, false>(simd, first),
                }
            } else if left == lanes {
                self.columns::<S, 8, 1, false>(simd, first);
            } else if left > lanes {
                self.columns::<S, 4, VECTORS, true>(simd, first);
            } else {
                self.columns::<S, 8, 1, true>(simd, first);
            }
            first += VECTORS * lanes;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(n: usize) -> Vec<f64> {
        (0..n as u64).map(|i| (i.wrapping_mul(2654435761) % 1000) as f64 / 500.0 - 1.0).collect()
    }

    #[test]
    fn a_product_is_the_sum_it_stands_for() {
        for (rows, cols, step, run, lines) in [
            (1, 1, 1, 1, 1),
            (23, 5, 2, 6, 3),
            (14, 16, 4, 4, 1),
            (11, 33, 3, 9, 2),
            (9, 50, 1, 7, 3),
            (11, 3, 2, 600, 2),
            (27, 24, 3, 300, 2),
        ] {
            let data = numbers(lines * ((rows - 1) * step + run));
            let lines = data.chunks((rows - 1) * step + run).map(|data| Line { data, step, run });
            let lines: Vec<Line<f64>> = lines.collect();
            let b = numbers(lines.len() * run * cols);
            let expected = |p: usize, n: usize| -> f64 {
                let terms = lines
                    .iter()
                    .enumerate()
                    .flat_map(|(l, line)| (0..run).map(move |j| (line.data[p * step + j], l * run + j)));
                terms.map(|(a, k)| a * b[k * cols + n]).sum()
            };
            for (accum, start) in [(Accum::Replace, 0.0), (Accum::Add, 0.5)] {
                let product = |uses: usize| {
                    let panels = Panels::dense(&b, lines.len() * run, cols, uses, Precision::F32);
                    let mut out = vec![if accum == Accum::Add { start } else { f64::NAN }; rows * cols];
                    Product { out: &mut out, out_step: cols, accum, lines: &lines, panels: &panels }.run();
                    out
                };
                let out = product(MANY);
                assert_eq!(out, product(MANY - 1), "the same bits, packed and as it lies");
                for (i, &found) in out.iter().enumerate() {
                    let expected = start + expected(i / cols, i % cols);
                    assert!((found - expected).abs() < 1e-12, "{rows}x{cols}, {i}: {found} for {expected}");
                }
            }
        }
    }

    #[test]
    fn lines_may_differ_in_length_and_step() {
        let (rows, cols, runs) = (13, 19, [3, 0, 270, 1]);
        let steps = runs.map(|run| run + 2);
        let data = steps.map(|step| numbers(rows * step));
        let lines: Vec<Line<f64>> =
            (0..runs.len()).map(|l| Line { data: &data[l], step: steps[l], run: runs[l] }).collect();
        let b = numbers(274 * cols);
        let panels = Panels::dense(&b, 274, cols, rows, Precision::F32);
        let mut out = vec![f64::NAN; rows * cols];
        Product { out: &mut out, out_step: cols, accum: Accum::Replace, lines: &lines, panels: &panels }.run();
        for (i, &found) in out.iter().enumerate() {
            let (p, n) = (i / cols, i % cols);
            let row = (0..runs.len()).flat_map(|l| &data[l][p * steps[l]..][..runs[l]]);
            let expected: f64 = row.enumerate().map(|(k, a)| a * b[k * cols + n]).sum();
            assert!((found - expected).abs() < 1e-12, "{i}: {found} for {expected}");
        }
    }

    #[test]
    fn rows_of_a_product_may_stand_apart() {
        let (rows, cols, run, step) = (14, 5, 3, 12);
        let (a, b) = (numbers(rows * run), numbers(run * cols));
        let panels = Panels::dense(&b, run, cols, rows, Precision::F32);
        let lines = [Line { data: &a, step: run, run }];
        // With and without what is missing behind the last row's numbers.
        for len in [rows * step, (rows - 1) * step + cols] {
            let mut out = vec![7.0; len];
            Product { out: &mut out, out_step: step, accum: Accum::Replace, lines: &lines, panels: &panels }.run();
            for (i, &found) in out.iter().enumerate() {
                let (p, n) = (i / step, i % step);
                let product = || (0..run).map(|k| a[p * run + k] * b[k * cols + n]).sum();
                let expected: f64 = if n < cols { product() } else { 7.0 };
                assert!((found - expected).abs() < 1e-12, "{i}: {found} for {expected}");
            }
        }
    }

    #[test]
    fn panels_of_a_transpose_are_those_of_the_matrix() {
        let b = numbers(7 * 21);
        let turned: Vec<f64> = (0..7 * 21).map(|i| b[(i % 7) * 21 + i / 7]).collect();
        let [packed, of_transpose] =
            [Panels::dense(&b, 7, 21, MANY, Precision::F32), Panels::transposed(&turned, 7, 21)];
        let (Data::Packed(packed), Data::Packed(of_transpose)) = (packed.data, of_transpose.data) else {
            panic!("packed, for as many uses");
        };
        assert_eq!(*packed, *of_transpose);
    }

    #[test]
    fn a_gram_product_is_the_sum_it_stands_for() {
        for (rows, cols, count) in [(1, 1, 2), (13, 8, 6), (10, 16, 4), (7, 21, 10), (5, 37, 4)] {
            let (a_step, b_step, out_step) = (rows + 2, cols + 1, cols + 3);
            let (a, b) = (numbers(count * a_step), numbers(count * b_step));
            let mut out = vec![0.25; rows * out_step];
            let half = count / 2;
            let terms = [(&a[..], &b[..]), (&a[half * a_step..], &b[half * b_step..])];
            Gram { out: &mut out, out_step, rows, cols, terms: &terms, count: half, a_step, b_step }.run();
            for (i, &found) in out.iter().enumerate() {
                let (r, c) = (i / out_step, i % out_step);
                let terms = (0..count).map(|t| a[t * a_step + r] * b[t * b_step + c.min(cols - 1)]);
                let expected = 0.25 + if c < cols { terms.sum() } else { 0.0 };
                assert!((found - expected).abs() < 1e-12, "{rows}x{cols}, {i}: {found} for {expected}");
            }
        }
    }
}
