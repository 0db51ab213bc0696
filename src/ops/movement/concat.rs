//! Concatenation along one dimension.

use crate::ops::Tile;
use crate::ops::support::put::put_run;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::simd::copy_run;
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// Concatenation along dimension `axis`, in which alone the parts may differ.
#[derive(Clone, Copy, Debug)]
pub struct Concat {
    /// Dimension, from 0.
    pub axis: usize,
    /// Runs handed to a thread at a time, chosen by the shapes by default.
    pub tile: Tile,
}

/// Elements copied by a thread at a time, about.
const CHUNK: usize = 1 << 15;

impl Concat {
    /// The length of a part's run: its extent along the axis times what lies inside.
    fn run(&self, shape: &Shape) -> usize {
        shape.dims()[self.axis..].iter().product()
    }

    fn tile(&self, run: usize) -> usize {
        self.tile.or((CHUNK / run.max(1)).max(1))
    }
}

impl<T: Float> Op<T> for Concat {
    /// The length of each part's run.
    type Saved = Vec<usize>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let Some(first) = inputs.first() else { return Err(ShapeError::new("nothing to concatenate")) };
        if self.axis >= first.rank() {
            return Err(ShapeError::new(format!("no dimension {}", self.axis)));
        }
        if inputs.iter().any(|s| s.rank() != first.rank() || s.with(self.axis, 0) != first.with(self.axis, 0)) {
            return Err(ShapeError::new(format!("the parts differ in more than dimension {}", self.axis)));
        }
        Ok(vec![first.with(self.axis, inputs.iter().map(|s| s.dims()[self.axis]).sum())])
    }

    fn traffic(&self, inputs: &[Shape], outputs: &[Shape], needs: &Needs) -> [u64; 2] {
        crate::ops::op::traffic_without_inputs(inputs, outputs, needs)
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let runs: Vec<usize> = inputs.iter().map(|x| self.run(x.shape())).collect();
        let total: usize = runs.iter().sum();
        let extent = inputs.iter().map(|x| x.dims()[self.axis]).sum();
        let y = Tensor::build(inputs[0].shape().with(self.axis, extent), |out| {
            let (tile, work) = (self.tile(total), out.len());
            if total == 0 {
                return;
            }
            parallel::for_each_chunk(out, tile * total, work, |i, out| {
                T::dispatch(
                    #[inline(always)]
                    || {
                        let mut from = 0;
                        for (x, &run) in inputs.iter().zip(&runs).filter(|(_, run)| **run > 0) {
                            let x = x.data()[i * tile * run..].chunks_exact(run);
                            for (row, x) in out.chunks_exact_mut(total).zip(x) {
                                copy_run(&mut row[from..from + run], x);
                            }
                            from += run;
                        }
                    },
                );
            });
        });
        (vec![y], runs)
    }

    /// Each part gets its range of the gradient.
    fn backward(&self, runs: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let total: usize = runs.iter().sum();
        let mut from = 0;
        for (part, &run) in runs.iter().enumerate() {
            sink.accumulate(part, |out, accum| {
                let (tile, work) = (self.tile(run), out.len());
                if run == 0 {
                    return;
                }
                parallel::for_each_chunk(out, tile * run, work, |i, out| {
                    let g = g.data()[i * tile * total..].chunks_exact(total);
                    T::dispatch(
                        #[inline(always)]
                        || {
                            for (d, g) in out.chunks_exact_mut(run).zip(g) {
                                let g = &g[from..from + run];
                                put_run(accum, d, g);
                            }
                        },
                    );
                });
            });
            from += run;
        }
    }
}

impl Checked for Concat {
    fn cases() -> Vec<Case<Self>> {
        let part = |name, shape: &[usize]| Input::random(name, shape);
        let at = |axis| Concat { axis, tile: Tile::AUTO };
        let tiled = |tile| Concat { axis: 2, tile: Tile::of(tile) };
        let two = |n| [part("a", &[n, 2, 3]), part("b", &[n, 2, 4])];
        vec![
            Case::new(
                "three parts",
                at(3),
                [part("a", &[2, 3, 2, 1]), part("b", &[2, 3, 2, 8]), part("c", &[2, 3, 2, 3])],
            ),
            Case::new("batch", at(0), [part("a", &[2, 3, 2]), part("b", &[1, 3, 2])]),
            Case::new("rows", at(1), [part("a", &[2, 3, 2, 3]), part("b", &[2, 1, 2, 3])]),
            Case::new("one part", at(1), [part("a", &[2, 3])]),
            Case::new("an empty part", at(1), [part("a", &[2, 0]), part("b", &[2, 3])]),
            Case::new("nothing but empty parts", at(1), [part("a", &[2, 0]), part("b", &[2, 0])]).flat(),
            Case::new("tile less one", tiled(4), two(1)),
            Case::new("a whole tile", tiled(4), two(2)),
            Case::new("tile and a rest", tiled(4), two(3)),
        ]
    }
}

impl<T: Float> Var<T> {
    /// The parts, any number of them, one after the other along dimension `axis`; the other extents are the same.
    #[track_caller]
    pub fn concat(parts: &[&Var<T>], axis: usize) -> Var<T> {
        apply1(Concat { axis, tile: Tile::AUTO }, parts)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn channels_stand_side_by_side() {
        let a = Var::constant(Tensor::from_vec([2, 1], vec![1.0f32, 2.0]));
        let b = Var::constant(Tensor::from_vec([2, 2], vec![3.0f32, 4.0, 5.0, 6.0]));
        assert_eq!(Var::concat(&[&a, &b], 1).value().data(), [1.0, 3.0, 4.0, 2.0, 5.0, 6.0]);
        let a = a.reshape([1, 2]);
        assert_eq!(Var::concat(&[&a, &b], 0).value().data(), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    }

    #[test]
    #[should_panic(expected = "concat: the parts differ in more than dimension 1")]
    fn parts_must_fit() {
        let part = |shape: [usize; 2]| Var::<f32>::constant(Tensor::zeros(shape));
        Var::concat(&[&part([2, 1]), &part([3, 1])], 1);
    }
}
