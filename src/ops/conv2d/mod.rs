//! 2-D convolution: windows times weights. A 1x1 convolution is a product of the pixels as they lie.
//!
//! In this layout the window of one output pixel is `kernel height` contiguous runs of `kernel width * channels` numbers.
//! `direct` multiplies these runs where they lie in a padded row; grouped convolutions, and those dilated along the row,
//! whose windows are not whole runs, are copied into an im2col matrix in tiles that fit the cache (`kernel`). Reflection
//! padding is a matter of what is copied, and costs nothing.

mod direct;
pub(super) mod geometry;
pub(super) mod kernel;

use super::fused::{Activation, Finish};
use super::linear;
use super::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::gemm::Rows;
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var};
use geometry::Geometry;

/// `x [batch, height, width, in]`, `w [kh, kw, in / groups, out]`, optionally `b [out]`
/// -> `[batch, (height + 2 padding - dilation (kh - 1) - 1) / stride + 1, ..., out]`.
///
/// A cross-correlation, as everywhere in deep learning, and an activation if one is set. Depthwise convolution has an op of its own.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Conv2d {
    /// Stride, (height, width).
    pub stride: [usize; 2],
    /// Padding on both sides, (height, width).
    pub padding: [usize; 2],
    /// Dilation, (height, width).
    pub dilation: [usize; 2],
    /// Channels are cut into so many groups, each convolved for itself.
    pub groups: usize,
    /// Whether the padding mirrors the image (without repeating its edge) instead of being zero.
    pub reflect: bool,
    /// Output rows handed to a thread at a time; chosen by shape if 0. A gradient check shrinks it.
    pub tile: usize,
    /// What follows, applied to a tile while it is in the cache.
    pub activation: Activation,
}

impl Default for Conv2d {
    fn default() -> Self {
        Conv2d {
            stride: [1; 2],
            padding: [0; 2],
            dilation: [1; 2],
            groups: 1,
            reflect: false,
            tile: 0,
            activation: Activation::None,
        }
    }
}

impl Conv2d {
    /// Stride 1 and zero padding on all sides.
    pub fn padded(padding: usize) -> Self {
        Conv2d { padding: [padding; 2], ..Self::default() }
    }

    /// The same, with a stride in both directions.
    pub fn strided(self, stride: usize) -> Self {
        Conv2d { stride: [stride; 2], ..self }
    }

    /// The same, with mirrored padding.
    pub fn reflecting(self) -> Self {
        Conv2d { reflect: true, ..self }
    }

    /// The same, with an activation behind it.
    pub fn activated(self, activation: Activation) -> Self {
        Conv2d { activation, ..self }
    }

    fn is_pointwise(&self, kernel: [usize; 2]) -> bool {
        kernel == [1, 1] && self.stride == [1; 2] && self.padding == [0; 2] && self.groups == 1
    }
}

/// A kernel path's names, by the activation behind it.
macro_rules! paths {
    ($path:literal) => {
        [$path, concat!($path, "_relu"), concat!($path, "_hardswish"), concat!($path, "_elu")]
    };
}

impl<T: Float> Op<T> for Conv2d {
    /// The input and the weights, as far as they are needed, how they lie, and what the activation keeps.
    type Saved = (Option<Tensor<T>>, Option<Tensor<T>>, Geometry, Option<Tensor<T>>);

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        if let Some(b) = inputs.get(2)
            && b.dims() != [inputs[1].last()]
        {
            return Err(ShapeError::new("expected b [out]"));
        }
        let g = Geometry::new(self, &inputs[0], &inputs[1])?;
        Ok(vec![Shape::new(&[g.batch, g.out[0], g.out[1], g.out_channels])])
    }

    fn algo(&self, inputs: &[Shape]) -> &'static str {
        let Ok(g) = Geometry::new(self, &inputs[0], &inputs[1]) else { return "none" };
        let [plain, relu, hardswish, elu] = match g.side_by_side() {
            _ if self.is_pointwise(g.kernel) => paths!("pointwise"),
            _ if !g.is_direct() => paths!("im2col"),
            1 if self.reflect => paths!("direct_reflect"),
            1 if self.stride != [1; 2] => paths!("direct_strided"),
            1 => paths!("direct"),
            _ if self.reflect => paths!("side_by_side_reflect"),
            _ if self.stride != [1; 2] => paths!("side_by_side_strided"),
            _ => paths!("side_by_side"),
        };
        match self.activation {
            Activation::None => plain,
            Activation::Relu => relu,
            Activation::Hardswish => hardswish,
            Activation::Elu => elu,
        }
    }

    fn flops(&self, inputs: &[Shape]) -> u64 {
        match Geometry::new(self, &inputs[0], &inputs[1]) {
            Ok(g) => 2 * (g.batch * g.out[0] * g.out[1] * inputs[1].len()) as u64,
            Err(_) => 0,
        }
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let (x, w, b) = (inputs[0], inputs[1], inputs.get(2).map(|b| b.data()));
        let g = Geometry::new(self, x.shape(), w.shape()).expect("checked by the shape rule");
        // What the backward pass cannot do without is kept in a pass of its own.
        let keeps_argument = needs.any() && !self.activation.follows_from_result();
        let finish = Finish::new(b, if keeps_argument { Activation::None } else { self.activation });
        let y = Tensor::build([g.batch, g.out[0], g.out[1], g.out_channels], |out| {
            if self.is_pointwise(g.kernel) {
                linear::forward(out, Rows::dense(x.data(), x.shape().rows(), g.channels), w.data(), &finish, 0);
            } else {
                kernel::convolve(out, Accum::Replace, &g, x.data(), w.data(), &finish);
            }
        });
        let kept = (needs.any() && self.activation != Activation::None).then(|| y.clone());
        let y = if keeps_argument { self.activation.of(&y) } else { y };
        (vec![y], (needs.get(1).then(|| x.clone()), needs.get(0).then(|| w.clone()), g, kept))
    }

    /// Each output is a sum of products of a patch and the weights, so
    /// dw = sum over pixels of patch^T dy, db = sum over pixels of dy, and dx collects w dy from every patch that a
    /// pixel is part of: with stride 1 that is itself a convolution of dy, with the window turned by half a circle.
    ///
    /// An activation turns dy into the gradient of its argument first.
    fn backward(&self, (x, w, g, kept): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let dy = self.activation.backward(kept.as_ref(), upstream.only());
        drop(kept);
        if let Some(w) = w {
            sink.accumulate(0, |out, accum| match self.is_pointwise(g.kernel) {
                true => linear::input_gradient(
                    out,
                    accum,
                    Rows::dense(dy.data(), dy.shape().rows(), g.out_channels),
                    w.data(),
                    0,
                ),
                false => kernel::input_gradient(out, accum, &g, dy.data(), w.data()),
            });
        }
        if let Some(x) = x {
            let rows = x.shape().rows();
            sink.accumulate(1, |out, accum| match self.is_pointwise(g.kernel) {
                true => linear::weight_gradient(
                    out,
                    accum,
                    Rows::dense(x.data(), rows, g.channels),
                    Rows::dense(dy.data(), rows, g.out_channels),
                ),
                false => kernel::weight_gradient(out, accum, &g, x.data(), dy.data()),
            });
        }
        sink.accumulate(2, |out, accum| linear::bias_gradient(out, accum, dy.data()));
    }
}

impl Checked for Conv2d {
    fn cases() -> Vec<Case<Self>> {
        let same = Conv2d::padded(1);
        let case = |name, op: Conv2d, x: [usize; 4], w: [usize; 4], bias: bool| {
            let mut inputs = vec![Input::random("x", x), Input::random("w", w)];
            if bias {
                inputs.push(Input::random("b", [w[3]]));
            }
            Case::new(name, op, inputs)
        };
        let mut cases = vec![
            case("3x3, same size", same, [2, 4, 5, 3], [3, 3, 3, 4], true),
            case("3x3 without bias", same, [2, 4, 5, 3], [3, 3, 3, 4], false),
            case("runs of whole vectors", same, [1, 3, 4, 8], [3, 3, 8, 2], false),
            case("unpadded", Conv2d::default(), [1, 4, 5, 2], [3, 2, 2, 3], true),
            case("padded beyond the window", Conv2d::padded(3), [1, 3, 4, 2], [2, 2, 2, 3], false),
            case("image smaller than the window", Conv2d::padded(2), [1, 2, 1, 2], [5, 5, 2, 2], true),
            case("stride 2", same.strided(2), [2, 5, 6, 2], [3, 3, 2, 3], true),
            case("stride 2, a remainder dropped", same.strided(2), [1, 6, 7, 2], [3, 3, 2, 2], false),
            case("7x7, stride 2", Conv2d::padded(3).strided(2), [1, 7, 8, 2], [7, 7, 2, 2], false),
            case("stride 4, window 4", Conv2d::default().strided(4), [1, 11, 8, 1], [4, 4, 1, 2], true),
            case("stride 2 of 1x1", Conv2d::default().strided(2), [2, 5, 4, 3], [1, 1, 3, 2], false),
            case(
                "different in height and width",
                Conv2d { stride: [2, 3], padding: [1, 2], dilation: [2, 1], groups: 2, ..Conv2d::default() },
                [2, 7, 6, 4],
                [3, 2, 2, 6],
                true,
            ),
            case(
                "dilated",
                Conv2d { padding: [2, 1], dilation: [2, 3], ..Conv2d::default() },
                [1, 5, 8, 2],
                [3, 3, 2, 2],
                false,
            ),
            case("groups, stride 1", Conv2d { groups: 2, ..same }, [2, 3, 4, 4], [3, 3, 2, 6], true),
            case("as many groups as channels", Conv2d { groups: 3, ..same }, [1, 3, 4, 3], [3, 3, 1, 6], false),
            case("reflected", same.reflecting(), [2, 3, 4, 2], [3, 3, 2, 3], true),
            case("reflected, two rows", same.reflecting(), [1, 2, 2, 2], [3, 3, 2, 2], true),
            case("reflected, 5x5", Conv2d::padded(2).reflecting(), [1, 4, 5, 1], [5, 5, 1, 2], false),
            case("reflected, stride 2", same.reflecting().strided(2), [1, 4, 5, 2], [3, 3, 2, 2], false),
            case("1x1", Conv2d::default(), [2, 3, 4, 5], [1, 1, 5, 3], true),
            case("1x1 without bias", Conv2d::default(), [2, 3, 4, 5], [1, 1, 5, 3], false),
            // Strides and padding that cancel: as many pixels as before, but not the same ones.
            case(
                "1x1, strided and padded to the same size",
                Conv2d { stride: [1, 2], padding: [0, 3], ..Conv2d::default() },
                [1, 1, 6, 2],
                [1, 1, 2, 3],
                true,
            ),
            case("tile less one", Conv2d { tile: 4, ..same }, [1, 3, 3, 2], [3, 3, 2, 2], false),
            case("a whole tile", Conv2d { tile: 4, ..same }, [1, 4, 3, 2], [3, 3, 2, 2], false),
            case("tile and one", Conv2d { tile: 4, ..same }, [1, 5, 3, 2], [3, 3, 2, 2], false),
            case("a tile across images", Conv2d { tile: 2, ..same }, [2, 3, 3, 2], [3, 3, 2, 2], false),
            case(
                "tiles of a strided convolution",
                Conv2d { tile: 2, ..same.strided(2) },
                [2, 5, 4, 2],
                [3, 3, 2, 2],
                false,
            ),
            case(
                "tiles of a reflected one",
                Conv2d { tile: 2, ..same.reflecting() },
                [2, 3, 4, 2],
                [3, 3, 2, 2],
                false,
            ),
            case("two side by side", same, [2, 3, 6, 2], [3, 3, 2, 16], true),
            case("four side by side", same, [1, 3, 8, 2], [3, 3, 2, 8], true),
            case("sixteen side by side", same, [1, 2, 16, 2], [3, 3, 2, 1], false),
            case("side by side, wider than the image", Conv2d::padded(2), [1, 2, 4, 1], [5, 5, 1, 2], false),
            case("side by side, 7x7, stride 2", Conv2d::padded(3).strided(2), [1, 5, 8, 2], [7, 7, 2, 4], false),
            case("side by side, unpadded", Conv2d::default(), [2, 3, 6, 2], [3, 3, 2, 3], true),
            case("side by side, reflected", same.reflecting(), [2, 3, 8, 2], [3, 3, 2, 3], true),
            case("side by side, tile and one", Conv2d { tile: 4, ..same }, [1, 5, 4, 2], [3, 3, 2, 2], false),
            case("many channels", same, [1, 3, 5, 1], [3, 3, 1, 70], false),
            case("several register tiles", same, [1, 2, 15, 4], [3, 3, 4, 17], true),
            case("register tiles of few rows and many columns", same, [1, 2, 11, 4], [3, 3, 4, 16], false),
            case("empty batch", same, [0, 4, 5, 3], [3, 3, 3, 4], true).flat(),
        ];
        for activation in [Activation::Relu, Activation::Hardswish, Activation::Elu] {
            let paths = [
                ("activated", same, [2, 4, 5, 3], [3, 3, 3, 4]),
                ("activated, reflected", same.reflecting(), [2, 3, 5, 2], [3, 3, 2, 3]),
                ("activated, stride 2", same.strided(2), [2, 5, 6, 2], [3, 3, 2, 3]),
                ("activated, 1x1", Conv2d::default(), [2, 3, 4, 5], [1, 1, 5, 3]),
                ("activated, groups", Conv2d { groups: 2, ..same }, [2, 3, 4, 4], [3, 3, 2, 6]),
                ("activated, tile and one", Conv2d { tile: 4, ..same }, [1, 5, 3, 2], [3, 3, 2, 2]),
                ("activated, side by side", same, [1, 3, 4, 2], [3, 3, 2, 3]),
                ("activated, reflected, side by side", same.reflecting(), [1, 3, 4, 2], [3, 3, 2, 3]),
                ("activated, stride 2, side by side", Conv2d::padded(3).strided(2), [1, 4, 8, 1], [7, 7, 1, 3]),
            ];
            for (name, op, x, w) in paths {
                cases.push(case(name, op.activated(activation), x, w, true));
            }
            cases.push(case("activated without bias", same.activated(activation), [1, 4, 5, 3], [3, 3, 3, 2], false));
        }
        cases
    }
}

impl<T: Float> Var<T> {
    /// 2-D convolution of an image `[batch, height, width, in]` with `weight [kh, kw, in / groups, out]`.
    #[track_caller]
    pub fn conv2d(&self, weight: &Self, bias: Option<&Self>, op: Conv2d) -> Self {
        match bias {
            Some(bias) => apply1(op, &[self, weight, bias]),
            None => apply1(op, &[self, weight]),
        }
    }
}
