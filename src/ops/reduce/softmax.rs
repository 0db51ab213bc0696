//! Softmax along any axis.

use super::axis_loops::Blocks;
use crate::ops::support::put::put;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::random::Random;
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var};

/// `y = e^(x - max) / sum e^(x - max)`, maximum and sum along an axis. Where all of them are minus infinity (or one is
/// plus infinity or NaN) the result is NaN.
#[derive(Clone, Copy, Debug)]
pub struct Softmax {
    /// The axis along which the result sums to 1.
    pub axis: usize,
}

impl<T: Float> Op<T> for Softmax {
    /// The result.
    type Saved = Option<Tensor<T>>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        if self.axis >= inputs[0].rank() {
            return Err(ShapeError::new(format!("no dimension {}", self.axis)));
        }
        Ok(vec![inputs[0]])
    }

    fn algo(&self, inputs: &[Shape]) -> &'static str {
        Blocks::of(&inputs[0], self.axis, 1).algo()
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let x = inputs[0];
        let blocks = Blocks::of(x.shape(), self.axis, 1);
        let y = Tensor::build(*x.shape(), |out| {
            blocks.for_each(
                out,
                blocks.inner,
                #[inline(always)]
                |o, y, scratch| {
                    let x = blocks.block(o, x.data());
                    if blocks.inner == 1 { row(y, x) } else { columns(y, x, scratch) }
                },
            );
        });
        let saved = needs.any().then(|| y.clone());
        (vec![y], saved)
    }

    /// dx = y (dy - sum dy y), the sum along the axis.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let (y, g) = (saved.expect("saved for a wanted gradient"), upstream.only());
        let blocks = Blocks::of(y.shape(), self.axis, 1);
        sink.accumulate(0, |out, accum| {
            blocks.for_each(
                out,
                blocks.inner,
                #[inline(always)]
                |o, out, sums| {
                    let rows = || blocks.rows(o, y.data()).zip(blocks.rows(o, g.data()));
                    sums.fill(T::ZERO);
                    for (y, g) in rows() {
                        sums.iter_mut().zip(y.iter().zip(g)).for_each(|(s, (&y, &g))| *s = y.mul_add(g, *s));
                    }
                    for (out, (y, g)) in out.chunks_exact_mut(blocks.inner).zip(rows()) {
                        let terms = out.iter_mut().zip(y.iter().zip(g).zip(sums.iter()));
                        put(accum, terms.map(|(o, ((&y, &g), &s))| (o, y * (g - s))));
                    }
                },
            );
        });
    }
}

/// One contiguous row.
#[inline(always)]
fn row<T: Float>(y: &mut [T], x: &[T]) {
    let max = x.iter().fold(-T::INFINITY, |m, &x| m.max(x));
    y.iter_mut().zip(x).for_each(|(y, &x)| *y = (x - max).exp());
    let share = T::ONE / y.iter().copied().sum::<T>();
    y.iter_mut().for_each(|y| *y *= share);
}

/// All columns of a matrix side by side; `scratch` holds a number for each.
#[inline(always)]
fn columns<T: Float>(y: &mut [T], x: &[T], scratch: &mut [T]) {
    let inner = scratch.len();
    scratch.fill(-T::INFINITY);
    for x in x.chunks_exact(inner) {
        scratch.iter_mut().zip(x).for_each(|(m, &x)| *m = m.max(x));
    }
    for (y, x) in y.chunks_exact_mut(inner).zip(x.chunks_exact(inner)) {
        y.iter_mut().zip(x.iter().zip(scratch.iter())).for_each(|(y, (&x, &m))| *y = (x - m).exp());
    }
    scratch.fill(T::ZERO);
    for y in y.chunks_exact(inner) {
        scratch.iter_mut().zip(y).for_each(|(s, &y)| *s += y);
    }
    scratch.iter_mut().for_each(|s| *s = T::ONE / *s);
    for y in y.chunks_exact_mut(inner) {
        y.iter_mut().zip(scratch.iter()).for_each(|(y, &s)| *y *= s);
    }
}

impl Checked for Softmax {
    fn cases() -> Vec<Case<Self>> {
        let op = |axis| Softmax { axis };
        let x = |shape: &[usize]| Input::uniform("x", shape, -3.0, 3.0);
        vec![
            Case::new("last axis", op(2), [x(&[2, 3, 7])]),
            Case::new("a vector", op(0), [x(&[9])]),
            Case::new("middle axis", op(1), [x(&[2, 5, 3])]),
            Case::new("first axis", op(0), [x(&[4, 3, 2])]),
            Case::new("inner axis of an image", op(1), [x(&[2, 3, 4, 5])]),
            Case::new("far from zero", op(0), [Input::uniform("x", [5, 2], 99.0, 101.0)])
                .tolerance(1e-6, "the step grows with x, and the truncation with its square"),
            Case::new("one element", op(1), [x(&[3, 1])]).flat(),
            Case::new("nothing", op(0), [x(&[0, 2])]).flat(),
        ]
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        let shape: Vec<usize> = (0..random.extreme(1, 4)).map(|_| random.extreme(1, 7)).collect();
        let op = Softmax { axis: random.below(shape.len()) };
        let worth = shape[op.axis] > 1;
        worth.then(|| Case::drawn(op, [Input::uniform("x", &shape, -3.0, 3.0)])).or_else(|| Self::draw(random))
    }
}

impl<T: Float> Var<T> {
    /// e^x over its sum along an axis.
    #[track_caller]
    pub fn softmax(&self, axis: usize) -> Self {
        apply1(Softmax { axis }, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_sum_to_one_and_a_row_of_minus_infinities_is_nan() {
        let low = f32::NEG_INFINITY;
        let x = Var::constant(Tensor::from_vec([2, 3], vec![1e30f32, 2.0, low, low, low, low]));
        for y in [x.softmax(1), Var::constant(x.value().permute(&[1, 0])).softmax(0)] {
            let y = if y.dims() == [2, 3] { y.into_value() } else { y.into_value().permute(&[1, 0]) };
            assert_eq!(y.data()[..3], [1.0, 0.0, 0.0]);
            assert!(y.data()[3..].iter().all(|y| y.is_nan()));
        }
    }
}
