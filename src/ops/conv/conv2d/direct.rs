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
use crate::tensor::pool::Buffer;
use crate::tensor::register_tile::{Gram, Line, Panels, Product};
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
        let (c, [height_in, width]) = (g.channels, g.size);
        let cells = (g.out[1] - 1) * g.stride[1] + g.kernel[1];
        let height = (rows.len() - 1) * g.stride[0] + (g.kernel[0] - 1) * g.dilation[0] + 1;
        let line = cells * c;
        let mut data = Buffer::stale(height * line);
        let inside = g.padding[1].min(cells)..(g.padding[1] + width).min(cells);
        T::dispatch(
            #[inline(always)]
            || {
                for (i, out) in data.chunks_exact_mut(line.max(1)).enumerate() {
                    let Some(y) = g.padded(0, rows.start * g.stride[0] + i) else {
                        out.fill(T::ZERO);
                        continue;
                    };
                    let row = (b * height_in + y) * width;
                    copy_pixels(&mut out[inside.start * c..inside.end * c], x, row, inside.len());
                    for at in (0..inside.start).chain(inside.end..cells) {
                        let out = &mut out[at * c..(at + 1) * c];
                        match g.padded(1, at) {
                            Some(column) => copy_pixels(out, x, row + column, 1),
                            None => out.fill(T::ZERO),
                        }
                    }
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

/// Whether dw is cheaper summed as its transpose: registers are filled along the rows of the sum.
pub(super) fn is_better_transposed(g: &Geometry) -> bool {
    let run = g.kernel[1] * g.channels;
    g.out_channels * run.div_ceil(16) < run * g.out_channels.div_ceil(16)
}

/// What some output rows of the batch add to dw, `[patch, out]`, or to its transpose.
pub(super) fn add_weight_gradient<T: Float>(
    sum: &mut [T],
    g: &Geometry,
    x: &[Part<T>],
    dy: &[T],
    rows: Range<usize>,
    transposed: bool,
) {
    let (n, width) = (g.out_channels, g.out[1]);
    let (step, run) = (g.stride[1] * g.channels, g.kernel[1] * g.channels);
    for_each_band(g, x, rows, |band, b, rows| {
        let dy = &dy[(b * g.out[0] + rows.start) * width * n..];
        let dy: Vec<&[T]> = dy.chunks_exact((width * n).max(1)).take(rows.len()).collect();
        for ky in 0..g.kernel[0] {
            let lines = (0..rows.len()).map(|r| band.line(g, r, ky));
            if transposed {
                let terms: Vec<_> = dy.iter().copied().zip(lines).collect();
                let (out, out_step) = (&mut sum[ky * run..], g.patch());
                Gram { out, out_step, rows: n, cols: run, terms: &terms, count: width, a_step: n, b_step: step }.run();
            } else {
                let terms: Vec<_> = lines.zip(dy.iter().copied()).collect();
                let (out, out_step) = (&mut sum[ky * run * n..], n);
                Gram { out, out_step, rows: run, cols: n, terms: &terms, count: width, a_step: step, b_step: n }.run();
            }
        }
    });
}
