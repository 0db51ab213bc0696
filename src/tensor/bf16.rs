//! Products of numbers rounded to bf16, summed in f32: for inference on processors that multiply them twice as fast.
//!
//! bf16 is the upper half of an f32: its range, and 8 bits of precision. `vdpbf16ps` takes two numbers of a row and of a
//! column at a time: `fma(a[2i], b[2i], fma(a[2i + 1], b[2i + 1], sum))`, each rounded to nearest even in f32, subnormal
//! numbers read and written as 0. So pairs of rows of the right operand lie side by side in memory, and the left one is
//! rounded where it lies: each line once for each product, although windows overlap.

use super::Float;
#[cfg(not(target_arch = "x86_64"))]
use super::register_tile::Product;

/// In which numbers the products of convolutions and linear layers are taken, in inference. Sums are f32, and so is all
/// else; training and f64 know only [`Precision::F32`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    /// The element type's own numbers.
    #[default]
    F32,
    /// Both factors rounded to bf16: 8 bits, an error of a product of at most 2^-7.
    Bf16,
}

impl Precision {
    /// Whether this machine has the instruction (AVX-512 BF16), and `PARALLAX_SIMD` does not forbid it.
    pub fn is_available(self) -> bool {
        self == Precision::F32 || available()
    }

    /// This, where every line of the left operand has an even number of columns, so that pairs do not reach into the
    /// next; else f32.
    pub(crate) fn of_lines(self, mut lines: impl Iterator<Item = usize>) -> Precision {
        if self == Precision::Bf16 && available() && lines.all(|run| run.is_multiple_of(2)) {
            self
        } else {
            Precision::F32
        }
    }
}

/// Numbers in a vector of sums.
const LANES: usize = 16;

/// The nearest bf16, ties to even. NaN stays NaN.
#[inline(always)]
pub(crate) fn rounded(x: f32) -> u16 {
    let bits = x.to_bits();
    let nearest = bits.wrapping_add(0x7fff + (bits >> 16 & 1)) >> 16;
    (if x.is_nan() { bits >> 16 | 0x40 } else { nearest }) as u16
}

/// Two numbers of a column, as the instruction takes them.
#[inline(always)]
fn pair(first: f32, second: f32) -> u32 {
    u32::from(rounded(first)) | u32::from(rounded(second)) << 16
}

/// Packs the columns of a dense matrix from `first` on, as many as a row of the panel has room for: each pair of rows is a
/// row, filled up with zeros. The pairs stand as bits of f32, which the pool has buffers of.
pub(super) fn pack<T: Float>(panel: &mut [f32], matrix: &[T], cols: usize, first: usize, step: usize) {
    let width = step.min(cols - first);
    for (out, rows) in panel.chunks_exact_mut(step).zip(matrix.chunks_exact(2 * cols)) {
        let (upper, lower) = rows.split_at(cols);
        let pairs = upper[first..first + width].iter().zip(&lower[first..first + width]);
        out[width..].fill(0.0);
        out.iter_mut().zip(pairs).for_each(|(o, (&a, &b))| *o = f32::from_bits(pair(a.f64() as f32, b.f64() as f32)));
    }
}

#[cfg(not(target_arch = "x86_64"))]
fn available() -> bool {
    false
}

#[cfg(not(target_arch = "x86_64"))]
pub(super) fn product(_: &mut Product<f32>, _: &[f32]) {
    unreachable!("no operand is packed for an instruction that is not there")
}

#[cfg(target_arch = "x86_64")]
pub(super) use x86::{available, product};

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::is_x86_feature_detected;
    use std::arch::x86_64::{__m512, __m512bh, _mm512_dpbf16_ps};
    use std::cell::RefCell;
    use std::mem::transmute;
    use std::sync::LazyLock;

    use super::super::gemm::Accum;
    use super::super::register_tile::{Line, Product};
    use super::super::simd;
    use super::{LANES, rounded};

    /// Whether the instruction is there.
    pub(in super::super) fn available() -> bool {
        static AVAILABLE: LazyLock<bool> = LazyLock::new(|| {
            is_x86_feature_detected!("avx512bf16")
                && is_x86_feature_detected!("avx512bw")
                && simd::level().is_ok_and(|level| level == "avx512")
        });
        *AVAILABLE
    }

    type Floats = [f32; LANES];
    type Pairs = [u32; LANES];

    thread_local! {
        /// The lines of a left operand in bf16, one after the other.
        static LINES: RefCell<Vec<u16>> = const { RefCell::new(Vec::new()) };
    }

    /// A product whose right operand is packed by [`pack`](super::pack).
    #[expect(unsafe_code, reason = "the one way into a function that is compiled for an instruction")]
    pub(in super::super) fn product(product: &mut Product<f32>, panels: &[f32]) {
        assert!(available(), "the operand was packed for an instruction that is not there");
        LINES.with_borrow_mut(|lines| {
            // SAFETY: the processor has the instructions: that was asserted.
            unsafe { run(product, panels, lines) }
        });
    }

    /// Sums of products of pairs.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
    #[expect(unsafe_code, reason = "vectors of bf16 have no other constructor")]
    fn dot(sums: Floats, a: Pairs, b: Pairs) -> Floats {
        // SAFETY: all are 64 bytes, of which any bits are a value.
        unsafe {
            let [a, b] = [a, b].map(|pairs| transmute::<Pairs, __m512bh>(pairs));
            transmute::<__m512, Floats>(_mm512_dpbf16_ps(transmute::<Floats, __m512>(sums), a, b))
        }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
    fn run(product: &mut Product<f32>, panels: &[f32], numbers: &mut Vec<u16>) {
        let cols = product.panels.cols();
        let rows = (product.out.len() + product.out_step - cols) / product.out_step;
        // A line's rows overlap or follow each other: what they cover is rounded once.
        numbers.clear();
        let mut lines: Vec<Rounded> = Vec::with_capacity(product.lines.len());
        for &Line { data, step, run } in product.lines {
            let covered = &data[..(rows - 1) * step + run];
            lines.push(Rounded { first: numbers.len(), step, run });
            numbers.extend(covered.iter().map(|&x| rounded(x)));
        }
        let depth: usize = lines.iter().map(|line| line.run).sum();
        let end = cols.next_multiple_of(LANES);
        let mut first = 0;
        while first < end {
            let wide = (end - first).min(2 * LANES);
            let panel = &panels[first * depth / 2..][..wide * depth / 2];
            let at = At { out: &mut *product.out, out_step: product.out_step, cols, accum: product.accum, first };
            if wide == LANES {
                columns::<20, 1>(at, rows, &lines, numbers, panel);
            } else {
                columns::<10, 2>(at, rows, &lines, numbers, panel);
            }
            first += wide;
        }
    }

    /// A line of the left operand: row p is `numbers[first + p * step..][..run]`.
    struct Rounded {
        first: usize,
        step: usize,
        run: usize,
    }

    /// Where sums go.
    struct At<'a> {
        out: &'a mut [f32],
        out_step: usize,
        cols: usize,
        accum: Accum,
        /// The first column.
        first: usize,
    }

    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
    fn columns<const P: usize, const N: usize>(
        mut at: At,
        rows: usize,
        lines: &[Rounded],
        numbers: &[u16],
        panel: &[f32],
    ) {
        let mut row = 0;
        while row + P <= rows {
            tile::<P, N>(&mut at, row, lines, numbers, panel);
            row += P;
        }
        while row + 4 <= rows {
            tile::<4, N>(&mut at, row, lines, numbers, panel);
            row += 4;
        }
        while row < rows {
            tile::<1, N>(&mut at, row, lines, numbers, panel);
            row += 1;
        }
    }

    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bf16")]
    fn tile<const P: usize, const N: usize>(
        at: &mut At,
        row: usize,
        lines: &[Rounded],
        numbers: &[u16],
        panel: &[f32],
    ) {
        let mut sums = [[[0.0; LANES]; N]; P];
        let mut panel = panel.chunks_exact(N * LANES);
        for &Rounded { first, step, run } in lines {
            let mut a: [&[[u16; 2]]; P] = [&[]; P];
            for (p, a) in a.iter_mut().enumerate() {
                *a = &numbers[first + (row + p) * step..][..run].as_chunks().0[..run / 2];
            }
            for (j, b) in (0..run / 2).zip(panel.by_ref()) {
                let mut right = [[0; LANES]; N];
                for (right, b) in right.iter_mut().zip(b.as_chunks::<LANES>().0) {
                    *right = b.map(f32::to_bits);
                }
                for (sums, a) in sums.iter_mut().zip(a) {
                    let left = [u32::from(a[j][0]) | u32::from(a[j][1]) << 16; LANES];
                    for (sum, right) in sums.iter_mut().zip(right) {
                        *sum = dot(*sum, left, right);
                    }
                }
            }
        }
        for (out, sums) in at.out[row * at.out_step..].chunks_mut(at.out_step).zip(sums) {
            let out = &mut out[at.first..at.cols];
            for (out, sum) in out.chunks_mut(LANES).zip(sums) {
                let sums = out.iter_mut().zip(sum);
                match at.accum {
                    Accum::Replace => sums.for_each(|(o, s)| *o = s),
                    Accum::Add => sums.for_each(|(o, s)| *o += s),
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;
    use crate::tensor::gemm::Accum;
    use crate::tensor::register_tile::{Line, Panels, Product};

    #[test]
    fn rounding_is_to_the_nearest_and_ties_go_to_even() {
        let f = |bits: u32| f32::from_bits(bits);
        for (x, expected) in [
            (1.0, 0x3f80),
            (f(0x3f80_8000), 0x3f80),
            (f(0x3f81_8000), 0x3f82),
            (f(0x3f80_8001), 0x3f81),
            (-0.0, 0x8000),
            (f32::INFINITY, 0x7f80),
            (f32::MAX, 0x7f80),
        ] {
            assert_eq!(rounded(x), expected, "{x}");
        }
        let nan = rounded(f(0x7f80_0001));
        assert!(nan & 0x7f80 == 0x7f80 && nan & 0x7f != 0);
    }

    /// What the instruction computes, by two fused steps for each pair.
    fn emulated(a: &[f32], b: &[f32]) -> f32 {
        let wide = |x: f32| f32::from_bits(u32::from(rounded(x)) << 16);
        let pairs = a.as_chunks::<2>().0.iter().zip(b.as_chunks::<2>().0);
        pairs.fold(0.0, |sum, (a, b)| wide(a[0]).mul_add(wide(b[0]), wide(a[1]).mul_add(wide(b[1]), sum)))
    }

    /// Every tile, with remainders of rows and of columns: the bits that the definition of the instruction gives.
    #[test]
    fn a_product_has_the_bits_of_its_definition() {
        if !available() {
            return;
        }
        let mut random = Random::new(3, 0);
        let mut draw = |n: usize| (0..n).map(|_| random.uniform(-1.0, 1.0) as f32).collect::<Vec<f32>>();
        for (rows, cols, step, run, lines) in [
            (1, 1, 2, 2, 1),
            (23, 5, 2, 6, 3),
            (14, 16, 4, 4, 1),
            (11, 33, 3, 10, 2),
            (9, 50, 2, 8, 3),
            (45, 64, 6, 300, 2),
        ] {
            let data: Vec<Vec<f32>> = (0..lines).map(|_| draw((rows - 1) * step + run)).collect();
            let matrix = draw(lines * run * cols);
            let panels = Panels::dense(&matrix, lines * run, cols, rows, Precision::Bf16);
            let lines: Vec<Line<f32>> = data.iter().map(|data| Line { data, step, run }).collect();
            for accum in [Accum::Replace, Accum::Add] {
                let before = draw(rows * cols);
                let mut out = before.clone();
                Product { out: &mut out, out_step: cols, accum, lines: &lines, panels: &panels }.run();
                for (i, &found) in out.iter().enumerate() {
                    let (p, c) = (i / cols, i % cols);
                    let a: Vec<f32> = lines.iter().flat_map(|l| l.data[p * step..][..run].to_vec()).collect();
                    let b: Vec<f32> = matrix.iter().skip(c).step_by(cols).copied().collect();
                    let sum = emulated(&a, &b);
                    let expected = if accum == Accum::Add { before[i] + sum } else { sum };
                    assert_eq!(found.to_bits(), expected.to_bits(), "row {p}, column {c} of {rows}x{cols}");
                }
            }
        }
    }
}
