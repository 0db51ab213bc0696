//! Repetition along an axis.

use crate::ops::support::axes::cut;
use crate::ops::support::put::begin_sum;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// Repetition of dimension `axis`, as a whole: `[.., n, ..]` -> `[.., n times, ..]`, `y[i] = x[i mod n]`.
#[derive(Clone, Copy, Debug)]
pub struct Repeat {
    /// Dimension, from 0.
    pub axis: usize,
    /// Number of repetitions.
    pub times: usize,
}

impl<T: Float> Op<T> for Repeat {
    /// The shape of x.
    type Saved = Shape;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        match inputs[0].dims().get(self.axis) {
            Some(n) => Ok(vec![inputs[0].with(self.axis, n * self.times)]),
            None => Err(ShapeError::new(format!("no dimension {}", self.axis))),
        }
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Shape) {
        let x = inputs[0];
        let [_, n, inner] = cut(x.shape(), self.axis, 1);
        let (run, times) = (n * inner, self.times);
        let y = Tensor::build(x.shape().with(self.axis, n * times), |out| {
            let work = out.len();
            parallel::for_each_unit(out, times * run, work, |i, out| {
                out.chunks_exact_mut(run).for_each(|out| out.copy_from_slice(&x.data()[i * run..][..run]));
            });
        });
        (vec![y], *x.shape())
    }

    /// An element gets the sum of the gradients of its copies, which stand n apart; its neighbours' stay theirs.
    fn backward(&self, shape: Shape, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let [_, n, inner] = cut(&shape, self.axis, 1);
        let (run, times) = (n * inner, self.times);
        sink.accumulate(0, |out, accum| {
            parallel::for_each_unit(out, run, g.len(), |i, out| {
                begin_sum(out, accum);
                for g in g.data()[i * times * run..][..times * run].chunks_exact(run) {
                    out.iter_mut().zip(g).for_each(|(d, &g)| *d += g);
                }
            });
        });
    }
}

impl Checked for Repeat {
    fn cases() -> Vec<Case<Self>> {
        let case =
            |name, axis, times, shape: &[usize]| Case::new(name, Repeat { axis, times }, [Input::random("x", shape)]);
        vec![
            case("first axis", 0, 2, &[3, 2, 2]),
            case("middle axis", 1, 3, &[2, 4, 3]),
            case("last axis", 2, 2, &[2, 3, 4]),
            case("rows of images", 1, 2, &[2, 3, 2, 2]),
            case("an extent of 1", 1, 4, &[3, 1, 2]),
            case("once", 0, 1, &[3, 2]),
            case("never", 1, 0, &[2, 3]).flat(),
            case("nothing", 0, 3, &[0, 2]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// The whole of dimension `axis`, `times` over: `[.., n, ..]` -> `[.., n times, ..]`.
    #[track_caller]
    pub fn repeat(&self, axis: usize, times: usize) -> Self {
        apply1(Repeat { axis, times }, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    #[test]
    fn repeats_follow_one_another_and_their_gradients_are_summed_each_for_itself() {
        let tape = Tape::new();
        let x = tape.leaf(Tensor::from_vec([2, 2], vec![1.0f64, 2.0, 3.0, 4.0]));
        let y = x.repeat(1, 3);
        assert_eq!(y.value().data(), [1.0, 2.0, 1.0, 2.0, 1.0, 2.0, 3.0, 4.0, 3.0, 4.0, 3.0, 4.0]);
        let g = Tensor::from_vec([2, 6], vec![1., 10., 2., 20., 3., 30., 4., 40., 5., 50., 6., 60.]);
        assert_eq!(tape.backward(&[(&y, g)]).get(&x).unwrap().data(), [6.0, 60.0, 15.0, 150.0]);
    }

    #[test]
    fn it_is_a_concatenation_with_itself() {
        let x = Var::constant(Tensor::from_vec([2, 3, 2], (0..12).map(f64::from).collect()));
        for axis in 0..3 {
            assert!(x.repeat(axis, 3).value().same_bits(Var::concat(&[&x; 3], axis).value()));
        }
    }
}
