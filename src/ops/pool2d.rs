//! Pooling over windows: the largest element, or the mean.

use super::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// The largest element of every window, `[B, H, W, C] -> [B, (H + 2 padding - kernel) / stride + 1, .., C]`.
///
/// Padding never wins. Of several equal ones the first in scan order gets the gradient. A NaN wins.
#[derive(Clone, Copy, Debug)]
pub struct MaxPool2d {
    /// Height and width of the window.
    pub kernel: usize,
    /// From one window to the next.
    pub stride: usize,
    /// Rows and columns added on each side; less than the window.
    pub padding: usize,
}

/// The mean of every window, `[B, H, W, C] -> [B, (H - kernel) / stride + 1, .., C]`. No padding.
#[derive(Clone, Copy, Debug)]
pub struct AvgPool2d {
    /// Height and width of the window.
    pub kernel: usize,
    /// From one window to the next.
    pub stride: usize,
}

fn pooled(x: &Shape, kernel: usize, stride: usize, padding: usize) -> Result<Vec<Shape>, ShapeError> {
    let [b, h, w, c] = x.nhwc().ok_or_else(|| ShapeError::new("expected x [batch, height, width, channels]"))?;
    if kernel == 0 || stride == 0 || padding >= kernel {
        return Err(ShapeError::new("window and stride are at least 1, the padding less than the window"));
    }
    let out = |n: usize| Some((n + 2 * padding).checked_sub(kernel)? / stride + 1);
    let (Some(oh), Some(ow)) = (out(h), out(w)) else {
        return Err(ShapeError::new("the window is larger than the padded image"));
    };
    Ok(vec![Shape::new(&[b, oh, ow, c])])
}

/// The rows (or columns) of the image under window `o`.
fn under(o: usize, n: usize, kernel: usize, stride: usize, padding: usize) -> std::ops::Range<usize> {
    (o * stride).saturating_sub(padding)..(o * stride + kernel).saturating_sub(padding).min(n)
}

impl<T: Float> Op<T> for MaxPool2d {
    /// Which pixel of its image won, for every output; and the shape of the input.
    type Saved = (Vec<u32>, Shape);

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        pooled(&inputs[0], self.kernel, self.stride, self.padding)
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let x = inputs[0];
        let [_, h, w, c] = x.shape().nhwc().expect("checked by the shape rule");
        let shape = pooled(x.shape(), self.kernel, self.stride, self.padding).expect("checked by the shape rule")[0];
        let [b, oh, ow, _] = shape.nhwc().expect("four dimensions");
        let mut winners = if needs.any() { vec![0u32; shape.len()] } else { vec![] };
        let y = Tensor::build(shape, |out| {
            let row = ow * c;
            let mut rows = winners.chunks_mut(row.max(1));
            let pieces: Vec<_> = out.chunks_mut(row.max(1)).map(|out| (out, rows.next())).enumerate().collect();
            let work = b * oh * row * self.kernel * self.kernel;
            parallel::for_each_piece(pieces, work, |(r, (out, mut winners))| {
                let image = &x.data()[(r / oh) * h * w * c..][..h * w * c];
                let ys = under(r % oh, h, self.kernel, self.stride, self.padding);
                for (ox, out) in out.chunks_exact_mut(c).enumerate() {
                    let xs = under(ox, w, self.kernel, self.stride, self.padding);
                    let mut winners = winners.as_mut().map(|w| &mut w[ox * c..(ox + 1) * c]);
                    let mut first = true;
                    for iy in ys.clone() {
                        for ix in xs.clone() {
                            let at = iy * w + ix;
                            let pixel = &image[at * c..(at + 1) * c];
                            for (k, (best, &x)) in out.iter_mut().zip(pixel).enumerate() {
                                if first || x > *best || (x.is_nan() && !best.is_nan()) {
                                    *best = x;
                                    if let Some(winners) = &mut winners {
                                        winners[k] = at as u32;
                                    }
                                }
                            }
                            first = false;
                        }
                    }
                }
            });
        });
        (vec![y], (winners, *x.shape()))
    }

    /// The winner of a window gets its gradient.
    fn backward(&self, (winners, shape): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let [b, h, w, c] = shape.nhwc().expect("an image");
        sink.accumulate(0, |out, accum| {
            let per_image = g.len() / b.max(1);
            parallel::for_each_chunk(out, h * w * c, 2 * g.len(), |i, out| {
                if accum == Accum::Replace {
                    out.fill(T::ZERO);
                }
                let range = i * per_image..(i + 1) * per_image;
                for (k, (&g, &at)) in g.data()[range.clone()].iter().zip(&winners[range]).enumerate() {
                    out[at as usize * c + k % c] += g;
                }
            });
        });
    }
}

impl Checked for MaxPool2d {
    fn cases() -> Vec<Case<Self>> {
        let op = |kernel, stride, padding| MaxPool2d { kernel, stride, padding };
        let x = |shape: [usize; 4]| Input::distinct("x", shape);
        vec![
            Case::new("3x3, stride 2, padded", op(3, 2, 1), [x([2, 5, 6, 3])]),
            Case::new("overlapping", op(3, 1, 0), [x([1, 4, 5, 2])]),
            Case::new("2x2, a remainder dropped", op(2, 2, 0), [x([2, 5, 4, 1])]),
            Case::new("stride beyond the window", op(2, 3, 1), [x([1, 7, 6, 2])]),
            Case::new("a tie of four", op(2, 2, 0), [Input::values("x", [1, 2, 2, 1], [1.0; 4])]).kinks(4),
            Case::new("negative, padded", op(3, 2, 1), [Input::uniform("x", [1, 3, 4, 2], -2.0, -1.0)]),
        ]
    }
}

impl<T: Float> Op<T> for AvgPool2d {
    type Saved = Shape;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        pooled(&inputs[0], self.kernel, self.stride, 0)
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Shape) {
        let x = inputs[0];
        let [_, h, w, c] = x.shape().nhwc().expect("checked by the shape rule");
        let shape = pooled(x.shape(), self.kernel, self.stride, 0).expect("checked by the shape rule")[0];
        let [_, oh, ow, _] = shape.nhwc().expect("four dimensions");
        let share = T::ONE / T::of((self.kernel * self.kernel) as f64);
        let y = Tensor::build(shape, |out| {
            let work = out.len() * self.kernel * self.kernel;
            parallel::for_each_chunk(out, ow * c, work, |r, out| {
                let image = &x.data()[(r / oh) * h * w * c..][..h * w * c];
                for (ox, out) in out.chunks_exact_mut(c).enumerate() {
                    out.fill(T::ZERO);
                    for iy in under(r % oh, h, self.kernel, self.stride, 0) {
                        for ix in under(ox, w, self.kernel, self.stride, 0) {
                            let pixel = &image[(iy * w + ix) * c..][..c];
                            out.iter_mut().zip(pixel).for_each(|(s, &x)| *s += x);
                        }
                    }
                    out.iter_mut().for_each(|s| *s *= share);
                }
            });
        });
        (vec![y], *x.shape())
    }

    /// Every element of a window gets an equal share of its gradient.
    fn backward(&self, shape: Shape, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let [_, h, w, c] = shape.nhwc().expect("an image");
        let [_, oh, ow, _] = g.shape().nhwc().expect("an image");
        let share = T::ONE / T::of((self.kernel * self.kernel) as f64);
        sink.accumulate(0, |out, accum| {
            let work = g.len() * self.kernel * self.kernel;
            parallel::for_each_chunk(out, h * w * c, work, |b, out| {
                if accum == Accum::Replace {
                    out.fill(T::ZERO);
                }
                for (o, g) in g.data()[b * oh * ow * c..][..oh * ow * c].chunks_exact(c).enumerate() {
                    for iy in under(o / ow, h, self.kernel, self.stride, 0) {
                        for ix in under(o % ow, w, self.kernel, self.stride, 0) {
                            let out = &mut out[(iy * w + ix) * c..][..c];
                            out.iter_mut().zip(g).for_each(|(d, &g)| *d += g * share);
                        }
                    }
                }
            });
        });
    }
}

impl Checked for AvgPool2d {
    fn cases() -> Vec<Case<Self>> {
        let op = |kernel, stride| AvgPool2d { kernel, stride };
        vec![
            Case::new("overlapping", op(3, 1), [Input::random("x", [2, 5, 4, 3])]),
            Case::new("2x2, a remainder dropped", op(2, 2), [Input::random("x", [1, 5, 4, 2])]),
            Case::new("stride beyond the window", op(2, 3), [Input::random("x", [1, 6, 8, 1])]),
        ]
    }
}

impl<T: Float> Var<T> {
    /// The largest element of every window; padding never wins.
    #[track_caller]
    pub fn max_pool2d(&self, kernel: usize, stride: usize, padding: usize) -> Self {
        apply1(MaxPool2d { kernel, stride, padding }, &[self])
    }

    /// The mean of every window.
    #[track_caller]
    pub fn avg_pool2d(&self, kernel: usize, stride: usize) -> Self {
        apply1(AvgPool2d { kernel, stride }, &[self])
    }
}
