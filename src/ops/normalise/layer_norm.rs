//! Layer normalisation over the last axis.

use pulp::{Simd, WithSimd};

use super::batch_norm::wide_statistics;
use crate::ops::Tile;
use crate::ops::support::put::put;
use crate::ops::support::sums::{add_sums, sum_of_pairs};
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::random::Random;
use crate::tensor::pool::Buffer;
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// `y = (x - mean) / sqrt(var + eps) * weight + bias`, mean and biased variance of each row of x [.., C] (Ba, Kiros and
/// Hinton, 1607.06450).
#[derive(Clone, Copy, Debug)]
pub struct LayerNorm {
    /// Added to the variance.
    pub eps: f64,
    /// Rows handed to a thread at a time.
    pub tile: Tile,
}

/// What the backward pass needs: x and the weight; statistics are computed again, from cache.
pub struct Saved<T: Float> {
    x: Tensor<T>,
    weight: Tensor<T>,
}

/// Mean and 1 / sqrt(var + eps) of every row of x, in two passes over it.
///
/// Rows are short: what counts is the sum over a vector's elements at the end of each, which the compiler makes of a plain
/// loop one element after the other.
struct Moments<'a, T> {
    x: &'a [T],
    eps: T,
    out: &'a mut [[T; 2]],
}

impl<T: Float> WithSimd for Moments<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let (c, lanes) = (self.x.len() / self.out.len(), T::lanes::<S>());
        let share = T::ONE / T::of(c as f64);
        for (out, x) in self.out.iter_mut().zip(self.x.chunks_exact(c)) {
            let (whole, rest) = x.split_at(c - c % lanes);
            let mut sum = T::load_part(simd, rest);
            for x in whole.chunks_exact(lanes) {
                sum = T::vector_add(simd, sum, T::load(simd, x));
            }
            let mean = T::total(simd, sum) * share;
            let mut squares = T::splat(simd, T::ZERO);
            for x in whole.chunks_exact(lanes) {
                let x = T::vector_add(simd, T::load(simd, x), T::splat(simd, -mean));
                squares = T::fma(simd, x, x, squares);
            }
            let mut var = T::total(simd, squares);
            for &x in rest {
                var += (x - mean) * (x - mean);
            }
            let var = var * share;
            *out = [mean, T::ONE / (var + self.eps).sqrt()];
            if !var.is_finite() {
                let (mean, squares) = wide_statistics(x.iter().map(|x| x.f64()));
                *out = [T::of(mean), T::of(1.0 / (squares / c as f64 + self.eps.f64()).sqrt())];
            }
        }
    }
}

/// Mean and 1 / sqrt(var + eps) of each row of `c` elements.
fn moments<T: Float>(x: &[T], c: usize, eps: T) -> Vec<[T; 2]> {
    let mut out = vec![[T::ZERO; 2]; x.len() / c];
    if !out.is_empty() {
        T::dispatch_vector(Moments { x, eps, out: &mut out });
    }
    out
}

impl LayerNorm {
    /// Rows a tile: about 2^13 elements.
    fn tile(&self, c: usize) -> usize {
        self.tile.or(((1 << 13) / c).max(1))
    }
}

impl<T: Float> Op<T> for LayerNorm {
    type Saved = Option<Saved<T>>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let (x, c) = (inputs[0], inputs[0].last());
        if x.rank() == 0 || c == 0 || inputs[1..].iter().any(|s| s.dims() != [c]) {
            return Err(ShapeError::new("expected x [.., C] with C > 0, weight and bias of shape [C]"));
        }
        Ok(vec![x])
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let [x, weight, bias] = [inputs[0], inputs[1], inputs[2]];
        let c = x.shape().last();
        let (chunk, eps) = (self.tile(c) * c, T::of(self.eps));
        let y = Tensor::build(*x.shape(), |out| {
            let work = 6 * out.len();
            parallel::for_each_chunk(out, chunk, work, |i, out| {
                let x = &x.data()[i * chunk..][..out.len()];
                let moments = moments(x, c, eps);
                T::dispatch(
                    #[inline(always)]
                    || {
                        let rows = x.chunks_exact(c).zip(&moments);
                        for (y, (x, &[mean, rstd])) in out.chunks_exact_mut(c).zip(rows) {
                            for ((y, &x), (&w, &b)) in y.iter_mut().zip(x).zip(weight.data().iter().zip(bias.data())) {
                                *y = ((x - mean) * rstd).mul_add(w, b);
                            }
                        }
                    },
                );
            });
        });
        (vec![y], needs.any().then(|| Saved { x: x.clone(), weight: weight.clone() }))
    }

    /// With xhat = (x - mean) rstd and u = dy weight: dx = rstd (u - mean(u) - xhat mean(u xhat)), means over the row;
    /// dweight = sum dy xhat and dbias = sum dy, over the rows.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let Saved { x, weight } = saved.expect("saved for a wanted gradient");
        let g = upstream.only();
        let (c, rows) = (x.shape().last(), x.shape().rows());
        let (chunk, eps) = (self.tile(c) * c, T::of(self.eps));
        let share = T::ONE / T::of(c as f64);
        let weight = weight.data();
        sink.accumulate(0, |out, accum| {
            let work = 10 * out.len();
            parallel::for_each_chunk(out, chunk, work, |i, out| {
                let (x, g) = (&x.data()[i * chunk..][..out.len()], &g.data()[i * chunk..][..out.len()]);
                let (mut products, moments) = (Buffer::<T>::stale(c), moments(x, c, eps));
                T::dispatch(
                    #[inline(always)]
                    || {
                        let rows = x.chunks_exact(c).zip(g.chunks_exact(c)).zip(&moments);
                        for (out, ((x, g), &[mean, rstd])) in out.chunks_exact_mut(c).zip(rows) {
                            products.iter_mut().zip(g.iter().zip(weight)).for_each(|(u, (&g, &w))| *u = g * w);
                            let level = sum_of_pairs(&products, x, |u, _| u) * share;
                            let slope = sum_of_pairs(&products, x, |u, x| u * (x - mean)) * share * rstd * rstd;
                            let terms = out.iter_mut().zip(products.iter().zip(x));
                            put(accum, terms.map(|(o, (&u, &x))| (o, (u - level - (x - mean) * slope) * rstd)));
                        }
                    },
                );
            });
        });
        if !sink.wants(1) && !sink.wants(2) {
            return;
        }
        let mut parts = Buffer::<T>::stale((rows * c).div_ceil(chunk) * 2 * c);
        parallel::for_each_unit(&mut parts, 2 * c, 8 * x.len(), |i, part| {
            let end = ((i + 1) * chunk).min(x.len());
            let (x, g) = (&x.data()[i * chunk..end], &g.data()[i * chunk..end]);
            let (dweight, dbias) = part.split_at_mut(c);
            let moments = moments(x, c, eps);
            T::dispatch(
                #[inline(always)]
                || {
                    dweight.fill(T::ZERO);
                    dbias.fill(T::ZERO);
                    for ((x, g), &[mean, rstd]) in x.chunks_exact(c).zip(g.chunks_exact(c)).zip(&moments) {
                        let sums = dweight.iter_mut().zip(dbias.iter_mut());
                        for ((dw, db), (&x, &g)) in sums.zip(x.iter().zip(g)) {
                            *dw = g.mul_add((x - mean) * rstd, *dw);
                            *db += g;
                        }
                    }
                },
            );
        });
        let mut sums = vec![0.0; 2 * c];
        for part in parts.chunks_exact(2 * c) {
            sums.iter_mut().zip(part).for_each(|(s, p)| *s += p.f64());
        }
        add_sums(sink, 1, &sums[..c]);
        add_sums(sink, 2, &sums[c..]);
    }
}

impl Checked for LayerNorm {
    fn cases() -> Vec<Case<Self>> {
        let op = |tile| LayerNorm { eps: 1e-3, tile: Tile::of(tile) };
        let inputs = |rows: &[usize], c: usize| {
            let shape: Vec<usize> = rows.iter().copied().chain([c]).collect();
            [Input::random("x", &shape), Input::random("weight", [c]), Input::random("bias", [c])]
        };
        let one_channel = inputs(&[3], 1).map(|input| if input.name == "bias" { input } else { input.ignored() });
        vec![
            Case::new("tokens", op(0), inputs(&[2, 5], 7)),
            Case::new("a vector", op(0), inputs(&[], 6)),
            Case::new("two channels", op(0), inputs(&[2, 3], 2)),
            Case::new("as many channels as lanes", op(0), inputs(&[3], 16)),
            Case::new("lanes and a rest", op(0), inputs(&[2, 4], 37)),
            Case::new("tile less one", op(4), inputs(&[3], 8)),
            Case::new("a whole tile", op(4), inputs(&[4], 8)),
            Case::new("tile and one", op(4), inputs(&[5], 8)),
            Case::new("one channel: nothing varies", op(0), one_channel),
            Case::new("no rows", op(0), inputs(&[0], 3)).flat(),
        ]
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        // Of two channels little is left to have a gradient.
        let c = random.pick(&[3, 7, 16, 33]);
        let op = LayerNorm { eps: random.pick(&[1e-5, 1e-3]), tile: Tile::of(random.extreme(0, 5)) };
        let x = [random.extreme(1, 3), random.extreme(1, 7), c];
        Some(Case::drawn(op, [Input::random("x", x), Input::random("weight", [c]), Input::random("bias", [c])]))
    }
}

impl<T: Float> Var<T> {
    /// Normalises each row (the last axis) to mean 0 and variance 1, times `weight` plus `bias`.
    #[track_caller]
    pub fn layer_norm(&self, weight: &Self, bias: &Self, eps: f64) -> Self {
        apply1(LayerNorm { eps, tile: Tile::AUTO }, &[self, weight, bias])
    }
}
