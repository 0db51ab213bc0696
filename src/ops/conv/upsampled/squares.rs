//! The 3x3 window: four convolutions of the small image with 2x2 windows, one for each place in a square of four.
//!
//! Row 2y + p of the enlarged image, p = 0 or 1, is row y of the small one. A window over the rows 2y + p - 1 ..
//! 2y + p + 1 therefore sees two rows of the small image: y - 1 and twice y for p = 0, twice y and y + 1 for p = 1. The
//! same holds for columns. The weights of what is seen twice are added once, before anything is multiplied.

use crate::ops::conv::conv2d::direct::{Padded, for_each_band};
use crate::ops::conv::conv2d::geometry::{Beyond, Geometry};
use crate::ops::conv::conv2d::kernel;
use crate::ops::conv::conv2d::parts::whole;
use crate::ops::support::epilogue::Finish;
use crate::ops::support::weight_blocks::{Cuts, Pixels};
use crate::tensor::pool::Buffer;
use crate::tensor::register_tile::{Line, Panels, Product};
use crate::tensor::{Accum, Float, Precision, parallel};

/// The places in a square, (row, column).
pub(super) const PHASES: [[usize; 2]; 4] = [[0, 0], [0, 1], [1, 0], [1, 1]];
/// Small pixels that a window sees.
pub(super) const TAPS: usize = 4;

/// Which of the two small rows (or columns) in sight row `k` of the window lies on, at place `p` of a square. The first
/// of the two is the one before the square's own for p = 0, and its own for p = 1.
fn tap(p: usize, k: usize) -> usize {
    (p + k).div_ceil(2) - p
}

/// Calls `f(row and column of the 3x3 window, small pixel of the 2x2 window)` for a place in a square.
fn for_each_tap([py, px]: [usize; 2], mut f: impl FnMut(usize, usize)) {
    for ky in 0..3 {
        for kx in 0..3 {
            f(3 * ky + kx, 2 * tap(py, ky) + tap(px, kx));
        }
    }
}

#[inline(always)]
fn add<T: Float>(out: &mut [T], w: &[T]) {
    T::dispatch(
        #[inline(always)]
        || out.iter_mut().zip(w).for_each(|(o, &w)| *o += w),
    );
}

/// The weights of the 2x2 window at a place, `[2, 2, in, out]`.
fn weights_at<T: Float>(phase: [usize; 2], g: &Geometry, w: &[T]) -> Buffer<T> {
    let block = g.channels * g.out_channels;
    let mut out = Buffer::filled(TAPS * block, T::ZERO);
    for_each_tap(phase, |k, t| add(&mut out[t * block..][..block], &w[k * block..][..block]));
    out
}

/// Small rows a tile.
fn tile(g: &Geometry) -> usize {
    Geometry { out_channels: 4 * g.out_channels, ..*g }.tile()
}

/// `out = conv(x enlarged, w)`, or added to what is there; and finished.
pub(super) fn convolve<T: Float>(
    out: &mut [T],
    accum: Accum,
    g: &Geometry,
    x: &[T],
    w: &[T],
    finish: &Finish<T>,
    precision: Precision,
) {
    let (c, n, width, tile) = (g.channels, g.out_channels, g.out[1], tile(g));
    let weights = PHASES.map(|phase| weights_at(phase, g, w));
    let precision = precision.of_lines([2 * c].into_iter());
    let panels = weights.each_ref().map(|w| Panels::dense(w, TAPS * c, n, g.rows() * width, precision));
    let row = 2 * width * n;
    let work = 2 * out.len() * TAPS * c;
    parallel::for_each_chunk(out, tile * 2 * row, work, |i, out| {
        let first = i * tile;
        let mut rest = &mut *out;
        for_each_band(g, &whole(g, x), first..first + rest.len() / (2 * row), |band, _, rows| {
            for r in 0..rows.len() {
                let (out, others) = std::mem::take(&mut rest).split_at_mut(2 * row);
                rest = others;
                for ([py, px], panels) in PHASES.iter().zip(&panels) {
                    let lines = [0, 1].map(|t| Line { data: &band.line(g, r, py + t)[px * c..], step: c, run: 2 * c });
                    let out = &mut out[py * row + px * n..(py + 1) * row];
                    Product { out, out_step: 2 * n, accum, lines: &lines, panels }.run();
                }
            }
        });
        finish.run(out);
    });
}

/// dx from dy: a pixel is seen from the four rows 2y - 1 .. 2y + 2 of the output, and from four columns. That is a
/// convolution of dy by steps of two, with a 4x4 window.
pub(super) fn input_gradient<T: Float>(out: &mut [T], accum: Accum, g: &Geometry, dy: &[T], w: &[T]) {
    if out.is_empty() {
        return;
    }
    let t = Geometry {
        size: [2 * g.size[0], 2 * g.size[1]],
        channels: g.out_channels,
        out: g.size,
        out_channels: g.channels,
        kernel: [4; 2],
        stride: [2; 2],
        padding: [1; 2],
        beyond: Beyond::Zero,
        ..*g
    };
    let turned = turned(g, w);
    kernel::convolve(out, accum, &t, &whole(&t, dy), &turned, &Finish::nothing(), Precision::F32);
    kernel::border_gradient(out, g, &t, dy, &turned);
}

/// The weights with which a small pixel is seen from around it, `[4, 4, out, in]`.
fn turned<T: Float>(g: &Geometry, w: &[T]) -> Buffer<T> {
    let (c, n) = (g.channels, g.out_channels);
    let mut out = Buffer::filled(16 * n * c, T::ZERO);
    // Row a of the 4x4 window is row 2y + a - 1 of the output, which sees row y with rows 2 - a and 3 - a of its
    // window.
    let seen = |a: usize| (2usize.saturating_sub(a)..=3 - a).filter(move |k| *k < 3 && *k + a >= 2);
    parallel::for_each_unit(&mut out, n * c, 4 * w.len(), |at, out| {
        for ky in seen(at / 4) {
            for kx in seen(at % 4) {
                let w = &w[(3 * ky + kx) * c * n..][..c * n];
                for (j, out) in out.chunks_exact_mut(c).enumerate() {
                    out.iter_mut().zip(w[j..].iter().step_by(n)).for_each(|(o, &w)| *o += w);
                }
            }
        }
    });
    out
}

/// dw: first of the 2x2 windows, block by block; then each of their weights counts for all those that were added to
/// make it.
pub(super) fn weight_gradient<T: Float>(out: &mut [T], g: &Geometry, x: &[T], dy: &[T]) {
    let (c, n, width) = (g.channels, g.out_channels, g.out[1]);
    if c * n == 0 {
        return;
    }
    let padded = Padded::new(g, &whole(g, x));
    // A row of one of the four windows sees two pixels that follow each other.
    let place = |of: usize| (PHASES[of / 2], of % 2);
    let pixels = Pixels {
        run: 2 * c,
        width,
        gapless: false,
        a_step: c,
        b_step: 2 * n,
        a: |of: usize, row: usize| {
            let ([py, px], t) = place(of);
            &padded.from(g, row, py + t)[px * c..]
        },
        b: |of: usize, row: usize| {
            let ([py, px], _) = place(of);
            &dy[((2 * row + py) * 2 * width + px) * n..]
        },
    };
    let block = c * n;
    let mut sum = Buffer::stale(PHASES.len() * TAPS * block);
    let cuts = Cuts::new([PHASES.len() * TAPS * c, n], g.rows(), width);
    cuts.sum(&mut sum, Accum::Replace, |block, sum| pixels.add(block, sum));
    parallel::for_each_unit(out, block, sum.len(), |k, out| {
        out.fill(T::ZERO);
        for (&phase, sum) in PHASES.iter().zip(sum.chunks_exact(TAPS * block)) {
            for_each_tap(phase, |tap, t| {
                if tap == k {
                    add(out, &sum[t * block..][..block]);
                }
            });
        }
    });
}
