//! The three products of a matrix of rows with a weight, tile by tile: outputs, the gradient of the rows, the gradient of
//! the weight. A linear layer is nothing else, and neither is a convolution whose window is one pixel.

use super::epilogue::Finish;
use super::weight_blocks::{Cuts, Pixels};
use crate::ops::Tile;
use crate::tensor::gemm::Rows;
use crate::tensor::register_tile::{Line, Panels, Product};
use crate::tensor::{Accum, Float, Precision, Tensor, parallel};

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

/// `dw = x^T dy`, block by block.
pub(in crate::ops) fn weight_gradient<T: Float>(out: &mut [T], accum: Accum, x: Rows<T>, g: Rows<T>) {
    let pixels = Pixels {
        run: x.cols.max(1),
        width: 1,
        gapless: true,
        a_step: x.row_stride,
        b_step: g.row_stride,
        a: |_: usize, row: usize| &x.data[row * x.row_stride..],
        b: |_: usize, row: usize| &g.data[row * g.row_stride..],
    };
    Cuts::new([x.cols, g.cols], x.rows, 1).sum(out, accum, |block, sum| pixels.add(block, sum));
}
