//! Rows chosen by their numbers; an embedding is the same thing.

use crate::ops::support::axes::cut;
use crate::ops::support::indices;
use crate::ops::support::indices::countable;
use crate::ops::support::put::begin_sum;
use crate::ops::{Case, Checked, Input, Needs, Op, Registered, ShapeError, apply1};
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// Selection of rows by index: `x [.., n, ..]`, `index [k]` -> `[.., k, ..]`: `y[.., j, ..] = x[.., index[j], ..]`,
/// along dimension `axis`.
///
/// The indices are whole numbers below n, in any order, any number of times; they are not differentiated. Another
/// number panics.
#[derive(Clone, Copy, Debug)]
pub struct IndexSelect {
    /// Dimension, from 0.
    pub axis: usize,
}

impl<T: Float> Op<T> for IndexSelect {
    /// The indices, and the shape of x.
    type Saved = (Tensor<T>, Shape);

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let [x, index] = [inputs[0], inputs[1]];
        if self.axis >= x.rank() {
            return Err(ShapeError::new(format!("no dimension {}", self.axis)));
        }
        countable::<T>(x.dims()[self.axis])?;
        match index.dims() {
            &[k] => Ok(vec![x.with(self.axis, k)]),
            _ => Err(ShapeError::new("expected an index of one dimension")),
        }
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let [x, index] = [inputs[0], inputs[1]];
        let ([_, n, inner], k) = (cut(x.shape(), self.axis, 1), index.len());
        indices::check(Self::NAME, index, n);
        let y = Tensor::build(x.shape().with(self.axis, k), |out| {
            let work = out.len();
            parallel::for_each_unit(out, k * inner, work, |o, out| {
                let x = &x.data()[o * n * inner..][..n * inner];
                for (row, &i) in out.chunks_exact_mut(inner).zip(index.data()) {
                    row.copy_from_slice(&x[indices::position(i) * inner..][..inner]);
                }
            });
        });
        (vec![y], (index.clone(), *x.shape()))
    }

    /// Row j of the gradient is added to row `index[j]`: a row chosen twice gets both, one not chosen stays 0.
    fn backward(&self, (index, shape): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let ([_, n, inner], k) = (cut(&shape, self.axis, 1), index.len());
        sink.accumulate(0, |out, accum| {
            let work = g.len();
            parallel::for_each_unit(out, n * inner, work, |o, out| {
                begin_sum(out, accum);
                let g = &g.data()[o * k * inner..][..k * inner];
                for (row, &i) in g.chunks_exact(inner).zip(index.data()) {
                    let to = &mut out[indices::position(i) * inner..][..inner];
                    to.iter_mut().zip(row).for_each(|(d, &g)| *d += g);
                }
            });
        });
    }
}

impl Checked for IndexSelect {
    fn cases() -> Vec<Case<Self>> {
        let case = |name, axis, x: &[usize], index: &[f64]| {
            let index = Input::values("index", [index.len()], index).constant("an index");
            Case::new(name, IndexSelect { axis }, [Input::random("x", x), index])
        };
        vec![
            case("first axis, out of order", 0, &[5, 2, 3], &[3.0, 0.0, 4.0]),
            case("middle axis, repeated", 1, &[2, 4, 3], &[2.0, 0.0, 2.0, 2.0, 1.0]),
            case("last axis, some never chosen", 2, &[2, 3, 5], &[4.0, 4.0, 1.0]),
            case("rows of images", 2, &[2, 3, 4, 2], &[3.0, 1.0, 1.0, 0.0, 3.0, 2.0]),
            case("a vector", 0, &[4], &[1.0, 1.0, 3.0]),
            case("exactly one of several", 1, &[3, 4], &[2.0]),
            case("the only one, three times", 0, &[1, 3], &[0.0, 0.0, 0.0]),
            case("more than there are", 0, &[2, 2], &[1.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0]),
            case("none", 1, &[2, 3], &[]).flat(),
            case("of nothing, none", 0, &[0, 3], &[]).flat(),
            case("rows of nothing", 0, &[3, 0], &[2.0, 0.0]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// Rows along dimension `axis`, chosen by their numbers: `[.., n, ..]` and `index [k]` -> `[.., k, ..]`.
    ///
    /// # Panics
    /// If an index is not a whole number below n.
    #[track_caller]
    pub fn index_select(&self, axis: usize, index: &Self) -> Self {
        apply1(IndexSelect { axis }, &[self, index])
    }

    /// Rows of this table `[n, d]` for an index of any shape: `[..]` -> `[.., d]`.
    ///
    /// # Panics
    /// If this is no table, or an index is not a whole number below n.
    #[track_caller]
    pub fn embedding(&self, index: &Self) -> Self {
        let &[_, d] = self.dims() else { panic!("embedding: expected a table [n, d], not {}", self.shape()) };
        let rows = self.index_select(0, &index.reshape([index.shape().len()]));
        rows.reshape([index.dims(), &[d]].concat().as_slice())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    #[test]
    fn a_row_chosen_twice_gets_both_gradients_and_one_not_chosen_exactly_none() {
        let tape = Tape::new();
        let x = tape.leaf(Tensor::from_vec([3, 2], vec![1.0f64, 2.0, 3.0, 4.0, 5.0, 6.0]));
        let y = x.index_select(0, &Var::constant(Tensor::from_vec([3], vec![2.0, 0.0, 2.0])));
        assert_eq!(y.value().data(), [5.0, 6.0, 1.0, 2.0, 5.0, 6.0]);
        let g = Tensor::from_vec([3, 2], vec![1.0, 10.0, 100.0, 1000.0, 0.5, 0.25]);
        let gradients = tape.backward(&[(&y, g)]);
        assert_eq!(gradients.get(&x).unwrap().data(), [100.0, 1000.0, 0.0, 0.0, 1.5, 10.25]);
    }

    #[test]
    fn an_embedding_appends_the_width_of_the_table_to_the_shape_of_the_index() {
        let tape = Tape::new();
        let table = tape.leaf(Tensor::from_vec([3, 2], vec![0.0f32, 0.5, 1.0, 1.5, 2.0, 2.5]));
        let y = table.embedding(&Var::constant(Tensor::from_vec([2, 1, 2], vec![2.0, 0.0, 2.0, 2.0])));
        assert_eq!(y.dims(), [2, 1, 2, 2]);
        assert_eq!(y.value().data(), [2.0, 2.5, 0.0, 0.5, 2.0, 2.5, 2.0, 2.5]);
        assert_eq!(y.sum_all().backward().get(&table).unwrap().data(), [1.0, 1.0, 0.0, 0.0, 3.0, 3.0]);
        let one = table.value().clone();
        let one = Var::constant(one).embedding(&Var::constant(Tensor::scalar(1.0)));
        assert_eq!((one.dims(), one.value().data()), (&[2][..], &[1.0, 1.5][..]));
    }

    #[test]
    #[should_panic(expected = "index_select: the index 3 is not a whole number below 3")]
    fn an_index_must_be_in_range() {
        Var::<f32>::constant(Tensor::zeros([3, 2])).index_select(0, &Var::constant(Tensor::full([1], 3.0)));
    }

    #[test]
    #[should_panic(expected = "index_select: the index 0.5 is not a whole number below 3")]
    fn an_index_must_be_whole() {
        Var::<f32>::constant(Tensor::zeros([3, 2])).embedding(&Var::constant(Tensor::full([1], 0.5)));
    }

    #[test]
    #[should_panic(expected = "index_select: expected an index of one dimension (inputs [[3, 2], [1, 1]])")]
    fn an_index_has_one_dimension() {
        Var::<f32>::constant(Tensor::zeros([3, 2])).index_select(0, &Var::constant(Tensor::zeros([1, 1])));
    }
}
