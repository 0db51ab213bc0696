//! The linear layer: one product over all the rows of the batch.

use super::fused::{Activation, Finish};
use super::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::gemm::Rows;
use crate::tensor::register_tile::{Gram, Panels, Product};
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// `y [.., out] = x [.., in] w [in, out] (+ b [out])`. A 1x1 convolution is the same thing.
#[derive(Clone, Copy, Debug, Default)]
pub struct Linear {
    /// Rows handed to a thread at a time; chosen by shape if 0. A gradient check shrinks it to reach tile edges.
    pub tile: usize,
}

/// Rows a tile: about 2^17 multiplications, at least 40 rows; or `tile`, if that is given.
fn tile_rows(tile: usize, k: usize, n: usize) -> usize {
    if tile > 0 { tile } else { ((1 << 17) / (k * n).max(1)).clamp(40, 1000).next_multiple_of(20) }
}

/// `out = x w`, finished.
pub(super) fn forward<T: Float>(out: &mut [T], x: Rows<T>, w: &[T], finish: &Finish<T>, tile: usize) {
    let k = x.cols;
    let n = out.len() / x.rows.max(1);
    let tile = tile_rows(tile, k, n);
    let work = 2 * out.len() * k;
    let panels = Panels::dense(w, k, n);
    parallel::for_each_chunk(out, tile * n, work, |i, out| {
        let rows = out.len() / n;
        product(out, Accum::Replace, x.rows(i * tile, rows), &panels);
        finish.run(out);
    });
}

/// `dx = dy w^T`.
pub(crate) fn input_gradient<T: Float>(out: &mut [T], accum: Accum, dy: Rows<T>, w: &[T], tile: usize) {
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
fn product<T: Float>(out: &mut [T], accum: Accum, x: Rows<T>, panels: &Panels<T>) {
    Product { out, accum, lines: &[x.data], step: x.row_stride, run: x.cols, panels }.run();
}

/// How many partial sums a weight gradient is made of: depends on the shape alone.
fn partials(rows: usize) -> usize {
    rows.div_ceil(256).clamp(1, 8)
}

impl<T: Float> Op<T> for Linear {
    /// The rows x, the weight, and whether there is a bias.
    type Saved = (Option<Tensor<T>>, Option<Tensor<T>>);

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let (x, w) = (inputs[0], inputs[1].dims());
        if x.rank() == 0 || w.len() != 2 || w[0] != x.last() {
            return Err(ShapeError::new("expected x [.., in] and w [in, out]"));
        }
        if inputs.get(2).is_some_and(|b| b.dims() != [w[1]]) {
            return Err(ShapeError::new("expected b [out]"));
        }
        Ok(vec![x.with(x.rank() - 1, w[1])])
    }

    fn algo(&self, inputs: &[Shape]) -> &'static str {
        if inputs.len() > 2 { "bias" } else { "no_bias" }
    }

    fn flops(&self, inputs: &[Shape]) -> u64 {
        2 * (inputs[0].rows() * inputs[1].len()) as u64
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let (x, w, b) = (inputs[0], inputs[1], inputs.get(2));
        let shape = x.shape().with(x.shape().rank() - 1, w.dims()[1]);
        let rows = Rows::dense(x.data(), x.shape().rows(), w.dims()[0]);
        let finish = Finish::new(b.map(|b| b.data()), Activation::None);
        let y = Tensor::build(shape, |out| forward(out, rows, w.data(), &finish, self.tile));
        (vec![y], (needs.get(1).then(|| x.clone()), needs.get(0).then(|| w.clone())))
    }

    /// dx = dy w^T, dw = x^T dy, db = the sum of dy's rows.
    fn backward(&self, (x, w): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let (rows, n) = (g.shape().rows(), g.shape().last());
        if let Some(w) = w {
            let g = Rows::dense(g.data(), rows, n);
            sink.accumulate(0, |out, accum| input_gradient(out, accum, g, w.data(), self.tile));
        }
        if let Some(x) = x {
            let k = x.shape().last();
            sink.accumulate(1, |out, accum| {
                weight_gradient(out, accum, Rows::dense(x.data(), rows, k), Rows::dense(g.data(), rows, n));
            });
        }
        sink.accumulate(2, |out, accum| bias_gradient(out, accum, g.data()));
    }
}

/// `dw = x^T dy` in a fixed number of partial sums, added up in order: the same bits for any number of threads.
pub(crate) fn weight_gradient<T: Float>(out: &mut [T], accum: Accum, x: Rows<T>, g: Rows<T>) {
    let (rows, k, n) = (x.rows, x.cols, g.cols);
    let parts = partials(rows);
    let step = rows.div_ceil(parts).max(1);
    let product = |part: usize, out: &mut [T], accum| {
        let (from, to) = ((part * step).min(rows), ((part + 1) * step).min(rows));
        let (x, g) = (x.rows(from, to - from), g.rows(from, to - from));
        if accum == Accum::Replace {
            out.fill(T::ZERO);
        }
        let (terms, count) = (&[(x.data, g.data)], to - from);
        Gram { out, out_step: n, rows: k, cols: n, terms, count, a_step: x.row_stride, b_step: g.row_stride }.run();
    };
    if parts == 1 {
        return product(0, out, accum);
    }
    let sums =
        parallel::map(parts, 2 * rows * k * n, |part| Tensor::build([k, n], |out| product(part, out, Accum::Replace)));
    sum_into(out, accum, &sums);
}

/// Adds up partial sums in order.
pub(crate) fn sum_into<T: Float>(out: &mut [T], accum: Accum, parts: &[Tensor<T>]) {
    let mut parts = parts.iter();
    if accum == Accum::Replace {
        match parts.next() {
            Some(first) => out.copy_from_slice(first.data()),
            None => out.fill(T::ZERO),
        }
    }
    for part in parts {
        out.iter_mut().zip(part.data()).for_each(|(s, &x)| *s += x);
    }
}

/// The sum of the rows of `g`, in blocks: the same bits for any number of threads.
pub(crate) fn bias_gradient<T: Float>(out: &mut [T], accum: Accum, g: &[T]) {
    let n = out.len();
    if n == 0 {
        return;
    }
    const BLOCK: usize = 256;
    let rows = g.len() / n;
    let blocks = parallel::map(rows.div_ceil(BLOCK), g.len(), |i| {
        let rows = &g[i * BLOCK * n..((i + 1) * BLOCK).min(rows) * n];
        Tensor::build([n], |sum| {
            sum.fill(T::ZERO);
            for row in rows.chunks_exact(n) {
                sum.iter_mut().zip(row).for_each(|(s, &g)| *s += g);
            }
        })
    });
    sum_into(out, accum, &blocks);
}

impl Checked for Linear {
    fn cases() -> Vec<Case<Self>> {
        let x = |shape: &[usize]| Input::random("x", shape);
        let w = |k: usize, n: usize| Input::random("w", [k, n]);
        let b = |n: usize| Input::random("b", [n]);
        let tiled = |tile| Linear { tile };
        vec![
            Case::new("with bias", tiled(0), [x(&[2, 3, 5]), w(5, 4), b(4)]),
            Case::new("without bias", tiled(0), [x(&[2, 3, 5]), w(5, 4)]),
            Case::new("a vector", tiled(0), [x(&[5]), w(5, 4), b(4)]),
            Case::new("tile less one", tiled(4), [x(&[3, 5]), w(5, 2), b(2)]),
            Case::new("a whole tile", tiled(4), [x(&[4, 5]), w(5, 2), b(2)]),
            Case::new("tile and one", tiled(4), [x(&[5, 5]), w(5, 2), b(2)]),
            Case::new("partial sums", tiled(0), [x(&[300, 2]), w(2, 3), b(3)]),
            Case::new("partial sums without bias", tiled(0), [x(&[300, 2]), w(2, 3)]),
            Case::new("several register tiles", tiled(0), [x(&[25, 11]), w(11, 17), b(17)]),
            Case::new("no rows", tiled(0), [x(&[0, 2]), w(2, 3), b(3)]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// `x [.., in] w [in, out] (+ b [out])`.
    #[track_caller]
    pub fn linear(&self, weight: &Self, bias: Option<&Self>) -> Self {
        match bias {
            Some(bias) => apply1(Linear::default(), &[self, weight, bias]),
            None => apply1(Linear::default(), &[self, weight]),
        }
    }
}
