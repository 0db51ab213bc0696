//! The logarithm of a sum of exponentials: the smooth maximum.

use super::axis_loops::Blocks;
use crate::ops::support::axes::dropped;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::pool::Buffer;
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var};

/// `y = max + ln sum e^(x - max)` along an axis, which is dropped.
///
/// Where all elements are minus infinity (or there is none) the result is minus infinity, and the gradient 0. A plus
/// infinity makes the result plus infinity, its own gradient NaN, and that of the others 0.
#[derive(Clone, Copy, Debug)]
pub struct LogSumExp {
    /// The axis.
    pub axis: usize,
}

/// What the backward pass needs: the input, and the two parts of the result. Their sum has not the digits of both.
pub struct Saved<T: Float> {
    x: Tensor<T>,
    max: Buffer<T>,
    log_sum: Buffer<T>,
}

/// The largest element of every column; NaN if one is.
pub(in crate::ops) fn maxima<T: Float>(x: &[T], blocks: Blocks) -> Buffer<T> {
    blocks.fold(x, &vec![(); blocks.columns()], -T::INFINITY, |max, x, ()| max.max(x))
}

/// ln sum e^(x - max) of every column.
pub(in crate::ops) fn log_sums<T: Float>(x: &[T], blocks: Blocks, max: &[T]) -> Buffer<T> {
    let mut sums = blocks.sum(x, max, |x, max| (x - max).exp());
    sums.iter_mut().for_each(|s| *s = s.ln());
    sums
}

impl<T: Float> Op<T> for LogSumExp {
    type Saved = Option<Saved<T>>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        dropped(&inputs[0], self.axis, 1)
    }

    fn algo(&self, inputs: &[Shape]) -> &'static str {
        Blocks::of(&inputs[0], self.axis, 1).algo()
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let x = inputs[0];
        let blocks = Blocks::of(x.shape(), self.axis, 1);
        let mut max = maxima(x.data(), blocks);
        // An infinity less itself would be NaN.
        max.iter_mut().for_each(|m| *m = if m.abs() == T::INFINITY { T::ZERO } else { *m });
        let log_sum = log_sums(x.data(), blocks, &max);
        let y = Tensor::build(x.shape().without(self.axis), |out| {
            out.iter_mut().zip(max.iter().zip(log_sum.iter())).for_each(|(y, (&max, &log))| *y = max + log);
        });
        let saved = needs.any().then(|| Saved { x: x.clone(), max, log_sum });
        (vec![y], saved)
    }

    /// dx = dy e^(x - y), the softmax; 0 where y is minus infinity.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let (Saved { x, max, log_sum }, g) = (saved.expect("saved for the only input"), upstream.only());
        let blocks = Blocks::of(x.shape(), self.axis, 1);
        let parts = max.iter().zip(log_sum.iter()).zip(g.data());
        let columns: Vec<[T; 3]> = parts
            .map(|((&max, &log), &g)| if log == -T::INFINITY { [T::ZERO, T::ZERO, g] } else { [max, log, g] })
            .collect();
        sink.accumulate(0, |out, accum| {
            blocks.map(out, accum, x.data(), &columns, |x, [max, log, g]| ((x - max) - log).exp() * g);
        });
    }
}

impl Checked for LogSumExp {
    fn cases() -> Vec<Case<Self>> {
        let op = |axis| LogSumExp { axis };
        let x = |shape: &[usize]| Input::uniform("x", shape, -3.0, 3.0);
        vec![
            Case::new("last axis", op(2), [x(&[2, 3, 7])]),
            Case::new("a vector", op(0), [x(&[9])]),
            Case::new("middle axis", op(1), [x(&[2, 5, 3])]),
            Case::new("first axis", op(0), [x(&[4, 3, 2])]),
            Case::new("inner axis of an image", op(1), [x(&[2, 3, 4, 5])]),
            Case::new("zeros: all are the largest", op(1), [Input::values("x", [2, 3], [0.0; 6])]),
            Case::new("one far above", op(0), [Input::values("x", [4], [0.0, 50.0, -50.0, -800.0])]),
            Case::new("one element", op(1), [x(&[3, 1])]),
            Case::new("of nothing", op(0), [x(&[0, 2])]).flat(),
            Case::new("empty rest", op(0), [x(&[3, 0])]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// ln sum e^x along an axis, which is dropped.
    ///
    /// # Panics
    /// If there is no such axis.
    #[track_caller]
    pub fn log_sum_exp(&self, axis: usize) -> Self {
        apply1(LogSumExp { axis }, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    fn at(x: [f32; 2]) -> (f32, Vec<f32>) {
        let tape = Tape::new();
        let x = tape.leaf(Tensor::from_vec([2], x.to_vec()));
        let y = x.log_sum_exp(0);
        let value = y.value().item();
        (value, y.backward().get(&x).unwrap().data().to_vec())
    }

    #[test]
    fn it_neither_overflows_nor_vanishes() {
        let (y, dx) = at([1e30, 1e30]);
        assert_eq!((y, &dx[..]), (1e30, &[0.5, 0.5][..]));
        // ln 2 is lost beside 1e4 in f32, but the two shares are not.
        let (y, dx) = at([-1e4, -1e4]);
        assert!((y + 1e4 - std::f32::consts::LN_2).abs() < 1e-3 && dx.iter().all(|d| (d - 0.5).abs() < 1e-6));
    }

    #[test]
    fn infinities_and_nan() {
        let inf = f32::INFINITY;
        assert_eq!(at([-inf, -inf]), (-inf, vec![0.0, 0.0]));
        assert_eq!(at([-inf, 3.0]), (3.0, vec![0.0, 1.0]));
        let (y, dx) = at([inf, 3.0]);
        assert!(y == inf && dx[0].is_nan() && dx[1] == 0.0);
        assert!(at([f32::NAN, 1.0]).0.is_nan() && at([1.0, f32::NAN]).0.is_nan() && at([f32::NAN, -inf]).0.is_nan());
        let nothing = Var::constant(Tensor::<f64>::zeros([0, 2])).log_sum_exp(0);
        assert_eq!(nothing.value().data(), [f64::NEG_INFINITY; 2]);
    }
}
