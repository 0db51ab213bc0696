//! Depthwise convolution: each channel has a window of its own.

pub(crate) mod kernel;

use self::kernel::{Path, Window};
use crate::ops::Tile;
use crate::ops::support::epilogue::{Activation, paths};
use crate::ops::support::sums::bias_gradient;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::random::Random;
use crate::tensor::gemm::{Rows, RowsMut};
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var};

/// `y[oy, ox, c] = b[c] + sum over ky, kx of x[oy stride + ky - padding, ox stride + kx - padding, c] w[ky, kx, c]`,
/// where x [batch, height, width, channels] is 0 outside the image; w [kh, kw, channels], b \[channels\].
#[derive(Clone, Copy, Debug, Default)]
pub struct DepthwiseConv2d {
    /// Stride: pixels from one window to the next.
    pub stride: usize,
    /// Zero padding: rows and columns added on each side.
    pub padding: usize,
    /// Rows handed to a thread at a time.
    pub tile: Tile,
    /// Activation, applied to rows of the result while they are in the cache.
    pub activation: Activation,
}

impl DepthwiseConv2d {
    fn window(&self, x: &Shape, w: &Shape) -> Option<Window> {
        let [batch, height, width, _] = x.nhwc()?;
        let kernel = [*w.dims().first()?, *w.dims().get(1)?];
        Some(Window { batch, height, width, kernel, stride: self.stride, padding: self.padding })
    }
}

impl<T: Float> Op<T> for DepthwiseConv2d {
    /// The input if the weight's gradient is wanted, the weight if the input's is, their shapes, and what the
    /// activation keeps.
    type Saved = (Option<Tensor<T>>, Option<Tensor<T>>, [Shape; 2], Option<Tensor<T>>);

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let (x, w) = (inputs[0], inputs[1]);
        if x.rank() != 4 || w.rank() != 3 || w.last() != x.last() {
            return Err(ShapeError::new("expected x [batch, height, width, channels] and w [kh, kw, channels]"));
        }
        if inputs.get(2).is_some_and(|b| b.dims() != [x.last()]) {
            return Err(ShapeError::new("expected b [channels]"));
        }
        match self.window(&x, &w).and_then(|window| window.output()) {
            Some([h, width]) => Ok(vec![x.with(1, h).with(2, width)]),
            None => Err(ShapeError::new(format!(
                "no window fits, with stride {} and padding {}",
                self.stride, self.padding
            ))),
        }
    }

    fn algo(&self, inputs: &[Shape]) -> &'static str {
        self.activation.among(match Path::of([inputs[1].dims()[0], inputs[1].dims()[1]], self.stride) {
            Path::ThreeByThree => paths!("3x3"),
            Path::ThreeByThreeStrided => paths!("3x3_by_2"),
            Path::FiveByFive => paths!("5x5"),
            Path::SevenBySeven => paths!("7x7"),
            Path::Any => paths!("any"),
        })
    }

    fn flops(&self, inputs: &[Shape]) -> u64 {
        let [h, w] = self.window(&inputs[0], &inputs[1]).and_then(|window| window.output()).unwrap_or([0; 2]);
        2 * (inputs[0].dims()[0] * h * w * inputs[1].len()) as u64
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let (x, w, b) = (inputs[0], inputs[1], inputs.get(2));
        let (window, c) = (self.window(x.shape(), w.shape()).expect("checked by the shape rule"), x.shape().last());
        let [height, width] = window.output().expect("checked by the shape rule");
        let shape = x.shape().with(1, height).with(2, width);
        let (y, kept) = self.activation.after(None, needs.any(), |finish| {
            Tensor::build(shape, |out| {
                let x = Rows::dense(x.data(), x.shape().rows(), c);
                let y = RowsMut::dense(out, shape.rows(), c);
                let bias = b.map(|b| b.data());
                kernel::forward(&window, x, (w.data(), bias), y, Accum::Replace, self.tile, &|rows| finish.run(rows));
            })
        });
        (vec![y], (needs.get(1).then(|| x.clone()), needs.get(0).then(|| w.clone()), [*x.shape(), *w.shape()], kept))
    }

    /// With i = o stride + k - padding: dx\[i\] = sum over those k, o of dy\[o\] w\[k\]; dw\[k\] = sum over o of x\[i\]
    /// dy\[o\]; db = the sum of dy's pixels.
    ///
    /// An activation turns dy into the gradient of its argument first.
    fn backward(&self, (x, w, shapes, kept): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = self.activation.backward(kept.as_ref(), upstream.only());
        drop(kept);
        let window = self.window(&shapes[0], &shapes[1]).expect("checked by the shape rule");
        let c = g.shape().last();
        let g = Rows::dense(g.data(), g.shape().rows(), c);
        if let Some(w) = w {
            sink.accumulate(0, |out, accum| {
                let dx = RowsMut::dense(out, shapes[0].rows(), c);
                kernel::input_gradient(&window, g, w.data(), dx, accum, self.tile);
            });
        }
        if let Some(x) = x {
            sink.accumulate(1, |out, accum| {
                let x = Rows::dense(x.data(), shapes[0].rows(), c);
                kernel::weight_gradient(&window, x, g, out, accum, self.tile);
            });
        }
        sink.accumulate(2, |out, accum| bias_gradient(out, accum, g));
    }
}

impl Checked for DepthwiseConv2d {
    fn cases() -> Vec<Case<Self>> {
        let x = |shape: &[usize]| Input::random("x", shape);
        let w = |kh: usize, kw: usize, c: usize| Input::random("w", [kh, kw, c]);
        let b = |c: usize| Input::random("b", [c]);
        let op = |stride, padding| DepthwiseConv2d { stride, padding, ..DepthwiseConv2d::default() };
        let tiled = |tile| DepthwiseConv2d { tile: Tile::of(tile), ..op(1, 1) };
        let mut cases = vec![
            Case::new("3x3, a whole block", op(1, 1), [x(&[2, 2, 7, 16]), w(3, 3, 16), b(16)]),
            Case::new("3x3, overlapping blocks", op(1, 1), [x(&[2, 2, 6, 18]), w(3, 3, 18)]),
            Case::new("3x3, narrow", op(1, 1), [x(&[2, 3, 7, 8]), w(3, 3, 8), b(8)]),
            Case::new("3x3, narrow and overlapping", op(1, 1), [x(&[1, 3, 7, 12]), w(3, 3, 12)]),
            Case::new("3x3 by 2, odd", op(2, 1), [x(&[1, 3, 9, 17]), w(3, 3, 17), b(17)]),
            Case::new("3x3 by 2, even", op(2, 1), [x(&[1, 4, 8, 17]), w(3, 3, 17)]),
            Case::new("3x3 by 2, narrow", op(2, 1), [x(&[2, 3, 9, 8]), w(3, 3, 8)]),
            Case::new("5x5", op(1, 2), [x(&[1, 3, 9, 18]), w(5, 5, 18), b(18)]),
            Case::new("5x5, narrow", op(1, 2), [x(&[2, 3, 6, 12]), w(5, 5, 12)]),
            Case::new("7x7", op(1, 3), [x(&[1, 3, 10, 16]), w(7, 7, 16), b(16)]),
            Case::new("7x7, narrow", op(1, 3), [x(&[2, 2, 8, 8]), w(7, 7, 8)]),
            Case::new("7x7, smaller image", op(1, 3), [x(&[2, 2, 3, 17]), w(7, 7, 17)]),
            Case::new("one channel", op(1, 1), [x(&[2, 5, 7, 1]), w(3, 3, 1), b(1)]),
            Case::new("three channels", op(2, 1), [x(&[2, 5, 6, 3]), w(3, 3, 3), b(3)]),
            Case::new("no padding", op(1, 0), [x(&[2, 5, 6, 8]), w(3, 3, 8)]),
            Case::new("wide padding", op(1, 2), [x(&[2, 2, 3, 8]), w(3, 3, 8)]),
            Case::new("padding beyond the window", op(1, 3), [x(&[2, 2, 3, 8]), w(3, 3, 8)]),
            Case::new("2x3 by 3", op(3, 1), [x(&[2, 5, 7, 8]), w(2, 3, 8), b(8)]),
            Case::new("4x4 by 2", op(2, 1), [x(&[1, 5, 6, 17]), w(4, 4, 17)]),
            Case::new("1x1 by 2", op(2, 0), [x(&[2, 5, 6, 3]), w(1, 1, 3)]),
            Case::new("tile less one", tiled(4), [x(&[1, 3, 5, 8]), w(3, 3, 8)]),
            Case::new("a whole tile", tiled(4), [x(&[2, 2, 5, 8]), w(3, 3, 8)]),
            Case::new("tile and one", tiled(4), [x(&[1, 5, 5, 8]), w(3, 3, 8)]),
            Case::new(
                "tiles by 2",
                DepthwiseConv2d { tile: Tile::of(2), ..op(2, 1) },
                [x(&[2, 5, 4, 8]), w(3, 3, 8), b(8)],
            ),
            Case::new("no image", op(1, 1), [x(&[0, 3, 3, 8]), w(3, 3, 8), b(8)]).flat(),
        ];
        for activation in Activation::fused() {
            let activated = |op| DepthwiseConv2d { activation, ..op };
            cases.extend([
                Case::new("3x3, activated", activated(op(1, 1)), [x(&[2, 2, 7, 16]), w(3, 3, 16), b(16)]),
                Case::new("3x3 by 2, activated", activated(op(2, 1)), [x(&[1, 3, 9, 17]), w(3, 3, 17), b(17)]),
                Case::new("5x5, activated", activated(op(1, 2)), [x(&[1, 3, 6, 18]), w(5, 5, 18)]),
                Case::new("7x7, activated", activated(op(1, 3)), [x(&[1, 3, 8, 12]), w(7, 7, 12), b(12)]),
                Case::new("2x3 by 3, activated", activated(op(3, 1)), [x(&[2, 5, 7, 8]), w(2, 3, 8), b(8)]),
                Case::new("tile and one, activated", activated(tiled(4)), [x(&[1, 5, 5, 8]), w(3, 3, 8)]),
            ]);
        }
        cases
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        let kernel = random.pick(&[1, 3, 5, 7]);
        let op = DepthwiseConv2d {
            stride: random.extreme(1, 3),
            padding: random.extreme(0, kernel),
            tile: Tile::of(random.extreme(0, 5)),
            activation: random.pick(&Activation::ALL),
        };
        let channels = random.pick(&[1, 3, 8, 16, 17, 33]);
        let image = [random.extreme(1, 3), random.extreme(1, 6), random.extreme(1, 9), channels];
        let mut inputs = vec![Input::random("x", image), Input::random("w", [kernel, kernel, channels])];
        if random.coin() {
            inputs.push(Input::random("b", [channels]));
        }
        Some(Case::drawn(op, inputs))
    }
}

impl<T: Float> Var<T> {
    /// Convolves each channel of [batch, height, width, channels] with its own window w [kh, kw, channels], and adds
    /// its bias \[channels\]. `padding` zeros on each side.
    #[track_caller]
    pub fn depthwise_conv2d(&self, weight: &Self, bias: Option<&Self>, stride: usize, padding: usize) -> Self {
        self.depthwise(weight, bias, DepthwiseConv2d { stride, padding, ..DepthwiseConv2d::default() })
    }

    /// The same, with all its attributes.
    #[track_caller]
    pub fn depthwise(&self, weight: &Self, bias: Option<&Self>, op: DepthwiseConv2d) -> Self {
        match bias {
            Some(bias) => apply1(op, &[self, weight, bias]),
            None => apply1(op, &[self, weight]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;
    use crate::tensor::{Accum, Tape};

    fn random(shape: impl Into<Shape>, seed: u64) -> Tensor<f64> {
        Input::random("", shape).draw(&mut Random::new(seed, 0))
    }

    /// The definition, term by term.
    fn naive(x: &Tensor<f64>, w: &Tensor<f64>, b: &[f64], stride: usize, padding: usize) -> Tensor<f64> {
        let ([n, h, width, c], [kh, kw]) = (x.shape().nhwc().unwrap(), [w.dims()[0], w.dims()[1]]);
        let [oh, ow] = [(h + 2 * padding - kh) / stride + 1, (width + 2 * padding - kw) / stride + 1];
        let mut y = Tensor::zeros([n, oh, ow, c]);
        for (i, y) in y.data_mut().iter_mut().enumerate() {
            let (ch, ox, oy, n) = (i % c, i / c % ow, i / c / ow % oh, i / c / ow / oh);
            *y = b[ch];
            for (ky, kx) in (0..kh).flat_map(|ky| (0..kw).map(move |kx| (ky, kx))) {
                let (iy, ix) = (oy * stride + ky, ox * stride + kx);
                if (padding..h + padding).contains(&iy) && (padding..width + padding).contains(&ix) {
                    *y += x.at(&[n, iy - padding, ix - padding, ch]) * w.at(&[ky, kx, ch]);
                }
            }
        }
        y
    }

    #[test]
    fn every_path_agrees_with_the_definition() {
        for (k, stride, padding) in [(3, 1, 1), (3, 2, 1), (5, 1, 2), (7, 1, 3), (4, 3, 2), (1, 1, 0)] {
            for c in [1, 3, 8, 12, 16, 17, 48] {
                for width in [4, 9, 13] {
                    let (x, w, b) = (random([2, 5, width, c], 1), random([k, k, c], 2), random([c], 3));
                    let [xv, wv, bv] = [&x, &w, &b].map(|t| Var::constant(t.clone()));
                    let y = xv.depthwise_conv2d(&wv, Some(&bv), stride, padding);
                    let expected = naive(&x, &w, b.data(), stride, padding);
                    assert_eq!(y.shape(), expected.shape());
                    for (a, b) in y.value().data().iter().zip(expected.data()) {
                        assert!((a - b).abs() < 1e-12, "{k}x{k} by {stride}, {c} channels: {a} for {b}");
                    }
                }
            }
        }
    }

    /// A range of channels of a wider tensor gives what a copy of the range gives, in both directions, and leaves the
    /// other channels alone.
    #[test]
    fn a_range_of_channels_is_convolved_where_it_lies() {
        for stride in [1, 2] {
            let (wide, first, c) = (40, 7, 18);
            let window = Window { batch: 2, height: 5, width: 7, kernel: [3, 3], stride, padding: 1 };
            let [oh, ow] = window.output().unwrap();
            let (rows, out_rows) = (2 * 5 * 7, 2 * oh * ow);
            let (x, g, w) = (random([rows, wide], 1), random([out_rows, wide], 2), random([3, 3, c], 3));
            let columns = |t: &Tensor<f64>| {
                let rows = t.data().chunks_exact(wide).flat_map(|row| row[first..first + c].to_vec());
                Tensor::from_vec([t.dims()[0], c], rows.collect())
            };
            let tape = Tape::new();
            let [xv, wv] = [tape.leaf(columns(&x).reshape([2, 5, 7, c])), tape.leaf(w.clone())];
            let y = xv.depthwise_conv2d(&wv, None, stride, 1);
            let mut gradients = tape.backward(&[(&y, columns(&g).reshape([2, oh, ow, c]))]);

            let x_part = Rows::columns(x.data(), rows, wide, first, c);
            let g_part = Rows::columns(g.data(), out_rows, wide, first, c);
            let mut out = Tensor::full([out_rows, wide], 0.5);
            let to = RowsMut::columns(out.data_mut(), out_rows, wide, first, c);
            kernel::forward(&window, x_part, (w.data(), None), to, Accum::Replace, Tile::AUTO, &|_| ());
            assert!(columns(&out).reshape(*y.shape()).same_bits(y.value()));
            assert_eq!(out.data().iter().filter(|&&v| v == 0.5).count(), out_rows * (wide - c));

            let mut dx = Tensor::full([rows, wide], 0.5);
            let to = RowsMut::columns(dx.data_mut(), rows, wide, first, c);
            kernel::input_gradient(&window, g_part, w.data(), to, Accum::Replace, Tile::AUTO);
            assert!(columns(&dx).reshape([2, 5, 7, c]).same_bits(&gradients.take(&xv).unwrap()));
            assert_eq!(dx.data().iter().filter(|&&v| v == 0.5).count(), rows * (wide - c));

            let mut dw = Tensor::zeros([3, 3, c]);
            kernel::weight_gradient(&window, x_part, g_part, dw.data_mut(), Accum::Replace, Tile::AUTO);
            assert!(dw.same_bits(&gradients.take(&wv).unwrap()));
        }
    }
}
