//! Convolution without an im2col matrix: windows are read from padded rows of the image where they lie.
//!
//! A row of the image with its padding is copied once, from all its parts; the windows of the output pixels of a row
//! are then runs of it, a stride apart, for each row of the window. That is a product whose left operand needs no
//! memory of its own ([`register_tile`](crate::tensor::register_tile)), where im2col writes every number as often as
//! windows overlap.

use std::ops::Range;

use super::geometry::Geometry;
use super::parts::{Part, copy_pixels};
use crate::ops::support::epilogue::Finish;
use crate::ops::support::put::begin_sum;
use crate::ops::support::weight_blocks::{Cuts, Pixels};
use crate::tensor::pool::Buffer;
use crate::tensor::register_tile::{Line, Panels, Product};
use crate::tensor::{Accum, Float, Precision, parallel};

/// The rows of one image that some rows of the output see, with their padding.
pub(in crate::ops) struct Band<T: Float> {
    data: Buffer<T>,
    /// Numbers in a padded row.
    line: usize,
}

impl<T: Float> Band<T> {
    /// What the output rows `rows` of image `b` see.
    fn new(g: &Geometry, x: &[Part<T>], b: usize, rows: Range<usize>) -> Self {
        let (height, line) = (height_under(g, rows.len()), line_of(g));
        let mut data = Buffer::stale(height * line);
        T::dispatch(
            #[inline(always)]
            || {
                for (i, out) in data.chunks_exact_mut(line.max(1)).enumerate() {
                    pad_row(out, g, x, b, rows.start * g.stride[0] + i);
                }
            },
        );
        Band { data, line }
    }

    /// The row under row `ky` of the windows of the band's output row `r`.
    pub(in crate::ops) fn line(&self, g: &Geometry, r: usize, ky: usize) -> &[T] {
        &self.data[(r * g.stride[0] + ky * g.dilation[0]) * self.line..][..self.line]
    }
}

/// Rows of the padded image under the windows of neighbouring output rows.
fn height_under(g: &Geometry, rows: usize) -> usize {
    (rows - 1) * g.stride[0] + (g.kernel[0] - 1) * g.dilation[0] + 1
}

/// Numbers of a padded row.
fn line_of(g: &Geometry) -> usize {
    ((g.out[1] - 1) * g.stride[1] + g.kernel[1]) * g.channels
}

/// Row `at` of padded image `b`.
#[inline(always)]
fn pad_row<T: Float>(out: &mut [T], g: &Geometry, x: &[Part<T>], b: usize, at: usize) {
    let (c, [height, width]) = (g.channels, g.size);
    let Some(y) = g.padded(0, at) else { return out.fill(T::ZERO) };
    let cells = out.len() / c;
    let inside = g.padding[1].min(cells)..(g.padding[1] + width).min(cells);
    let row = (b * height + y) * width;
    copy_pixels(&mut out[inside.start * c..inside.end * c], x, row, inside.len());
    for at in (0..inside.start).chain(inside.end..cells) {
        let out = &mut out[at * c..(at + 1) * c];
        match g.padded(1, at) {
            Some(column) => copy_pixels(out, x, row + column, 1),
            None => out.fill(T::ZERO),
        }
    }
}

/// All images of a batch with their padding: for products whose chunks each see all of them.
pub(in crate::ops) struct Padded<T: Float> {
    data: Buffer<T>,
    line: usize,
    /// Rows of a padded image.
    height: usize,
}

impl<T: Float> Padded<T> {
    /// Copies them.
    pub(in crate::ops) fn new(g: &Geometry, x: &[Part<T>]) -> Self {
        let (height, line) = (height_under(g, g.out[0]), line_of(g));
        let mut data = Buffer::stale(g.batch * height * line);
        if line > 0 {
            let work = data.len();
            parallel::for_each_unit(&mut data, line, work, |i, out| {
                T::dispatch(
                    #[inline(always)]
                    || pad_row(out, g, x, i / height, i % height),
                );
            });
        }
        Padded { data, line, height }
    }

    /// The numbers that row `ky` of the windows sees of output row `row` of the whole batch, and all that follow.
    pub(in crate::ops) fn from(&self, g: &Geometry, row: usize, ky: usize) -> &[T] {
        let at = row / g.out[0] * self.height + row % g.out[0] * g.stride[0] + ky * g.dilation[0];
        &self.data[at * self.line..]
    }
}

/// Calls `f(band, image, output rows in the image)` for output rows of the whole batch, image by image.
pub(in crate::ops) fn for_each_band<T: Float>(
    g: &Geometry,
    x: &[Part<T>],
    rows: Range<usize>,
    mut f: impl FnMut(Band<T>, usize, Range<usize>),
) {
    let mut first = rows.start;
    while first < rows.end {
        let b = first / g.out[0];
        let end = rows.end.min((b + 1) * g.out[0]);
        let mine = first - b * g.out[0]..end - b * g.out[0];
        f(Band::new(g, x, b, mine.clone()), b, mine);
        first = end;
    }
}

/// `out = conv(x, w)`, or added to what is there; and finished.
pub(super) fn convolve<T: Float>(
    out: &mut [T],
    accum: Accum,
    g: &Geometry,
    x: &[Part<T>],
    w: &[T],
    finish: &Finish<T>,
    precision: Precision,
) {
    let (n, width, tile) = (g.out_channels, g.out[1], g.tile());
    let (step, run) = (g.stride[1] * g.channels, g.kernel[1] * g.channels);
    let precision = precision.of_lines([run].into_iter());
    let panels = Panels::dense(w, g.patch(), n, g.rows() * width, precision);
    let work = 2 * g.rows() * width * g.patch() * n;
    parallel::for_each_chunk(out, tile * width * n, work, |i, out| {
        let first = i * tile;
        let mut rest = &mut *out;
        for_each_band(g, x, first..first + rest.len() / (width * n), |band, _, rows| {
            for r in 0..rows.len() {
                let lines = (0..g.kernel[0]).map(|ky| Line { data: band.line(g, r, ky), step, run });
                let lines: Vec<Line<T>> = lines.collect();
                let (out, others) = std::mem::take(&mut rest).split_at_mut(width * n);
                rest = others;
                Product { out, out_step: n, accum, lines: &lines, panels: &panels }.run();
            }
        });
        finish.run(out);
    });
}

/// dw, block by block.
pub(super) fn weight_gradient<T: Float>(out: &mut [T], accum: Accum, g: &Geometry, x: &[Part<T>], dy: &[T]) {
    let (n, width) = (g.out_channels, g.out[1]);
    if out.is_empty() || dy.is_empty() {
        return begin_sum(out, accum);
    }
    let padded = Padded::new(g, x);
    let pixels = Pixels {
        run: g.kernel[1] * g.channels,
        width,
        gapless: false,
        a_step: g.stride[1] * g.channels,
        b_step: n,
        a: |ky: usize, row: usize| padded.from(g, row, ky),
        b: |_: usize, row: usize| &dy[row * width * n..],
    };
    Cuts::new([g.patch(), n], g.rows(), width).sum(out, accum, |block, sum| pixels.add(block, sum));
}
