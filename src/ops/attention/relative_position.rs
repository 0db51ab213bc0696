//! The convolutional relative position encoding of factorised attention.

use crate::ops::Tile;
use crate::ops::support::put::{begin_sum, put};
use crate::ops::support::sums::add_sums;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::random::Random;
use crate::tensor::pool::Buffer;
use crate::tensor::simd::copy_run;
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel, simd};

/// Convolutional relative position encoding: `out = q * (depthwise convolution of v as an image)`, with windows of
/// several sizes, each over its own heads (Xu et al. 2021, 2104.06399, section 3.3). Zero padding half the window.
///
/// Inputs: qkv [batch, height * width, 3 C], q, k and v side by side; then for every window, over the next heads in
/// order, a weight [window, window, channels of those heads] and a bias [those channels]. The result is
/// [batch, height * width, C]. Nothing depends on k.
#[derive(Clone, Debug)]
pub struct ConvRelativePosition {
    /// Height of the image, in tokens.
    pub height: usize,
    /// Width of the image, in tokens.
    pub width: usize,
    /// Number of heads; C is a multiple of it.
    pub heads: usize,
    /// Windows: the (odd) extent of each, and the number of heads it serves.
    pub windows: Vec<(usize, usize)>,
    /// Image rows a partial sum of the weight gradient covers; 8 by default.
    pub tile: Tile,
}

/// The channels that are computed side by side.
const LANES: usize = 16;
/// Pixels of a row that are computed side by side, where [`LANES`] numbers are one vector: ten sums.
const MANY: usize = 10;
/// The same, where they are two.
const FEW: usize = 5;
/// The extent of the largest window that is taken.
const LARGEST: usize = 15;

/// A block of [`LANES`] channels and the window that holds all of theirs; smaller ones are surrounded by zeros.
#[derive(Clone, Copy)]
struct Block {
    window: usize,
    /// Where its taps begin, counted in taps.
    from: usize,
}

/// The extents, and the blocks of channels.
struct Plan {
    batch: usize,
    height: usize,
    width: usize,
    channels: usize,
    /// Of the largest window, half.
    pad: usize,
    blocks: Vec<Block>,
    taps: usize,
    /// Each window's extent, first channel, and number of channels.
    windows: Vec<[usize; 3]>,
    tile: usize,
}

impl ConvRelativePosition {
    fn plan(&self, qkv: &Shape) -> Result<Plan, ShapeError> {
        let &[batch, tokens, stride] = qkv.dims() else {
            return Err(ShapeError::new("expected qkv [batch, tokens, 3 C]"));
        };
        if tokens != self.height * self.width {
            return Err(ShapeError::new(format!("{tokens} tokens are not {} x {}", self.height, self.width)));
        }
        if stride == 0 || self.heads == 0 || stride % (3 * self.heads) != 0 {
            return Err(ShapeError::new(format!("{stride} channels are not q, k and v of {} heads", self.heads)));
        }
        if self.windows.iter().any(|w| w.0 % 2 == 0 || w.0 > LARGEST || w.1 == 0)
            || self.windows.iter().map(|w| w.1).sum::<usize>() != self.heads
        {
            return Err(ShapeError::new(format!(
                "expected odd windows up to {LARGEST} over all {} heads, not {:?}",
                self.heads, self.windows
            )));
        }
        let (channels, c) = (stride / 3, stride / 3 / self.heads);
        let mut first = 0;
        let windows: Vec<[usize; 3]> = (self.windows.iter())
            .map(|&(window, heads)| {
                first += heads * c;
                [window, first - heads * c, heads * c]
            })
            .collect();
        let mut taps = 0;
        let blocks = (0..channels.div_ceil(LANES))
            .map(|b| {
                let here = windows.iter().filter(|w| w[1] < (b + 1) * LANES && w[1] + w[2] > b * LANES);
                let window = here.map(|w| w[0]).max().expect("the windows cover all channels");
                taps += window * window;
                Block { window, from: taps - window * window }
            })
            .collect();
        let pad = self.windows.iter().map(|w| w.0 / 2).max().unwrap_or(0);
        let tile = self.tile.or(8);
        Ok(Plan { batch, height: self.height, width: self.width, channels, pad, blocks, taps, windows, tile })
    }
}

impl Plan {
    fn padded_width(&self) -> usize {
        self.width + 2 * self.pad
    }

    fn padded_height(&self) -> usize {
        self.height + 2 * self.pad
    }

    /// The place of a weight among the taps of all blocks.
    fn place(&self, window: usize, dy: usize, dx: usize, channel: usize) -> usize {
        let block = self.blocks[channel / LANES];
        let ring = (block.window - window) / 2;
        (block.from + (dy + ring) * block.window + dx + ring) * LANES + channel % LANES
    }

    /// All weights as taps of blocks; turned by 180 degrees for the way back.
    fn arrange<T: Float>(&self, weights: &[Tensor<T>], turned: bool) -> Buffer<T> {
        let mut out = Buffer::filled(self.taps * LANES, T::ZERO);
        for (&[window, first, count], weight) in self.windows.iter().zip(weights) {
            for (tap, weight) in weight.data().chunks_exact(count).enumerate() {
                let tap = if turned { window * window - 1 - tap } else { tap };
                for (k, &w) in weight.iter().enumerate() {
                    out[self.place(window, tap / window, tap % window, first + k)] = w;
                }
            }
        }
        out
    }

    /// Where row y of a block begins in a padded image b, counted in pixels of [`LANES`] numbers.
    fn row_of(&self, b: usize, y: usize, k: usize) -> usize {
        ((b * self.padded_height() + y) * self.blocks.len() + k) * self.padded_width()
    }

    /// An image surrounded by zeros, its channels filled up with zeros to whole blocks, each row block by block: every
    /// load is then of [`LANES`] numbers beside the last ones, and none needs a condition. `fill(token, channel, out)`
    /// writes the channels of a token from one on.
    fn padded<T: Float>(&self, fill: impl Fn(usize, usize, &mut [T]) + Sync + Send) -> Buffer<T> {
        let across = self.padded_width() * LANES;
        let (height, pad) = (self.padded_height(), self.pad);
        let mut out = Buffer::stale(self.batch * height * self.blocks.len() * across);
        let work = out.len();
        parallel::for_each_unit(&mut out, self.blocks.len() * across, work, |i, out| {
            let (b, y) = (i / height, i % height);
            if !(pad..pad + self.height).contains(&y) {
                return out.fill(T::ZERO);
            }
            let token = (b * self.height + y - pad) * self.width;
            T::dispatch(
                #[inline(always)]
                || {
                    for (k, out) in out.chunks_exact_mut(across).enumerate() {
                        let (left, rest) = out.split_at_mut(pad * LANES);
                        let (inside, right) = rest.split_at_mut(self.width * LANES);
                        left.fill(T::ZERO);
                        right.fill(T::ZERO);
                        for (x, out) in inside.chunks_exact_mut(LANES).enumerate() {
                            let (out, unused) = out.split_at_mut(LANES.min(self.channels - k * LANES));
                            fill(token + x, k * LANES, out);
                            unused.fill(T::ZERO);
                        }
                    }
                },
            );
        });
        out
    }

    /// The convolution of row y of image b, handed pixel by pixel and block by block to `emit(x, block, values)`.
    #[inline(always)]
    fn row<T: Float>(
        &self,
        image: &[T],
        taps: &[T],
        b: usize,
        y: usize,
        mut emit: impl FnMut(usize, usize, [T; LANES]),
    ) {
        let fits = simd::lanes::<T>() >= LANES;
        let mut x = 0;
        while fits && x + MANY <= self.width {
            self.pixels::<T, MANY>(image, taps, [b, y, x], &mut emit);
            x += MANY;
        }
        while x + FEW <= self.width {
            self.pixels::<T, FEW>(image, taps, [b, y, x], &mut emit);
            x += FEW;
        }
        while x < self.width {
            self.pixels::<T, 1>(image, taps, [b, y, x], &mut emit);
            x += 1;
        }
    }

    /// The same of P pixels from x on: as many sums that do not wait for one another.
    #[inline(always)]
    fn pixels<T: Float, const P: usize>(
        &self,
        image: &[T],
        taps: &[T],
        [b, y, x]: [usize; 3],
        emit: &mut impl FnMut(usize, usize, [T; LANES]),
    ) {
        let ((image, _), (taps, _)) = (image.as_chunks::<LANES>(), taps.as_chunks::<LANES>());
        for (k, block) in self.blocks.iter().enumerate() {
            let (window, ring) = (block.window, self.pad - block.window / 2);
            let taps = &taps[block.from..][..window * window];
            let mut sums = [[T::ZERO; LANES]; P];
            for (dy, taps) in taps.chunks_exact(window).enumerate() {
                let row = &image[self.row_of(b, y + ring + dy, k) + ring + x..];
                for (pixels, tap) in row.windows(P).zip(taps) {
                    for (sum, pixel) in sums.iter_mut().zip(pixels) {
                        for (s, (&p, &t)) in sum.iter_mut().zip(pixel.iter().zip(tap)) {
                            *s = p.mul_add(t, *s);
                        }
                    }
                }
            }
            for (p, sum) in sums.into_iter().enumerate() {
                emit(x + p, k, sum);
            }
        }
    }

    /// The gradient of the taps over some rows of image b: of each, the sum over pixels of g times v beside it.
    fn taps_gradient<T: Float>(&self, out: &mut [T], image: &[T], g: &[T], b: usize, rows: std::ops::Range<usize>) {
        let (out, _) = out.as_chunks_mut::<LANES>();
        let ((image, _), (g, _)) = (image.as_chunks::<LANES>(), g.as_chunks::<LANES>());
        for (k, block) in self.blocks.iter().enumerate() {
            for dy in 0..block.window {
                let out = &mut out[block.from + dy * block.window..][..block.window];
                let mut dx = 0;
                while dx < block.window {
                    let span = Span { b, rows: rows.clone(), k, block: *block, dy, dx };
                    let out = &mut out[dx..];
                    dx += match out.len() {
                        4.. => self.tap_group::<T, 4>(out, image, g, span),
                        3 => self.tap_group::<T, 3>(out, image, g, span),
                        2 => self.tap_group::<T, 2>(out, image, g, span),
                        _ => self.tap_group::<T, 1>(out, image, g, span),
                    };
                }
            }
        }
    }

    /// G taps beside each other; gives G. Up to four stay in registers.
    fn tap_group<T: Float, const G: usize>(
        &self,
        out: &mut [[T; LANES]],
        image: &[[T; LANES]],
        g: &[[T; LANES]],
        s: Span,
    ) -> usize {
        let ring = self.pad - s.block.window / 2;
        let mut result = [[T::ZERO; LANES]; G];
        T::dispatch(
            #[inline(always)]
            || {
                // Sums that live outside the closure would be stored to memory at every step.
                let mut sums = result;
                for y in s.rows {
                    let g = &g[self.row_of(s.b, y + self.pad, s.k) + self.pad..][..self.width];
                    let v = &image[self.row_of(s.b, y + ring + s.dy, s.k) + ring + s.dx..];
                    for (g, v) in g.iter().zip(v.windows(G)) {
                        for (sums, v) in sums.iter_mut().zip(v) {
                            for (s, (&g, &v)) in sums.iter_mut().zip(g.iter().zip(v)) {
                                *s = g.mul_add(v, *s);
                            }
                        }
                    }
                }
                result = sums;
            },
        );
        out[..G].copy_from_slice(&result);
        G
    }
}

/// Writes channels of v of a token, of q, k and v side by side.
fn v_of<T: Float>(qkv: &[T], channels: usize) -> impl Fn(usize, usize, &mut [T]) {
    move |token, first, out| copy_run(out, &qkv[(3 * token + 2) * channels + first..][..out.len()])
}

/// Which part of the gradient of the taps.
struct Span {
    b: usize,
    rows: std::ops::Range<usize>,
    k: usize,
    block: Block,
    dy: usize,
    dx: usize,
}

/// What the backward pass needs.
pub struct Saved<T: Float> {
    qkv: Tensor<T>,
    weights: Vec<Tensor<T>>,
    /// The convolution with its bias, if the gradient of q is wanted.
    conv: Option<Buffer<T>>,
}

impl<T: Float> Op<T> for ConvRelativePosition {
    type Saved = Option<Saved<T>>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let plan = self.plan(&inputs[0])?;
        if inputs.len() != 1 + 2 * plan.windows.len() {
            return Err(ShapeError::new("expected a weight and a bias for every window"));
        }
        for (&[window, _, count], pair) in plan.windows.iter().zip(inputs[1..].chunks_exact(2)) {
            if pair[0].dims() != [window, window, count] || pair[1].dims() != [count] {
                return Err(ShapeError::new(format!(
                    "expected a weight [{window}, {window}, {count}] and a bias [{count}]"
                )));
            }
        }
        Ok(vec![[plan.batch, self.height * self.width, plan.channels].into()])
    }

    fn flops(&self, inputs: &[Shape]) -> u64 {
        let taps = |plan: Plan| plan.windows.iter().map(|w| w[0] * w[0] * w[2]).sum::<usize>();
        let rows = inputs[0].rows();
        self.plan(&inputs[0]).map_or(0, |plan| 2 * (rows * taps(plan)) as u64)
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let qkv = inputs[0];
        let plan = self.plan(qkv.shape()).expect("checked by the shape rule");
        let (channels, stride) = (plan.channels, 3 * plan.channels);
        let weights: Vec<Tensor<T>> = inputs[1..].iter().step_by(2).map(|&w| w.clone()).collect();
        let mut bias = Vec::with_capacity(channels);
        inputs[1..].iter().skip(1).step_by(2).for_each(|b| bias.extend_from_slice(b.data()));
        bias.resize(plan.blocks.len() * LANES, T::ZERO);
        let taps = plan.arrange(&weights, false);
        let image = plan.padded(v_of(qkv.data(), channels));
        // Only the gradient of q needs the convolution itself.
        let mut conv = needs.get(0).then(|| Buffer::stale(qkv.len() / 3));
        let work = qkv.len() * plan.taps / plan.blocks.len();
        let line = plan.width * channels;
        let y = Tensor::build([plan.batch, plan.height * plan.width, channels], |out| {
            let mut kept = conv.iter_mut().flat_map(|conv| conv.chunks_mut(line.max(1)));
            let rows = out.chunks_mut(line.max(1)).enumerate().map(|(i, out)| (i, out, kept.next()));
            parallel::for_each_piece(rows, work, |(i, out, mut kept)| {
                let q = &qkv.data()[i * plan.width * stride..];
                T::dispatch(
                    #[inline(always)]
                    || {
                        plan.row(
                            &image,
                            &taps,
                            i / plan.height,
                            i % plan.height,
                            #[inline(always)]
                            |x, k, mut sum| {
                                let (first, count) = (k * LANES, LANES.min(channels - k * LANES));
                                sum.iter_mut().zip(&bias[first..first + LANES]).for_each(|(s, &b)| *s += b);
                                let at = x * channels + first;
                                if let Some(kept) = &mut kept {
                                    copy_run(&mut kept[at..at + count], &sum[..count]);
                                }
                                sum.iter_mut().zip(&q[x * stride + first..]).for_each(|(s, &q)| *s *= q);
                                copy_run(&mut out[at..at + count], &sum[..count]);
                            },
                        );
                    },
                );
            });
        });
        (vec![y], needs.any().then(|| Saved { qkv: qkv.clone(), weights, conv }))
    }

    /// With u = dy q: dq = dy conv(v); dv = u convolved with the weights turned by 180 degrees; dweight at a tap = the
    /// sum over pixels of u times v at that tap; dbias = the sum of u; dk = 0.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let Saved { qkv, weights, conv } = saved.expect("saved for a wanted gradient");
        let g = upstream.only();
        let plan = self.plan(qkv.shape()).expect("checked by the shape rule");
        let (channels, stride) = (plan.channels, 3 * plan.channels);
        let (qkv, g) = (qkv.data(), g.data());
        let u = plan.padded(|token, first, out| {
            let (g, q) = (&g[token * channels + first..], &qkv[token * stride + first..]);
            out.iter_mut().zip(g.iter().zip(q)).for_each(|(o, (&g, &q))| *o = g * q);
        });
        let work = qkv.len() * plan.taps / plan.blocks.len();
        sink.accumulate(0, |out, accum| {
            let conv = conv.as_ref().expect("saved for the gradient of q");
            let taps = plan.arrange(&weights, true);
            parallel::for_each_unit(out, plan.width * stride, work, |i, out| {
                let first = i * plan.width * channels;
                let rows = g[first..].chunks_exact(channels).zip(conv[first..].chunks_exact(channels));
                for (out, (g, conv)) in out.chunks_exact_mut(stride).zip(rows) {
                    let terms = out.iter_mut().zip(g.iter().zip(conv));
                    put(accum, terms.map(|(o, (&g, &c))| (o, g * c)));
                    begin_sum(&mut out[channels..2 * channels], accum);
                }
                T::dispatch(
                    #[inline(always)]
                    || {
                        plan.row(
                            &u,
                            &taps,
                            i / plan.height,
                            i % plan.height,
                            #[inline(always)]
                            |x, k, sum| {
                                let lanes = k * LANES..((k + 1) * LANES).min(channels);
                                let out = &mut out[x * stride + 2 * channels..][..channels][lanes];
                                put(accum, out.iter_mut().zip(sum));
                            },
                        );
                    },
                );
            });
        });
        if (1..=2 * plan.windows.len()).any(|i| sink.wants(i)) {
            let image = plan.padded(v_of(qkv, channels));
            parameters(&plan, &image, &u, work, sink);
        }
    }
}

/// The gradients of weights and biases, in one partial sum for every few rows of an image.
fn parameters<T: Float>(plan: &Plan, image: &[T], u: &[T], work: usize, sink: &mut GradSink<T>) {
    let (tiles, lanes) = (plan.height.div_ceil(plan.tile), plan.blocks.len() * LANES);
    let size = plan.taps * LANES + lanes;
    let mut parts = Buffer::<T>::stale(plan.batch * tiles * size);
    parallel::for_each_unit(&mut parts, size, work, |i, part| {
        let (b, first) = (i / tiles, i % tiles * plan.tile);
        let rows = first..(first + plan.tile).min(plan.height);
        let (taps, bias) = part.split_at_mut(plan.taps * LANES);
        plan.taps_gradient(taps, image, u, b, rows.clone());
        bias.fill(T::ZERO);
        for y in rows {
            for (k, bias) in bias.chunks_exact_mut(LANES).enumerate() {
                let row = (plan.row_of(b, y + plan.pad, k) + plan.pad) * LANES;
                for u in u[row..][..plan.width * LANES].chunks_exact(LANES) {
                    bias.iter_mut().zip(u).for_each(|(s, &u)| *s += u);
                }
            }
        }
    });
    let mut sums = vec![0.0; size];
    for part in parts.chunks_exact(size) {
        sums.iter_mut().zip(part).for_each(|(s, p)| *s += p.f64());
    }
    for (i, &[window, first, count]) in plan.windows.iter().enumerate() {
        let at = |k: usize| {
            let (tap, channel) = (k / count, first + k % count);
            sums[plan.place(window, tap / window, tap % window, channel)]
        };
        add_sums(sink, 1 + 2 * i, &(0..window * window * count).map(at).collect::<Vec<_>>());
        add_sums(sink, 2 + 2 * i, &sums[plan.taps * LANES + first..][..count]);
    }
}

impl Checked for ConvRelativePosition {
    fn cases() -> Vec<Case<Self>> {
        let case = |name, batch: usize, size: [usize; 2], c: usize, windows: &[(usize, usize)], tile| {
            let [height, width] = size;
            let heads = windows.iter().map(|w| w.1).sum::<usize>();
            let op = ConvRelativePosition { height, width, heads, windows: windows.to_vec(), tile: Tile::of(tile) };
            const NAMES: [[&str; 2]; 3] = [["w0", "b0"], ["w1", "b1"], ["w2", "b2"]];
            let mut inputs = vec![Input::random("qkv", [batch, height * width, 3 * c * heads])];
            for (&(window, heads), names) in windows.iter().zip(NAMES) {
                inputs.push(Input::random(names[0], [window, window, c * heads]));
                inputs.push(Input::random(names[1], [c * heads]));
            }
            Case::new(name, op, inputs)
        };
        vec![
            case("windows 3, 5 and 7", 2, [3, 4], 1, &[(3, 2), (5, 3), (7, 3)], 0),
            case("larger than the windows", 1, [8, 9], 1, &[(3, 1), (7, 1)], 0),
            case("a window to a block", 2, [2, 3], 8, &[(1, 2), (3, 1)], 0),
            case("two windows in a block", 1, [3, 2], 6, &[(3, 2), (5, 1)], 0),
            case("one token", 2, [1, 1], 2, &[(3, 1)], 0),
            case("a window of 9", 1, [3, 2], 2, &[(9, 1)], 0),
            case("tile less one", 2, [3, 2], 3, &[(3, 1)], 4),
            case("a whole tile", 2, [4, 2], 3, &[(3, 1)], 4),
            case("tile and one", 2, [5, 2], 3, &[(3, 1)], 4),
            case("no sample", 0, [2, 2], 3, &[(3, 1)], 0).flat(),
        ]
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        let count = random.extreme(1, 3);
        let windows: Vec<(usize, usize)> =
            (0..count).map(|_| (1 + 2 * random.extreme(0, LARGEST / 2), random.extreme(1, 3))).collect();
        let heads = windows.iter().map(|w| w.1).sum();
        let [height, width] = [random.extreme(1, 5), random.extreme(1, 17)];
        let tile = Tile::of(random.extreme(0, 4));
        let (batch, c) = (random.extreme(1, 3), random.pick(&[1, 2, 5, 8, 16]));
        let mut inputs = vec![Input::random("qkv", [batch, height * width, 3 * c * heads])];
        for (&(window, heads), names) in windows.iter().zip([["w0", "b0"], ["w1", "b1"], ["w2", "b2"]]) {
            inputs.push(Input::random(names[0], [window, window, c * heads]));
            inputs.push(Input::random(names[1], [c * heads]));
        }
        Some(Case::drawn(ConvRelativePosition { height, width, heads, windows, tile }, inputs))
    }
}

impl<T: Float> Var<T> {
    /// `q * (depthwise convolution of v)` of q, k and v side by side in [batch, height * width, 3 C]; each window
    /// (extent, heads, weight [extent, extent, channels], bias \[channels\]) over the next heads in order.
    #[track_caller]
    pub fn conv_relative_position(
        &self,
        height: usize,
        width: usize,
        heads: usize,
        windows: &[(usize, usize, &Self, &Self)],
    ) -> Self {
        let extents = windows.iter().map(|w| (w.0, w.1)).collect();
        let mut inputs = vec![self];
        windows.iter().for_each(|w| inputs.extend([w.2, w.3]));
        apply1(ConvRelativePosition { height, width, heads, windows: extents, tile: Tile::AUTO }, &inputs)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    fn tensor<T: Float>(random: &mut Random, shape: &[usize]) -> Tensor<T> {
        Tensor::build(shape, |o| o.iter_mut().for_each(|x| *x = T::of(random.uniform(-1.0, 1.0))))
    }

    #[test]
    fn agrees_with_the_sum_it_stands_for() {
        let (batch, height, width, heads, c) = (2, 5, 7, 8, 6);
        let channels = heads * c;
        let mut random = Random::new(1, 5);
        let qkv: Tensor<f64> = tensor(&mut random, &[batch, height * width, 3 * channels]);
        let windows = [(3, 2), (5, 3), (7, 3)];
        let parameters: Vec<(Var<f64>, Var<f64>)> = (windows.iter())
            .map(|&(k, h)| (tensor(&mut random, &[k, k, h * c]).into(), tensor(&mut random, &[h * c]).into()))
            .collect();
        let list: Vec<_> = windows.iter().zip(&parameters).map(|(&(k, h), (w, b))| (k, h, w, b)).collect();
        let y = Var::constant(qkv.clone()).conv_relative_position(height, width, heads, &list);
        let mut first = 0;
        for (k, h, w, b) in list {
            for (i, channel) in (first..first + h * c).enumerate() {
                for (n, at) in (0..batch).flat_map(|n| (0..height * width).map(move |at| (n, at))) {
                    let (row, column) = (at / width, at % width);
                    let mut sum = b.value().data()[i];
                    for (dy, dx) in (0..k).flat_map(|dy| (0..k).map(move |dx| (dy, dx))) {
                        let (y, x) = (row + dy, column + dx);
                        if y >= k / 2 && x >= k / 2 && y < height + k / 2 && x < width + k / 2 {
                            let token = (y - k / 2) * width + x - k / 2;
                            sum += w.value().at(&[dy, dx, i]) * qkv.at(&[n, token, 2 * channels + channel]);
                        }
                    }
                    let expected = sum * qkv.at(&[n, at, channel]);
                    assert!((y.value().at(&[n, at, channel]) - expected).abs() < 1e-13);
                }
            }
            first += h * c;
        }
    }
}
