//! Sorting along any axis.

use std::cmp::Ordering;

use crate::ops::support::axes::cut;
use crate::ops::support::indices;
use crate::ops::support::indices::countable;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply};
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// Sort along dimension `axis`: the elements in order, and (auxiliary) the index where each stood, as a number:
/// `y[j] = x[index[j]]`.
///
/// Stable: equal elements (as 0 and -0 are) keep their order, ascending and descending. NaN comes last either way.
#[derive(Clone, Copy, Debug)]
pub struct Sort {
    /// Dimension, from 0.
    pub axis: usize,
    /// Whether the largest comes first.
    pub descending: bool,
}

/// Ascending or descending order of two numbers. A NaN equals everything, so the caller looks for it first.
pub(in crate::ops) fn compare<T: Float>(a: T, b: T, descending: bool) -> Ordering {
    let order = a.partial_cmp(&b).unwrap_or(Ordering::Equal);
    if descending { order.reverse() } else { order }
}

/// The `keep` elements that come first along an axis, in order, and the indices where they stood. Of equal ones the
/// earlier comes first.
pub(in crate::ops) fn leading<T: Float>(
    x: &Tensor<T>,
    axis: usize,
    keep: usize,
    order: impl Fn(T, T) -> Ordering + Sync + Send,
) -> [Tensor<T>; 2] {
    let [_, n, inner] = cut(x.shape(), axis, 1);
    let shape = x.shape().with(axis, keep);
    let mut index = Tensor::zeros(shape);
    let y = Tensor::build(shape, |out| {
        if out.is_empty() {
            return;
        }
        let places = index.data_mut().chunks_mut(keep * inner);
        let pieces = out.chunks_mut(keep * inner).zip(places).zip(x.data().chunks(n * inner));
        parallel::for_each_piece(pieces, 16 * x.len(), |((values, places), x)| {
            // The index decides between equals, so that the order is total and an unstable sort will do.
            let order = |a: &(usize, T), b: &(usize, T)| order(a.1, b.1).then(a.0.cmp(&b.0));
            let mut lane = Vec::with_capacity(n);
            for column in 0..inner {
                lane.clear();
                lane.extend(x[column..].iter().step_by(inner).copied().enumerate());
                if keep < n {
                    lane.select_nth_unstable_by(keep, order);
                }
                lane[..keep].sort_unstable_by(order);
                let values = values[column..].iter_mut().step_by(inner);
                let places = places[column..].iter_mut().step_by(inner);
                for ((value, place), &(i, x)) in values.zip(places).zip(&lane) {
                    (*value, *place) = (x, T::of(i as f64));
                }
            }
        });
    });
    [y, index]
}

impl<T: Float> Op<T> for Sort {
    /// The indices.
    type Saved = Tensor<T>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        if self.axis >= inputs[0].rank() {
            return Err(ShapeError::new(format!("no dimension {}", self.axis)));
        }
        countable::<T>(inputs[0].dims()[self.axis])?;
        Ok(vec![inputs[0]; 2])
    }

    fn auxiliary(&self) -> usize {
        1
    }

    fn algo(&self, _: &[Shape]) -> &'static str {
        if self.descending { "descending" } else { "ascending" }
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let order = |a: T, b: T| a.is_nan().cmp(&b.is_nan()).then(compare(a, b, self.descending));
        let [y, index] = leading(inputs[0], self.axis, inputs[0].dims()[self.axis], order);
        (vec![y, index.clone()], index)
    }

    /// Each gradient goes back to where its element stood.
    fn backward(&self, index: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        sink.accumulate(0, |out, accum| indices::scatter(out, accum, g.shape(), self.axis, &index, &g));
    }
}

impl Checked for Sort {
    fn cases() -> Vec<Case<Self>> {
        let (up, down) = (|axis| Sort { axis, descending: false }, |axis| Sort { axis, descending: true });
        let x = |shape: &[usize]| Input::distinct("x", shape);
        let tie = |numbers: &[f64]| Input::values("x", [numbers.len()], numbers);
        vec![
            Case::new("first axis", up(0), [x(&[3, 2, 4])]),
            Case::new("middle axis", up(1), [x(&[2, 5, 3])]),
            Case::new("last axis", up(2), [x(&[2, 3, 5])]),
            Case::new("rows of images", up(1), [x(&[2, 4, 3, 2])]),
            Case::new("descending, first axis", down(0), [x(&[5, 3])]),
            Case::new("descending, middle axis", down(2), [x(&[2, 1, 4, 3])]),
            Case::new("descending, last axis", down(1), [x(&[3, 6])]),
            Case::new("one element", up(1), [x(&[3, 1])]),
            Case::new("a long vector", down(0), [x(&[50])]),
            Case::new("a tie", up(0), [tie(&[2.0, 1.0, 2.0, 3.0])]).kinks(2).promises(0, [1.0; 4]),
            Case::new("a descending tie of three", down(0), [tie(&[1.0, 2.0, 2.0, 0.5, 2.0])])
                .kinks(3)
                .promises(0, [1.0; 5]),
            Case::new("0 and -0", up(0), [tie(&[0.0, 1.0, -0.0])]).kinks(2).promises(0, [1.0; 3]),
            Case::new("nothing", up(0), [x(&[0, 3])]).flat(),
            Case::new("columns of nothing", down(0), [x(&[3, 0])]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// The elements along dimension `axis` in order, and the indices where they stood (as numbers). Stable; NaN comes
    /// last.
    #[track_caller]
    pub fn sort(&self, axis: usize, descending: bool) -> [Self; 2] {
        apply(Sort { axis, descending }, &[self]).try_into().ok().expect("two outputs")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    const NAN: f64 = f64::NAN;

    fn sorted(x: &[f64], descending: bool) -> [Vec<f64>; 2] {
        let x = Var::constant(Tensor::from_vec([x.len()], x.to_vec()));
        x.sort(0, descending).map(|y| y.value().data().to_vec())
    }

    #[test]
    fn nan_comes_last_in_both_directions() {
        let x = [NAN, 2.0, f64::INFINITY, NAN, -1.0, f64::NEG_INFINITY];
        let [up, index] = sorted(&x, false);
        assert_eq!(up[..4], [f64::NEG_INFINITY, -1.0, 2.0, f64::INFINITY]);
        assert!(up[4].is_nan() && up[5].is_nan());
        assert_eq!(index, [5.0, 4.0, 1.0, 2.0, 0.0, 3.0]);
        let [down, index] = sorted(&x, true);
        assert_eq!(down[..4], [f64::INFINITY, 2.0, -1.0, f64::NEG_INFINITY]);
        assert!(down[4].is_nan() && down[5].is_nan());
        assert_eq!(index, [2.0, 1.0, 4.0, 5.0, 0.0, 3.0]);
    }

    #[test]
    fn equal_elements_keep_their_order_in_both_directions() {
        let x = [0.0, -0.0, 1.0, 0.0, -0.0];
        let [up, index] = sorted(&x, false);
        assert_eq!(index, [0.0, 1.0, 3.0, 4.0, 2.0]);
        let negative: Vec<bool> = up.iter().map(|y| y.is_sign_negative()).collect();
        assert_eq!(negative, [false, true, false, true, false]);
        assert_eq!(sorted(&x, true)[1], [2.0, 0.0, 1.0, 3.0, 4.0]);
        // Long enough that an unstable sort would show.
        let x: Vec<f64> = (0..1000).map(|i| f64::from(i % 3)).collect();
        for descending in [false, true] {
            let [y, index] = sorted(&x, descending);
            assert!(y.windows(2).zip(index.windows(2)).all(|(y, i)| y[0] != y[1] || i[0] < i[1]));
        }
    }

    #[test]
    fn the_indices_gather_the_sorted_elements_along_any_axis() {
        let x = Var::constant(Tensor::from_vec([3, 4, 2], (0..24).map(|i| f64::from(i * 7 % 24)).collect()));
        for axis in 0..3 {
            let [y, index] = x.sort(axis, axis == 1);
            assert!(x.gather(axis, &index).value().same_bits(y.value()));
        }
        assert_eq!(x.sort(1, false)[0].slice(0, 0..1).slice(2, 0..1).value().data(), [0.0, 4.0, 14.0, 18.0]);
    }

    #[test]
    fn any_number_of_threads_sorts_the_same() {
        let x = Var::constant(Tensor::from_vec([8, 50, 40], (0..16_000).map(|i| f64::from(i * 7919 % 1009)).collect()));
        let [one, two] = [1, 2].map(|threads| parallel::with_threads(threads, || x.sort(1, true)));
        assert!(one.iter().zip(&two).all(|(a, b)| a.value().same_bits(b.value())));
        assert!(x.gather(1, &two[1]).value().same_bits(one[0].value()));
    }

    #[test]
    fn a_gradient_goes_back_along_the_axis_that_was_sorted() {
        let tape = Tape::new();
        let x = tape.leaf(Tensor::from_vec([3, 2], vec![3.0f64, 10.0, 1.0, 30.0, 2.0, 20.0]));
        let [y, index] = x.sort(0, false);
        assert_eq!(y.value().data(), [1.0, 10.0, 2.0, 20.0, 3.0, 30.0]);
        assert!(!index.is_tracked());
        let gradients = tape.backward(&[(&y, Tensor::from_vec([3, 2], vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))]);
        assert_eq!(gradients.get(&x).unwrap().data(), [5.0, 2.0, 1.0, 6.0, 3.0, 4.0]);
    }

    #[test]
    #[should_panic(expected = "sort: no dimension 1 (inputs [[3]])")]
    fn the_axis_must_exist() {
        Var::<f32>::constant(Tensor::zeros([3])).sort(1, false);
    }
}
