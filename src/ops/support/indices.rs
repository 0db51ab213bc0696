//! Indices: whole numbers in a tensor that point along an axis. What the ops that take or make them share.
//!
//! They are numbers of the same type as the data, so that an op's inputs and outputs are all alike; in `f32` they are
//! exact up to 2^24. Nobody differentiates them.

use crate::ops::ShapeError;
use crate::ops::support::put::begin_sum;
use crate::tensor::shape::MAX_RANK;
use crate::tensor::{Accum, Float, Shape, Tensor};

/// Whether all indices along an axis of this extent can be told apart as numbers of this type: whole numbers are exact up
/// to 2^24 in `f32`, and to 2^53 in `f64`.
pub(in crate::ops) fn countable<T: Float>(extent: usize) -> Result<(), ShapeError> {
    let exact = 2.0 / T::EPSILON.f64();
    if extent as f64 <= exact {
        return Ok(());
    }
    Err(ShapeError::new(format!(
        "{extent} elements are more than the indices of this element type count exactly ({exact})"
    )))
}

/// Panics unless every index is a whole number below `extent`.
pub(in crate::ops) fn check<T: Float>(op: &str, index: &Tensor<T>, extent: usize) {
    for i in index.data().iter().map(|i| i.f64()) {
        let points = i >= 0.0 && i < extent as f64 && i.floor() == i;
        assert!(points, "{op}: the index {i} is not a whole number below {extent}, the extent of the axis");
    }
}

/// An index that was checked.
#[inline(always)]
pub(in crate::ops) fn position<T: Float>(index: T) -> usize {
    index.f64() as usize
}

/// The offsets, in memory with the given strides, of the elements of a tensor with these extents, in row-major order.
pub(in crate::ops) fn walk(extents: Shape, strides: [usize; MAX_RANK]) -> impl Iterator<Item = usize> {
    let mut at = [0; MAX_RANK];
    let mut next = 0;
    (0..extents.len()).map(move |_| {
        let offset = next;
        for d in (0..extents.rank()).rev() {
            at[d] += 1;
            next += strides[d];
            if at[d] < extents.dims()[d] {
                break;
            }
            next -= at[d] * strides[d];
            at[d] = 0;
        }
        offset
    })
}

/// Where the indices point in a tensor of shape `into`, as offsets, in the order of the indices: to the place where the
/// index itself stands, but along `axis` to the place that it names.
pub(in crate::ops) fn pointed<T: Float>(index: &Tensor<T>, into: &Shape, axis: usize) -> impl Iterator<Item = usize> {
    let mut strides = into.strides();
    let along = std::mem::replace(&mut strides[axis], 0);
    walk(*index.shape(), strides).zip(index.data()).map(move |(offset, &i)| offset + position(i) * along)
}

/// The gradient of whatever took elements of a tensor of shape `into` by an index: each number of `g`, which has the
/// shape of the index, is added where its index points; what was taken twice gets both, what was not taken nothing.
pub(in crate::ops) fn scatter<T: Float>(
    out: &mut [T],
    accum: Accum,
    into: &Shape,
    axis: usize,
    index: &Tensor<T>,
    g: &Tensor<T>,
) {
    begin_sum(out, accum);
    for (at, &g) in pointed(index, into, axis).zip(g.data()) {
        out[at] += g;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_walk_over_a_corner_skips_the_rest() {
        let strides = Shape::new(&[3, 4]).strides();
        assert_eq!(walk([2, 3].into(), strides).collect::<Vec<_>>(), [0, 1, 2, 4, 5, 6]);
        assert_eq!(walk([].into(), Shape::new(&[]).strides()).collect::<Vec<_>>(), [0]);
        assert_eq!(walk([0, 3].into(), strides).count(), 0);
    }

    #[test]
    fn an_index_points_along_its_axis_alone() {
        let index = Tensor::from_vec([2, 2], vec![2.0f32, 0.0, 1.0, 1.0]);
        assert_eq!(pointed(&index, &[3, 4].into(), 0).collect::<Vec<_>>(), [8, 1, 4, 5]);
        assert_eq!(pointed(&index, &[3, 4].into(), 1).collect::<Vec<_>>(), [2, 0, 5, 5]);
    }

    #[test]
    fn axes_longer_than_exact_whole_numbers_are_refused() {
        assert!(countable::<f32>(1 << 24).is_ok() && countable::<f32>((1 << 24) + 1).is_err());
        assert!(countable::<f64>((1 << 24) + 1).is_ok());
        let long = Shape::new(&[(1 << 24) + 1, 1]);
        let one = Shape::new(&[1]);
        let refused =
            |found: Result<Vec<Shape>, ShapeError>| found.is_err_and(|e| e.to_string().contains("count exactly"));
        use crate::ops::Op;
        use crate::ops::movement::{gather::Gather, index_select::IndexSelect, sort::Sort, top_k::TopK};
        use crate::ops::reduce::sum::{Extreme, Max};
        assert!(refused(Op::<f32>::shape(&Sort { axis: 0, descending: false }, &[long])));
        assert!(refused(Op::<f32>::shape(&TopK { axis: 0, k: 1, largest: true }, &[long])));
        assert!(refused(Op::<f32>::shape(&IndexSelect { axis: 0 }, &[long, one])));
        assert!(refused(Op::<f32>::shape(&Gather { axis: 0 }, &[long, Shape::new(&[1, 1])])));
        assert!(refused(Op::<f32>::shape(&Extreme { first: 0, count: 1, side: Max }, &[long])));
    }

    #[test]
    fn only_whole_numbers_within_the_extent_are_indices() {
        check("op", &Tensor::from_vec([3], vec![0.0f64, -0.0, 4.0]), 5);
        for bad in [5.0, -1.0, 0.5, f64::NAN, f64::INFINITY] {
            let outcome = std::panic::catch_unwind(|| check("op", &Tensor::scalar(bad), 5));
            assert!(outcome.is_err(), "{bad} passes");
        }
    }
}
