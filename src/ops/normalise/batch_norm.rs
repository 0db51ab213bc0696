//! Batch normalisation with its activation in the same pass over memory, by the statistics of the batch
//! ([`BatchNorm`]) or by given ones ([`BatchNormEval`]).
//!
//! Everything is a loop over rows of C channels. So that few channels vectorise as well as many, a row is read together
//! with its followers, up to a `width` that is a multiple of the channels, and per-channel numbers are repeated to it.

use crate::ops::Tile;
use crate::ops::elementwise::unary::Function;
use crate::ops::support::epilogue::{repeat, width, with_activation};
use crate::ops::support::put::put;
use crate::ops::support::sums::add_sums;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply, apply1};
use crate::random::Random;
use crate::tensor::pool::Buffer;
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

pub use crate::ops::support::epilogue::Activation;

/// `y = act((x - mean) / sqrt(var + eps) * weight + bias)`, mean and (biased) variance of each channel over all rows of
/// x [.., C] (Ioffe and Szegedy, 1502.03167). Outputs y, and as auxiliary ones the mean \[C\] and the variance \[C\].
#[derive(Clone, Copy, Debug)]
pub struct BatchNorm {
    /// Added to the variance.
    pub eps: f64,
    /// What follows.
    pub activation: Activation,
    /// Rows handed to a thread at a time.
    pub tile: Tile,
}

/// The same with given statistics: inputs x, weight, bias, mean and variance, the last two constants.
#[derive(Clone, Copy, Debug)]
pub struct BatchNormEval {
    /// Added to the variance.
    pub eps: f64,
    /// What follows.
    pub activation: Activation,
    /// Rows handed to a thread at a time.
    pub tile: Tile,
}

/// What the backward pass needs: x, from which the normalised value is computed again, and C numbers of each kind.
pub struct Saved<T: Float> {
    x: Tensor<T>,
    weight: Tensor<T>,
    bias: Tensor<T>,
    mean: Tensor<T>,
    /// 1 / sqrt(var + eps).
    rstd: Vec<T>,
}

/// Rows a tile: about 2^14 elements, which stay in the inner caches between the two passes of the statistics.
fn tile_rows(tile: Tile, c: usize) -> usize {
    tile.or(((1 << 14) / c).max(1))
}

/// Sums of lanes that belong to the same channel.
#[inline(always)]
fn fold<T: Float>(out: &mut [T], lanes: &[T]) {
    out.fill(T::ZERO);
    for lanes in lanes.chunks_exact(out.len()) {
        out.iter_mut().zip(lanes).for_each(|(s, &x)| *s += x);
    }
}

/// Mean and biased variance of each channel.
///
/// Each tile has its mean subtracted before squaring (two passes, the second from cache); tiles are joined in order and
/// in f64 (Chan, Golub and LeVeque 1979), so that neither a large mean nor many rows cost digits.
fn statistics<T: Float>(x: &[T], c: usize, tile: usize) -> (Vec<f64>, Vec<f64>) {
    let (rows, width) = (x.len() / c, width(c));
    let mut parts = Buffer::<T>::stale(rows.div_ceil(tile) * 2 * c);
    parallel::for_each_unit(&mut parts, 2 * c, 2 * x.len(), |i, part| {
        let x = &x[i * tile * c..((i + 1) * tile).min(rows) * c];
        let share = T::ONE / T::of((x.len() / c) as f64);
        let (mean, squares) = part.split_at_mut(c);
        let (mut sums, mut centre) = (Buffer::<T>::stale(width), Buffer::<T>::stale(width));
        T::dispatch(
            #[inline(always)]
            || {
                sums.fill(T::ZERO);
                for x in x.chunks(width) {
                    sums.iter_mut().zip(x).for_each(|(s, &x)| *s += x);
                }
                fold(mean, &sums);
                mean.iter_mut().for_each(|m| *m *= share);
                centre.chunks_exact_mut(c).for_each(|l| l.copy_from_slice(mean));
                sums.fill(T::ZERO);
                for x in x.chunks(width) {
                    for (s, (&x, &m)) in sums.iter_mut().zip(x.iter().zip(centre.iter())) {
                        let d = x - m;
                        *s = d.mul_add(d, *s);
                    }
                }
                fold(squares, &sums);
            },
        );
    });
    let (mut mean, mut squares) = (vec![0.0; c], vec![0.0; c]);
    let mut before = 0.0;
    for (i, part) in parts.chunks_exact(2 * c).enumerate() {
        let here = (tile.min(rows - i * tile)) as f64;
        let of_tile = &x[i * tile * c..((i + 1) * tile).min(rows) * c];
        let share = here / (before + here);
        for (k, (mean, squares)) in mean.iter_mut().zip(&mut squares).enumerate() {
            let (mut centre, mut spread) = (part[k].f64(), part[c + k].f64());
            if !(centre.is_finite() && spread.is_finite()) {
                (centre, spread) = wide_statistics(of_tile.iter().skip(k).step_by(c).map(|x| x.f64()));
            }
            let step = centre - *mean;
            *mean += step * share;
            *squares += spread + step * step * before * share;
        }
        before += here;
    }
    squares.iter_mut().for_each(|s| *s /= rows as f64);
    (mean, squares)
}

/// The mean of some numbers, and the sum of squares around it, in f64: for those whose sums or squares overflow f32.
pub(super) fn wide_statistics(x: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let (sum, count) = x.clone().fold((0.0, 0.0), |(sum, count), x| (sum + x, count + 1.0));
    let mean = sum / count;
    (mean, x.map(|x| (x - mean) * (x - mean)).sum())
}

/// weight / sqrt(var + eps).
fn scale<T: Float>(weight: &[T], rstd: &[T]) -> Vec<T> {
    weight.iter().zip(rstd).map(|(&w, &r)| w * r).collect()
}

fn rstd<T: Float>(var: impl IntoIterator<Item = f64>, eps: f64) -> Vec<T> {
    var.into_iter().map(|v| T::of(1.0 / (v + eps).sqrt())).collect()
}

/// `act((x - mean) scale + bias)`.
fn normalise<T: Float>(s: &Saved<T>, activation: Activation, tile: usize) -> Tensor<T> {
    with_activation!(activation, |f| normalise_with(s, f, tile))
}

/// What the kernels read beside a row: for each of its channels the mean, weight / sqrt(var + eps) and the bias, repeated
/// to the width of the rows that are read at a time.
struct Lanes<T: Float> {
    width: usize,
    mean: Buffer<T>,
    scale: Buffer<T>,
    bias: Buffer<T>,
}

impl<T: Float> Lanes<T> {
    fn of(s: &Saved<T>) -> Self {
        let width = width(s.mean.data().len());
        let [mean, scale, bias] =
            [s.mean.data(), &scale(s.weight.data(), &s.rstd), s.bias.data()].map(|numbers| repeat(width, numbers));
        Lanes { width, mean, scale, bias }
    }

    /// (mean, scale, bias) of each number of a row.
    #[inline(always)]
    fn iter(&self) -> impl Iterator<Item = (T, T, T)> {
        self.mean.iter().zip(self.scale.iter()).zip(self.bias.iter()).map(|((&m, &s), &b)| (m, s, b))
    }
}

fn normalise_with<T: Float>(s: &Saved<T>, act: impl Function, tile: usize) -> Tensor<T> {
    let (lanes, chunk) = (Lanes::of(s), tile * s.x.shape().last());
    Tensor::build(*s.x.shape(), |out| {
        let work = 4 * out.len();
        parallel::for_each_chunk(out, chunk, work, |i, out| {
            let x = &s.x.data()[i * chunk..][..out.len()];
            T::dispatch(
                #[inline(always)]
                || {
                    for (out, x) in out.chunks_mut(lanes.width).zip(x.chunks(lanes.width)) {
                        for ((y, &x), (m, s, b)) in out.iter_mut().zip(x).zip(lanes.iter()) {
                            *y = act.f((x - m).mul_add(s, b));
                        }
                    }
                },
            );
        });
    })
}

/// The gradients of x, weight and bias.
///
/// With z = xhat weight + bias, xhat = (x - mean) / sqrt(var + eps), dz = dy act'(z): dbias = sum dz,
/// dweight = sum dz xhat. Given statistics: dx = dz scale, scale = weight / sqrt(var + eps). Those of n rows also move:
/// dx = scale (dz - dbias / n - xhat dweight / n).
fn backward<T: Float>(
    s: Saved<T>,
    activation: Activation,
    tile: usize,
    moving: bool,
    g: Tensor<T>,
    sink: &mut GradSink<T>,
) {
    with_activation!(activation, |f| backward_with(s, f, tile, moving, g, sink))
}

fn backward_with<T: Float>(
    s: Saved<T>,
    act: impl Function,
    tile: usize,
    moving: bool,
    g: Tensor<T>,
    sink: &mut GradSink<T>,
) {
    let (lanes, c) = (Lanes::of(&s), s.x.shape().last());
    let [dbias, dweight] = if moving || sink.wants(1) || sink.wants(2) {
        parameter_gradients(&s, act, &lanes, tile * c, g.data())
    } else {
        [vec![0.0; c], vec![0.0; c]]
    };
    sink.accumulate(0, |out, accum| {
        // What the movement of the statistics takes from each channel: a number, and one times x - mean.
        let (n, scale) = (s.x.shape().rows() as f64, scale(s.weight.data(), &s.rstd));
        let share = |sum: &[f64], factor: &dyn Fn(usize) -> f64| -> Vec<T> {
            if !moving {
                return vec![T::ZERO; c];
            }
            sum.iter().enumerate().map(|(k, d)| T::of(scale[k].f64() * factor(k) * d / n)).collect()
        };
        let shares = [share(&dbias, &|_| 1.0), share(&dweight, &|k| s.rstd[k].f64())];
        input_gradient(out, accum, [s.x.data(), g.data()], act, &lanes, tile * c, shares);
    });
    add_sums(sink, 1, &dweight);
    add_sums(sink, 2, &dbias);
}

/// The gradients of bias and weight: sums of dz and of dz xhat, of the rows of each chunk and then of all chunks.
fn parameter_gradients<T: Float>(
    s: &Saved<T>,
    act: impl Function,
    lanes: &Lanes<T>,
    chunk: usize,
    g: &[T],
) -> [Vec<f64>; 2] {
    let (x, c, width) = (s.x.data(), s.x.shape().last(), lanes.width);
    let mut parts = Buffer::<T>::stale(x.len().div_ceil(chunk) * 2 * c);
    parallel::for_each_unit(&mut parts, 2 * c, 4 * x.len(), |i, part| {
        let end = ((i + 1) * chunk).min(x.len());
        let (x, g) = (&x[i * chunk..end], &g[i * chunk..end]);
        let (mut plain, mut centred) = (Buffer::<T>::stale(width), Buffer::<T>::stale(width));
        let (dbias, dweight) = part.split_at_mut(c);
        T::dispatch(
            #[inline(always)]
            || {
                plain.fill(T::ZERO);
                centred.fill(T::ZERO);
                for (x, g) in x.chunks(width).zip(g.chunks(width)) {
                    let sums = plain.iter_mut().zip(centred.iter_mut());
                    for (((p, q), (&x, &g)), (m, s, b)) in sums.zip(x.iter().zip(g)).zip(lanes.iter()) {
                        let d = x - m;
                        let dz = g * act.slope(d.mul_add(s, b));
                        *p += dz;
                        *q = dz.mul_add(d, *q);
                    }
                }
                fold(dbias, &plain);
                fold(dweight, &centred);
            },
        );
    });
    let mut sums = [vec![0.0; c], vec![0.0; c]];
    for part in parts.chunks_exact(2 * c) {
        for (sums, part) in sums.iter_mut().zip(part.chunks_exact(c)) {
            sums.iter_mut().zip(part).for_each(|(s, p)| *s += p.f64());
        }
    }
    sums[1].iter_mut().zip(&s.rstd).for_each(|(d, r)| *d *= r.f64());
    sums
}

/// `dx = dz scale - shift - (x - mean) slope`, where `shift` and `slope` are the channels' shares.
fn input_gradient<T: Float>(
    out: &mut [T],
    accum: Accum,
    [x, g]: [&[T]; 2],
    act: impl Function,
    lanes: &Lanes<T>,
    chunk: usize,
    shares: [Vec<T>; 2],
) {
    let width = lanes.width;
    let [shift, slope] = shares.map(|numbers| repeat(width, &numbers));
    let work = 6 * out.len();
    parallel::for_each_chunk(out, chunk, work, |i, out| {
        let (x, g) = (&x[i * chunk..][..out.len()], &g[i * chunk..][..out.len()]);
        T::dispatch(
            #[inline(always)]
            || {
                for (out, (x, g)) in out.chunks_mut(width).zip(x.chunks(width).zip(g.chunks(width))) {
                    let terms =
                        out.iter_mut().zip(x.iter().zip(g)).zip(lanes.iter()).zip(shift.iter().zip(slope.iter()));
                    put(
                        accum,
                        terms.map(|(((o, (&x, &g)), (m, s, b)), (&p, &q))| {
                            let d = x - m;
                            (o, (g * act.slope(d.mul_add(s, b))).mul_add(s, -d.mul_add(q, p)))
                        }),
                    );
                }
            },
        );
    });
}

/// The channels, if vectors of as many numbers stand beside a nonempty x.
fn channels(inputs: &[Shape], names: &str) -> Result<usize, ShapeError> {
    let x = inputs[0];
    let c = x.last();
    if x.rank() == 0 || inputs[1..].iter().any(|s| s.dims() != [c]) {
        return Err(ShapeError::new(format!("expected x [.., C] and {names} of shape [C]")));
    }
    if x.is_empty() {
        return Err(ShapeError::new("nothing has no statistics"));
    }
    Ok(c)
}

impl<T: Float> Op<T> for BatchNorm {
    type Saved = Option<Saved<T>>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let c = channels(inputs, "weight and bias")?;
        Ok(vec![inputs[0], [c].into(), [c].into()])
    }

    fn auxiliary(&self) -> usize {
        2
    }

    fn algo(&self, _: &[Shape]) -> &'static str {
        self.activation.name()
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let x = inputs[0];
        let c = x.shape().last();
        let tile = tile_rows(self.tile, c);
        let (mean, var) = statistics(x.data(), c, tile);
        let tensor =
            |numbers: &[f64]| Tensor::build([c], |out| out.iter_mut().zip(numbers).for_each(|(o, &x)| *o = T::of(x)));
        let (mean, var, rstd) = (tensor(&mean), tensor(&var), rstd(var, self.eps));
        let saved =
            Saved { x: x.clone(), weight: inputs[1].clone(), bias: inputs[2].clone(), mean: mean.clone(), rstd };
        let y = normalise(&saved, self.activation, tile);
        (vec![y, mean, var], needs.any().then_some(saved))
    }

    /// See `backward` above: the statistics move with x.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let saved = saved.expect("saved for a wanted gradient");
        let tile = tile_rows(self.tile, saved.x.shape().last());
        backward(saved, self.activation, tile, true, upstream.only(), sink);
    }
}

impl<T: Float> Op<T> for BatchNormEval {
    type Saved = Option<Saved<T>>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        channels(inputs, "weight, bias, mean and variance")?;
        Ok(vec![inputs[0]])
    }

    fn algo(&self, _: &[Shape]) -> &'static str {
        self.activation.name()
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let [x, weight, bias, mean, var] = std::array::from_fn(|i| inputs[i].clone());
        let tile = tile_rows(self.tile, x.shape().last());
        let rstd = rstd(var.data().iter().map(|v| v.f64()), self.eps);
        let saved = Saved { x, weight, bias, mean, rstd };
        let y = normalise(&saved, self.activation, tile);
        (vec![y], needs.any().then_some(saved))
    }

    /// See `backward` above: the statistics stand still.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let saved = saved.expect("saved for a wanted gradient");
        let tile = tile_rows(self.tile, saved.x.shape().last());
        backward(saved, self.activation, tile, false, upstream.only(), sink);
    }
}

/// Numbers whose normalised values, times 2 and plus 0.3, keep away from the kinks of the activations: the distances to
/// -3, 0 and 3 are at least 0.02.
fn spread(rows: usize, c: usize) -> Vec<f64> {
    let step = 2.0 * 1.6 / rows as f64;
    (0..rows * c)
        .map(|i| {
            let (row, channel) = (i / c, i % c);
            // Every channel has the rows in another order, and its own place and size.
            let at = (row * 7 + channel * 5 + (row * channel) % 3) % rows;
            (0.5 + channel as f64 * 0.1) * (-1.6 + step * (at as f64 + 0.5)) + 0.3 * channel as f64
        })
        .collect()
}

impl Checked for BatchNorm {
    fn cases() -> Vec<Case<Self>> {
        let mut cases = Vec::new();
        for activation in Activation::ALL {
            let op = |tile| BatchNorm { eps: 1e-3, activation, tile: Tile::of(tile) };
            // 1, 3, 8, 17 and 128 channels: one and several rows side by side, with and without a remainder.
            let inputs = |rows: &[usize], c: usize| {
                let shape: Vec<usize> = rows.iter().copied().chain([c]).collect();
                let values = spread(rows.iter().product(), c);
                let weights: Vec<f64> = (0..c).map(|k| 2.0 - 0.003 * k as f64).collect();
                let biases: Vec<f64> = (0..c).map(|k| 0.3 + 0.0002 * k as f64).collect();
                [
                    Input::values("x", &shape, values),
                    Input::values("weight", [c], weights),
                    Input::values("bias", [c], biases),
                ]
            };
            cases.extend([
                Case::new("an image", op(0), inputs(&[2, 3, 4], 3)),
                Case::new("one channel", op(0), inputs(&[2, 7, 2], 1)),
                Case::new("8 channels", op(0), inputs(&[2, 5, 4], 8)),
                Case::new("17 channels", op(0), inputs(&[2, 3, 5], 17)),
                Case::new("more channels than lanes", op(0), inputs(&[4], 130)),
                Case::new("tile less one", op(8), inputs(&[7], 5)),
                Case::new("a whole tile", op(8), inputs(&[8], 5)),
                Case::new("tile and one", op(8), inputs(&[9], 5)),
                Case::new("several tiles", op(8), inputs(&[2, 25], 8)),
            ]);
        }
        cases
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        let c = random.pick(&[1, 3, 8, 17, 128]);
        let op = BatchNorm {
            eps: random.pick(&[1e-5, 1e-3]),
            activation: random.pick(&Activation::ALL),
            tile: Tile::of(random.extreme(0, 5)),
        };
        let x = [random.extreme(1, 4), random.extreme(2, 3), random.extreme(2, 3), c];
        Some(Case::drawn(op, [Input::random("x", x), Input::random("weight", [c]), Input::random("bias", [c])]))
    }
}

impl Checked for BatchNormEval {
    fn cases() -> Vec<Case<Self>> {
        let mut cases = Vec::new();
        for activation in Activation::ALL {
            let op = |tile| BatchNormEval { eps: 1e-3, activation, tile: Tile::of(tile) };
            let inputs = |rows: &[usize], c: usize| {
                let shape: Vec<usize> = rows.iter().copied().chain([c]).collect();
                let why = "statistics of evaluation are frozen buffers";
                let channel =
                    |low: f64, step: f64| (0..c).map(|k| low + step * ((k * 5) % 8) as f64).collect::<Vec<_>>();
                let (weight, bias) = (channel(-1.6, 0.43), channel(-0.5, 0.17));
                let (mean, var) = (channel(0.3, -0.09), channel(0.2, 0.25));
                // Normalised values on a grid of odd sixteenths, never at -3, 0 or 3.
                let x = (0..shape.iter().product::<usize>()).map(|i| {
                    let (k, z) = (i % c, ((i * 29) % 64) as f64 / 8.0 - 4.0 + 1.0 / 16.0);
                    (z - bias[k]) / weight[k] * (var[k] + 1e-3).sqrt() + mean[k]
                });
                [
                    Input::values("x", &shape, x.collect::<Vec<_>>()),
                    Input::values("weight", [c], weight.clone()),
                    Input::values("bias", [c], bias.clone()),
                    Input::values("running_mean", [c], mean.clone()).constant(why),
                    Input::values("running_var", [c], var.clone()).constant(why),
                ]
            };
            cases.extend([
                Case::new("an image", op(0), inputs(&[2, 3, 4], 3)),
                Case::new("one channel", op(0), inputs(&[2, 7, 2], 1)),
                Case::new("17 channels", op(0), inputs(&[2, 3, 5], 17)),
                Case::new("tile less one", op(8), inputs(&[7], 8)),
                Case::new("a whole tile", op(8), inputs(&[8], 8)),
                Case::new("tile and one", op(8), inputs(&[9], 8)),
            ]);
        }
        cases
    }
}

impl<T: Float> Var<T> {
    /// Normalises each channel over all rows by the statistics of the batch, times `weight` plus `bias`, and applies the
    /// activation. Also gives the mean and the biased variance of each channel.
    #[track_caller]
    pub fn batch_norm(
        &self,
        weight: &Self,
        bias: &Self,
        eps: f64,
        activation: Activation,
    ) -> (Self, Tensor<T>, Tensor<T>) {
        let outputs = apply(BatchNorm { eps, activation, tile: Tile::AUTO }, &[self, weight, bias]);
        let [y, mean, var] = outputs.try_into().ok().expect("three outputs");
        (y, mean.into_value(), var.into_value())
    }

    /// Normalises each channel by a given mean and variance, times `weight` plus `bias`, and applies the activation.
    /// Nothing flows to the statistics.
    #[track_caller]
    pub fn batch_norm_eval(
        &self,
        weight: &Self,
        bias: &Self,
        mean: &Self,
        var: &Self,
        eps: f64,
        activation: Activation,
    ) -> Self {
        apply1(
            BatchNormEval { eps, activation, tile: Tile::AUTO },
            &[self, weight, bias, &mean.detach(), &var.detach()],
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    #[test]
    fn statistics_in_f32_keep_their_digits_far_from_zero() {
        let (rows, c) = (30_720, 32);
        let mut random = Random::new(1, 2);
        let x: Vec<f32> = (0..rows * c).map(|_| (300.0 + random.uniform(-1.0, 1.0)) as f32).collect();
        let (mean, var) = statistics(&x, c, tile_rows(Tile::AUTO, c));
        for k in 0..c {
            let column = || x[k..].iter().step_by(c).map(|&x| x as f64);
            let m = column().sum::<f64>() / rows as f64;
            let v = column().map(|x| (x - m).powi(2)).sum::<f64>() / rows as f64;
            assert!((mean[k] - m).abs() < 1e-5, "{} for {m}", mean[k]);
            assert!((var[k] / v - 1.0).abs() < 1e-5, "{} for {v}", var[k]);
        }
    }
}
