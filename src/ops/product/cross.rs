//! The cross product of vectors.

use crate::ops::support::put::put;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var};

/// Cross product `a x b` along the last dimension, of three: `a [.., 3]`, `b [.., 3]` -> `[.., 3]`. No broadcasting.
#[derive(Clone, Copy, Debug)]
pub struct Cross;

/// `out = a x b`, or added to what is there, vector by vector.
fn products<T: Float>(out: &mut [T], accum: Accum, a: &[T], b: &[T]) {
    let vectors = a.as_chunks::<3>().0.iter().zip(b.as_chunks::<3>().0);
    for (out, (a, b)) in out.as_chunks_mut::<3>().0.iter_mut().zip(vectors) {
        let product = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
        put(accum, out.iter_mut().zip(product));
    }
}

impl<T: Float> Op<T> for Cross {
    /// a and b, as far as they are needed.
    type Saved = [Option<Tensor<T>>; 2];

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        if inputs[0] != inputs[1] || inputs[0].last() != 3 {
            return Err(ShapeError::new("expected two tensors [.., 3] of one shape"));
        }
        Ok(vec![inputs[0]])
    }

    fn flops(&self, inputs: &[Shape]) -> u64 {
        3 * inputs[0].len() as u64
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let [a, b] = [inputs[0], inputs[1]];
        let y = Tensor::build(*a.shape(), |out| products(out, Accum::Replace, a.data(), b.data()));
        (vec![y], [needs.get(1).then(|| a.clone()), needs.get(0).then(|| b.clone())])
    }

    /// g . (a x b) is a triple product, which stays the same when its factors are turned round in a circle:
    /// a . (b x g) and b . (g x a), so da = b x g and db = g x a.
    fn backward(&self, [a, b]: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        if let Some(b) = b {
            sink.accumulate(0, |out, accum| products(out, accum, b.data(), g.data()));
        }
        if let Some(a) = a {
            sink.accumulate(1, |out, accum| products(out, accum, g.data(), a.data()));
        }
    }
}

impl Checked for Cross {
    fn cases() -> Vec<Case<Self>> {
        let case =
            |name, shape: &[usize]| Case::new(name, Cross, [Input::random("a", shape), Input::random("b", shape)]);
        let parallel = [Input::values("a", [3], [1.0, -2.0, 0.5]), Input::values("b", [3], [-2.0, 4.0, -1.0])];
        vec![
            case("one pair", &[3]),
            case("a batch", &[4, 3]),
            case("an image of vectors", &[2, 3, 2, 3]),
            Case::new("parallel vectors", Cross, parallel),
            case("none", &[0, 3]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// The cross product `a x b` along the last dimension, which is 3; both have one shape `[.., 3]`.
    #[track_caller]
    pub fn cross(&self, other: &Self) -> Self {
        apply1(Cross, &[self, other])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_axes_follow_one_another() {
        let axes = Tensor::from_vec([3, 3], vec![1.0f32, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
        let axes = Var::constant(axes);
        let next = Var::concat(&[&axes.slice(0, 1..3), &axes.slice(0, 0..1)], 0);
        let last = Var::concat(&[&axes.slice(0, 2..3), &axes.slice(0, 0..2)], 0);
        assert_eq!(axes.cross(&next).value().data(), last.value().data());
        let back: Vec<f32> = last.value().data().iter().map(|x| -x).collect();
        assert_eq!(next.cross(&axes).value().data(), back);
    }

    #[test]
    #[should_panic(expected = "cross: expected two tensors [.., 3] of one shape (inputs [[2, 3], [3]])")]
    fn both_have_one_shape() {
        Var::<f32>::constant(Tensor::zeros([2, 3])).cross(&Var::constant(Tensor::zeros([3])));
    }
}
