//! A convolution of an image whose first channels come at half the size and are enlarged on the way, each pixel to a
//! square of four (nearest neighbour).
//!
//! On an enlarged image a window meets every pixel several times. Multiplied out, those weights can be added first, and
//! the window laid on the small image: of a 3x3 window four products remain of nine (`squares`), of a 1x1 window one
//! for four outputs (`pointwise`). The enlarged image is never made.

mod pointwise;
mod squares;

use super::conv2d::geometry::{Beyond, Geometry};
use super::conv2d::{Conv2d, kernel, parts_of};
use crate::ops::Tile;
use crate::ops::support::epilogue::{Activation, Finish, paths};
use crate::ops::support::put::put_run;
use crate::ops::support::row_products::{self, rows_of};
use crate::ops::support::sums::bias_gradient;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::random::Random;
use crate::tensor::gemm::Rows;
use crate::tensor::{Accum, Float, GradSink, Precision, Shape, Tensor, Upstream, Var};

/// `x0 [batch, height, width, ..], x1 .. xn [batch, 2 height, 2 width, ..], w [k, k, in, out]`, optionally `b [out]`
/// -> `[batch, 2 height, 2 width, out]`: the convolution of x0, enlarged, and x1 .. xn, concatenated along the
/// channels.
///
/// k is 1, or 3 with mirrored padding of 1, so that the size stays.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UpsampledConv2d {
    /// How many images stand beside the small one: n.
    pub parts: usize,
    /// Rows of x0 handed to a thread at a time, chosen by the shapes by default.
    pub tile: Tile,
    /// Numbers in which products are taken, in f32's forward pass.
    pub precision: Precision,
    /// Activation, applied to the result.
    pub activation: Activation,
}

/// How the small image is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Path {
    /// A 1x1 window: one product for the four pixels of a square.
    Pointwise,
    /// A 3x3 window: four windows of 2x2, one for each pixel of a square.
    Squares,
}

/// The two convolutions that are added.
#[derive(Clone, Copy, Debug)]
struct Both {
    /// Of x0, as though its size stayed: enlarging shows in the kernels alone. Mirroring the enlarged image repeats the
    /// small one's edge.
    small: Geometry,
    /// Of x1 .. xn.
    full: Geometry,
}

impl Both {
    /// Channels of all the images.
    fn channels(&self) -> usize {
        self.small.channels + self.full.channels
    }

    /// The one place where a path is chosen.
    fn path(&self) -> Path {
        if self.small.kernel == [1, 1] { Path::Pointwise } else { Path::Squares }
    }
}

impl UpsampledConv2d {
    fn geometry(&self, inputs: &[Shape]) -> Result<Both, ShapeError> {
        if inputs.len() < self.parts + 2 {
            return Err(ShapeError::new(format!("expected x0, {} more images, then w", self.parts)));
        }
        let (parts, w) = (&inputs[1..=self.parts], &inputs[self.parts + 1]);
        let (Some([batch, h, wd, channels]), Some([kh, kw, per_window, out_channels])) = (inputs[0].nhwc(), w.nhwc())
        else {
            return Err(ShapeError::new("expected x0 [batch, height, width, ..] and w [k, k, in, out]"));
        };
        if parts.iter().any(|part| part.nhwc().is_none_or(|[b, y, x, _]| [b, y, x] != [batch, 2 * h, 2 * wd])) {
            return Err(ShapeError::new("expected the other images to be [batch, 2 height, 2 width, ..]"));
        }
        let others = parts.iter().map(Shape::last).sum();
        if per_window != channels + others {
            return Err(ShapeError::new(format!("{} channels do not fit the weights", channels + others)));
        }
        if kh != kw || ![1, 3].contains(&kh) {
            return Err(ShapeError::new("expected a window of 1x1 or 3x3"));
        }
        if kh == 3 && h * wd == 0 {
            return Err(ShapeError::new("a padding of 1 cannot mirror an extent of 0"));
        }
        let full = Geometry {
            batch,
            size: [2 * h, 2 * wd],
            channels: others,
            out: [2 * h, 2 * wd],
            out_channels,
            kernel: [kh, kw],
            stride: [1; 2],
            padding: [kh / 2; 2],
            dilation: [1; 2],
            groups: 1,
            beyond: Beyond::Mirrored,
            tile: self.tile.times(2),
        };
        let (size, tile) = ([h, wd], self.tile);
        Ok(Both { small: Geometry { size, out: size, channels, beyond: Beyond::Nearest, tile, ..full }, full })
    }
}

impl<T: Float> Op<T> for UpsampledConv2d {
    type Saved = Saved<T>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let Both { full, .. } = self.geometry(inputs)?;
        if inputs.get(self.parts + 2).is_some_and(|b| b.dims() != [full.out_channels]) {
            return Err(ShapeError::new("expected b [out]"));
        }
        Ok(vec![Shape::new(&[full.batch, full.out[0], full.out[1], full.out_channels])])
    }

    fn algo(&self, inputs: &[Shape]) -> &'static str {
        let Ok(g) = self.geometry(inputs) else { return "none" };
        self.activation.among(match g.path() {
            Path::Pointwise => paths!("pointwise"),
            Path::Squares => paths!("squares"),
        })
    }

    fn flops(&self, inputs: &[Shape]) -> u64 {
        let Ok(g) = self.geometry(inputs) else { return 0 };
        let taps = match g.path() {
            Path::Pointwise => 1,
            Path::Squares => squares::PHASES.len() * squares::TAPS,
        };
        let of_small = g.small.rows() * g.small.out[1] * taps * g.small.channels;
        2 * ((of_small + g.full.rows() * g.full.out[1] * g.full.patch()) * g.full.out_channels) as u64
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let (xs, rest) = inputs.split_at(self.parts + 1);
        let (w, b) = (rest[0], rest.get(1).map(|b| b.data()));
        let shapes: Vec<Shape> = inputs.iter().map(|x| *x.shape()).collect();
        let g = self.geometry(&shapes).expect("checked by the shape rule");
        let of_small = kernel::weights_of(&g.small, 0, g.channels(), w.data());
        let (y, kept) = self.activation.after(b, needs.any(), |finish| {
            Tensor::build([g.full.batch, g.full.out[0], g.full.out[1], g.full.out_channels], |out| {
                let mut accum = Accum::Replace;
                if g.full.channels > 0 {
                    let of_full = kernel::weights_of(&g.full, g.small.channels, g.channels(), w.data());
                    match g.path() {
                        Path::Pointwise => {
                            let rows: Vec<Rows<T>> = xs[1..].iter().map(|x| rows_of(x)).collect();
                            row_products::forward(out, &rows, &of_full, &Finish::nothing(), Tile::AUTO, self.precision);
                        }
                        Path::Squares => {
                            let parts = parts_of(xs[1..].iter().copied());
                            kernel::convolve(out, accum, &g.full, &parts, &of_full, &Finish::nothing(), self.precision);
                        }
                    }
                    accum = Accum::Add;
                }
                match g.path() {
                    Path::Pointwise => {
                        pointwise::convolve(out, accum, &g.small, rows_of(xs[0]), &of_small, finish, self.precision)
                    }
                    Path::Squares => {
                        squares::convolve(out, accum, &g.small, xs[0].data(), &of_small, finish, self.precision)
                    }
                }
            })
        });
        let inputs = needs.get(self.parts + 1).then(|| xs.iter().copied().cloned().collect());
        let weights = (0..=self.parts).any(|i| needs.get(i)).then(|| w.clone());
        let channels = xs[1..].iter().map(|x| x.shape().last()).collect();
        (vec![y], Saved { inputs, weights, channels, geometry: g, kept })
    }

    /// The gradients of x1 .. xn and of their weights are those of a convolution. x0 meets each of its weights at
    /// several places of the output: dx0 and dw collect from all of them.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let Saved { inputs, weights, channels, geometry: g, kept } = saved;
        let dy = self.activation.backward(kept.as_ref(), upstream.only());
        drop(kept);
        // For a 1x1 window the four pixels of a square count as one.
        let sums = (g.path() == Path::Pointwise).then(|| pointwise::sum_squares(&g.small, &dy));
        if let Some(w) = weights {
            sink.accumulate(0, |out, accum| {
                let w = kernel::weights_of(&g.small, 0, g.channels(), w.data());
                match &sums {
                    Some(sums) => row_products::input_gradient(out, accum, rows_of(sums), &w, Tile::AUTO),
                    None => squares::input_gradient(out, accum, &g.small, dy.data(), &w),
                }
            });
            let mut first = g.small.channels;
            for (i, &count) in channels.iter().enumerate() {
                let part = Geometry { channels: count, ..g.full };
                sink.accumulate(i + 1, |out, accum| {
                    let w = kernel::weights_of(&part, first, g.channels(), w.data());
                    match g.path() {
                        Path::Pointwise => row_products::input_gradient(out, accum, rows_of(&dy), &w, Tile::AUTO),
                        Path::Squares => kernel::input_gradient(out, accum, &part, dy.data(), &w),
                    }
                });
                first += count;
            }
        }
        if let Some(xs) = inputs {
            sink.accumulate(self.parts + 1, |out, accum| {
                let n = g.full.out_channels;
                let (small, others) = xs.split_at(1);
                let of_small = Tensor::build([g.small.patch() * n], |out| match &sums {
                    Some(sums) => row_products::weight_gradient(out, Accum::Replace, rows_of(&small[0]), rows_of(sums)),
                    None => squares::weight_gradient(out, &g.small, small[0].data(), dy.data()),
                });
                put_weights(out, accum, g.channels() * n, 0, of_small.data(), g.small.channels * n);
                let mut first = g.small.channels;
                if g.path() == Path::Pointwise {
                    for x in others {
                        let count = x.shape().last();
                        let out = &mut out[first * n..(first + count) * n];
                        row_products::weight_gradient(out, accum, rows_of(x), rows_of(&dy));
                        first += count;
                    }
                } else if g.full.channels > 0 {
                    let of_full = Tensor::build([g.full.patch() * n], |out| {
                        kernel::weight_gradient(out, Accum::Replace, &g.full, &parts_of(others), dy.data());
                    });
                    put_weights(out, accum, g.channels() * n, first * n, of_full.data(), g.full.channels * n);
                }
            });
        }
        sink.accumulate(self.parts + 2, |out, accum| bias_gradient(out, accum, rows_of(&dy)));
    }
}

/// Puts (or adds) blocks of `count` numbers to `first` in each block of `block`.
fn put_weights<T: Float>(out: &mut [T], accum: Accum, block: usize, first: usize, w: &[T], count: usize) {
    if count == 0 {
        return;
    }
    for (out, w) in out.chunks_exact_mut(block).zip(w.chunks_exact(count)) {
        let out = &mut out[first..first + count];
        put_run(accum, out, w);
    }
}

/// What the backward pass needs.
pub struct Saved<T: Float> {
    /// All the images, for the gradient of the weights.
    inputs: Option<Vec<Tensor<T>>>,
    /// The weights, for the gradients of the images.
    weights: Option<Tensor<T>>,
    /// The channels of x1 .. xn.
    channels: Vec<usize>,
    geometry: Both,
    /// What the activation keeps.
    kept: Option<Tensor<T>>,
}

impl Checked for UpsampledConv2d {
    fn cases() -> Vec<Case<Self>> {
        let case = |name, op: UpsampledConv2d, [b, h, w, c]: [usize; 4], channels: &[usize], kn: [usize; 2], bias| {
            const NAMES: [&str; 3] = ["x1", "x2", "x3"];
            let mut inputs = vec![Input::random("x0", [b, h, w, c])];
            inputs.extend(NAMES.iter().zip(channels).map(|(&name, &c)| Input::random(name, [b, 2 * h, 2 * w, c])));
            let [k, n] = kn;
            inputs.push(Input::random("w", [k, k, c + channels.iter().sum::<usize>(), n]));
            if bias {
                inputs.push(Input::random("b", [n]));
            }
            Case::new(name, UpsampledConv2d { parts: channels.len(), ..op }, inputs)
        };
        let plain = UpsampledConv2d::default();
        let mut cases = vec![
            case("3x3, several panels of outputs", plain, [1, 2, 2, 1], &[], [3, 37], true),
            case("3x3", plain, [2, 3, 2, 2], &[], [3, 3], true),
            case("3x3, three images", plain, [3, 2, 3, 2], &[1], [3, 2], true),
            case("3x3, one pixel", plain, [1, 1, 1, 2], &[], [3, 2], false),
            case("3x3, one row", plain, [1, 1, 3, 1], &[1], [3, 2], true),
            case("3x3 beside others", plain, [2, 2, 3, 2], &[1, 2], [3, 3], true),
            case("3x3 beside others, one of them empty", plain, [1, 2, 2, 1], &[1, 0, 2], [3, 3], false),
            case("3x3, no channel of it", plain, [1, 2, 2, 0], &[2], [3, 3], false),
            case("3x3, several register tiles", plain, [1, 1, 13, 2], &[2], [3, 17], true),
            case("3x3, whole vectors", plain, [1, 2, 3, 8], &[], [3, 16], false),
            case(
                "3x3, tile and one",
                UpsampledConv2d { tile: Tile::of(2), ..plain },
                [1, 3, 2, 2],
                &[1],
                [3, 2],
                false,
            ),
            case(
                "3x3, a tile across images",
                UpsampledConv2d { tile: Tile::of(2), ..plain },
                [2, 3, 1, 2],
                &[],
                [3, 2],
                true,
            ),
            case("3x3 of an empty batch", plain, [0, 2, 3, 2], &[1], [3, 2], true).flat(),
            case("1x1", plain, [2, 2, 3, 3], &[2], [1, 4], true),
            case("1x1 without bias", plain, [1, 3, 2, 2], &[1, 0, 3], [1, 17], false),
            case("1x1, no channel of it", plain, [1, 2, 2, 0], &[2], [1, 3], false),
            case("1x1 alone", plain, [2, 2, 2, 3], &[], [1, 2], true),
            case("1x1 of an empty batch", plain, [0, 2, 3, 2], &[1], [1, 2], true).flat(),
        ];
        for activation in Activation::fused() {
            let op = UpsampledConv2d { activation, ..plain };
            cases.push(case("3x3, activated", op, [2, 2, 2, 1], &[], [3, 33], true));
            cases.push(case("3x3 beside another, activated", op, [1, 2, 3, 1], &[2], [3, 3], true));
            cases.push(case("1x1, activated", op, [2, 1, 2, 2], &[3], [1, 33], true));
        }
        cases
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        let parts = random.extreme(0, 2);
        let op = UpsampledConv2d {
            parts,
            tile: Tile::of(random.extreme(0, 5)),
            activation: random.pick(&Activation::ALL),
            precision: Precision::F32,
        };
        let [b, h, w, c] = [random.extreme(1, 3), random.extreme(1, 4), random.extreme(1, 5), random.extreme(1, 5)];
        let channels: Vec<usize> = (0..parts).map(|_| random.extreme(1, 4)).collect();
        let (kernel, out) = (random.pick(&[1, 3]), random.pick(&[1, 2, 8, 17]));
        let mut inputs = vec![Input::random("x0", [b, h, w, c])];
        let beside = ["x1", "x2"].into_iter().zip(&channels);
        inputs.extend(beside.map(|(name, &c)| Input::random(name, [b, 2 * h, 2 * w, c])));
        inputs.push(Input::random("w", [kernel, kernel, c + channels.iter().sum::<usize>(), out]));
        if random.coin() {
            inputs.push(Input::random("b", [out]));
        }
        Some(Case::drawn(op, inputs))
    }
}

impl<T: Float> Var<T> {
    /// 2-D convolution of `small [batch, height, width, ..]`, enlarged to twice its size, and the images
    /// `parts [batch, 2 height, 2 width, ..]` behind it, concatenated along the channels, which is not made;
    /// `op` is 1x1, or 3x3 with mirrored padding of 1.
    ///
    /// # Panics
    /// If `op` is another convolution, or the images or the weights do not fit.
    #[track_caller]
    pub fn conv2d_of_upsampled(small: &Self, parts: &[&Self], weight: &Self, bias: Option<&Self>, op: Conv2d) -> Self {
        let kernel = weight.shape().dims()[0];
        let plain = if kernel == 1 { Conv2d::default() } else { Conv2d::padded(1).reflecting() };
        assert_eq!(
            Conv2d { precision: Precision::F32, ..op },
            plain.activated(op.activation),
            "a convolution of an enlarged image keeps its size"
        );
        let Conv2d { activation, precision, .. } = op;
        let op = UpsampledConv2d { parts: parts.len(), activation, precision, ..UpsampledConv2d::default() };
        let inputs: Vec<&Self> = [small].into_iter().chain(parts.iter().copied()).chain([weight]).chain(bias).collect();
        apply1(op, &inputs)
    }
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;
