//! The three products of a matrix of rows with a weight, tile by tile: outputs, the gradient of the rows, the gradient of
//! the weight. A linear layer is nothing else, and neither is a convolution whose window is one pixel.

use super::epilogue::Finish;
use super::put::begin_sum;
use super::sums::sum_into;
use crate::ops::Tile;
use crate::tensor::gemm::Rows;
use crate::tensor::register_tile::{Gram, Line, Panels, Product};
use crate::tensor::{Accum, Float, Precision, Tensor, parallel, regime};

/// Pixels as rows of channels.
pub(in crate::ops) fn rows_of<T: Float>(x: &Tensor<T>) -> Rows<'_, T> {
    Rows::dense(x.data(), x.shape().rows(), x.shape().last())
}

/// Rows a tile: about 2^17 multiplications, at least 40 rows; or `tile`, if that is given.
pub(in crate::ops) fn tile_rows(tile: Tile, k: usize, n: usize) -> usize {
    tile.or(((1 << 17) / (k * n).max(1)).clamp(40, 1000).next_multiple_of(20))
}

/// `out = x w`, finished; x may come in parts, whose columns stand side by side.
pub(in crate::ops) fn forward<T: Float>(
    out: &mut [T],
    parts: &[Rows<T>],
    w: &[T],
    finish: &Finish<T>,
    tile: Tile,
    precision: Precision,
) {
    let k = parts.iter().map(|x| x.cols).sum();
    let n = out.len() / parts[0].rows.max(1);
    let tile = tile_rows(tile, k, n);
    let work = 2 * out.len() * k;
    let panels = Panels::dense(w, k, n, parts[0].rows, precision.of_lines(parts.iter().map(|x| x.cols)));
    parallel::for_each_chunk(out, tile * n, work, |i, out| {
        let rows = out.len() / n;
        let lines: Vec<Line<T>> = parts.iter().map(|x| line(x.rows(i * tile, rows))).collect();
        Product { out, out_step: n, accum: Accum::Replace, lines: &lines, panels: &panels }.run();
        finish.run(out);
    });
}

/// `dx = dy w^T`.
pub(in crate::ops) fn input_gradient<T: Float>(out: &mut [T], accum: Accum, dy: Rows<T>, w: &[T], tile: Tile) {
    let n = dy.cols;
    let k = out.len() / dy.rows.max(1);
    let tile = tile_rows(tile, k, n);
    let work = 2 * out.len() * n;
    let panels = Panels::transposed(w, n, k);
    parallel::for_each_chunk(out, tile * k, work, |i, out| {
        let rows = out.len() / k;
        product(out, accum, dy.rows(i * tile, rows), &panels);
    });
}

/// `out = x panels`, or added to what is there.
pub(in crate::ops) fn product<T: Float>(out: &mut [T], accum: Accum, x: Rows<T>, panels: &Panels<T>) {
    Product { out, out_step: panels.cols(), accum, lines: &[line(x)], panels }.run();
}

/// Rows as the left operand of a product.
fn line<T: Float>(x: Rows<'_, T>) -> Line<'_, T> {
    Line { data: x.data, step: x.row_stride, run: x.cols }
}

/// How many partial sums a weight gradient is made of: depends on the shape alone.
fn partials(rows: usize) -> usize {
    rows.div_ceil(regime::size(256)).clamp(1, 8)
}

/// Rows of a product that adds to a weight's gradient.
const ROWS: usize = 512;

/// `dw = x^T dy` in a fixed number of partial sums, added up in order: the same bits for any number of threads.
pub(in crate::ops) fn weight_gradient<T: Float>(out: &mut [T], accum: Accum, x: Rows<T>, g: Rows<T>) {
    let (rows, k, n) = (x.rows, x.cols, g.cols);
    let parts = partials(rows);
    let step = rows.div_ceil(parts).max(1);
    let product = |part: usize, out: &mut [T], accum| {
        let (from, to) = ((part * step).min(rows), ((part + 1) * step).min(rows));
        begin_sum(out, accum);
        // Sums of sums, as far as rounding goes; and what a product reads stays in the cache.
        for rows in regime::blocks(from..to, ROWS) {
            let (first, count) = (rows.start, rows.len());
            let (a_step, b_step) = (x.row_stride, g.row_stride);
            let terms = &[(x.rows(first, count).data, g.rows(first, count).data)];
            Gram { out, out_step: n, rows: k, cols: n, terms, count, a_step, b_step }.run();
        }
    };
    if parts == 1 {
        return product(0, out, accum);
    }
    let sums =
        parallel::map(parts, 2 * rows * k * n, |part| Tensor::build([k, n], |out| product(part, out, Accum::Replace)));
    sum_into(out, accum, &sums);
}
