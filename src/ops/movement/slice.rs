//! A range along one dimension.

use std::ops::Range;

use crate::ops::Tile;
use crate::ops::support::put::{begin_sum, put_run};
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// Slice `start..end` of dimension `axis`.
#[derive(Clone, Copy, Debug)]
pub struct Slice {
    /// Dimension, from 0.
    pub axis: usize,
    /// The first index.
    pub start: usize,
    /// One past the last.
    pub end: usize,
    /// Runs handed to a thread at a time, chosen by the shapes by default.
    pub tile: Tile,
}

/// Elements copied by a thread at a time, about.
const CHUNK: usize = 1 << 15;

impl Slice {
    /// The length of a run of the input, and the range of it that is taken.
    fn run(&self, shape: &Shape) -> (usize, Range<usize>) {
        let inner: usize = shape.dims()[self.axis + 1..].iter().product();
        (shape.dims()[self.axis] * inner, self.start * inner..self.end * inner)
    }

    fn tile(&self, run: usize) -> usize {
        self.tile.or((CHUNK / run.max(1)).max(1))
    }
}

impl<T: Float> Op<T> for Slice {
    /// The shape of the input.
    type Saved = Shape;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let Slice { axis, start, end, .. } = *self;
        match inputs[0].dims().get(axis) {
            Some(&extent) if start <= end && end <= extent => Ok(vec![inputs[0].with(axis, end - start)]),
            _ => Err(ShapeError::new(format!("no range {start}..{end} of dimension {axis}"))),
        }
    }

    /// Only what is taken is read; every element's gradient is written.
    fn traffic(&self, inputs: &[Shape], outputs: &[Shape], _: &Needs) -> [u64; 2] {
        let [all, taken] = [inputs[0].len() as u64, outputs[0].len() as u64];
        [2 * taken, all + taken]
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Shape) {
        let x = inputs[0];
        let (run, range) = self.run(x.shape());
        let y = Tensor::build(x.shape().with(self.axis, self.end - self.start), |out| {
            let (tile, work) = (self.tile(range.len()), out.len());
            if range.is_empty() {
                return;
            }
            parallel::for_each_chunk(out, tile * range.len(), work, |i, out| {
                let x = x.data()[i * tile * run..].chunks_exact(run);
                out.chunks_exact_mut(range.len()).zip(x).for_each(|(y, x)| y.copy_from_slice(&x[range.clone()]));
            });
        });
        (vec![y], *x.shape())
    }

    /// The gradient goes back to where its elements came from; the others get nothing.
    fn backward(&self, shape: Shape, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let (run, range) = self.run(&shape);
        sink.accumulate(0, |out, accum| {
            let (tile, work) = (self.tile(run), out.len());
            if range.is_empty() {
                begin_sum(out, accum);
                return;
            }
            parallel::for_each_chunk(out, tile * run, work, |i, out| {
                let g = g.data()[i * tile * range.len()..].chunks_exact(range.len());
                for (d, g) in out.chunks_exact_mut(run).zip(g) {
                    begin_sum(&mut d[..range.start], accum);
                    put_run(accum, &mut d[range.clone()], g);
                    begin_sum(&mut d[range.end..], accum);
                }
            });
        });
    }
}

impl Checked for Slice {
    fn cases() -> Vec<Case<Self>> {
        let x = |shape: &[usize]| Input::random("x", shape);
        let of = |axis, range: Range<usize>| Slice { axis, start: range.start, end: range.end, tile: Tile::AUTO };
        let tiled = |tile| Slice { axis: 1, start: 1, end: 3, tile: Tile::of(tile) };
        vec![
            Case::new("channels", of(3, 1..4), [x(&[2, 3, 2, 5])]),
            Case::new("first channels", of(3, 0..2), [x(&[2, 3, 2, 5])]),
            Case::new("last channels", of(3, 4..5), [x(&[2, 3, 2, 5])]),
            Case::new("rows", of(1, 1..3), [x(&[2, 4, 3, 2])]),
            Case::new("batch", of(0, 1..2), [x(&[3, 2, 2])]),
            Case::new("everything", of(1, 0..3), [x(&[2, 3])]),
            Case::new("nothing", of(1, 2..2), [x(&[2, 3])]).flat(),
            Case::new("tile less one", tiled(4), [x(&[3, 4])]),
            Case::new("a whole tile", tiled(4), [x(&[4, 4])]),
            Case::new("tile and one", tiled(4), [x(&[5, 4])]),
        ]
    }
}

impl<T: Float> Var<T> {
    /// The elements `range` of dimension `axis`; the other dimensions stay whole.
    #[track_caller]
    pub fn slice(&self, axis: usize, range: Range<usize>) -> Self {
        apply1(Slice { axis, start: range.start, end: range.end, tile: Tile::AUTO }, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slice_undoes_a_concatenation() {
        let x = Var::constant(Tensor::from_vec([2, 3, 4], (0..24).map(f64::from).collect()));
        for axis in 0..3 {
            let (first, rest) = (x.slice(axis, 0..1), x.slice(axis, 1..x.shape().dims()[axis]));
            assert!(Var::concat(&[&first, &rest], axis).value().same_bits(x.value()));
        }
        assert_eq!(x.slice(1, 2..3).value().data(), [8.0, 9.0, 10.0, 11.0, 20.0, 21.0, 22.0, 23.0]);
    }

    #[test]
    #[should_panic(expected = "slice: no range 1..5 of dimension 0")]
    fn a_range_must_be_inside() {
        Var::<f32>::constant(Tensor::zeros([4])).slice(0, 1..5);
    }
}
