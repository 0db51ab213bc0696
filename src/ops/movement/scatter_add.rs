//! Values added along an axis where an index points.

use super::gather::fits;
use crate::ops::support::indices;
use crate::ops::support::indices::countable;
use crate::ops::support::put::begin_sum;
use crate::ops::{Case, Checked, Input, Needs, Op, Registered, ShapeError, apply1};
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var};

/// Scatter-add: `x`, `index`, `values` -> `y` in the shape of x, which is x with the values added where the index
/// points: along dimension 1 of three, `y[i, index[i, j, k], k] += values[i, j, k]`.
///
/// All three have as many dimensions. The index may be smaller than the values, of which only the corner that it covers
/// is added, and beside `axis` smaller than x. Indices are whole numbers below x's extent along the axis; what they
/// name several times gets every value. They are not differentiated. Another number panics.
#[derive(Clone, Copy, Debug)]
pub struct ScatterAdd {
    /// Dimension, from 0.
    pub axis: usize,
}

impl<T: Float> Op<T> for ScatterAdd {
    /// The indices, and the shape of the values.
    type Saved = (Tensor<T>, Shape);

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let [x, index, values] = [inputs[0], inputs[1], inputs[2]];
        if self.axis >= x.rank() {
            return Err(ShapeError::new(format!("no dimension {}", self.axis)));
        }
        countable::<T>(x.dims()[self.axis])?;
        if !fits(&index, &x, self.axis) {
            return Err(ShapeError::new(format!("the index does not fit into x beside dimension {}", self.axis)));
        }
        if !fits(&index, &values, values.rank()) {
            return Err(ShapeError::new("the index covers more than there are values"));
        }
        Ok(vec![x])
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let [x, index, values] = [inputs[0], inputs[1], inputs[2]];
        indices::check(Self::NAME, index, x.dims()[self.axis]);
        let y = Tensor::build(*x.shape(), |out| {
            out.copy_from_slice(x.data());
            let from = indices::walk(*index.shape(), values.shape().strides());
            for (to, from) in indices::pointed(index, x.shape(), self.axis).zip(from) {
                out[to] += values.data()[from];
            }
        });
        (vec![y], (index.clone(), *values.shape()))
    }

    /// y is a sum, so dx = dy, and each value that was added gets the gradient of the place it was added to. Values
    /// that the index does not cover get nothing.
    fn backward(&self, (index, values): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        sink.accumulate(2, |out, accum| {
            begin_sum(out, accum);
            let to = indices::walk(*index.shape(), values.strides());
            for (from, to) in indices::pointed(&index, g.shape(), self.axis).zip(to) {
                out[to] += g.data()[from];
            }
        });
        sink.give(0, g);
    }
}

impl Checked for ScatterAdd {
    fn cases() -> Vec<Case<Self>> {
        let case = |name, axis, x: &[usize], shape: &[usize], index: &[f64], values: &[usize]| {
            let index = Input::values("index", shape, index).constant("an index");
            Case::new(name, ScatterAdd { axis }, [Input::random("x", x), index, Input::random("values", values)])
        };
        vec![
            case("first axis", 0, &[3, 2], &[2, 2], &[2.0, 0.0, 1.0, 0.0], &[2, 2]),
            case("middle axis", 1, &[2, 3, 1], &[2, 2, 1], &[2.0, 0.0, 1.0, 1.0], &[2, 2, 1]),
            case("last axis, repeated", 1, &[2, 3], &[2, 4], &[1., 1., 1., 0., 2., 0., 2., 2.], &[2, 4]),
            case("three sizes", 0, &[3, 5], &[2, 3], &[2.0, 0.0, 1.0, 2.0, 2.0, 0.0], &[4, 4]),
            case("three sizes, middle axis", 1, &[3, 2, 3], &[2, 3, 1], &[1., 0., 1., 1., 1., 0.], &[4, 3, 2]),
            case("four dimensions", 3, &[1, 2, 2, 3], &[1, 2, 1, 2], &[2.0, 2.0, 0.0, 1.0], &[2, 2, 3, 2]),
            case("one element", 0, &[1], &[3], &[0.0, 0.0, 0.0], &[4]),
            case("no index", 1, &[2, 3], &[2, 0], &[], &[2, 2]).ignores(2),
            case("into nothing", 0, &[0, 3], &[0, 3], &[], &[2, 3]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// This, with `values` added along dimension `axis` where the index points; in the shape of this. The index may
    /// cover only a corner of the values.
    ///
    /// # Panics
    /// If an index is not a whole number below the extent of the axis.
    #[track_caller]
    pub fn scatter_add(&self, axis: usize, index: &Self, values: &Self) -> Self {
        apply1(ScatterAdd { axis }, &[self, index, values])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    #[test]
    fn only_the_corner_that_the_index_covers_is_added_and_has_a_gradient() {
        let tape = Tape::new();
        let x = tape.leaf(Tensor::full([2, 3], 100.0f64));
        let values = tape.leaf(Tensor::from_vec([2, 3], vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0]));
        let y = x.scatter_add(1, &Var::constant(Tensor::from_vec([1, 2], vec![2.0, 2.0])), &values);
        assert_eq!(y.value().data(), [100.0, 100.0, 103.0, 100.0, 100.0, 100.0]);
        let g = Tensor::from_vec([2, 3], vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        let gradients = tape.backward(&[(&y, g.clone())]);
        assert!(gradients.get(&x).unwrap().same_bits(&g));
        assert_eq!(gradients.get(&values).unwrap().data(), [3.0, 3.0, 0.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn scattering_and_gathering_are_transposes() {
        let index = Var::constant(Tensor::from_vec([2, 4], vec![1.0, 0.0, 1.0, 1.0, 2.0, 2.0, 0.0, 2.0]));
        let values = Var::constant(Tensor::from_vec([2, 4], (0..8).map(|i| f64::from(i) - 2.5).collect()));
        let x = Var::constant(Tensor::from_vec([2, 3], (0..6).map(|i| f64::from(i * i)).collect()));
        let scattered = Var::constant(Tensor::zeros([2, 3])).scatter_add(1, &index, &values);
        let (left, right) = ((&scattered * &x).sum_all(), (&values * &x.gather(1, &index)).sum_all());
        assert_eq!(left.value().item(), right.value().item());
    }

    #[test]
    #[should_panic(expected = "scatter_add: the index 3 is not a whole number below 3")]
    fn an_index_must_be_in_range() {
        let x = Var::<f32>::constant(Tensor::zeros([2, 3]));
        x.scatter_add(1, &Var::constant(Tensor::full([1, 1], 3.0)), &x);
    }

    #[test]
    #[should_panic(expected = "scatter_add: the index covers more than there are values")]
    fn an_index_must_fit_into_the_values() {
        let x = Var::<f32>::constant(Tensor::zeros([2, 3]));
        x.scatter_add(1, &Var::constant(Tensor::zeros([2, 3])), &Var::constant(Tensor::zeros([2, 2])));
    }
}
