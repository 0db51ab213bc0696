//! The linear layer: one product over all the rows of the batch.

use crate::ops::Tile;
use crate::ops::elementwise::unary::{Function, Gelu};
use crate::ops::support::epilogue::{Activation, Finish};
use crate::ops::support::put::put;
use crate::ops::support::row_products::{forward, input_gradient, product, tile_rows, weight_gradient};
use crate::ops::support::sums::bias_gradient;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::random::Random;
use crate::tensor::gemm::Rows;
use crate::tensor::pool::Buffer;
use crate::tensor::register_tile::Panels;
use crate::tensor::{Accum, Float, GradSink, Precision, Shape, Tensor, Upstream, Var, parallel, regime};

/// Linear layer: `y [.., out] = x [.., in] w [in, out] (+ b [out])`. A 1x1 convolution is the same thing.
#[derive(Clone, Copy, Debug, Default)]
pub struct Linear {
    /// Whether GELU is applied to x first: `y = gelu(x) w + b`, as in the second half of a transformer's MLP.
    /// gelu(x), the widest tensor of a block, is then computed tile by tile and again for the gradient, never kept.
    pub gelu: bool,
    /// Rows handed to a thread at a time.
    pub tile: Tile,
    /// Numbers in which products are taken, in f32's forward pass.
    pub precision: Precision,
}

/// `to = gelu(from)`.
fn gelu<T: Float>(to: &mut [T], from: &[T]) {
    T::dispatch(
        #[inline(always)]
        || to.iter_mut().zip(from).for_each(|(t, &x)| *t = Gelu.f(x)),
    );
}

/// The whole of gelu(x).
fn apply_gelu<T: Float>(x: &Tensor<T>) -> Tensor<T> {
    let chunk = regime::size(1 << 14);
    Tensor::build(*x.shape(), |out| {
        let work = 16 * out.len();
        parallel::for_each_chunk(out, chunk, work, |i, out| gelu(out, &x.data()[i * chunk..][..out.len()]));
    })
}

/// `out = gelu(x) w`, finished; x has rows of k.
fn forward_of_gelu<T: Float>(out: &mut [T], x: Rows<T>, w: &[T], finish: &Finish<T>, tile: Tile, precision: Precision) {
    let k = x.cols;
    let n = out.len() / x.rows.max(1);
    let tile = tile_rows(tile, k, n);
    let work = (2 * n + 16) * x.rows * k;
    let panels = Panels::dense(w, k, n, x.rows, precision.of_lines([k].into_iter()));
    parallel::for_each_chunk(out, tile * n, work, |i, out| {
        let rows = out.len() / n;
        let mut h = Buffer::stale(rows * k);
        gelu(&mut h, &x.data[i * tile * k..][..rows * k]);
        product(out, Accum::Replace, Rows::dense(&h, rows, k), &panels);
        finish.run(out);
    });
}

/// `dx = dy w^T gelu'(x)`.
fn input_gradient_of_gelu<T: Float>(out: &mut [T], accum: Accum, x: &[T], dy: Rows<T>, w: &[T], tile: Tile) {
    let n = dy.cols;
    let k = out.len() / dy.rows.max(1);
    let tile = tile_rows(tile, k, n);
    let work = (2 * n + 32) * out.len();
    let panels = Panels::transposed(w, n, k);
    parallel::for_each_chunk(out, tile * k, work, |i, out| {
        let rows = out.len() / k;
        let mut dh = Buffer::stale(out.len());
        product(&mut dh, Accum::Replace, dy.rows(i * tile, rows), &panels);
        let terms = dh.iter().zip(&x[i * tile * k..]);
        T::dispatch(
            #[inline(always)]
            || put(accum, out.iter_mut().zip(terms).map(|(d, (&dh, &x))| (d, dh * Gelu.df(x)))),
        );
    });
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
        match (self.gelu, inputs.len() > 2) {
            (false, true) => "bias",
            (false, false) => "no_bias",
            (true, true) => "gelu_bias",
            (true, false) => "gelu_no_bias",
        }
    }

    fn flops(&self, inputs: &[Shape]) -> u64 {
        2 * (inputs[0].rows() * inputs[1].len()) as u64
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let (x, w, b) = (inputs[0], inputs[1], inputs.get(2));
        let shape = x.shape().with(x.shape().rank() - 1, w.dims()[1]);
        let rows = Rows::dense(x.data(), x.shape().rows(), w.dims()[0]);
        let finish = Finish::new(b.map(|b| b.data()), Activation::None);
        let y = Tensor::build(shape, |out| match self.gelu {
            true => forward_of_gelu(out, rows, w.data(), &finish, self.tile, self.precision),
            false => forward(out, &[rows], w.data(), &finish, self.tile, self.precision),
        });
        let x_matters = needs.get(1) || self.gelu && needs.get(0);
        (vec![y], (x_matters.then(|| x.clone()), needs.get(0).then(|| w.clone())))
    }

    /// dx = dy w^T, dw = x^T dy, db = the sum of dy's rows; behind GELU, dx = dy w^T gelu'(x) and dw = gelu(x)^T dy.
    fn backward(&self, (x, w): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let (rows, n) = (g.shape().rows(), g.shape().last());
        let dy = Rows::dense(g.data(), rows, n);
        if let Some(w) = w {
            sink.accumulate(0, |out, accum| match x.as_ref().filter(|_| self.gelu) {
                Some(x) => input_gradient_of_gelu(out, accum, x.data(), dy, w.data(), self.tile),
                None => input_gradient(out, accum, dy, w.data(), self.tile),
            });
        }
        if let Some(x) = x {
            let k = x.shape().last();
            sink.accumulate(1, |out, accum| {
                let h = if self.gelu { apply_gelu(&x) } else { x };
                weight_gradient(out, accum, Rows::dense(h.data(), rows, k), dy);
            });
        }
        sink.accumulate(2, |out, accum| bias_gradient(out, accum, dy));
    }
}

impl Checked for Linear {
    fn cases() -> Vec<Case<Self>> {
        let x = |shape: &[usize]| Input::random("x", shape);
        let w = |k: usize, n: usize| Input::random("w", [k, n]);
        let b = |n: usize| Input::random("b", [n]);
        let tiled = |tile| Linear { tile: Tile::of(tile), ..Linear::default() };
        let gelu = |tile| Linear { tile: Tile::of(tile), gelu: true, ..Linear::default() };
        vec![
            Case::new("with bias", tiled(0), [x(&[2, 3, 5]), w(5, 4), b(4)]),
            Case::new("without bias", tiled(0), [x(&[2, 3, 5]), w(5, 4)]),
            Case::new("a vector", tiled(0), [x(&[5]), w(5, 4), b(4)]),
            Case::new("tile less one", tiled(4), [x(&[3, 5]), w(5, 2), b(2)]),
            Case::new("a whole tile", tiled(4), [x(&[4, 5]), w(5, 2), b(2)]),
            Case::new("tile and one", tiled(4), [x(&[5, 5]), w(5, 2), b(2)]),
            Case::new("partial sums", tiled(0), [x(&[300, 2]), w(2, 3), b(3)]),
            Case::new("partial sums without bias", tiled(0), [x(&[300, 2]), w(2, 3)]),
            Case::new("whole panels of weights", tiled(0), [x(&[160, 2]), w(2, 48)]),
            Case::new("several register tiles", tiled(0), [x(&[25, 11]), w(11, 17), b(17)]),
            Case::new("GELU, with bias", gelu(0), [x(&[2, 3, 5]), w(5, 4), b(4)]),
            Case::new("GELU, without bias", gelu(0), [x(&[2, 3, 5]), w(5, 4)]),
            Case::new("GELU, tile and one", gelu(4), [x(&[5, 5]), w(5, 2), b(2)]),
            Case::new("GELU, tiles without bias", gelu(4), [x(&[9, 5]), w(5, 2)]),
            Case::new("GELU, several register tiles", gelu(0), [x(&[25, 11]), w(11, 17), b(17)]),
            Case::new("GELU, partial sums", gelu(0), [x(&[300, 2]), w(2, 3), b(3)]),
            Case::new("GELU, no rows", gelu(0), [x(&[0, 2]), w(2, 3), b(3)]).flat(),
            Case::new("no rows", tiled(0), [x(&[0, 2]), w(2, 3), b(3)]).flat(),
        ]
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        let op = Linear { gelu: random.coin(), tile: Tile::of(random.extreme(0, 5)), ..Linear::default() };
        let [k, n] = [random.pick(&[1, 2, 5, 16, 17]), random.pick(&[1, 2, 8, 17, 33])];
        let mut inputs =
            vec![Input::random("x", [random.extreme(1, 3), random.extreme(1, 9), k]), Input::random("w", [k, n])];
        if random.coin() {
            inputs.push(Input::random("b", [n]));
        }
        Some(Case::drawn(op, inputs))
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

    /// `gelu(x) [.., in] w [in, out] (+ b [out])`, without ever holding the whole of gelu(x).
    #[track_caller]
    pub fn gelu_linear(&self, weight: &Self, bias: Option<&Self>) -> Self {
        let op = Linear { gelu: true, ..Linear::default() };
        match bias {
            Some(bias) => apply1(op, &[self, weight, bias]),
            None => apply1(op, &[self, weight]),
        }
    }
}
