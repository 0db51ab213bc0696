//! 2-D convolution: windows times weights. A 1x1 convolution is a product of the pixels as they lie.
//!
//! In this layout the window of one output pixel is `kernel height` contiguous runs of `kernel width * channels`
//! numbers. `direct` multiplies these runs where they lie in a padded row; grouped convolutions, and those dilated
//! along the row, whose windows are not whole runs, are copied into an im2col matrix in tiles that fit the cache
//! (`kernel`). Reflection padding is a matter of what is copied, and costs nothing.

pub(in crate::ops) mod direct;
pub(in crate::ops) mod geometry;
pub(in crate::ops) mod kernel;
pub(in crate::ops) mod parts;

use crate::ops::Tile;
use crate::ops::support::epilogue::{Activation, paths};
use crate::ops::support::row_products::{self, rows_of};
use crate::ops::support::sums::bias_gradient;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::random::Random;
use crate::tensor::gemm::Rows;
use crate::tensor::{Accum, Float, GradSink, Precision, Shape, Tensor, Upstream, Var};
use geometry::{Geometry, Path};
use parts::Part;

/// `x [batch, height, width, in]`, `w [kh, kw, in / groups, out]`, optionally `b [out]`
/// -> `[batch, (height + 2 padding - dilation (kh - 1) - 1) / stride + 1, ..., out]`.
///
/// A cross-correlation, as everywhere in deep learning, and an activation if one is set. Depthwise convolution has an
/// op of its own.
///
/// x may come in several `parts`, inputs `x_1 .. x_n, w (, b)`: the convolution of their concatenation along the
/// channels, which is never made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Conv2d {
    /// Stride: pixels from one window to the next, (height, width).
    pub stride: [usize; 2],
    /// Padding: rows and columns added on both sides, (height, width).
    pub padding: [usize; 2],
    /// Dilation: pixels from one tap of the window to the next, (height, width).
    pub dilation: [usize; 2],
    /// Number of groups; each sees in / groups input channels.
    pub groups: usize,
    /// Number of parts of x: the first so many inputs, whose channels follow one another. Several parts exclude groups.
    pub parts: usize,
    /// Reflection padding (the edge is not repeated) instead of zero padding.
    pub reflect: bool,
    /// Output rows handed to a thread at a time, chosen by the shapes by default.
    pub tile: Tile,
    /// Activation, applied to each tile of the result while it is in the cache.
    pub activation: Activation,
    /// Numbers in which products are taken, in f32's forward pass.
    pub precision: Precision,
}

impl Default for Conv2d {
    fn default() -> Self {
        Conv2d {
            stride: [1; 2],
            padding: [0; 2],
            dilation: [1; 2],
            groups: 1,
            parts: 1,
            reflect: false,
            tile: Tile::AUTO,
            activation: Activation::None,
            precision: Precision::F32,
        }
    }
}

impl Conv2d {
    /// A convolution with stride 1 and zero padding on all sides.
    pub fn padded(padding: usize) -> Self {
        Conv2d { padding: [padding; 2], ..Self::default() }
    }

    /// This convolution with a stride in both directions.
    pub fn strided(self, stride: usize) -> Self {
        Conv2d { stride: [stride; 2], ..self }
    }

    /// This convolution with reflection padding.
    pub fn reflecting(self) -> Self {
        Conv2d { reflect: true, ..self }
    }

    /// This convolution with an activation applied to its result.
    pub fn activated(self, activation: Activation) -> Self {
        Conv2d { activation, ..self }
    }

    /// The shape of x, whose parts differ in nothing but channels.
    fn image(&self, inputs: &[Shape]) -> Result<Shape, ShapeError> {
        if self.parts == 0 || inputs.len() <= self.parts {
            return Err(ShapeError::new(format!("expected {} parts of x, at least one, then w", self.parts)));
        }
        let parts = &inputs[..self.parts];
        let (first, rank) = (parts[0], parts[0].rank());
        if self.parts == 1 {
            return Ok(first);
        }
        if self.groups > 1 {
            return Err(ShapeError::new("parts of x cannot be grouped"));
        }
        if rank != 4 || parts.iter().any(|s| s.rank() != 4 || s.with(3, 0) != first.with(3, 0)) {
            return Err(ShapeError::new(
                "expected parts of x [batch, height, width, ..] that differ in channels alone",
            ));
        }
        Ok(first.with(3, parts.iter().map(Shape::last).sum()))
    }

    fn geometry(&self, inputs: &[Shape]) -> Result<Geometry, ShapeError> {
        Geometry::new(self, &self.image(inputs)?, &inputs[self.parts])
    }
}

impl<T: Float> Op<T> for Conv2d {
    type Saved = Saved<T>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let g = self.geometry(inputs)?;
        if inputs.get(self.parts + 1).is_some_and(|b| b.dims() != [g.out_channels]) {
            return Err(ShapeError::new("expected b [out]"));
        }
        Ok(vec![Shape::new(&[g.batch, g.out[0], g.out[1], g.out_channels])])
    }

    fn algo(&self, inputs: &[Shape]) -> &'static str {
        let Ok(g) = self.geometry(inputs) else { return "none" };
        let (several, strided) = (self.parts > 1, self.stride != [1; 2]);
        self.activation.among(match g.path() {
            Path::Pointwise if several => paths!("parts_pointwise"),
            Path::Im2col if several => paths!("parts_im2col"),
            Path::Direct if several => paths!("parts_direct"),
            Path::SideBySide(_) if several => paths!("parts_side_by_side"),
            Path::Pointwise => paths!("pointwise"),
            Path::Im2col => paths!("im2col"),
            Path::Direct if self.reflect => paths!("direct_reflect"),
            Path::Direct if strided => paths!("direct_strided"),
            Path::Direct => paths!("direct"),
            Path::SideBySide(_) if self.reflect => paths!("side_by_side_reflect"),
            Path::SideBySide(_) if strided => paths!("side_by_side_strided"),
            Path::SideBySide(_) => paths!("side_by_side"),
        })
    }

    fn flops(&self, inputs: &[Shape]) -> u64 {
        match self.geometry(inputs) {
            Ok(g) => 2 * (g.batch * g.out[0] * g.out[1] * inputs[self.parts].len()) as u64,
            Err(_) => 0,
        }
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let (xs, rest) = inputs.split_at(self.parts);
        let (w, b) = (rest[0], rest.get(1).map(|b| b.data()));
        let shapes: Vec<Shape> = inputs.iter().map(|x| *x.shape()).collect();
        let g = self.geometry(&shapes).expect("checked by the shape rule");
        let (y, kept) = self.activation.after(b, needs.any(), |finish| {
            Tensor::build([g.batch, g.out[0], g.out[1], g.out_channels], |out| match g.path() {
                Path::Pointwise => {
                    let rows: Vec<Rows<T>> = xs.iter().map(|x| rows_of(x)).collect();
                    row_products::forward(out, &rows, w.data(), finish, Tile::AUTO, self.precision);
                }
                _ => kernel::convolve(
                    out,
                    Accum::Replace,
                    &g,
                    &parts_of(xs.iter().copied()),
                    w.data(),
                    finish,
                    self.precision,
                ),
            })
        });
        let inputs = needs.get(self.parts).then(|| xs.iter().copied().cloned().collect());
        let weights = (0..self.parts).any(|i| needs.get(i)).then(|| w.clone());
        let channels = xs.iter().map(|x| x.shape().last()).collect();
        (vec![y], Saved { inputs, weights, channels, geometry: g, kept })
    }

    /// Each output is a sum of products of a patch and the weights, so
    /// dw = sum over pixels of patch^T dy, db = sum over pixels of dy, and dx collects w dy from every patch that a
    /// pixel is part of: with stride 1 that is itself a convolution of dy, with the window turned by half a circle.
    /// A part of x sees the weights of its channels alone.
    ///
    /// An activation turns dy into the gradient of its argument first.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let Saved { inputs, weights, channels, geometry: g, kept } = saved;
        let dy = self.activation.backward(kept.as_ref(), upstream.only());
        drop(kept);
        if let Some(w) = weights {
            let mut first = 0;
            for (i, &count) in channels.iter().enumerate() {
                let part = Geometry { channels: count, ..g };
                sink.accumulate(i, |out, accum| {
                    let some;
                    let w = if count == g.channels {
                        w.data()
                    } else {
                        some = kernel::weights_of(&part, first, g.channels, w.data());
                        &some
                    };
                    match g.path() {
                        Path::Pointwise => row_products::input_gradient(out, accum, rows_of(&dy), w, Tile::AUTO),
                        _ => kernel::input_gradient(out, accum, &part, dy.data(), w),
                    }
                });
                first += count;
            }
        }
        if let Some(xs) = inputs {
            sink.accumulate(self.parts, |out, accum| {
                if g.path() != Path::Pointwise {
                    return kernel::weight_gradient(out, accum, &g, &parts_of(&xs), dy.data());
                }
                let mut rest = out;
                for x in &xs {
                    let (out, others) = std::mem::take(&mut rest).split_at_mut(x.shape().last() * g.out_channels);
                    rest = others;
                    row_products::weight_gradient(out, accum, rows_of(x), rows_of(&dy));
                }
            });
        }
        sink.accumulate(self.parts + 1, |out, accum| bias_gradient(out, accum, rows_of(&dy)));
    }
}

/// What the backward pass needs.
pub struct Saved<T: Float> {
    /// The parts of x, for the gradient of the weights.
    inputs: Option<Vec<Tensor<T>>>,
    /// The weights, for the gradient of x.
    weights: Option<Tensor<T>>,
    /// The channels of each part of x.
    channels: Vec<usize>,
    geometry: Geometry,
    /// What the activation keeps.
    kept: Option<Tensor<T>>,
}

pub(in crate::ops) fn parts_of<'a, T: Float>(xs: impl IntoIterator<Item = &'a Tensor<T>>) -> Vec<Part<'a, T>> {
    xs.into_iter().map(|x| Part { data: x.data(), channels: x.shape().last() }).collect()
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
        let parts = |name, op: Conv2d, [b, h, wd]: [usize; 3], channels: &[usize], w: [usize; 4], bias: bool| {
            const NAMES: [&str; 4] = ["x1", "x2", "x3", "x4"];
            let image = |(&name, &c): (&&'static str, &usize)| Input::random(name, [b, h, wd, c]);
            let mut inputs: Vec<Input> = NAMES.iter().zip(channels).map(image).collect();
            inputs.push(Input::random("w", w));
            if bias {
                inputs.push(Input::random("b", [w[3]]));
            }
            Case::new(name, Conv2d { parts: channels.len(), ..op }, inputs)
        };
        let dilated = Conv2d { padding: [1, 2], dilation: [1, 2], ..Conv2d::default() };
        let tall = Conv2d { padding: [2, 0], dilation: [2, 1], ..Conv2d::default() };
        let mut cases = vec![
            case("3x3, same size", same, [2, 4, 5, 3], [3, 3, 3, 4], true),
            case("3x3 without bias", same, [2, 4, 5, 3], [3, 3, 3, 4], false),
            case("runs of whole vectors", same, [1, 3, 4, 8], [3, 3, 8, 2], false),
            case("unpadded", Conv2d::default(), [1, 4, 5, 2], [3, 2, 2, 3], true),
            case("padded beyond the window", Conv2d::padded(3), [1, 3, 4, 2], [2, 2, 2, 3], false),
            case("image smaller than the window", Conv2d::padded(2), [1, 2, 1, 2], [5, 5, 2, 2], true),
            case("stride 2", same.strided(2), [2, 5, 6, 2], [3, 3, 2, 3], true),
            case("stride 2, three images", same.strided(2), [3, 4, 5, 1], [3, 3, 1, 33], false),
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
            case("reflected, three images", same.reflecting(), [3, 2, 3, 2], [3, 3, 2, 2], true),
            case("reflected, two rows", same.reflecting(), [1, 2, 2, 2], [3, 3, 2, 2], true),
            case("reflected, 5x5", Conv2d::padded(2).reflecting(), [1, 4, 5, 1], [5, 5, 1, 2], false),
            case("reflected, stride 2", same.reflecting().strided(2), [1, 4, 5, 2], [3, 3, 2, 2], false),
            case("1x1", Conv2d::default(), [2, 3, 4, 5], [1, 1, 5, 3], true),
            case("1x1 without bias", Conv2d::default(), [2, 3, 4, 2], [1, 1, 2, 33], false),
            // Strides and padding that cancel: as many pixels as before, but not the same ones.
            case(
                "1x1, strided and padded to the same size",
                Conv2d { stride: [1, 2], padding: [0, 3], ..Conv2d::default() },
                [1, 1, 6, 2],
                [1, 1, 2, 3],
                true,
            ),
            case("tile less one", Conv2d { tile: Tile::of(4), ..same }, [1, 3, 3, 2], [3, 3, 2, 2], false),
            case("a whole tile", Conv2d { tile: Tile::of(4), ..same }, [1, 4, 3, 2], [3, 3, 2, 2], false),
            case("tile and one", Conv2d { tile: Tile::of(4), ..same }, [1, 5, 3, 2], [3, 3, 2, 2], false),
            case("a tile across images", Conv2d { tile: Tile::of(2), ..same }, [2, 3, 3, 2], [3, 3, 2, 2], false),
            case(
                "tiles of a strided convolution",
                Conv2d { tile: Tile::of(2), ..same.strided(2) },
                [2, 5, 4, 2],
                [3, 3, 2, 2],
                false,
            ),
            case(
                "tiles of a reflected one",
                Conv2d { tile: Tile::of(2), ..same.reflecting() },
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
            case("side by side, reflected", same.reflecting(), [2, 3, 8, 2], [3, 3, 2, 9], true),
            case("side by side, tile and one", Conv2d { tile: Tile::of(4), ..same }, [1, 5, 4, 2], [3, 3, 2, 2], false),
            case("many channels", same, [1, 3, 5, 1], [3, 3, 1, 70], false),
            case("several register tiles", same, [1, 2, 15, 4], [3, 3, 4, 17], true),
            case("register tiles of few rows and many columns", same, [1, 2, 11, 4], [3, 3, 4, 16], false),
            parts("two parts", same, [2, 4, 5], &[3, 2], [3, 3, 5, 4], true),
            parts("four parts, one of them empty", same, [1, 3, 4], &[1, 0, 2, 1], [3, 3, 4, 17], false),
            parts("parts, stride 2", same.strided(2), [2, 5, 6], &[2, 1], [3, 3, 3, 3], true),
            parts("parts, reflected", same.reflecting(), [2, 3, 5], &[1, 2], [3, 3, 3, 3], true),
            parts("parts, dilated along the row", dilated, [2, 5, 6], &[1, 2], [3, 3, 3, 2], true),
            parts("parts, dilated down the columns", tall, [2, 5, 4], &[1, 2], [3, 1, 3, 2], false),
            parts("parts, 1x1", Conv2d::default(), [2, 3, 4], &[3, 1, 2], [1, 1, 6, 3], true),
            parts("parts, 1x1, without bias", Conv2d::default(), [1, 5, 6], &[3, 8], [1, 1, 11, 17], false),
            parts("parts, stride 2 of 1x1", Conv2d::default().strided(2), [2, 5, 4], &[1, 2], [1, 1, 3, 2], true),
            parts("parts, side by side", same, [2, 3, 6], &[1, 1], [3, 3, 2, 16], true),
            parts("parts, tile and one", Conv2d { tile: Tile::of(4), ..same }, [1, 5, 3], &[1, 2], [3, 3, 3, 2], false),
            parts("parts of an empty batch", same, [0, 4, 5], &[1, 2], [3, 3, 3, 4], true).flat(),
            case("empty batch", same, [0, 4, 5, 3], [3, 3, 3, 4], true).flat(),
        ];
        for activation in Activation::fused() {
            let paths = [
                // Of 33 outputs: two panels of registers.
                ("activated", same, [2, 4, 5, 1], [3, 3, 1, 33]),
                ("activated, reflected", same.reflecting(), [2, 3, 5, 2], [3, 3, 2, 33]),
                ("activated, stride 2", same.strided(2), [2, 5, 6, 2], [3, 3, 2, 3]),
                ("activated, 1x1", Conv2d::default(), [2, 3, 4, 2], [1, 1, 2, 33]),
                ("activated, groups", Conv2d { groups: 2, ..same }, [2, 3, 4, 4], [3, 3, 2, 6]),
                ("activated, tile and one", Conv2d { tile: Tile::of(4), ..same }, [1, 5, 3, 2], [3, 3, 2, 2]),
                ("activated, side by side", same, [1, 3, 4, 2], [3, 3, 2, 3]),
                ("activated, reflected, side by side", same.reflecting(), [2, 3, 4, 2], [3, 3, 2, 3]),
                ("activated, stride 2, side by side", Conv2d::padded(3).strided(2), [1, 4, 8, 1], [7, 7, 1, 3]),
            ];
            for (name, op, x, w) in paths {
                cases.push(case(name, op.activated(activation), x, w, true));
            }
            let paths = [
                ("parts, activated", same, [3, 3, 3, 4]),
                ("parts, activated, reflected", same.reflecting(), [3, 3, 3, 3]),
                ("parts, activated, 1x1", Conv2d::default(), [1, 1, 3, 2]),
                ("parts, activated, dilated", dilated, [3, 3, 3, 2]),
            ];
            for (name, op, w) in paths {
                cases.push(parts(name, op.activated(activation), [2, 3, 5], &[2, 1], w, true));
            }
            let side_by_side = same.activated(activation);
            cases.push(parts("parts, activated, side by side", side_by_side, [1, 3, 4], &[1, 1], [3, 3, 2, 3], true));
            cases.push(case("activated without bias", same.activated(activation), [1, 4, 5, 3], [3, 3, 3, 2], false));
        }
        cases
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        let groups = random.pick(&[1, 1, 2, 3]);
        let (kernel, stride, dilation) = ([0; 2], [0; 2], [0; 2]);
        let kernel = kernel.map(|_| random.pick(&[1, 2, 3, 5, 7]));
        let op = Conv2d {
            stride: stride.map(|_| random.extreme(1, 4)),
            padding: kernel.map(|k| random.extreme(0, k)),
            dilation: dilation.map(|_| random.extreme(1, 3)),
            groups,
            reflect: random.coin(),
            activation: random.pick(&Activation::ALL),
            tile: Tile::of(random.extreme(0, 5)),
            parts: if groups == 1 { random.extreme(1, 3) } else { 1 },
            precision: Precision::F32,
        };
        let image = [random.extreme(1, 3), random.extreme(1, 7), random.extreme(1, 9)];
        let channels: Vec<usize> = (0..op.parts).map(|_| groups * random.extreme(1, 5)).collect();
        let out = groups * random.pick(&[1, 2, 3, 8, 17]);
        let [b, h, w] = image;
        let mut inputs: Vec<Input> =
            ["x1", "x2", "x3"].into_iter().zip(&channels).map(|(name, &c)| Input::random(name, [b, h, w, c])).collect();
        inputs.push(Input::random("w", [kernel[0], kernel[1], channels.iter().sum::<usize>() / groups, out]));
        if random.coin() {
            inputs.push(Input::random("b", [out]));
        }
        Some(Case::drawn(op, inputs))
    }
}

impl<T: Float> Var<T> {
    /// 2-D convolution of the concatenation along the channels of images `[batch, height, width, ..]`, which is not
    /// made.
    ///
    /// # Panics
    /// If the images differ in more than channels, or the weights do not fit.
    #[track_caller]
    pub fn conv2d_of_parts(parts: &[&Self], weight: &Self, bias: Option<&Self>, op: Conv2d) -> Self {
        let inputs: Vec<&Self> = parts.iter().copied().chain([weight]).chain(bias).collect();
        apply1(Conv2d { parts: parts.len(), ..op }, &inputs)
    }

    /// 2-D convolution of an image `[batch, height, width, in]` with `weight [kh, kw, in / groups, out]`.
    #[track_caller]
    pub fn conv2d(&self, weight: &Self, bias: Option<&Self>, op: Conv2d) -> Self {
        match bias {
            Some(bias) => apply1(op, &[self, weight, bias]),
            None => apply1(op, &[self, weight]),
        }
    }
}
