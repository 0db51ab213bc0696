//! Dropout (Srivastava et al., 2014).

use crate::ops::support::put::put;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::random::Random;
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var, parallel, regime};

/// `y = x mask / keep`: elements whose mask is 0 are dropped, the others scaled so that the mean stays.
///
/// The mask has the shape of x and is not differentiated; [`dropout_mask`] draws it. A dropped element gives 0 and has
/// gradient 0 even if it is infinite or NaN. With `keep` 1 and a mask of ones this is the identity.
#[derive(Clone, Copy, Debug)]
pub struct Dropout {
    /// The probability that an element is kept: above 0, at most 1.
    pub keep: f64,
}

/// A mask of zeros and ones, each 1 with probability `keep`. Of ones alone for 1.
pub fn dropout_mask<T: Float>(shape: impl Into<Shape>, keep: f64, random: &mut Random) -> Tensor<T> {
    Tensor::build(shape, |out| out.iter_mut().for_each(|m| *m = if random.unit() < keep { T::ONE } else { T::ZERO }))
}

/// Elements handed to a thread at a time.
const CHUNK: usize = 1 << 14;

/// `out = x mask / keep`, or added to what is there: the value, and the gradient too.
fn masked<T: Float>(out: &mut [T], accum: Accum, x: &[T], mask: &[T], keep: f64) {
    let (scale, chunk, work) = (T::of(1.0 / keep), regime::size(CHUNK), 2 * out.len());
    let f = |x: T, m: T| if m == T::ZERO { T::ZERO } else { x * m * scale };
    parallel::for_each_chunk(out, chunk, work, |i, out| {
        let (x, mask) = (&x[i * chunk..][..out.len()], &mask[i * chunk..][..out.len()]);
        let terms = out.iter_mut().zip(x.iter().zip(mask));
        T::dispatch(
            #[inline(always)]
            || put(accum, terms.map(|(y, (&x, &m))| (y, f(x, m)))),
        );
    });
}

impl<T: Float> Op<T> for Dropout {
    /// The mask.
    type Saved = Tensor<T>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        if !(self.keep > 0.0 && self.keep <= 1.0) {
            return Err(ShapeError::new(format!("a probability of {} to keep an element", self.keep)));
        }
        if inputs[0] != inputs[1] {
            return Err(ShapeError::new("expected a mask in the shape of x"));
        }
        Ok(vec![inputs[0]])
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let [x, mask] = [inputs[0], inputs[1]];
        let y = Tensor::build(*x.shape(), |out| masked(out, Accum::Replace, x.data(), mask.data(), self.keep));
        (vec![y], mask.clone())
    }

    /// dx = dy mask / keep.
    fn backward(&self, mask: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        sink.accumulate(0, |out, accum| masked(out, accum, g.data(), mask.data(), self.keep));
    }
}

impl Checked for Dropout {
    fn cases() -> Vec<Case<Self>> {
        let case = |name, keep, shape: &[usize], mask: &[f64]| {
            let mask = Input::values("mask", shape, mask).constant("drawn, not computed");
            Case::new(name, Dropout { keep }, [Input::random("x", shape), mask])
        };
        let mixed = [1.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0];
        vec![
            case("some kept", 0.6, &[2, 3, 2], &mixed),
            case("few kept", 0.1, &[3, 4], &mixed),
            case("images", 0.5, &[1, 3, 2, 2], &mixed),
            case("everything kept", 1.0, &[4], &[1.0; 4]),
            case("nothing kept", 0.5, &[4], &[0.0; 4]).flat(),
            case("a scalar", 0.5, &[], &[1.0]),
            case("empty", 0.5, &[2, 0], &[]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// `x mask / keep`, for a mask of zeros and ones in the shape of this, drawn by [`dropout_mask`] with the same `keep`.
    #[track_caller]
    pub fn dropout(&self, mask: &Self, keep: f64) -> Self {
        apply1(Dropout { keep }, &[self, mask])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    #[test]
    fn what_is_dropped_is_0_and_has_exactly_no_gradient_whatever_it_was() {
        let tape = Tape::new();
        let x = tape.leaf(Tensor::from_vec([5], vec![f64::NAN, f64::INFINITY, -3.0, 2.0, f64::NAN]));
        let mask = Var::constant(Tensor::from_vec([5], vec![0.0, 0.0, 0.0, 1.0, 1.0]));
        let y = x.dropout(&mask, 0.5);
        assert_eq!(y.value().data()[..4], [0.0, 0.0, 0.0, 4.0]);
        assert!(y.value().data()[4].is_nan());
        let g = Tensor::from_vec([5], vec![1.0, f64::NAN, f64::INFINITY, 3.0, 4.0]);
        assert_eq!(tape.backward(&[(&y, g)]).get(&x).unwrap().data(), [0.0, 0.0, 0.0, 6.0, 8.0]);
    }

    #[test]
    fn keeping_everything_is_the_identity() {
        let mask = dropout_mask([1000], 1.0, &mut Random::new(1, 0));
        assert!(mask.data().iter().all(|&m| m == 1.0));
        let x = Var::constant(Tensor::from_vec([1000], (0..1000).map(|i| i as f32 / 7.0 - 50.0).collect()));
        assert!(x.dropout(&Var::constant(mask), 1.0).value().same_bits(x.value()));
    }

    #[test]
    fn a_mask_keeps_about_its_share_and_dropout_the_mean() {
        let mask = dropout_mask::<f64>([20_000], 0.8, &mut Random::new(2, 0));
        assert!(mask.data().iter().all(|&m| m == 0.0 || m == 1.0));
        let y = Var::constant(Tensor::full([20_000], 3.0)).dropout(&Var::constant(mask.clone()), 0.8);
        assert!(y.value().data().iter().zip(mask.data()).all(|(&y, &m)| y == 3.0 * m * 1.25));
        let mean = y.mean_all().value().item();
        assert!((mean - 3.0).abs() < 0.05, "{mean}");
    }

    #[test]
    #[should_panic(expected = "dropout: a probability of 0 to keep an element")]
    fn something_must_have_a_chance() {
        let x = Var::<f32>::constant(Tensor::zeros([3]));
        x.dropout(&x, 0.0);
    }
}
