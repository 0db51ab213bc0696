//! Elements chosen along an axis, each by an index of its own.

use crate::ops::support::indices;
use crate::ops::support::indices::countable;
use crate::ops::{Case, Checked, Input, Needs, Op, Registered, ShapeError, apply1};
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var};

/// Gather: `x`, `index` -> `y` in the shape of the index: along dimension 1 of three, `y[i, j, k] = x[i, index[i, j,
/// k], k]`.
///
/// The index has as many dimensions as x, and in those other than `axis` it may be smaller: the rest of x is not
/// looked at. Indices are whole numbers below the extent of the axis, any number of times; they are not differentiated.
/// Another number panics.
#[derive(Clone, Copy, Debug)]
pub struct Gather {
    /// Dimension, from 0.
    pub axis: usize,
}

/// Whether an index fits into `shape` in every dimension but `axis`.
pub(in crate::ops) fn fits(index: &Shape, shape: &Shape, axis: usize) -> bool {
    let pairs = index.dims().iter().zip(shape.dims()).enumerate();
    index.rank() == shape.rank() && pairs.into_iter().all(|(d, (i, s))| d == axis || i <= s)
}

impl<T: Float> Op<T> for Gather {
    /// The indices, and the shape of x.
    type Saved = (Tensor<T>, Shape);

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let [x, index] = [inputs[0], inputs[1]];
        if self.axis >= x.rank() {
            return Err(ShapeError::new(format!("no dimension {}", self.axis)));
        }
        countable::<T>(x.dims()[self.axis])?;
        if !fits(&index, &x, self.axis) {
            return Err(ShapeError::new(format!("the index does not fit into x beside dimension {}", self.axis)));
        }
        Ok(vec![index])
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let [x, index] = [inputs[0], inputs[1]];
        indices::check(Self::NAME, index, x.dims()[self.axis]);
        let y = Tensor::build(*index.shape(), |out| {
            let places = indices::pointed(index, x.shape(), self.axis);
            out.iter_mut().zip(places).for_each(|(y, at)| *y = x.data()[at]);
        });
        (vec![y], (index.clone(), *x.shape()))
    }

    /// Each gradient is added where its element came from: one taken twice gets both, one not taken stays 0.
    fn backward(&self, (index, shape): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        sink.accumulate(0, |out, accum| indices::scatter(out, accum, &shape, self.axis, &index, &g));
    }
}

impl Checked for Gather {
    fn cases() -> Vec<Case<Self>> {
        let case = |name, axis, x: &[usize], shape: &[usize], index: &[f64]| {
            let index = Input::values("index", shape, index).constant("an index");
            Case::new(name, Gather { axis }, [Input::random("x", x), index])
        };
        vec![
            case("first axis", 0, &[3, 2], &[2, 2], &[2.0, 0.0, 1.0, 0.0]),
            case("middle axis", 1, &[2, 3, 2], &[2, 2, 2], &[2.0, 0.0, 0.0, 1.0, 1.0, 2.0, 0.0, 2.0]),
            case("last axis, repeated", 1, &[2, 3], &[2, 4], &[1.0, 1.0, 1.0, 0.0, 2.0, 0.0, 2.0, 2.0]),
            case("four dimensions", 2, &[1, 2, 4, 2], &[1, 2, 1, 2], &[3.0, 0.0, 2.0, 2.0]),
            case("an index smaller all round", 1, &[3, 4, 3], &[2, 2, 1], &[3.0, 1.0, 0.0, 0.0]),
            case("smaller beside the axis, larger along it", 0, &[2, 3], &[4, 2], &[1., 0., 1., 1., 0., 1., 1., 0.]),
            case("a vector", 0, &[4], &[3], &[3.0, 0.0, 3.0]),
            case("the only element", 1, &[1, 1], &[1, 3], &[0.0, 0.0, 0.0]),
            case("no index", 1, &[2, 3], &[2, 0], &[]).flat(),
            case("of nothing", 0, &[0, 3], &[0, 2], &[]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// Elements along dimension `axis`, each chosen by an index of its own; the result has the shape of the index,
    /// which beside the axis may be smaller than this.
    ///
    /// # Panics
    /// If an index is not a whole number below the extent of the axis.
    #[track_caller]
    pub fn gather(&self, axis: usize, index: &Self) -> Self {
        apply1(Gather { axis }, &[self, index])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    #[test]
    fn an_element_taken_twice_gets_both_gradients_and_one_not_taken_exactly_none() {
        let tape = Tape::new();
        let x = tape.leaf(Tensor::from_vec([2, 3], vec![0.0f64, 1.0, 2.0, 10.0, 11.0, 12.0]));
        let y = x.gather(1, &Var::constant(Tensor::from_vec([1, 4], vec![2.0, 0.0, 2.0, 2.0])));
        assert_eq!(y.value().data(), [2.0, 0.0, 2.0, 2.0]);
        let gradients = tape.backward(&[(&y, Tensor::from_vec([1, 4], vec![1.0, 10.0, 100.0, 1000.0]))]);
        assert_eq!(gradients.get(&x).unwrap().data(), [10.0, 0.0, 1101.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn the_same_index_for_a_whole_row_is_index_select() {
        let x = Var::constant(Tensor::from_vec([2, 3, 2], (0..12).map(f64::from).collect()));
        let index = Tensor::from_vec([2, 2, 2], vec![2.0, 2.0, 0.0, 0.0, 2.0, 2.0, 0.0, 0.0]);
        let rows = x.index_select(1, &Var::constant(Tensor::from_vec([2], vec![2.0, 0.0])));
        assert!(x.gather(1, &Var::constant(index)).value().same_bits(rows.value()));
    }

    #[test]
    #[should_panic(expected = "gather: the index -1 is not a whole number below 3")]
    fn an_index_must_be_in_range() {
        Var::<f32>::constant(Tensor::zeros([2, 3])).gather(1, &Var::constant(Tensor::full([1, 1], -1.0)));
    }

    #[test]
    #[should_panic(expected = "gather: the index does not fit into x beside dimension 1 (inputs [[2, 3], [3, 1]])")]
    fn an_index_must_fit_beside_the_axis() {
        Var::<f32>::constant(Tensor::zeros([2, 3])).gather(1, &Var::constant(Tensor::zeros([3, 1])));
    }
}
