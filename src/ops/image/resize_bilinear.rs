//! Bilinear resizing.

use crate::depth::half_pixel;
use crate::ops::support::put::begin_sum;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::random::Random;
use crate::tensor::pool::Buffer;
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var, parallel, regime};

/// Bilinear resize of [batch, height, width, channels], each pixel interpolated between its four neighbours;
/// no smoothing when it shrinks.
///
/// Position i of n pixels lies at `(i + 0.5) m / n - 0.5` among m, not below 0 nor above m - 1; with `align_corners` at
/// `i (m - 1) / (n - 1)`.
#[derive(Clone, Copy, Debug)]
pub struct ResizeBilinear {
    /// Height of the result.
    pub height: usize,
    /// Width of the result.
    pub width: usize,
    /// Whether the centres of the corner pixels are aligned; pixel centres lie at half numbers otherwise.
    pub align_corners: bool,
}

/// Where an output lies along one dimension: between `low` and `high`, this far from `low`.
#[derive(Clone, Copy)]
struct Tap<T> {
    low: usize,
    high: usize,
    weight: T,
}

impl ResizeBilinear {
    /// The taps of `to` outputs among `from` inputs.
    fn taps<T: Float>(&self, from: usize, to: usize) -> Vec<Tap<T>> {
        let last = from.saturating_sub(1);
        (0..to)
            .map(|i| {
                let at = match self.align_corners {
                    true if to > 1 => (i * last) as f64 / (to - 1) as f64,
                    true => 0.0,
                    false => half_pixel(i, from, to),
                };
                let low = (at as usize).min(last);
                let weight = if low == last { 0.0 } else { at - low as f64 };
                Tap { low, high: (low + 1).min(last), weight: T::of(weight) }
            })
            .collect()
    }
}

/// The transpose of taps: for each input the outputs that it is in, in order, with their weights.
struct Transposed<T> {
    start: Vec<usize>,
    entries: Vec<(usize, T)>,
}

impl<T: Float> Transposed<T> {
    fn of(taps: &[Tap<T>], from: usize) -> Self {
        let mut all: Vec<Vec<(usize, T)>> = vec![Vec::new(); from];
        for (o, tap) in taps.iter().enumerate() {
            all[tap.low].push((o, T::ONE - tap.weight));
            if tap.high != tap.low {
                all[tap.high].push((o, tap.weight));
            }
        }
        let mut start = vec![0];
        start.extend(all.iter().scan(0, |sum, outputs| {
            *sum += outputs.len();
            Some(*sum)
        }));
        Transposed { start, entries: all.concat() }
    }

    fn get(&self, i: usize) -> &[(usize, T)] {
        &self.entries[self.start[i]..self.start[i + 1]]
    }
}

/// Rows handed to a thread at a time: about 2^14 elements.
fn band(row: usize) -> usize {
    regime::size(((1 << 14) / row.max(1)).max(1))
}

impl<T: Float> Op<T> for ResizeBilinear {
    /// The shape of x.
    type Saved = Shape;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let Some([_, h, w, _]) = inputs[0].nhwc() else {
            return Err(ShapeError::new("expected x [batch, height, width, channels]"));
        };
        if h * w == 0 || self.height * self.width == 0 {
            return Err(ShapeError::new(format!("to {} x {}: no pixels", self.height, self.width)));
        }
        Ok(vec![inputs[0].with(1, self.height).with(2, self.width)])
    }

    fn algo(&self, _: &[Shape]) -> &'static str {
        if self.align_corners { "align_corners" } else { "half_pixel" }
    }

    fn traffic(&self, inputs: &[Shape], outputs: &[Shape], needs: &Needs) -> [u64; 2] {
        crate::ops::op::traffic_without_inputs(inputs, outputs, needs)
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Shape) {
        let x = inputs[0];
        let [_, h, w, c] = x.shape().nhwc().expect("checked by the shape rule");
        let (rows, columns) = (self.taps::<T>(h, self.height), self.taps::<T>(w, self.width));
        let (line, tile) = (self.width * c, band(self.width * c));
        let y = Tensor::build(x.shape().with(1, self.height).with(2, self.width), |out| {
            let work = 6 * out.len();
            parallel::for_each_chunk(out, tile * line, work, |i, out| {
                // Two rows are blended in full width, then the columns are taken from the blend.
                let mut blend = Buffer::stale(w * c);
                for (j, out) in out.chunks_exact_mut(line).enumerate() {
                    let at = i * tile + j;
                    let (image, tap) = (at / self.height * h, rows[at % self.height]);
                    let [low, high] = [tap.low, tap.high].map(|row| &x.data()[(image + row) * w * c..][..w * c]);
                    T::dispatch(
                        #[inline(always)]
                        || {
                            for ((b, &l), &h) in blend.iter_mut().zip(low).zip(high) {
                                *b = tap.weight.mul_add(h, (T::ONE - tap.weight) * l);
                            }
                            columns_of(out, &blend, &columns, c);
                        },
                    );
                }
            });
        });
        (vec![y], *x.shape())
    }

    /// Each pixel gathers from the outputs between which it lies, with their weights: rows first, then columns.
    fn backward(&self, shape: Shape, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let [_, h, w, c] = shape.nhwc().expect("an image");
        let rows = Transposed::of(&self.taps::<T>(h, self.height), h);
        let columns = Transposed::of(&self.taps::<T>(w, self.width), w);
        let (line, tile) = (self.width * c, band(w * c));
        sink.accumulate(0, |out, accum| {
            let work = 6 * g.len();
            parallel::for_each_chunk(out, tile * w * c, work, |i, out| {
                let mut blend = Buffer::stale(line);
                for (j, out) in out.chunks_exact_mut(w * c).enumerate() {
                    let at = i * tile + j;
                    let (image, row) = (at / h * self.height, at % h);
                    T::dispatch(
                        #[inline(always)]
                        || {
                            blend.fill(T::ZERO);
                            for &(oy, weight) in rows.get(row) {
                                let g = &g.data()[(image + oy) * line..][..line];
                                blend.iter_mut().zip(g).for_each(|(b, &g)| *b = weight.mul_add(g, *b));
                            }
                            gather_columns(out, accum, &blend, &columns, c);
                        },
                    );
                }
            });
        });
    }
}

/// Interpolates the pixels of a row.
#[inline(always)]
fn columns_of<T: Float>(out: &mut [T], x: &[T], taps: &[Tap<T>], c: usize) {
    if c == 1 {
        for (y, tap) in out.iter_mut().zip(taps) {
            *y = tap.weight.mul_add(x[tap.high], (T::ONE - tap.weight) * x[tap.low]);
        }
        return;
    }
    for (y, tap) in out.chunks_exact_mut(c).zip(taps) {
        let [low, high] = [tap.low, tap.high].map(|i| &x[i * c..][..c]);
        for ((y, &l), &h) in y.iter_mut().zip(low).zip(high) {
            *y = tap.weight.mul_add(h, (T::ONE - tap.weight) * l);
        }
    }
}

/// The transpose of that.
#[inline(always)]
fn gather_columns<T: Float>(out: &mut [T], accum: Accum, g: &[T], taps: &Transposed<T>, c: usize) {
    begin_sum(out, accum);
    if c == 1 {
        for (x, d) in out.iter_mut().enumerate() {
            *d = taps.get(x).iter().fold(*d, |sum, &(o, weight)| weight.mul_add(g[o], sum));
        }
        return;
    }
    for (x, d) in out.chunks_exact_mut(c).enumerate() {
        for &(o, weight) in taps.get(x) {
            let g = &g[o * c..][..c];
            d.iter_mut().zip(g).for_each(|(d, &g)| *d = weight.mul_add(g, *d));
        }
    }
}

impl Checked for ResizeBilinear {
    fn cases() -> Vec<Case<Self>> {
        let x = |shape: &[usize]| Input::random("x", shape);
        let to = |height, width, align_corners| ResizeBilinear { height, width, align_corners };
        let mut cases = Vec::new();
        for align in [false, true] {
            cases.extend([
                Case::new("twice", to(6, 10, align), [x(&[2, 3, 5, 3])]),
                Case::new("one channel", to(6, 10, align), [x(&[2, 3, 5, 1])]),
                Case::new("eight times", to(16, 24, align), [x(&[1, 2, 3, 1])]),
                Case::new("odd factors", to(7, 8, align), [x(&[2, 4, 5, 2])]),
                Case::new("smaller", to(3, 4, align), [x(&[2, 5, 7, 3])]),
                Case::new("smaller, pixels that no output sees", to(2, 2, align), [x(&[1, 9, 7, 1])]),
                Case::new("wider and lower", to(2, 9, align), [x(&[2, 5, 4, 17])]),
                Case::new("the same size", to(3, 4, align), [x(&[2, 3, 4, 8])]),
                Case::new("from one pixel", to(3, 2, align), [x(&[2, 1, 1, 3])]),
                Case::new("to one pixel", to(1, 1, align), [x(&[2, 4, 3, 3])]),
                Case::new("no image", to(3, 4, align), [x(&[0, 2, 2, 3])]).flat(),
            ]);
        }
        cases
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        let op = ResizeBilinear {
            height: random.extreme(1, 11),
            width: random.extreme(1, 11),
            align_corners: random.coin(),
        };
        let image = [random.extreme(1, 3), random.extreme(1, 7), random.extreme(1, 7), random.pick(&[1, 2, 3, 17])];
        Some(Case::drawn(op, [Input::random("x", image)]))
    }
}

impl<T: Float> Var<T> {
    /// Resizes [batch, height, width, channels] by bilinear interpolation, without smoothing. Pixel centres lie at half
    /// numbers, or, with `align_corners`, the corner pixels' centres fall on each other.
    #[track_caller]
    pub fn resize_bilinear(&self, height: usize, width: usize, align_corners: bool) -> Self {
        apply1(ResizeBilinear { height, width, align_corners }, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_along_a_line() {
        let x = Var::constant(Tensor::from_vec([1, 1, 3, 1], vec![0.0, 1.0, 4.0]));
        let half = x.resize_bilinear(1, 6, false);
        assert_eq!(half.value().data(), [0.0, 0.25, 0.75, 1.75, 3.25, 4.0]);
        let corners = x.resize_bilinear(1, 5, true);
        assert_eq!(corners.value().data(), [0.0, 0.5, 1.0, 2.5, 4.0]);
    }

    #[test]
    fn the_same_size_changes_nothing() {
        let x = Tensor::from_vec([1, 2, 3, 2], (0..12).map(f64::from).collect());
        for align in [false, true] {
            assert!(Var::constant(x.clone()).resize_bilinear(2, 3, align).value().same_bits(&x));
        }
    }
}
