//! Reversal along an axis.

use crate::ops::support::axes::cut;
use crate::ops::support::put::put_run;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// Flip of dimension `axis`: `y[i] = x[n - 1 - i]`, in the same shape. Along dimension 2 an image is mirrored.
#[derive(Clone, Copy, Debug)]
pub struct Flip {
    /// Dimension, from 0.
    pub axis: usize,
}

/// `out = ` the numbers of `x` reversed along an axis, or added to what is there: the value, and the gradient too.
fn reversed<T: Float>(out: &mut [T], accum: Accum, x: &Tensor<T>, axis: usize) {
    let [_, n, inner] = cut(x.shape(), axis, 1);
    parallel::for_each_unit(out, n * inner, x.len(), |i, out| {
        let x = &x.data()[i * n * inner..][..n * inner];
        for (out, x) in out.chunks_exact_mut(inner).zip(x.chunks_exact(inner).rev()) {
            put_run(accum, out, x);
        }
    });
}

impl<T: Float> Op<T> for Flip {
    type Saved = ();

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        if self.axis >= inputs[0].rank() {
            return Err(ShapeError::new(format!("no dimension {}", self.axis)));
        }
        Ok(vec![inputs[0]])
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, ()) {
        let y = Tensor::build(*inputs[0].shape(), |out| reversed(out, Accum::Replace, inputs[0], self.axis));
        (vec![y], ())
    }

    /// Element i came from n - 1 - i, and what came from i went to n - 1 - i: the gradient is reversed too.
    fn backward(&self, _: (), upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        sink.accumulate(0, |out, accum| reversed(out, accum, &g, self.axis));
    }
}

impl Checked for Flip {
    fn cases() -> Vec<Case<Self>> {
        let case = |name, axis, shape: &[usize]| Case::new(name, Flip { axis }, [Input::random("x", shape)]);
        vec![
            case("first axis", 0, &[3, 2, 2]),
            case("middle axis", 1, &[2, 4, 3]),
            case("last axis", 2, &[2, 3, 5]),
            case("a mirrored image", 2, &[2, 2, 3, 3]),
            case("a vector", 0, &[4]),
            case("an extent of 1", 1, &[3, 1, 2]),
            case("nothing", 1, &[2, 0]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// Dimension `axis` backwards, in the same shape.
    #[track_caller]
    pub fn flip(&self, axis: usize) -> Self {
        apply1(Flip { axis }, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flip_reverses_its_axis_and_undoes_itself() {
        let x = Var::constant(Tensor::from_vec([2, 3, 1], (0..6).map(f64::from).collect()));
        assert_eq!(x.flip(0).value().data(), [3.0, 4.0, 5.0, 0.0, 1.0, 2.0]);
        assert_eq!(x.flip(1).value().data(), [2.0, 1.0, 0.0, 5.0, 4.0, 3.0]);
        assert_eq!(x.flip(2).value().data(), x.value().data());
        for axis in 0..3 {
            assert!(x.flip(axis).flip(axis).value().same_bits(x.value()));
        }
    }

    #[test]
    #[should_panic(expected = "flip: no dimension 2 (inputs [[3, 2]])")]
    fn the_axis_must_exist() {
        Var::<f32>::constant(Tensor::zeros([3, 2])).flip(2);
    }
}
