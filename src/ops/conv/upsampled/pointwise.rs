//! The 1x1 window: a product of the small image's pixels, whose results fill squares of four.

use crate::ops::Tile;
use crate::ops::conv::conv2d::geometry::Geometry;
use crate::ops::support::epilogue::Finish;
use crate::ops::support::put::put_run;
use crate::ops::support::{row_products, squares};
use crate::tensor::gemm::Rows;
use crate::tensor::{Accum, Float, Precision, Tensor, parallel};

/// `out = x w` in squares, or added to what is there; and finished.
pub(super) fn convolve<T: Float>(
    out: &mut [T],
    accum: Accum,
    g: &Geometry,
    x: Rows<T>,
    w: &[T],
    finish: &Finish<T>,
    precision: Precision,
) {
    let n = g.out_channels;
    let products = Tensor::build([x.rows, n], |out| {
        row_products::forward(out, &[x], w, &Finish::nothing(), Tile::AUTO, precision)
    });
    let line = g.out[1] * n;
    let work = 2 * out.len();
    if work == 0 {
        return;
    }
    parallel::for_each_unit(out, 4 * line, work, |i, out| {
        let products = &products.data()[i * line..][..line];
        T::dispatch(
            #[inline(always)]
            || {
                for out in out.chunks_exact_mut(2 * line) {
                    for (pair, product) in out.chunks_exact_mut(2 * n).zip(products.chunks_exact(n)) {
                        for out in pair.chunks_exact_mut(n) {
                            put_run(accum, out, product);
                        }
                    }
                }
            },
        );
        finish.run(out);
    });
}

/// The sum of dy over each square: all that the small image sees of it.
pub(super) fn sum_squares<T: Float>(g: &Geometry, dy: &Tensor<T>) -> Tensor<T> {
    let n = g.out_channels;
    Tensor::build([g.batch, g.out[0], g.out[1], n], |out| {
        squares::sum_squares(out, Accum::Replace, dy.data(), [g.out[1], n], 2);
    })
}
