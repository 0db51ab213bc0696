//! The largest or smallest elements along any axis.

use super::sort::{compare, leading};
use crate::ops::support::indices;
use crate::ops::support::indices::countable;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply};
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var};

/// The `k` largest (or smallest) elements along dimension `axis`, `[.., n, ..]` -> `[.., k, ..]`, the furthest out
/// first, and (auxiliary) the index where each stood, as a number.
///
/// Of equal elements the earlier comes first, and is the one that is chosen. A NaN wins, as in a maximum: a choice that
/// left it out would hide it.
#[derive(Clone, Copy, Debug)]
pub struct TopK {
    /// Dimension, from 0.
    pub axis: usize,
    /// Number of elements taken.
    pub k: usize,
    /// Whether the largest, not the smallest.
    pub largest: bool,
}

impl<T: Float> Op<T> for TopK {
    /// The indices, and the shape of x.
    type Saved = (Tensor<T>, Shape);

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        match inputs[0].dims().get(self.axis) {
            Some(&n) if self.k <= n => {
                countable::<T>(n)?;
                Ok(vec![inputs[0].with(self.axis, self.k); 2])
            }
            Some(n) => Err(ShapeError::new(format!("no {} of {n} elements", self.k))),
            None => Err(ShapeError::new(format!("no dimension {}", self.axis))),
        }
    }

    fn auxiliary(&self) -> usize {
        1
    }

    fn algo(&self, _: &[Shape]) -> &'static str {
        if self.largest { "largest" } else { "smallest" }
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let order = |a: T, b: T| b.is_nan().cmp(&a.is_nan()).then(compare(a, b, self.largest));
        let [y, index] = leading(inputs[0], self.axis, self.k, order);
        (vec![y, index.clone()], (index, *inputs[0].shape()))
    }

    /// Each gradient goes back to where its element stood; those that were not chosen get nothing.
    fn backward(&self, (index, shape): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        sink.accumulate(0, |out, accum| indices::scatter(out, accum, &shape, self.axis, &index, &g));
    }
}

impl Checked for TopK {
    fn cases() -> Vec<Case<Self>> {
        let large = |axis, k| TopK { axis, k, largest: true };
        let small = |axis, k| TopK { axis, k, largest: false };
        let x = |shape: &[usize]| Input::distinct("x", shape);
        let tie = |numbers: &[f64]| Input::values("x", [numbers.len()], numbers);
        vec![
            Case::new("first axis", large(0, 2), [x(&[3, 2, 4])]),
            Case::new("middle axis", large(1, 3), [x(&[2, 5, 3])]),
            Case::new("last axis", large(2, 2), [x(&[2, 3, 5])]),
            Case::new("channels of images", large(3, 1), [x(&[2, 2, 3, 4])]),
            Case::new("smallest, first axis", small(0, 3), [x(&[5, 3])]),
            Case::new("smallest, middle axis", small(2, 2), [x(&[2, 1, 4, 3])]),
            Case::new("smallest, last axis", small(1, 4), [x(&[3, 6])]),
            Case::new("all of them", large(1, 4), [x(&[2, 4])]),
            Case::new("one of one", small(1, 1), [x(&[3, 1])]),
            Case::new("a tie within", large(0, 3), [tie(&[1.0, 2.0, 2.0, 5.0])])
                .kinks(2)
                .promises(0, [0.0, 1.0, 1.0, 1.0]),
            Case::new("a tie at the edge", large(0, 2), [tie(&[1.0, 2.0, 2.0, 5.0])])
                .kinks(2)
                .promises(0, [0.0, 1.0, 0.0, 1.0]),
            Case::new("a tie of the smallest at the edge", small(0, 2), [tie(&[3.0, 3.0, 1.0, 3.0])])
                .kinks(3)
                .promises(0, [1.0, 0.0, 1.0, 0.0]),
            Case::new("none", large(0, 0), [x(&[3, 2])]).flat(),
            Case::new("none of nothing", small(1, 0), [x(&[2, 0])]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// The `k` largest (or smallest) elements along dimension `axis`, the furthest out first, and the indices where
    /// they stood (as numbers): `[.., n, ..]` -> twice `[.., k, ..]`.
    #[track_caller]
    pub fn top_k(&self, axis: usize, k: usize, largest: bool) -> [Self; 2] {
        apply(TopK { axis, k, largest }, &[self]).try_into().ok().expect("two outputs")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    fn top(x: &[f64], k: usize, largest: bool) -> [Vec<f64>; 2] {
        let x = Var::constant(Tensor::from_vec([x.len()], x.to_vec()));
        x.top_k(0, k, largest).map(|y| y.value().data().to_vec())
    }

    #[test]
    fn of_equal_elements_the_earlier_is_chosen_and_comes_first() {
        assert_eq!(top(&[1.0, 3.0, 2.0, 3.0, 3.0], 2, true), [vec![3.0, 3.0], vec![1.0, 3.0]]);
        assert_eq!(top(&[5.0, 0.0, -0.0, 0.0], 2, false)[1], [1.0, 2.0]);
    }

    #[test]
    fn the_first_is_the_extreme_even_if_that_is_nan() {
        let x = Tensor::from_vec([3, 2], vec![1.0, f64::NAN, 3.0, 2.0, 3.0, f64::INFINITY]);
        let x = Var::constant(x);
        for (one, [extreme, index]) in [(x.top_k(0, 1, true), x.max(0, 1)), (x.top_k(0, 1, false), x.min(0, 1))] {
            let [y, i] = one.map(|v| v.reshape([2]));
            assert!(y.value().same_bits(extreme.value()) && i.value().same_bits(index.value()));
        }
    }

    #[test]
    fn without_nan_they_are_the_first_of_the_sorted() {
        let x = Var::constant(Tensor::from_vec([2, 7, 3], (0..42).map(|i| f64::from(i * 11 % 13)).collect()));
        for axis in 0..3 {
            for k in 0..=x.dims()[axis] {
                for largest in [false, true] {
                    let (top, sorted) = (x.top_k(axis, k, largest), x.sort(axis, largest));
                    for (a, b) in top.iter().zip(&sorted) {
                        assert!(a.value().same_bits(b.slice(axis, 0..k).value()), "{k} along {axis}");
                    }
                }
            }
        }
    }

    #[test]
    fn those_not_chosen_have_exactly_no_gradient() {
        let tape = Tape::new();
        let x = tape.leaf(Tensor::from_vec([3, 2], vec![3.0f64, 10.0, 1.0, 30.0, 2.0, 20.0]));
        let [y, _] = x.top_k(0, 2, true);
        assert_eq!(y.value().data(), [3.0, 30.0, 2.0, 20.0]);
        let gradients = tape.backward(&[(&y, Tensor::from_vec([2, 2], vec![1.0, 2.0, 3.0, 4.0]))]);
        assert_eq!(gradients.get(&x).unwrap().data(), [1.0, 0.0, 0.0, 2.0, 3.0, 4.0]);
    }

    #[test]
    #[should_panic(expected = "top_k: no 4 of 3 elements (inputs [[3, 2]])")]
    fn there_must_be_as_many() {
        Var::<f32>::constant(Tensor::zeros([3, 2])).top_k(0, 4, true);
    }
}
