//! Factorised attention: linear in the number of tokens, because keys meet values before queries.

use super::head_products::Heads;
use crate::ops::Tile;
use crate::ops::support::put::put_run;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::random::Random;
use crate::tensor::gemm::Rows;
use crate::tensor::pool::Buffer;
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// Factorised attention: `out = c^(-1/2) q (softmax(k)^T v)` for each head of c channels, the softmax over the tokens
/// (Xu et al. 2021, 2104.06399, equation 6).
///
/// The input [batch, tokens, 3 C] holds q, k and v beside each other, each head-major; the result is
/// [batch, tokens, C]. Nothing as large as a token map is stored between the passes: the first sums unnormalised
/// e^(k - max) v by tiles of tokens with their own maxima, the second multiplies by q.
#[derive(Clone, Copy, Debug)]
pub struct FactorisedAttention {
    /// Number of heads; C is a multiple of it.
    pub heads: usize,
    /// Tokens handed to a thread at a time, chosen by the shapes by default.
    pub tile: Tile,
}

/// The extents of an input.
#[derive(Clone, Copy)]
struct Extents {
    batch: usize,
    tokens: usize,
    heads: Heads,
    tile: usize,
}

/// What the backward pass needs; e^(k - max) / sum is computed again.
pub struct Saved<T: Float> {
    qkv: Tensor<T>,
    softmax: Statistics<T>,
    /// softmax(k)^T v, [batch, C, c].
    context: Buffer<T>,
}

/// The softmax of each channel over the tokens is e^(k - max) share.
struct Statistics<T: Float> {
    /// [batch, C].
    max: Buffer<T>,
    /// One over the sum, [batch, C].
    share: Buffer<T>,
}

impl FactorisedAttention {
    fn extents(&self, qkv: &Shape) -> Result<Extents, ShapeError> {
        let &[batch, tokens, channels] = qkv.dims() else {
            return Err(ShapeError::new("expected [batch, tokens, 3 C]"));
        };
        if channels == 0 || self.heads == 0 || channels % (3 * self.heads) != 0 {
            return Err(ShapeError::new(format!("{channels} channels are not q, k and v of {} heads", self.heads)));
        }
        let heads = Heads { heads: self.heads, c: channels / 3 / self.heads };
        let tile = self.tile.or(((1 << 15) / channels).max(16));
        Ok(Extents { batch, tokens, heads, tile })
    }
}

impl Extents {
    fn tiles(&self) -> usize {
        self.tokens.div_ceil(self.tile)
    }

    /// Cuts [batch, tokens, channels] by batch and tile; gives the batch's number too.
    fn cut<'a, T>(&self, data: &'a mut [T], channels: usize) -> impl Iterator<Item = (usize, usize, &'a mut [T])> {
        let (tile, tokens) = (self.tile, self.tokens);
        data.chunks_mut((tokens * channels).max(1)).enumerate().flat_map(move |(b, image)| {
            image.chunks_mut(tile * channels).enumerate().map(move |(t, out)| (b, b * tokens + t * tile, out))
        })
    }

    /// Columns `first..first + C` of the tokens of a tile, and how many tokens those are.
    fn rows<'a, T>(&self, data: &'a [T], stride: usize, b: usize, tile: usize, first: usize) -> Rows<'a, T> {
        let from = tile * self.tile;
        let rows = self.tile.min(self.tokens - from);
        Rows::columns(&data[(b * self.tokens + from) * stride..], rows, stride, first, self.heads.channels())
    }
}

impl<T: Float> Op<T> for FactorisedAttention {
    type Saved = Option<Saved<T>>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let e = self.extents(&inputs[0])?;
        Ok(vec![[e.batch, e.tokens, e.heads.channels()].into()])
    }

    fn algo(&self, inputs: &[Shape]) -> &'static str {
        match self.extents(&inputs[0]) {
            Ok(e) if e.heads.narrow() => "windows",
            _ => "gemm",
        }
    }

    fn flops(&self, inputs: &[Shape]) -> u64 {
        self.extents(&inputs[0]).map_or(0, |e| 4 * (e.batch * e.tokens * e.heads.channels() * e.heads.c) as u64)
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let qkv = inputs[0];
        let e = self.extents(qkv.shape()).expect("checked by the shape rule");
        let (heads, channels, stride) = (e.heads, e.heads.channels(), qkv.shape().last());
        let (softmax, context) = contexts(&e, qkv.data());
        let factor = T::of((heads.c as f64).powf(-0.5));
        let size = channels * heads.c;
        let matrices: Vec<_> = context.chunks_exact(size).map(|m| heads.matrices(m, false, factor)).collect();
        let y = Tensor::build([e.batch, e.tokens, channels], |out| {
            let work = 2 * out.len() * heads.c;
            parallel::for_each_piece(e.cut(out, channels), work, |(b, token, out)| {
                let q = Rows::columns(&qkv.data()[token * stride..], out.len() / channels, stride, 0, channels);
                heads.product(out, q, &matrices[b]);
            });
        });
        (vec![y], needs.any().then(|| Saved { qkv: qkv.clone(), softmax, context }))
    }

    /// With p = softmax(k), m = p^T v and f = c^(-1/2): dq = f dy m^T; dm = f q^T dy; dv = p dm; dp = v dm^T;
    /// dk = p (dp - sum p dp), and that sum over the tokens is, without going over them, the row sum of m dm.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let Saved { qkv, softmax, context } = saved.expect("saved for the only input");
        let g = upstream.only();
        let e = self.extents(qkv.shape()).expect("checked by the shape rule");
        let (heads, channels, stride) = (e.heads, e.heads.channels(), qkv.shape().last());
        let (qkv, g) = (qkv.data(), g.data());
        let (size, tiles) = (channels * heads.c, e.tiles());
        let factor = T::of((heads.c as f64).powf(-0.5));
        let mut parts = Buffer::<T>::stale(e.batch * tiles * size);
        parallel::for_each_unit(&mut parts, size, 2 * g.len() * heads.c, |i, part| {
            let (b, tile) = (i / tiles, i % tiles);
            heads.outer(part, e.rows(qkv, stride, b, tile, 0), e.rows(g, channels, b, tile, 0));
        });
        // For each sample: m^T f, dm, dm^T, and the row sums of m dm.
        let samples: Vec<[Buffer<T>; 4]> = (0..e.batch)
            .map(|b| {
                let mut dm = Buffer::filled(size, T::ZERO);
                for part in parts[b * tiles * size..][..tiles * size].chunks_exact(size) {
                    dm.iter_mut().zip(part).for_each(|(s, &p)| *s += p * factor);
                }
                let m = &context[b * size..][..size];
                let mut sums = Buffer::stale(channels);
                for (s, (m, dm)) in sums.iter_mut().zip(m.chunks_exact(heads.c).zip(dm.chunks_exact(heads.c))) {
                    *s = m.iter().zip(dm).map(|(&m, &dm)| m * dm).sum();
                }
                [
                    heads.matrices(m, true, factor),
                    heads.matrices(&dm, false, T::ONE),
                    heads.matrices(&dm, true, T::ONE),
                    sums,
                ]
            })
            .collect();
        sink.accumulate(0, |out, accum| {
            let work = 8 * out.len() * heads.c;
            parallel::for_each_piece(e.cut(out, stride), work, |(b, token, out)| {
                let rows = out.len() / stride;
                let qkv = &qkv[token * stride..][..out.len()];
                let g = Rows::dense(&g[token * channels..][..rows * channels], rows, channels);
                let [mt, dm, dmt, sums] = &samples[b];
                let (max, share) =
                    (&softmax.max[b * channels..][..channels], &softmax.share[b * channels..][..channels]);
                let (mut p, mut product) = (Buffer::stale(rows * channels), Buffer::stale(rows * channels));
                T::dispatch(
                    #[inline(always)]
                    || {
                        for (p, k) in p.chunks_exact_mut(channels).zip(qkv.chunks_exact(stride)) {
                            let lanes = max.iter().zip(share);
                            for ((p, &k), (&m, &s)) in p.iter_mut().zip(&k[channels..2 * channels]).zip(lanes) {
                                *p = (k - m).exp() * s;
                            }
                        }
                    },
                );
                heads.product(&mut product, g, mt);
                put(out, stride, 0, accum, &product, channels);
                heads.product(&mut product, Rows::columns(qkv, rows, stride, 2 * channels, channels), dmt);
                T::dispatch(
                    #[inline(always)]
                    || {
                        for (d, p) in product.chunks_exact_mut(channels).zip(p.chunks_exact(channels)) {
                            d.iter_mut().zip(p.iter().zip(sums.iter())).for_each(|(d, (&p, &s))| *d = p * (*d - s));
                        }
                    },
                );
                put(out, stride, channels, accum, &product, channels);
                heads.product(&mut product, Rows::dense(&p, rows, channels), dm);
                put(out, stride, 2 * channels, accum, &product, channels);
            });
        });
    }
}

/// Writes, or adds, a dense matrix to columns `first..` of one with wider rows.
fn put<T: Float>(out: &mut [T], stride: usize, first: usize, accum: Accum, dense: &[T], channels: usize) {
    for (out, d) in out.chunks_exact_mut(stride).zip(dense.chunks_exact(channels)) {
        let out = &mut out[first..first + channels];
        put_run(accum, out, d);
    }
}

/// The statistics of the softmax, and softmax(k)^T v of every sample.
///
/// Each tile of tokens gives its maxima, the sums of e^(k - its maximum), and their products with v; tiles are then
/// brought to the common maximum and added up in order.
fn contexts<T: Float>(e: &Extents, qkv: &[T]) -> (Statistics<T>, Buffer<T>) {
    let (heads, channels, stride) = (e.heads, e.heads.channels(), 3 * e.heads.channels());
    let (size, tiles) = (channels * heads.c, e.tiles());
    let mut parts = Buffer::<T>::stale(e.batch * tiles * (2 * channels + size));
    parallel::for_each_unit(&mut parts, 2 * channels + size, qkv.len() * (8 + heads.c), |i, part| {
        let (b, tile) = (i / tiles, i % tiles);
        let k = e.rows(qkv, stride, b, tile, channels);
        let (max, rest) = part.split_at_mut(channels);
        let (sum, product) = rest.split_at_mut(channels);
        let mut powers = Buffer::stale(k.rows * channels);
        T::dispatch(
            #[inline(always)]
            || {
                max.fill(-T::INFINITY);
                for k in k.data.chunks(stride).take(k.rows) {
                    max.iter_mut().zip(k).for_each(|(m, &k)| *m = m.max(k));
                }
                sum.fill(T::ZERO);
                for (p, k) in powers.chunks_exact_mut(channels).zip(k.data.chunks(stride)) {
                    for ((p, s), (&k, &m)) in p.iter_mut().zip(sum.iter_mut()).zip(k.iter().zip(max.iter())) {
                        // A tile of nothing but minus infinities adds nothing to the others.
                        *p = (k - if m == -T::INFINITY { T::ZERO } else { m }).exp();
                        *s += *p;
                    }
                }
            },
        );
        heads.outer(product, Rows::dense(&powers, k.rows, channels), e.rows(qkv, stride, b, tile, 2 * channels));
    });
    let mut max = Buffer::filled(e.batch * channels, -T::INFINITY);
    let mut share = Buffer::filled(e.batch * channels, T::ZERO);
    let mut context = Buffer::filled(e.batch * size, T::ZERO);
    // Compiled for the machine's vectors: without, every `mul_add` is a call into the C library.
    T::dispatch(
        #[inline(always)]
        || {
            for b in 0..e.batch {
                let parts = || parts.chunks_exact(2 * channels + size).skip(b * tiles).take(tiles);
                let (max, share) = (&mut max[b * channels..][..channels], &mut share[b * channels..][..channels]);
                let context = &mut context[b * size..][..size];
                for part in parts() {
                    max.iter_mut().zip(part).for_each(|(m, &p)| *m = m.max(p));
                }
                for part in parts() {
                    let rows = context.chunks_exact_mut(heads.c).zip(part[2 * channels..].chunks_exact(heads.c));
                    for (k, (context, product)) in rows.enumerate() {
                        let factor = (part[k] - max[k]).exp();
                        share[k] = factor.mul_add(part[channels + k], share[k]);
                        context.iter_mut().zip(product).for_each(|(s, &p)| *s = factor.mul_add(p, *s));
                    }
                }
                for (share, context) in share.iter_mut().zip(context.chunks_exact_mut(heads.c)) {
                    *share = T::ONE / *share;
                    context.iter_mut().for_each(|s| *s *= *share);
                }
            }
        },
    );
    (Statistics { max, share }, context)
}

impl Checked for FactorisedAttention {
    fn cases() -> Vec<Case<Self>> {
        let op = |heads, tile| FactorisedAttention { heads, tile: Tile::of(tile) };
        let qkv = |batch: usize, tokens: usize, c: usize| [Input::uniform("qkv", [batch, tokens, 3 * c], -2.0, 2.0)];
        vec![
            Case::new("windows", op(8, 0), qkv(2, 4, 16)),
            Case::new("windows over heads of 6", op(3, 0), qkv(2, 5, 18)),
            Case::new("heads of 15: groups of every size", op(2, 0), qkv(1, 5, 30)),
            Case::new("heads of 16", op(1, 0), qkv(2, 4, 16)),
            Case::new("windows, tile less one", op(2, 4), qkv(2, 3, 16)),
            Case::new("windows, a whole tile", op(2, 4), qkv(2, 4, 16)),
            Case::new("windows, tile and one", op(2, 4), qkv(2, 5, 16)),
            Case::new("few channels", op(2, 0), qkv(2, 5, 6)),
            Case::new("wide heads", op(1, 0), qkv(2, 4, 17)),
            Case::new("one channel", op(1, 0), qkv(2, 5, 1)),
            Case::new("gemm, tile less one", op(2, 4), qkv(2, 3, 4)),
            Case::new("gemm, a whole tile", op(2, 4), qkv(2, 4, 4)),
            Case::new("gemm, tile and one", op(2, 4), qkv(2, 5, 4)),
            Case::new("one token", op(2, 0), qkv(2, 1, 4)),
            Case::new("no sample", op(2, 0), qkv(0, 3, 4)).flat(),
        ]
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        let heads = random.pick(&[1, 2, 3, 8]);
        let channels = heads * random.pick(&[1, 2, 5, 6, 8, 15, 16, 17]);
        let qkv = [random.extreme(1, 3), random.extreme(1, 9), 3 * channels];
        let op = FactorisedAttention { heads, tile: Tile::of(random.extreme(0, 5)) };
        Some(Case::drawn(op, [Input::uniform("qkv", qkv, -2.0, 2.0)]))
    }
}

impl<T: Float> Var<T> {
    /// `c^(-1/2) q (softmax(k)^T v)` head by head, of q, k and v side by side in [batch, tokens, 3 C]; the softmax runs
    /// over the tokens.
    #[track_caller]
    pub fn factorised_attention(&self, heads: usize) -> Self {
        apply1(FactorisedAttention { heads, tile: Tile::AUTO }, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// Word for word, from ops that were checked by themselves.
    fn composed(qkv: &Var<f64>, heads: usize) -> Var<f64> {
        let &[batch, tokens, channels] = qkv.dims() else { unreachable!() };
        let c = channels / 3 / heads;
        let parts = qkv.reshape([batch, tokens, 3, heads, c]).into_value().permute(&[2, 0, 3, 1, 4]);
        let part = |i: usize| {
            let n = batch * tokens * heads * c;
            Var::constant(Tensor::from_vec([batch * heads, tokens, c], parts.data()[i * n..(i + 1) * n].to_vec()))
        };
        let (q, k, v) = (part(0), part(1).softmax(1), part(2));
        let context = Var::constant(k.value().permute(&[0, 2, 1])).matmul(&v);
        let y = q.matmul(&context).affine((c as f64).powf(-0.5), 0.0).into_value();
        let y = y.reshape([batch, heads, tokens, c]).permute(&[0, 2, 1, 3]);
        Var::constant(y.reshape([batch, tokens, heads * c]))
    }

    #[test]
    fn agrees_with_its_definition_step_by_step() {
        for (heads, c, tokens) in [(8, 6, 70), (2, 20, 33), (3, 1, 5)] {
            let mut random = Random::new(3, 4);
            let qkv = Tensor::build([2, tokens, 3 * heads * c], |o| {
                o.iter_mut().for_each(|x| *x = random.uniform(-3.0, 3.0));
            });
            let qkv = Var::constant(qkv);
            let fast = apply1(FactorisedAttention { heads, tile: Tile::of(16) }, &[&qkv]);
            let slow = composed(&qkv, heads);
            for (a, b) in fast.value().data().iter().zip(slow.value().data()) {
                assert!((a - b).abs() < 1e-13, "{a} {b}");
            }
        }
    }

    #[test]
    fn a_tile_of_minus_infinities_adds_nothing() {
        let mut qkv = Tensor::<f64>::full([1, 4, 3], 1.0);
        let low = f64::NEG_INFINITY;
        qkv.data_mut().iter_mut().skip(1).step_by(3).zip([low, low, -1000.0, -1000.0]).for_each(|(k, x)| *k = x);
        qkv.data_mut().iter_mut().skip(2).step_by(3).zip([7.0, 7.0, 1.0, 3.0]).for_each(|(v, x)| *v = x);
        let y = apply1(FactorisedAttention { heads: 1, tile: Tile::of(2) }, &[&Var::constant(qkv)]);
        assert_eq!(y.value().data(), [2.0; 4]);
    }
}
