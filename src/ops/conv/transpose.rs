//! Transposed 2-D convolution: the gradient of a convolution as a forward pass, which spreads every pixel over a
//! window.

use super::conv2d::geometry::{Beyond, Geometry};
use super::conv2d::kernel;
use super::conv2d::parts::whole;
use crate::ops::Tile;
use crate::ops::support::epilogue::Finish;
use crate::ops::support::row_products::rows_of;
use crate::ops::support::sums::bias_gradient;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::random::Random;
use crate::tensor::{Accum, Float, GradSink, Precision, Shape, Tensor, Upstream, Var};

/// `x [batch, height, width, in]`, `w [kh, kw, out / groups, in]`, optionally `b [out]`
/// -> `[batch, (height - 1) stride - 2 padding + dilation (kh - 1) + output padding + 1, ..., out]`: pixel i times tap
/// k of the window is added to pixel `i stride + k dilation - padding`.
///
/// It is the transpose of a [`Conv2d`](crate::ops::Conv2d) from `out` to `in` channels, with the same weights as they
/// lie: `<conv2d(y, w), x> = <y, conv_transpose2d(x, w)>`. PyTorch's weights `[in, out / groups, kh, kw]` become these
/// by the permutation `[2, 3, 1, 0]`.
///
/// With a stride, images of several sizes are convolved to one size; the output padding says to which of them the
/// transpose goes back. It adds rows and columns at the end, which the window may reach.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConvTranspose2d {
    /// Stride: pixels of the output from one pixel of the input to the next, (height, width).
    pub stride: [usize; 2],
    /// Padding: rows and columns taken off the output on both sides, (height, width).
    pub padding: [usize; 2],
    /// Dilation: pixels from one tap of the window to the next, (height, width).
    pub dilation: [usize; 2],
    /// Output padding: rows and columns added at the end of the output, (height, width), fewer than stride or dilation.
    pub output_padding: [usize; 2],
    /// Number of groups; each sees in / groups input channels.
    pub groups: usize,
    /// Rows of pixels handed to a thread at a time, chosen by the shapes by default.
    pub tile: Tile,
}

impl Default for ConvTranspose2d {
    fn default() -> Self {
        ConvTranspose2d {
            stride: [1; 2],
            padding: [0; 2],
            dilation: [1; 2],
            output_padding: [0; 2],
            groups: 1,
            tile: Tile::AUTO,
        }
    }
}

impl ConvTranspose2d {
    /// The convolution of which this is the transpose: its input is the output here.
    fn geometry(&self, x: &Shape, w: &Shape) -> Result<Geometry, ShapeError> {
        let (Some([batch, h, wd, channels]), Some([kh, kw, per_group, inputs])) = (x.nhwc(), w.nhwc()) else {
            return Err(ShapeError::new("expected x [batch, height, width, in] and w [kh, kw, out / groups, in]"));
        };
        if channels != inputs || self.groups == 0 || channels % self.groups != 0 {
            return Err(ShapeError::new(format!(
                "{channels} channels in {} groups do not fit the weights",
                self.groups
            )));
        }
        let mut out = [0; 2];
        for d in 0..2 {
            let (size, kernel) = ([h, wd][d], [kh, kw][d]);
            let (stride, dilation, extra) = (self.stride[d], self.dilation[d], self.output_padding[d]);
            if kernel == 0 || stride == 0 || dilation == 0 {
                return Err(ShapeError::new("window, stride and dilation are at least 1"));
            }
            if extra >= stride && extra >= dilation {
                return Err(ShapeError::new(format!(
                    "an output padding of {extra} is not less than the stride {stride} or the dilation {dilation}"
                )));
            }
            if size == 0 || channels == 0 || per_group == 0 {
                return Err(ShapeError::new("images and windows have at least one pixel and one channel"));
            }
            let full = (size - 1) * stride + dilation * (kernel - 1) + extra + 1;
            out[d] = full.checked_sub(2 * self.padding[d]).filter(|&n| n > 0).ok_or_else(|| {
                ShapeError::new(format!("a padding of {} leaves nothing of an extent of {full}", self.padding[d]))
            })?;
        }
        Ok(Geometry {
            batch,
            size: out,
            channels: per_group * self.groups,
            out: [h, wd],
            out_channels: channels,
            kernel: [kh, kw],
            stride: self.stride,
            padding: self.padding,
            dilation: self.dilation,
            groups: self.groups,
            beyond: Beyond::Zero,
            tile: self.tile,
        })
    }
}

impl<T: Float> Op<T> for ConvTranspose2d {
    /// The input and the weights, as far as they are needed, and how they lie.
    type Saved = (Option<Tensor<T>>, Option<Tensor<T>>, Geometry);

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let g = self.geometry(&inputs[0], &inputs[1])?;
        if inputs.get(2).is_some_and(|b| b.dims() != [g.channels]) {
            return Err(ShapeError::new("expected b [out]"));
        }
        Ok(vec![Shape::new(&[g.batch, g.size[0], g.size[1], g.channels])])
    }

    fn algo(&self, inputs: &[Shape]) -> &'static str {
        match self.geometry(&inputs[0], &inputs[1]).ok().and_then(|g| g.transposed()) {
            Some(g) if g.is_direct() => "direct",
            Some(_) => "im2col",
            None => "col2im",
        }
    }

    fn flops(&self, inputs: &[Shape]) -> u64 {
        2 * (inputs[0].dims()[..3].iter().product::<usize>() * inputs[1].len()) as u64
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let [x, w] = [inputs[0], inputs[1]];
        let g = self.geometry(x.shape(), w.shape()).expect("checked by the shape rule");
        let y = Tensor::build([g.batch, g.size[0], g.size[1], g.channels], |out| {
            let accum = match inputs.get(2) {
                Some(b) => {
                    out.chunks_exact_mut(g.channels).for_each(|pixel| pixel.copy_from_slice(b.data()));
                    Accum::Add
                }
                None => Accum::Replace,
            };
            kernel::input_gradient(out, accum, &g, x.data(), w.data());
        });
        (vec![y], (needs.get(1).then(|| x.clone()), needs.get(0).then(|| w.clone()), g))
    }

    /// y = C^T x + b, where C is the matrix of the convolution, so dx = C dy: the convolution of dy. And y . dy = x . C
    /// dy: dw is that of a convolution whose input is dy and whose output has the gradient x. db = sum over pixels of
    /// dy.
    fn backward(&self, (x, w, g): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let dy = upstream.only();
        if let Some(w) = w {
            sink.accumulate(0, |out, accum| {
                kernel::convolve(out, accum, &g, &whole(&g, dy.data()), w.data(), &Finish::nothing(), Precision::F32)
            });
        }
        if let Some(x) = x {
            sink.accumulate(1, |out, accum| kernel::weight_gradient(out, accum, &g, &whole(&g, dy.data()), x.data()));
        }
        sink.accumulate(2, |out, accum| bias_gradient(out, accum, rows_of(&dy)));
    }
}

impl Checked for ConvTranspose2d {
    fn cases() -> Vec<Case<Self>> {
        let plain = ConvTranspose2d::default();
        let by = |stride| ConvTranspose2d { stride: [stride; 2], ..plain };
        let case = |name, op: ConvTranspose2d, x: [usize; 4], w: [usize; 4], bias: bool| {
            let mut inputs = vec![Input::random("x", x), Input::random("w", w)];
            if bias {
                inputs.push(Input::random("b", [w[2] * op.groups]));
            }
            Case::new(name, op, inputs)
        };
        let asymmetric =
            ConvTranspose2d { stride: [2, 3], padding: [1, 2], dilation: [2, 1], output_padding: [1, 2], ..plain };
        let padded = |padding| ConvTranspose2d { padding: [padding; 2], ..plain };
        vec![
            case("3x3, stride 1", plain, [2, 3, 4, 2], [3, 3, 3, 2], true),
            case("3x3, stride 1, same size", padded(1), [1, 3, 4, 2], [3, 3, 2, 2], false),
            case("stride 2", by(2), [2, 3, 2, 2], [3, 3, 3, 2], true),
            case("stride 2 without bias", by(2), [2, 3, 2, 2], [3, 3, 3, 2], false),
            case(
                "twice the size",
                ConvTranspose2d { stride: [2; 2], padding: [1; 2], output_padding: [1; 2], ..plain },
                [1, 3, 4, 2],
                [3, 3, 2, 2],
                true,
            ),
            case("window 4, stride 4", by(4), [1, 2, 3, 1], [4, 4, 2, 1], false),
            case(
                "window 4, stride 4, the largest output padding",
                ConvTranspose2d { output_padding: [3; 2], ..by(4) },
                [1, 2, 2, 2],
                [4, 4, 1, 2],
                true,
            ),
            case("gaps between windows", by(3), [1, 3, 2, 2], [2, 1, 2, 2], true),
            case("different in height and width", asymmetric, [2, 3, 4, 2], [3, 4, 3, 2], true),
            case(
                "different, in groups",
                ConvTranspose2d { groups: 2, ..asymmetric },
                [1, 3, 3, 4],
                [2, 5, 3, 4],
                false,
            ),
            case(
                "groups, stride 2, dilated",
                ConvTranspose2d { groups: 2, stride: [2; 2], dilation: [2; 2], padding: [1; 2], ..plain },
                [2, 3, 3, 4],
                [3, 3, 2, 4],
                true,
            ),
            case(
                "as many groups as channels",
                ConvTranspose2d { groups: 3, ..by(2) },
                [1, 2, 3, 3],
                [3, 3, 2, 3],
                false,
            ),
            case("groups, stride 1", ConvTranspose2d { groups: 2, ..plain }, [1, 3, 2, 4], [2, 3, 3, 4], true),
            case(
                "output padding beyond the stride",
                ConvTranspose2d { dilation: [3, 2], output_padding: [2, 1], ..plain },
                [1, 2, 3, 2],
                [2, 2, 2, 2],
                true,
            ),
            case("padded beyond the window", padded(2), [1, 6, 5, 2], [2, 2, 3, 2], true),
            case("one pixel is left", padded(1), [1, 1, 1, 2], [3, 3, 2, 2], false),
            case("1x1", plain, [2, 3, 2, 3], [1, 1, 4, 3], true),
            case("1x1, stride 2", by(2), [2, 3, 2, 3], [1, 1, 2, 3], false),
            case("three images, stride 2", by(2), [3, 2, 3, 2], [3, 3, 2, 2], true),
            case("tile less one", ConvTranspose2d { tile: Tile::of(4), ..by(2) }, [1, 3, 2, 2], [3, 3, 2, 2], false),
            case("a whole tile", ConvTranspose2d { tile: Tile::of(4), ..by(2) }, [1, 4, 2, 2], [3, 3, 2, 2], false),
            case("tile and one", ConvTranspose2d { tile: Tile::of(4), ..by(2) }, [1, 5, 2, 2], [3, 3, 2, 2], false),
            case(
                "a tile across images",
                ConvTranspose2d { tile: Tile::of(2), ..padded(1) },
                [2, 3, 3, 2],
                [3, 3, 2, 2],
                true,
            ),
            case("empty batch", by(2), [0, 3, 2, 2], [3, 3, 3, 2], true).flat(),
        ]
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        let groups = random.pick(&[1, 1, 2, 3]);
        let kernel = [random.extreme(1, 5), random.extreme(1, 5)];
        let stride = [random.extreme(1, 4), random.extreme(1, 4)];
        let op = ConvTranspose2d {
            stride,
            padding: kernel.map(|k| random.extreme(0, k - 1)),
            dilation: [random.extreme(1, 3), random.extreme(1, 3)],
            output_padding: stride.map(|s| random.extreme(0, s - 1)),
            groups,
            tile: Tile::of(random.extreme(0, 5)),
        };
        let (c, out) = (groups * random.extreme(1, 4), random.extreme(1, 5));
        let image = [random.extreme(1, 3), random.extreme(1, 5), random.extreme(1, 5), c];
        let mut inputs = vec![Input::random("x", image), Input::random("w", [kernel[0], kernel[1], out, c])];
        if random.coin() {
            inputs.push(Input::random("b", [out * groups]));
        }
        Some(Case::drawn(op, inputs))
    }
}

impl<T: Float> Var<T> {
    /// Transposed 2-D convolution of an image `[batch, height, width, in]` with `weight [kh, kw, out / groups, in]` and
    /// a bias `[out]`.
    #[track_caller]
    pub fn conv_transpose2d(&self, weight: &Self, bias: Option<&Self>, op: ConvTranspose2d) -> Self {
        match bias {
            Some(bias) => apply1(op, &[self, weight, bias]),
            None => apply1(op, &[self, weight]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::Conv2d;
    use crate::random::Random;

    fn noise(shape: impl Into<Shape>, random: &mut Random) -> Var<f64> {
        let draw = |out: &mut [f64]| out.iter_mut().for_each(|x| *x = random.uniform(-1.0, 1.0));
        Var::constant(Tensor::build(shape, draw))
    }

    /// The definition: every pixel times every tap goes to its place.
    fn spread(op: &ConvTranspose2d, x: &Tensor<f64>, w: &Tensor<f64>, shape: &Shape) -> Tensor<f64> {
        let (&[batch, h, width, channels], &[kh, kw, og, _]) = (x.dims(), w.dims()) else { panic!("images") };
        let (&[_, oh, ow, out], cg) = (shape.dims(), channels / op.groups) else { panic!("an image") };
        let mut y = Tensor::zeros(*shape);
        let place = |d: usize, i: usize, k: usize, n: usize| {
            (i * op.stride[d] + k * op.dilation[d]).checked_sub(op.padding[d]).filter(|&o| o < n)
        };
        for (b, iy, ix) in (0..batch * h * width).map(|i| (i / (h * width), i / width % h, i % width)) {
            for (ky, kx) in (0..kh * kw).map(|k| (k / kw, k % kw)) {
                let (Some(oy), Some(ox)) = (place(0, iy, ky, oh), place(1, ix, kx, ow)) else { continue };
                for (c, j) in (0..channels * og).map(|i| (i / og, i % og)) {
                    let to = ((b * oh + oy) * ow + ox) * out + c / cg * og + j;
                    y.data_mut()[to] += x.at(&[b, iy, ix, c]) * w.at(&[ky, kx, j, c]);
                }
            }
        }
        y
    }

    #[test]
    fn every_pixel_is_spread_over_its_window() {
        let mut random = Random::new(1, 0);
        for case in ConvTranspose2d::cases() {
            let [x, w] = [0, 1].map(|i| noise(case.terms.inputs[i].shape, &mut random));
            let bias = case.terms.inputs.get(2).map(|b| noise(b.shape, &mut random));
            let y = x.conv_transpose2d(&w, bias.as_ref(), case.op);
            let mut expected = Var::constant(spread(&case.op, x.value(), w.value(), y.shape()));
            if let Some(b) = &bias {
                expected = &expected + b;
            }
            let far = (&y - &expected).value().data().iter().fold(0.0f64, |m, d| m.max(d.abs()));
            assert!(far < 1e-13, "{}: off by {far:e}", case.terms.name);
        }
    }

    #[test]
    fn it_is_the_transpose_of_the_convolution_with_the_same_weights() {
        let mut random = Random::new(2, 0);
        let mut remainders = 0;
        for (h, kernel, stride) in (1..=9).flat_map(|h| (1..=4).flat_map(move |k| (1..=4).map(move |s| (h, k, s)))) {
            for (padding, dilation, groups) in [(0, 1, 1), (1, 1, 2), (0, 2, 1), (2, 2, 2), (1, 3, 2)] {
                // The width differs from the height in everything.
                let (size, kernel) = ([h, h + 2usize], [kernel, 2usize]);
                let (stride, padding, dilation) = ([stride, 2], [padding, 1usize], [dilation, 2usize]);
                let room = |d: usize| (size[d] + 2 * padding[d]).checked_sub(dilation[d] * (kernel[d] - 1) + 1);
                let (Some(rows), Some(columns)) = (room(0), room(1)) else { continue };
                let output_padding = [rows % stride[0], columns % stride[1]];
                remainders += usize::from(output_padding[0] > 0);
                let y = noise([2, size[0], size[1], 2 * groups], &mut random);
                let w = noise([kernel[0], kernel[1], 2, 3 * groups], &mut random);
                let conv = Conv2d { stride, padding, dilation, groups, ..Conv2d::default() };
                let convolved = y.conv2d(&w, None, conv);
                let x = noise(*convolved.shape(), &mut random);
                let op = ConvTranspose2d { stride, padding, dilation, output_padding, groups, tile: Tile::AUTO };
                let back = x.conv_transpose2d(&w, None, op);
                assert_eq!(back.shape(), y.shape());
                let (left, right) = ((&convolved * &x).sum_all(), (&back * &y).sum_all());
                let apart = (left.value().item() - right.value().item()).abs();
                assert!(apart < 1e-12, "{op:?} of {size:?}: apart by {apart:e}");
            }
        }
        assert!(remainders > 100, "only {remainders} sizes leave a remainder");
    }

    #[test]
    fn stride_padding_and_output_padding_are_where_they_belong() {
        let x = Var::constant(Tensor::from_vec([1, 1, 2, 1], vec![1.0f32, 2.0]));
        let w = Var::constant(Tensor::from_vec([1, 3, 1, 1], vec![1.0, 10.0, 100.0]));
        let run = |stride, padding, output_padding| {
            let op = ConvTranspose2d {
                stride: [1, stride],
                padding: [0, padding],
                output_padding: [0, output_padding],
                ..Default::default()
            };
            x.conv_transpose2d(&w, None, op).value().data().to_vec()
        };
        assert_eq!(run(1, 0, 0), [1.0, 12.0, 120.0, 200.0]);
        assert_eq!(run(2, 0, 0), [1.0, 10.0, 102.0, 20.0, 200.0]);
        assert_eq!(run(2, 1, 0), [10.0, 102.0, 20.0]);
        assert_eq!(run(2, 1, 1), [10.0, 102.0, 20.0, 200.0]);
        assert_eq!(run(4, 0, 3), [1.0, 10.0, 100.0, 0.0, 2.0, 20.0, 200.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn weights_of_pytorch_are_permuted() {
        // Two channels in, three out; a window of one row and two columns: [in, out, kh, kw].
        let theirs = Tensor::from_vec([2, 3, 1, 2], (0..12).map(f64::from).collect());
        let w = Var::constant(theirs.permute(&[2, 3, 1, 0]));
        assert_eq!(w.dims(), [1, 2, 3, 2]);
        let x = Var::constant(Tensor::from_vec([1, 1, 1, 2], vec![1.0, 100.0]));
        let y = x.conv_transpose2d(&w, None, ConvTranspose2d::default());
        for (o, k) in (0..6).map(|i| (i / 2, i % 2)) {
            assert_eq!(y.value().at(&[0, 0, k, o]), theirs.at(&[0, o, 0, k]) + 100.0 * theirs.at(&[1, o, 0, k]));
        }
    }

    #[test]
    #[should_panic(
        expected = "conv_transpose2d: an output padding of 2 is not less than the stride 2 or the dilation 1"
    )]
    fn output_padding_stays_below_the_stride_or_the_dilation() {
        let (x, w) = (Tensor::<f32>::zeros([1, 2, 2, 1]), Tensor::zeros([3, 3, 1, 1]));
        let op = ConvTranspose2d { stride: [2; 2], output_padding: [0, 2], ..Default::default() };
        Var::constant(x).conv_transpose2d(&Var::constant(w), None, op);
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let x = [1, 2, 2, 4];
        let refused = |op: ConvTranspose2d, x: [usize; 4], w: [usize; 4], b: usize| {
            Op::<f32>::shape(&op, &[x.into(), w.into(), [b].into()]).is_err()
        };
        let plain = ConvTranspose2d::default();
        assert!(!refused(plain, x, [3, 3, 2, 4], 2));
        assert!(refused(plain, x, [3, 3, 2, 5], 2), "other channels");
        assert!(refused(plain, x, [3, 3, 2, 4], 4), "a bias of other channels");
        assert!(!refused(ConvTranspose2d { groups: 2, ..plain }, x, [3, 3, 2, 4], 4));
        assert!(refused(ConvTranspose2d { groups: 3, ..plain }, x, [3, 3, 2, 4], 6), "groups that do not divide");
        assert!(refused(ConvTranspose2d { padding: [2; 2], ..plain }, x, [3, 3, 2, 4], 2), "nothing left");
        assert!(refused(plain, [1, 0, 2, 4], [3, 3, 2, 4], 2), "no rows");
        assert!(refused(ConvTranspose2d { stride: [0; 2], ..plain }, x, [3, 3, 2, 4], 2), "no stride");
    }
}
