//! Pooling over windows of an image: the largest, and the mean.

use crate::ops::support::put::begin_sum;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::random::Random;
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// Max pooling: the largest element of each window of each channel of [batch, height, width, channels]. Padding never
/// wins, a NaN does. Of several equal ones the first, row by row, gets the gradient.
#[derive(Clone, Copy, Debug)]
pub struct MaxPool2d {
    /// Height and width of the window.
    pub kernel: usize,
    /// Stride: pixels from one window to the next.
    pub stride: usize,
    /// Padding: rows and columns added on each side.
    pub padding: usize,
}

/// Average pooling: the mean of each window of each channel of [batch, height, width, channels], without padding.
#[derive(Clone, Copy, Debug)]
pub struct AvgPool2d {
    /// Height and width of the window.
    pub kernel: usize,
    /// Stride: pixels from one window to the next.
    pub stride: usize,
}

/// The shape after windows of `kernel` pixels, `stride` apart, over images padded on each side.
fn pooled(x: &Shape, kernel: usize, stride: usize, padding: usize) -> Result<Vec<Shape>, ShapeError> {
    let Some([_, h, w, _]) = x.nhwc() else {
        return Err(ShapeError::new("expected x [batch, height, width, channels]"));
    };
    if kernel == 0 || kernel > 256 || stride == 0 {
        return Err(ShapeError::new(format!("windows of {kernel}, {stride} apart")));
    }
    if 2 * padding > kernel {
        return Err(ShapeError::new("more padding than half the window: some windows would hold nothing else"));
    }
    if h.min(w) + 2 * padding < kernel {
        return Err(ShapeError::new(format!("no window of {kernel} fits")));
    }
    let extent = |n: usize| (n + 2 * padding - kernel) / stride + 1;
    Ok(vec![x.with(1, extent(h)).with(2, extent(w))])
}

/// The taps of the window at `at` that meet one of `n` pixels.
#[inline(always)]
fn taps(at: usize, n: usize, kernel: usize, stride: usize, padding: usize) -> std::ops::Range<usize> {
    padding.saturating_sub(at * stride).min(kernel)..(n + padding - at * stride).min(kernel)
}

/// The windows, `count` of them, that meet the pixel `at` (counted with the padding).
#[inline(always)]
fn windows(at: usize, count: usize, kernel: usize, stride: usize) -> std::ops::Range<usize> {
    let from = (at + 1).saturating_sub(kernel).div_ceil(stride);
    from..(at / stride + 1).min(count)
}

impl<T: Float> Op<T> for MaxPool2d {
    /// The tap that won, `ky * kernel + kx`, for each output (nothing without a backward pass), and the shape of x.
    type Saved = (Vec<u16>, Shape);

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        pooled(&inputs[0], self.kernel, self.stride, self.padding)
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let MaxPool2d { kernel, stride, padding } = *self;
        let x = inputs[0];
        let [_, h, w, c] = x.shape().nhwc().expect("checked by the shape rule");
        let shape = pooled(x.shape(), kernel, stride, padding).expect("checked by the shape rule")[0];
        let [_, oh, ow, _] = shape.nhwc().expect("an image");
        let mut winners = vec![0u16; if needs.any() { shape.len() } else { 0 }];
        let row = ow * c;
        let y = Tensor::build(shape, |out| {
            if out.is_empty() {
                return;
            }
            let work = out.len() * kernel * kernel;
            // Without a backward pass the index of the winner goes to one row of scratch for each piece.
            let mut kept = winners.chunks_mut(row);
            let pieces: Vec<_> = out.chunks_mut(row).enumerate().map(|(i, out)| (i, out, kept.next())).collect();
            parallel::for_each_piece(pieces, work, |(i, out, at)| {
                let (image, oy) = (i / oh, i % oh);
                let mut scratch = Vec::new();
                let at = match at {
                    Some(at) => at,
                    None => {
                        scratch.resize(row, 0u16);
                        &mut scratch[..]
                    }
                };
                T::dispatch(
                    #[inline(always)]
                    || {
                        for (ox, (out, at)) in out.chunks_exact_mut(c).zip(at.chunks_exact_mut(c)).enumerate() {
                            let mut first = true;
                            for ky in taps(oy, h, kernel, stride, padding) {
                                let line = (image * h + oy * stride + ky - padding) * w;
                                for kx in taps(ox, w, kernel, stride, padding) {
                                    let x = &x.data()[(line + ox * stride + kx - padding) * c..][..c];
                                    let tap = (ky * kernel + kx) as u16;
                                    if first {
                                        out.copy_from_slice(x);
                                        at.fill(tap);
                                        first = false;
                                    } else {
                                        challenge(out, at, x, tap);
                                    }
                                }
                            }
                        }
                    },
                );
            });
        });
        (vec![y], (winners, *x.shape()))
    }

    /// The winner of each window gets its gradient: each pixel gathers from the windows that it may have won.
    fn backward(&self, (winners, shape): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let MaxPool2d { kernel, stride, padding } = *self;
        let g = upstream.only();
        let [_, oh, ow, c] = g.shape().nhwc().expect("an image");
        let [_, h, w, _] = shape.nhwc().expect("an image");
        sink.accumulate(0, |out, accum| {
            let work = g.len() * kernel * kernel;
            parallel::for_each_unit(out, w * c, work, |i, out| {
                let (image, y) = (i / h, i % h + padding);
                T::dispatch(
                    #[inline(always)]
                    || {
                        begin_sum(out, accum);
                        for (x, d) in out.chunks_exact_mut(c).enumerate() {
                            let x = x + padding;
                            for oy in windows(y, oh, kernel, stride) {
                                for ox in windows(x, ow, kernel, stride) {
                                    let tap = ((y - oy * stride) * kernel + x - ox * stride) as u16;
                                    let from = ((image * oh + oy) * ow + ox) * c;
                                    let (g, winners) = (&g.data()[from..][..c], &winners[from..][..c]);
                                    for ((d, &g), &winner) in d.iter_mut().zip(g).zip(winners) {
                                        *d += if winner == tap { g } else { T::ZERO };
                                    }
                                }
                            }
                        }
                    },
                );
            });
        });
    }
}

/// Puts each element that beats the best so far in its place. The first NaN beats everything.
#[inline(always)]
fn challenge<T: Float>(best: &mut [T], at: &mut [u16], x: &[T], tap: u16) {
    for ((best, at), &x) in best.iter_mut().zip(at).zip(x) {
        let wins = x > *best || (x.is_nan() && !best.is_nan());
        *best = if wins { x } else { *best };
        *at = if wins { tap } else { *at };
    }
}

impl Checked for MaxPool2d {
    fn cases() -> Vec<Case<Self>> {
        let x = |shape: &[usize]| Input::distinct("x", shape);
        let op = |kernel, stride, padding| MaxPool2d { kernel, stride, padding };
        vec![
            Case::new("3 by 2, even", op(3, 2, 1), [x(&[2, 4, 6, 8])]),
            Case::new("3 by 2, odd", op(3, 2, 1), [x(&[2, 5, 7, 3])]),
            Case::new("2 by 2 with a rest", op(2, 2, 0), [x(&[2, 5, 4, 3])]),
            Case::new("3 by 1", op(3, 1, 1), [x(&[1, 4, 5, 17])]),
            Case::new("2 by 3, gaps", op(2, 3, 0), [x(&[2, 5, 8, 1])]),
            Case::new("below zero", op(3, 2, 1), [Input::uniform("x", [1, 3, 4, 1], -2.0, -1.0)]),
            Case::new("a tie", op(2, 2, 0), [Input::values("x", [1, 2, 2, 1], [1.0, 1.0, 1.0, 1.0])])
                .kinks(4)
                .promises(0, [1.0, 0.0, 0.0, 0.0]),
            Case::new("no image", op(3, 2, 1), [x(&[0, 3, 3, 2])]).flat(),
        ]
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        let kernel = random.pick(&[1, 2, 3, 5, 9]);
        let op = MaxPool2d { kernel, stride: random.extreme(1, 4), padding: random.extreme(0, kernel / 2) };
        let image = [random.extreme(1, 3), random.extreme(1, 9), random.extreme(1, 9), random.pick(&[1, 3, 8, 17])];
        Some(Case::drawn(op, [Input::distinct("x", image)]))
    }
}

impl<T: Float> Op<T> for AvgPool2d {
    /// The shape of x.
    type Saved = Shape;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        pooled(&inputs[0], self.kernel, self.stride, 0)
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Shape) {
        let AvgPool2d { kernel, stride } = *self;
        let x = inputs[0];
        let [_, h, w, c] = x.shape().nhwc().expect("checked by the shape rule");
        let shape = pooled(x.shape(), kernel, stride, 0).expect("checked by the shape rule")[0];
        let [_, oh, ow, _] = shape.nhwc().expect("an image");
        let factor = T::ONE / T::of((kernel * kernel) as f64);
        let y = Tensor::build(shape, |out| {
            let work = out.len() * kernel * kernel;
            parallel::for_each_unit(out, ow * c, work, |i, out| {
                let (image, oy) = (i / oh, i % oh);
                T::dispatch(
                    #[inline(always)]
                    || {
                        out.fill(T::ZERO);
                        for ky in 0..kernel {
                            let line = &x.data()[(image * h + oy * stride + ky) * w * c..][..w * c];
                            for kx in 0..kernel {
                                add_every(out, &line[kx * c..], c, stride);
                            }
                        }
                        out.iter_mut().for_each(|y| *y *= factor);
                    },
                );
            });
        });
        (vec![y], *x.shape())
    }

    /// Each pixel gets its share from every window that it is in.
    fn backward(&self, shape: Shape, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let AvgPool2d { kernel, stride } = *self;
        let g = upstream.only();
        let [_, oh, ow, c] = g.shape().nhwc().expect("an image");
        let [_, h, w, _] = shape.nhwc().expect("an image");
        let factor = T::ONE / T::of((kernel * kernel) as f64);
        sink.accumulate(0, |out, accum| {
            let work = g.len() * kernel * kernel;
            parallel::for_each_unit(out, w * c, work, |i, out| {
                let (image, y) = (i / h, i % h);
                T::dispatch(
                    #[inline(always)]
                    || {
                        begin_sum(out, accum);
                        for oy in windows(y, oh, kernel, stride) {
                            let g = &g.data()[(image * oh + oy) * ow * c..][..ow * c];
                            for kx in 0..kernel {
                                spread_every(&mut out[kx * c..], g, c, stride, factor);
                            }
                        }
                    },
                );
            });
        });
    }
}

/// Adds every `stride`-th pixel of a row to the pixels of another; with a stride of 1, as one run.
#[inline(always)]
fn add_every<T: Float>(sum: &mut [T], x: &[T], c: usize, stride: usize) {
    if stride == 1 {
        return sum.iter_mut().zip(x).for_each(|(s, &x)| *s += x);
    }
    for (s, x) in sum.chunks_exact_mut(c).zip(x.chunks(stride * c)) {
        s.iter_mut().zip(x).for_each(|(s, &x)| *s += x);
    }
}

/// The transpose of that, with a factor.
#[inline(always)]
fn spread_every<T: Float>(out: &mut [T], g: &[T], c: usize, stride: usize, factor: T) {
    if stride == 1 {
        return out.iter_mut().zip(g).for_each(|(d, &g)| *d = g.mul_add(factor, *d));
    }
    for (d, g) in out.chunks_mut(stride * c).zip(g.chunks_exact(c)) {
        d.iter_mut().zip(g).for_each(|(d, &g)| *d = g.mul_add(factor, *d));
    }
}

impl Checked for AvgPool2d {
    fn cases() -> Vec<Case<Self>> {
        let x = |shape: &[usize]| Input::random("x", shape);
        let op = |kernel, stride| AvgPool2d { kernel, stride };
        vec![
            Case::new("3 by 1", op(3, 1), [x(&[2, 5, 6, 3])]),
            Case::new("3 by 1, the whole image", op(3, 1), [x(&[2, 3, 3, 8])]),
            Case::new("2 by 2 with a rest", op(2, 2), [x(&[2, 5, 7, 3])]),
            Case::new("3 by 2", op(3, 2), [x(&[1, 5, 8, 17])]),
            Case::new("2 by 3, gaps", op(2, 3), [x(&[2, 5, 9, 1])]),
            Case::new("no image", op(3, 1), [x(&[0, 3, 3, 2])]).flat(),
        ]
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        let kernel = random.pick(&[1, 2, 3, 5, 9]);
        let op = AvgPool2d { kernel, stride: random.extreme(1, 4) };
        let image = [random.extreme(1, 3), random.extreme(1, 9), random.extreme(1, 9), random.pick(&[1, 3, 8, 17])];
        Some(Case::drawn(op, [Input::random("x", image)]))
    }
}

impl<T: Float> Var<T> {
    /// The largest element of each window of [batch, height, width, channels]. Padding never wins.
    #[track_caller]
    pub fn max_pool2d(&self, kernel: usize, stride: usize, padding: usize) -> Self {
        apply1(MaxPool2d { kernel, stride, padding }, &[self])
    }

    /// The mean of each window of [batch, height, width, channels], without padding.
    #[track_caller]
    pub fn avg_pool2d(&self, kernel: usize, stride: usize) -> Self {
        apply1(AvgPool2d { kernel, stride }, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    fn column(values: &[f64]) -> Tensor<f64> {
        Tensor::from_vec([1, values.len(), 1, 1], values.to_vec())
    }

    #[test]
    fn the_first_of_equals_gets_the_gradient_and_padding_never_wins() {
        let tape = Tape::new();
        let x = tape.leaf(Tensor::full([1, 3, 3, 1], -5.0));
        let y = x.max_pool2d(3, 2, 1);
        assert_eq!(y.value().data(), [-5.0; 4]);
        let g = tape.backward(&[(&y, Tensor::from_vec([1, 2, 2, 1], vec![1.0, 2.0, 4.0, 8.0]))]).take(&x).unwrap();
        assert_eq!(g.data(), [1.0, 2.0, 0.0, 4.0, 8.0, 0.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn nan_wins_wherever_it_stands() {
        for at in 0..4 {
            let mut values = [1.0, 2.0, 3.0, 4.0];
            values[at] = f64::NAN;
            let x = Var::constant(column(&values).reshape([1, 2, 2, 1]));
            assert!(x.max_pool2d(2, 2, 0).value().item().is_nan());
            assert!(x.avg_pool2d(2, 2).value().item().is_nan());
        }
    }

    #[test]
    fn the_mean_of_a_window() {
        let x = Var::constant(Tensor::from_vec([1, 2, 3, 1], vec![1.0, 2.0, 3.0, 5.0, 6.0, 7.0]));
        assert_eq!(x.avg_pool2d(2, 1).value().data(), [3.5, 4.5]);
    }
}
