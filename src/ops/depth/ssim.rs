//! Structural similarity (Wang et al., 2004) as a loss, and the kernels that the photometric loss shares with it.
//!
//! Images are worked on row by row. The 3x3 means are separable: sums over three rows first, written into a row with
//! one pixel more at either end (mirrored), then over three neighbours; every loop runs over all of a row's pixels and
//! channels at once. Nothing but the inputs is saved: the backward pass forms the means again, which costs less than
//! writing and reading them as images.

use crate::ops::Tile;
use crate::ops::support::put::put;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var, parallel, pool::Buffer};

const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// Structural dissimilarity `clamp((1 - SSIM) / 2, 0, 1)` of x and y `[batch, height, width, channels]`, per channel:
/// means over 3x3 windows of the images, reflected by one pixel at the edges; `C1 = 0.01^2`, `C2 = 0.03^2`.
///
/// SSIM lies within [-1, 1], so the clamp only catches rounding: its derivative is 1 on the bounds and 0 beyond.
#[derive(Clone, Copy, Debug, Default)]
pub struct SsimLoss {
    /// Rows handed to a thread at a time.
    pub tile: Tile,
}

/// Rows handed to a thread at a time, unless said otherwise.
pub(crate) const TILE: usize = 16;

/// `ssim * clamp((1 - SSIM) / 2, 0, 1) + l1 * |x - y|` for every element; the kernel of two ops.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Kernel {
    /// Factor of the SSIM term; 0 leaves it out.
    pub ssim: f64,
    /// Factor of the absolute difference.
    pub l1: f64,
    /// Rows handed to a thread at a time.
    pub tile: usize,
    /// Whether the channels of a pixel are summed.
    pub sum: bool,
}

/// The rows of one image, each all of its pixels and channels.
#[derive(Clone, Copy)]
struct Rows<'a, T> {
    data: &'a [T],
    len: usize,
    height: usize,
}

impl<'a, T: Float> Rows<'a, T> {
    fn of(x: &'a Tensor<T>, sample: usize) -> Self {
        let [_, height, width, channels] = x.shape().nhwc().expect("checked by the shape rule");
        let len = width * channels;
        Rows { data: &x.data()[sample * height * len..][..height * len], len, height }
    }
    fn row(&self, i: usize) -> &'a [T] {
        &self.data[i * self.len..][..self.len]
    }
    /// The rows above, at and below, reflected at the edges.
    fn around(&self, i: usize) -> [&'a [T]; 3] {
        let above = if i == 0 { 1 } else { i - 1 };
        let below = if i + 1 == self.height { i - 1 } else { i + 1 };
        [above, i, below].map(|i| self.row(i))
    }
}

/// Sums over three rows of x, y, x^2 + y^2 and x y, with a pixel more at either end.
struct Stats<T: Float>([Buffer<T>; 4]);

/// The sum of three neighbours, of a row with a pixel more at either end.
#[inline(always)]
fn neighbours<T: Float>(row: &[T], channels: usize, n: usize) -> impl Iterator<Item = T> + '_ {
    let (left, middle, right) = (&row[..n], &row[channels..][..n], &row[2 * channels..][..n]);
    left.iter().zip(middle).zip(right).map(|((&a, &b), &c)| a + b + c)
}

impl<T: Float> Stats<T> {
    fn new(len: usize, channels: usize) -> Self {
        Stats(std::array::from_fn(|_| Buffer::stale(len + 2 * channels)))
    }

    #[inline(always)]
    fn gather(&mut self, x: [&[T]; 3], y: [&[T]; 3], channels: usize) {
        let n = x[0].len();
        let [sx, sy, squares, products] = &mut self.0;
        let sums = sx[channels..][..n].iter_mut().zip(&mut sy[channels..][..n]);
        let sums = sums.zip(squares[channels..][..n].iter_mut().zip(&mut products[channels..][..n]));
        let xs = x[0].iter().zip(x[1]).zip(x[2]);
        let ys = y[0].iter().zip(y[1]).zip(y[2]);
        for (((sx, sy), (q, p)), (((&a, &b), &c), ((&d, &e), &f))) in sums.zip(xs.zip(ys)) {
            *sx = a + b + c;
            *sy = d + e + f;
            *q = a.mul_add(a, b.mul_add(b, c * c)) + d.mul_add(d, e.mul_add(e, f * f));
            *p = a.mul_add(d, b.mul_add(e, c * f));
        }
        for row in &mut self.0 {
            // Reflected: the second pixel stands before the first, the last but one behind the last.
            let len = row.len();
            row.copy_within(2 * channels..3 * channels, 0);
            row.copy_within(len - 3 * channels..len - 2 * channels, len - channels);
        }
    }

    /// The means of x, y, x^2 + y^2 and x y over the windows of the row.
    #[inline(always)]
    fn means(&self, channels: usize, n: usize) -> impl Iterator<Item = [T; 4]> + '_ {
        let ninth = T::of(1.0 / 9.0);
        let [x, y, q, p] = &self.0;
        let x = neighbours(x, channels, n).zip(neighbours(y, channels, n));
        let q = neighbours(q, channels, n).zip(neighbours(p, channels, n));
        x.zip(q).map(move |((x, y), (q, p))| [x * ninth, y * ninth, q * ninth, p * ninth])
    }
}

/// The factors of SSIM = n1 n2 / (d1 d2).
#[inline(always)]
fn factors<T: Float>([x, y, q, p]: [T; 4]) -> [T; 4] {
    let (c1, c2, two) = (T::of(C1), T::of(C2), T::of(2.0));
    let (xy, squares) = (x * y, x.mul_add(x, y * y));
    [xy.mul_add(two, c1), (p - xy).mul_add(two, c2), squares + c1, q - squares + c2]
}

/// 1, 0 or -1.
#[inline(always)]
fn sign<T: Float>(x: T) -> T {
    let negative = if x < T::ZERO { -T::ONE } else { x };
    if x > T::ZERO { T::ONE } else { negative }
}

impl Kernel {
    /// The values of all elements, or their sums over channels.
    pub fn forward<T: Float>(&self, x: &Tensor<T>, y: &Tensor<T>, out: &mut [T]) {
        let [_, height, width, channels] = x.shape().nhwc().expect("checked by the shape rule");
        let n = width * channels;
        let per_row = if self.sum { width } else { n };
        parallel::for_each_chunk(out, per_row * self.tile, 32 * x.len(), |i, out| {
            let mut stats = Stats::new(n, channels);
            let mut value = Buffer::stale(n);
            for (k, out) in out.chunks_exact_mut(per_row).enumerate() {
                let (sample, row) = ((i * self.tile + k) / height, (i * self.tile + k) % height);
                let (x, y) = (Rows::of(x, sample), Rows::of(y, sample));
                T::dispatch(
                    #[inline(always)]
                    || {
                        self.value_row(x, y, row, channels, &mut stats, &mut value);
                        if !self.sum {
                            out.copy_from_slice(&value);
                        } else if channels == 3 {
                            let (pixels, _) = value.as_chunks::<3>();
                            out.iter_mut().zip(pixels).for_each(|(o, p)| *o = p[0] + p[1] + p[2]);
                        } else {
                            let pixels = value.chunks_exact(channels);
                            out.iter_mut().zip(pixels).for_each(|(o, p)| *o = p.iter().copied().sum());
                        }
                    },
                );
            }
        });
    }

    #[inline(always)]
    fn value_row<T: Float>(
        &self,
        x: Rows<T>,
        y: Rows<T>,
        row: usize,
        channels: usize,
        stats: &mut Stats<T>,
        value: &mut [T],
    ) {
        let l1 = T::of(self.l1);
        let pixels = x.row(row).iter().zip(y.row(row));
        if self.ssim == 0.0 {
            return value.iter_mut().zip(pixels).for_each(|(v, (&x, &y))| *v = l1 * (x - y).abs());
        }
        stats.gather(x.around(row), y.around(row), channels);
        let (weight, half) = (T::of(self.ssim), T::of(0.5));
        for ((value, means), (&x, &y)) in value.iter_mut().zip(stats.means(channels, x.len)).zip(pixels) {
            let [n1, n2, d1, d2] = factors(means);
            let loss = half - half * (n1 * n2 / (d1 * d2));
            *value = weight * loss.max(T::ZERO).min(T::ONE) + l1 * (x - y).abs();
        }
    }

    /// The gradient by `x`; by symmetry also that by `y`, with the two exchanged. `g` has the result's channels.
    ///
    /// SSIM depends on x through the window means of x, x^2 + y^2 and x y. With s = n1 n2 / D, D = d1 d2, its
    /// derivatives by them are A = 2 y' (n2 - n1) / D + 2 x' s (1/d2 - 1/d1) (primes are means), Q = -s / d2 and P = 2
    /// n1 / D. A pixel gets A + 2 x Q + y P summed over the windows that hold it (twice where reflection puts it there
    /// twice), over 9.
    pub fn backward<T: Float>(&self, x: &Tensor<T>, y: &Tensor<T>, g: &Tensor<T>, out: &mut [T], accum: Accum) {
        let [_, height, width, channels] = x.shape().nhwc().expect("checked by the shape rule");
        let n = width * channels;
        let tile = self.tile.min(height);
        let tiles = height.div_ceil(tile);
        let pieces = out.chunks_mut(height * n).flat_map(|sample| sample.chunks_mut(tile * n)).enumerate();
        parallel::for_each_piece(pieces, 64 * x.len(), |(i, out)| {
            let (sample, first) = (i / tiles, i % tiles * tile);
            let images = [x, y, g].map(|x| Rows::of(x, sample));
            let end = first + out.len() / n;
            let mut scratch = Scratch::new(n, channels);
            let mut rows = out.chunks_exact_mut(n).zip(first..);
            for row in first.saturating_sub(1)..(end + 1).min(height) {
                T::dispatch(
                    #[inline(always)]
                    || {
                        if self.ssim != 0.0 {
                            self.map_row(images, row, channels, &mut scratch);
                        }
                        // A row is finished once the maps of the row below it are there (or there is none).
                        let ready = if row + 1 == height { 2 } else { 1 };
                        for _ in 0..ready {
                            if (row > first || row + 1 == height)
                                && let Some((out, at)) = rows.next()
                            {
                                self.finish_row(images, at, channels, &mut scratch, out, accum);
                            }
                        }
                    },
                );
            }
        });
    }

    /// The derivatives by the window means of one row, summed over neighbouring windows, into its place in the ring.
    #[inline(always)]
    fn map_row<T: Float>(&self, [x, y, g]: [Rows<T>; 3], row: usize, channels: usize, scratch: &mut Scratch<T>) {
        let Scratch { stats, upstream, maps, ring } = scratch;
        let n = x.len;
        expand(g.row(row), upstream, channels);
        stats.gather(x.around(row), y.around(row), channels);
        let (half, two) = (T::of(0.5), T::of(2.0));
        let factor = T::of(-0.5 * self.ssim / 9.0);
        let [a, q, p] = &mut *maps;
        let out = a[channels..][..n].iter_mut().zip(&mut q[channels..][..n]).zip(&mut p[channels..][..n]);
        for ((((a, q), p), means), &g) in out.zip(stats.means(channels, n)).zip(upstream.iter()) {
            let [n1, n2, d1, d2] = factors(means);
            let [x, y, ..] = means;
            let over = T::ONE / (d1 * d2);
            let s = n1 * n2 * over;
            let loss = half - half * s;
            let inside = !(loss < T::ZERO || loss > T::ONE);
            let g = if inside { g * factor } else { T::ZERO };
            // 1/d2 - 1/d1 = (d1 - d2) / D, and 1/d2 = d1 / D; the 2 of 2 x Q is in q already.
            let scale = two * g * over;
            *a = scale * (y * (n2 - n1) + x * s * (d1 - d2));
            *q = -(scale * s * d1);
            *p = scale * n1;
        }
        for (map, sum) in maps.iter().zip(&mut ring[row % 3]) {
            sum.iter_mut().zip(neighbours(map, channels, n)).for_each(|(s, x)| *s = x);
            // The windows at the ends hold their inner neighbour twice.
            let (inner, edge) = (&mut sum[channels..2 * channels], &map[channels..2 * channels]);
            inner.iter_mut().zip(edge).for_each(|(s, &x)| *s += x);
            let (inner, edge) = (&mut sum[n - 2 * channels..n - channels], &map[n..n + channels]);
            inner.iter_mut().zip(edge).for_each(|(s, &x)| *s += x);
        }
    }

    /// The gradient of one row, of the maps of the rows around it.
    #[inline(always)]
    fn finish_row<T: Float>(
        &self,
        [x, y, g]: [Rows<T>; 3],
        row: usize,
        channels: usize,
        scratch: &mut Scratch<T>,
        out: &mut [T],
        accum: Accum,
    ) {
        let Scratch { upstream, ring, .. } = scratch;
        expand(g.row(row), upstream, channels);
        let l1 = T::of(self.l1);
        let (xs, ys) = (x.row(row), y.row(row));
        let pixels = xs.iter().zip(ys).zip(upstream.iter());
        if self.ssim == 0.0 {
            return put(accum, out.iter_mut().zip(pixels).map(|(o, ((&x, &y), &g))| (o, l1 * g * sign(x - y))));
        }
        // The first and last rows of windows hold the row next to them twice; outside there is none.
        let weight = |there: bool, edge: bool| T::of(if !there { 0.0 } else { 1.0 + f64::from(u8::from(edge)) });
        let above = weight(row > 0, row == 1);
        let below = weight(row + 1 < x.height, row + 2 == x.height);
        let up = if row > 0 { row - 1 } else { row };
        let down = if row + 1 < x.height { row + 1 } else { row };
        let [a, q, p] = std::array::from_fn(|m| {
            let (u, c, d) = (&ring[up % 3][m], &ring[row % 3][m], &ring[down % 3][m]);
            u.iter().zip(c.iter()).zip(d.iter()).map(move |((&u, &c), &d)| u.mul_add(above, d.mul_add(below, c)))
        });
        let terms = out.iter_mut().zip(pixels).zip(a.zip(q).zip(p));
        put(
            accum,
            terms.map(|((o, ((&x, &y), &g)), ((a, q), p))| (o, x.mul_add(q, y.mul_add(p, a)) + l1 * g * sign(x - y))),
        );
    }
}

/// What the backward pass of one tile needs besides images.
struct Scratch<T: Float> {
    stats: Stats<T>,
    /// The upstream gradient of a row, for every channel.
    upstream: Buffer<T>,
    /// The derivatives of a row by its window means, with a pixel of zeros at either end.
    maps: [Buffer<T>; 3],
    /// Their sums over neighbours, of the last three rows.
    ring: [[Buffer<T>; 3]; 3],
}

impl<T: Float> Scratch<T> {
    fn new(n: usize, channels: usize) -> Self {
        Scratch {
            stats: Stats::new(n, channels),
            upstream: Buffer::stale(n),
            maps: std::array::from_fn(|_| Buffer::filled(n + 2 * channels, T::ZERO)),
            ring: std::array::from_fn(|_| std::array::from_fn(|_| Buffer::stale(n))),
        }
    }
}

/// Repeats a number for each channel of its pixel, where the row has one for each pixel.
#[inline(always)]
fn expand<T: Float>(g: &[T], out: &mut [T], channels: usize) {
    if g.len() == out.len() {
        out.copy_from_slice(g);
    } else if channels == 3 {
        out.as_chunks_mut::<3>().0.iter_mut().zip(g).for_each(|(o, &g)| *o = [g; 3]);
    } else {
        out.chunks_exact_mut(channels).zip(g).for_each(|(o, &g)| o.fill(g));
    }
}

/// Two images of one shape, large enough for a reflected window.
pub(crate) fn pair(inputs: &[Shape]) -> Result<[usize; 4], ShapeError> {
    match inputs[0].nhwc() {
        Some(dims @ [_, h, w, c]) if inputs[0] == inputs[1] && h > 1 && w > 1 && c > 0 => Ok(dims),
        _ => Err(ShapeError::new("expected two images [batch, height, width, channels] of one size, at least 2x2")),
    }
}

impl SsimLoss {
    fn kernel(self) -> Kernel {
        Kernel { ssim: 1.0, l1: 0.0, tile: self.tile.or(TILE), sum: false }
    }
}

impl<T: Float> Op<T> for SsimLoss {
    /// The two images.
    type Saved = [Tensor<T>; 2];

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        pair(inputs).map(|_| vec![inputs[0]])
    }

    fn flops(&self, inputs: &[Shape]) -> u64 {
        45 * inputs[0].len() as u64
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let (x, y) = (inputs[0], inputs[1]);
        let loss = Tensor::build(*x.shape(), |out| self.kernel().forward(x, y, out));
        (vec![loss], [x.clone(), y.clone()])
    }

    /// See `Kernel::backward`.
    fn backward(&self, [x, y]: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        sink.accumulate(0, |out, accum| self.kernel().backward(&x, &y, &g, out, accum));
        sink.accumulate(1, |out, accum| self.kernel().backward(&y, &x, &g, out, accum));
    }
}

impl Checked for SsimLoss {
    fn cases() -> Vec<Case<Self>> {
        let op = |tile| SsimLoss { tile: Tile::of(tile) };
        let images = |shape: [usize; 4]| [Input::uniform("x", shape, 0.0, 1.0), Input::uniform("y", shape, 0.0, 1.0)];
        vec![
            Case::new("colour", op(0), images([2, 5, 7, 3])),
            Case::new("one channel, least size", op(0), images([2, 2, 2, 1])),
            Case::new("three rows and columns", op(0), images([1, 3, 3, 2])),
            Case::new("many channels", op(0), images([1, 2, 3, 17])),
            Case::new("tile less one", op(5), images([2, 4, 3, 3])),
            Case::new("a whole tile", op(4), images([2, 4, 3, 3])),
            Case::new("tile and one", op(3), images([2, 4, 3, 3])),
            Case::new("tiles of one row", op(1), images([2, 5, 4, 1])),
        ]
    }
}

impl<T: Float> Var<T> {
    /// `clamp((1 - SSIM) / 2, 0, 1)` of two images `[batch, height, width, channels]`, for every element: see
    /// [`SsimLoss`].
    #[track_caller]
    pub fn ssim_loss(&self, other: &Self) -> Self {
        apply1(SsimLoss::default(), &[self, other])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// Window by window, as the definition says.
    fn naive(x: &Tensor<f64>, y: &Tensor<f64>) -> Tensor<f64> {
        let [batch, height, width, channels] = x.shape().nhwc().unwrap();
        let reflect = |i: isize, n: usize| {
            if i < 0 {
                1
            } else if i as usize == n {
                n - 2
            } else {
                i as usize
            }
        };
        let mut out = Vec::new();
        for b in 0..batch {
            for v in 0..height as isize {
                for u in 0..width as isize {
                    for c in 0..channels {
                        let mean = |f: &dyn Fn(f64, f64) -> f64| -> f64 {
                            let mut sum = 0.0;
                            for (dv, du) in (-1..=1).flat_map(|dv| (-1..=1).map(move |du| (dv, du))) {
                                let at = [b, reflect(v + dv, height), reflect(u + du, width), c];
                                sum += f(x.at(&at), y.at(&at));
                            }
                            sum / 9.0
                        };
                        let (mx, my) = (mean(&|x, _| x), mean(&|_, y| y));
                        let (vx, vy) = (mean(&|x, _| x * x) - mx * mx, mean(&|_, y| y * y) - my * my);
                        let cov = mean(&|x, y| x * y) - mx * my;
                        let s = (2.0 * mx * my + C1) * (2.0 * cov + C2);
                        out.push(0.5 - 0.5 * s / ((mx * mx + my * my + C1) * (vx + vy + C2)));
                    }
                }
            }
        }
        Tensor::from_vec(*x.shape(), out)
    }

    #[test]
    fn it_agrees_with_the_definition_and_is_0_for_equal_images() {
        let mut random = Random::new(1, 2);
        let mut image = || Tensor::from_vec([2, 19, 6, 3], (0..684).map(|_| random.uniform(0.0, 1.0)).collect());
        let (x, y) = (image(), image());
        let (vx, vy) = (Var::constant(x.clone()), Var::constant(y.clone()));
        let loss = vx.ssim_loss(&vy).into_value();
        let expected = naive(&x, &y);
        assert!(loss.data().iter().zip(expected.data()).all(|(a, b)| (a - b).abs() < 1e-12));
        assert!(vx.ssim_loss(&vx).value().data().iter().all(|&l| (0.0..1e-12).contains(&l)));
    }

    #[test]
    fn nan_passes_through_the_clamp() {
        let x = Var::constant(Tensor::full([1, 3, 3, 1], f32::NAN));
        assert!(x.ssim_loss(&x).value().data().iter().all(|l| l.is_nan()));
    }
}
