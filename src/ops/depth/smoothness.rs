//! Edge-aware smoothness of a disparity, in one op (Godard et al., 1609.03677, with the mean normalisation of Wang et
//! al., 1712.00175).

use crate::ops::support::put::{begin_sum, put};
use crate::ops::support::sums::pairwise_sum;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel, pool::Buffer};

/// Guards the division by the mean disparity, as published.
const EPSILON: f64 = 1e-7;

/// Edge-aware smoothness. With `D = disparity / (mean over h, w + 1e-7)`: the mean of
/// `|D_x+1 - D_x| exp(-mean_c |I_x+1 - I_x|)`, plus the same in y. Disparity `[batch, height, width, 1]`, image `[batch,
/// height, width, channels]`, to a scalar.
///
/// The derivative of |0| is 0, in the disparity and in the image.
#[derive(Clone, Copy, Debug)]
pub struct Smoothness;

/// One of the two directions: the distance to the neighbour in the disparity, and how many pixels have one.
#[derive(Clone, Copy)]
struct Direction {
    step: usize,
    cols: usize,
    rows: usize,
    /// One over the number of differences in the batch.
    share: f64,
}

fn directions(shape: &Shape) -> [Direction; 2] {
    let [batch, height, width, _] = shape.nhwc().expect("checked by the shape rule");
    let direction = |step, rows, cols| Direction { step, rows, cols, share: 1.0 / (batch * rows * cols) as f64 };
    [direction(1, height, width - 1), direction(width, height - 1, width)]
}

#[inline(always)]
fn sign<T: Float>(x: T) -> T {
    let negative = if x < T::ZERO { -T::ONE } else { x };
    if x > T::ZERO { T::ONE } else { negative }
}

/// What the backward pass needs.
pub struct Saved<T: Float> {
    disparity: Tensor<T>,
    image: Tensor<T>,
    /// exp(-mean_c |dI|) of every pixel, towards its right neighbour and the one below: `[batch, 2, height, width]`.
    edges: Tensor<T>,
    /// For each sample its mean disparity (with epsilon) and its sum of weighted differences, each with its share.
    samples: Vec<[T; 2]>,
}

impl<T: Float> Op<T> for Smoothness {
    type Saved = Saved<T>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        match (inputs[0].nhwc(), inputs[1].nhwc()) {
            (Some([b, h, w, 1]), Some([b2, h2, w2, c])) if [b, h, w] == [b2, h2, w2] && b * c > 0 && h > 1 && w > 1 => {
                Ok(vec![Shape::new(&[])])
            }
            _ => Err(ShapeError::new(
                "expected a disparity [batch, h, w, 1] and an image [batch, h, w, c], at least 2x2",
            )),
        }
    }

    fn flops(&self, inputs: &[Shape]) -> u64 {
        (inputs[0].len() * (6 * inputs[1].last() + 30)) as u64
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Saved<T>) {
        let (disparity, image) = (inputs[0], inputs[1]);
        let [batch, height, width, channels] = image.shape().nhwc().expect("checked by the shape rule");
        let both = directions(disparity.shape());
        let mut sums = vec![T::ZERO; batch * 2 * height];
        let edges = Tensor::build([batch, 2, height, width], |edges| {
            let pieces = edges.chunks_mut(width).zip(&mut sums).enumerate();
            parallel::for_each_piece(pieces, 24 * image.len(), |(i, (edges, sum))| {
                let (b, direction, row) = (i / (2 * height), both[i / height % 2], i % height);
                edges.fill(T::ZERO);
                *sum = T::ZERO;
                if row >= direction.rows {
                    return;
                }
                let (at, step) = ((b * height + row) * width, direction.step);
                let near = &image.data()[at * channels..][..direction.cols * channels];
                let far = &image.data()[(at + step) * channels..][..direction.cols * channels];
                let d = &disparity.data()[at..][..direction.cols];
                let next = &disparity.data()[at + step..][..direction.cols];
                let mut terms = Buffer::stale(direction.cols);
                let edges = &mut edges[..direction.cols];
                T::dispatch(
                    #[inline(always)]
                    || {
                        channel_sums(near, far, channels, edges);
                        let factor = T::of(-1.0 / channels as f64);
                        edges.iter_mut().for_each(|e| *e = (*e * factor).exp());
                        let pairs = d.iter().zip(next).zip(edges.iter());
                        terms.iter_mut().zip(pairs).for_each(|(t, ((&a, &b), &e))| *t = (b - a).abs() * e);
                    },
                );
                *sum = pairwise_sum(&terms) * T::of(direction.share);
            });
        });
        let samples: Vec<[T; 2]> = disparity
            .data()
            .chunks_exact(height * width)
            .zip(sums.chunks_exact(2 * height))
            .map(|(d, sums)| {
                let mean = pairwise_sum(d) / T::of((height * width) as f64);
                [mean + T::of(EPSILON), pairwise_sum(sums)]
            })
            .collect();
        let loss = samples.iter().map(|&[mean, sum]| sum / mean).sum();
        let saved = Saved { disparity: disparity.clone(), image: image.clone(), edges, samples };
        (vec![Tensor::scalar(loss)], saved)
    }

    /// L = sum over samples of S / m, with m the mean and S the sum of |d' - d| e over both directions. A disparity
    /// gets e sign(d' - d) / m as d', the opposite as d, and -S / m^2 / (h w) through the mean. An image's channel
    /// gets, of the edge weight e = exp(-mean_c |I' - I|), -|d' - d| e / m sign(I' - I) / c as I', the opposite as I.
    fn backward(&self, saved: Saved<T>, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only().item();
        let Saved { disparity, image, edges, samples } = saved;
        let [_, height, width, channels] = image.shape().nhwc().expect("checked by the shape rule");
        let both = directions(disparity.shape());
        let plane = height * width;
        // The derivative by the far end of every difference, for one row and direction, is written by `difference`.
        let rows = |b: usize, k: usize, row: usize, out: &mut [T], difference: &dyn Fn(T, T, &mut T)| {
            let direction = both[k];
            let at = (b * height + row) * width;
            let d = &disparity.data()[at..][..direction.cols];
            let next = &disparity.data()[at + direction.step..][..direction.cols];
            let e = &edges.data()[((b * 2 + k) * height + row) * width..][..direction.cols];
            let terms = out.iter_mut().zip(d.iter().zip(next)).zip(e);
            terms.for_each(|((o, (&a, &b)), &e)| difference(b - a, e, o));
        };
        sink.accumulate(0, |out, accum| {
            parallel::for_each_unit(out, width, 16 * disparity.len(), |i, out| {
                let (b, row) = (i / height, i % height);
                let [mean, sum] = samples[b];
                let mut slopes = Buffer::stale(width);
                let through_mean = -(g * sum / (mean * mean) / T::of(plane as f64));
                put(accum, out.iter_mut().map(|o| (o, through_mean)));
                for (k, direction) in both.iter().enumerate() {
                    let scale = g * T::of(direction.share) / mean;
                    let slope = |d: T, e: T, out: &mut T| *out = scale * e * sign(d);
                    let cols = direction.cols;
                    if row < direction.rows {
                        rows(b, k, row, &mut slopes, &slope);
                        out.iter_mut().zip(&slopes[..cols]).for_each(|(o, &s)| *o += -s);
                        if k == 0 {
                            out[1..].iter_mut().zip(&slopes[..cols]).for_each(|(o, &s)| *o += s);
                        }
                    }
                    if k == 1 && row > 0 {
                        rows(b, k, row - 1, &mut slopes, &slope);
                        out.iter_mut().zip(&slopes[..cols]).for_each(|(o, &s)| *o += s);
                    }
                }
            });
        });
        sink.accumulate(1, |out, accum| {
            parallel::for_each_unit(out, width * channels, 16 * image.len(), |i, out| {
                let (b, row) = (i / height, i % height);
                let mut slopes = Buffer::stale(width);
                begin_sum(out, accum);
                for (k, direction) in both.iter().enumerate() {
                    let scale = -(g * T::of(direction.share / channels as f64) / samples[b][0]);
                    let slope = |d: T, e: T, out: &mut T| *out = scale * e * d.abs();
                    let (cols, step) = (direction.cols, direction.step * channels);
                    let mut add = |row: usize, slopes: &mut [T], far: bool| {
                        rows(b, k, row, slopes, &slope);
                        let at = (b * height + row) * width * channels;
                        let from = &image.data()[at..][..cols * channels];
                        let to = &image.data()[at + step..][..cols * channels];
                        let shift = if far && k == 0 { channels } else { 0 };
                        let one = if far { T::ONE } else { -T::ONE };
                        let out = out[shift..].chunks_exact_mut(channels).zip(slopes.iter());
                        let pixels = from.chunks_exact(channels).zip(to.chunks_exact(channels));
                        for ((out, &s), (a, b)) in out.zip(pixels) {
                            for ((o, &a), &b) in out.iter_mut().zip(a).zip(b) {
                                *o += one * s * sign(b - a);
                            }
                        }
                    };
                    if row < direction.rows {
                        add(row, &mut slopes, false);
                    }
                    if k == 0 {
                        add(row, &mut slopes, true);
                    } else if row > 0 {
                        add(row - 1, &mut slopes, true);
                    }
                }
            });
        });
    }
}

/// The sum over channels of |far - near|, pixel by pixel.
#[inline(always)]
fn channel_sums<T: Float>(near: &[T], far: &[T], channels: usize, out: &mut [T]) {
    if channels == 3 {
        let (near, far) = (near.as_chunks::<3>().0, far.as_chunks::<3>().0);
        for ((o, a), b) in out.iter_mut().zip(near).zip(far) {
            *o = (b[0] - a[0]).abs() + (b[1] - a[1]).abs() + (b[2] - a[2]).abs();
        }
    } else {
        for ((o, a), b) in out.iter_mut().zip(near.chunks_exact(channels)).zip(far.chunks_exact(channels)) {
            *o = a.iter().zip(b).map(|(&a, &b)| (b - a).abs()).sum();
        }
    }
}

impl Checked for Smoothness {
    fn cases() -> Vec<Case<Self>> {
        let inputs = |[b, h, w, c]: [usize; 4]| {
            [Input::uniform("disparity", [b, h, w, 1], 0.1, 1.0), Input::uniform("image", [b, h, w, c], 0.0, 1.0)]
        };
        vec![
            Case::new("colour", Smoothness, inputs([2, 5, 7, 3])),
            Case::new("one channel, least size", Smoothness, inputs([2, 2, 2, 1])),
            Case::new("many channels", Smoothness, inputs([1, 3, 4, 8])),
        ]
    }
}

impl<T: Float> Var<T> {
    /// The edge-aware smoothness of this disparity `[batch, height, width, 1]` under an image `[batch, height, width,
    /// channels]` of its size, a scalar: see [`Smoothness`].
    #[track_caller]
    pub fn smoothness(&self, image: &Self) -> Self {
        apply1(Smoothness, &[self, image])
    }
}
