//! The per-pixel minimum over candidate losses (Godard et al., 1806.01260), and its mean.

use crate::ops::Tile;
use crate::ops::support::put::put;
use crate::ops::support::sums::pairwise_sum;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply};
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// Minimum reprojection: the mean over pixels of the minimum over `candidates`, one or more tensors of one shape; and
/// (auxiliary) the index of the winner of each pixel, in that shape.
///
/// With the unwarped sources among the candidates this is the auto-mask: a pixel that one of them wins has no gradient
/// to give. Of several equal candidates the first wins. A NaN wins, so that the mean shows it.
#[derive(Clone, Copy, Debug, Default)]
pub struct MinReprojection {
    /// Pixels handed to a thread at a time, each a partial sum; 2^13 by default.
    pub tile: Tile,
}

impl MinReprojection {
    fn tile(&self) -> usize {
        self.tile.or(1 << 13)
    }
}

impl<T: Float> Op<T> for MinReprojection {
    /// The winners, and the number of candidates.
    type Saved = (Tensor<T>, usize);

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let Some(first) = inputs.first() else {
            return Err(ShapeError::new("expected at least one candidate"));
        };
        if first.is_empty() || inputs.iter().any(|s| s != first) {
            return Err(ShapeError::new("expected candidates of one shape, with at least one pixel"));
        }
        Ok(vec![Shape::new(&[]), *first])
    }

    fn auxiliary(&self) -> usize {
        1
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let (n, tile) = (inputs[0].len(), self.tile());
        let mut sums = vec![T::ZERO; n.div_ceil(tile)];
        let winner = Tensor::build(*inputs[0].shape(), |winner| {
            let pieces = winner.chunks_mut(tile).zip(&mut sums).enumerate();
            parallel::for_each_piece(pieces, 4 * n * inputs.len(), |(i, (winner, sum))| {
                let part = |k: usize| &inputs[k].data()[i * tile..][..winner.len()];
                let mut best = Tensor::build([winner.len()], |best| best.copy_from_slice(part(0)));
                let best = best.data_mut();
                winner.fill(T::ZERO);
                for (k, candidate) in inputs.iter().enumerate().skip(1) {
                    let (candidate, index) = (&candidate.data()[i * tile..][..winner.len()], T::of(k as f64));
                    T::dispatch(
                        #[inline(always)]
                        || {
                            for ((best, winner), &x) in best.iter_mut().zip(winner.iter_mut()).zip(candidate) {
                                let better = x < *best || (x.is_nan() && !best.is_nan());
                                *best = if better { x } else { *best };
                                *winner = if better { index } else { *winner };
                            }
                        },
                    );
                }
                *sum = pairwise_sum(best);
            });
        });
        let mean = pairwise_sum(&sums) / T::of(n as f64);
        (vec![Tensor::scalar(mean), winner.clone()], (winner, inputs.len()))
    }

    /// The winner of a pixel gets dL/dmean over the number of pixels, the others nothing.
    fn backward(&self, (winner, candidates): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let share = upstream.only().item() / T::of(winner.len() as f64);
        for k in 0..candidates {
            let index = T::of(k as f64);
            sink.accumulate(k, |out, accum| {
                let terms = out.iter_mut().zip(winner.data());
                T::dispatch(
                    #[inline(always)]
                    || put(accum, terms.map(|(d, &w)| (d, if w == index { share } else { T::ZERO }))),
                );
            });
        }
    }
}

impl Checked for MinReprojection {
    fn cases() -> Vec<Case<Self>> {
        let op = |tile| MinReprojection { tile: Tile::of(tile) };
        let inputs = |names: &[&'static str]| -> Vec<Input> {
            names.iter().map(|name| Input::random(name, [2, 3, 5, 1])).collect()
        };
        let mut noisy = inputs(&["warped", "other", "unwarped"]);
        let unwarped = noisy.remove(2).constant("the unwarped source and its noise depend on no parameter");
        noisy.push(unwarped);
        let tied = |name| Input::values(name, [1, 1, 3, 1], [0.5, -1.0, 2.0]);
        vec![
            Case::new("four candidates", op(0), inputs(&["warped", "other", "third", "fourth"])),
            Case::new("a constant among them", op(0), noisy),
            Case::new("one candidate", op(0), inputs(&["warped"])),
            Case::new("tile less one", op(31), inputs(&["warped", "other"])),
            Case::new("a whole tile", op(30), inputs(&["warped", "other"])),
            Case::new("tile and one", op(29), inputs(&["warped", "other"])),
            Case::new("ties", op(0), [tied("warped"), tied("other").ignored()]).kinks(6).promises(0, [1.0 / 3.0; 3]),
        ]
    }
}

impl<T: Float> Var<T> {
    /// The mean over pixels of the smallest of the candidates (each `[batch, height, width, 1]`), a scalar; and the
    /// index of the winner of each pixel, of the candidates' shape. The first of equal ones wins, and a NaN wins.
    #[track_caller]
    pub fn min_reprojection(candidates: &[&Self]) -> (Self, Tensor<T>) {
        let [mean, winner] = apply(MinReprojection::default(), candidates).try_into().ok().expect("two outputs");
        (mean, winner.into_value())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_of_equals_wins_and_nan_wins() {
        let candidate = |x: [f64; 3]| Var::constant(Tensor::from_vec([1, 1, 3, 1], x.to_vec()));
        let (a, b) = (candidate([1.0, 2.0, 0.5]), candidate([1.0, 1.0, 0.7]));
        let (mean, winner) = Var::min_reprojection(&[&a, &b]);
        assert_eq!(winner.data(), [0.0, 1.0, 0.0]);
        assert!((mean.value().item() - 2.5 / 3.0).abs() < 1e-15);
        for (i, pair) in [[f64::NAN, 0.1, 0.1], [0.1, 0.1, f64::NAN]].into_iter().enumerate() {
            let nan = candidate(pair);
            let (mean, winner) = Var::min_reprojection(&[&nan, &a]);
            assert!(mean.value().item().is_nan());
            assert_eq!(winner.data()[2 * i], 0.0);
            let (mean, winner) = Var::min_reprojection(&[&a, &nan]);
            assert!(mean.value().item().is_nan());
            assert_eq!(winner.data()[2 * i], 1.0);
        }
    }
}
