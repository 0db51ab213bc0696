//! The logarithm of the softmax along any axis.

use super::axis_loops::Blocks;
use super::log_sum_exp::{log_sums, maxima};
use crate::ops::support::put::put;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var};

/// `y = (x - max) - ln sum e^(x - max)`, maximum and sum along an axis. Where all of them are minus infinity (or one is
/// plus infinity or NaN) the result is NaN, as that of the softmax is; a single minus infinity stays one.
#[derive(Clone, Copy, Debug)]
pub struct LogSoftmax {
    /// The axis along which e^y sums to 1.
    pub axis: usize,
}

impl<T: Float> Op<T> for LogSoftmax {
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
        let max = maxima(x.data(), blocks);
        let log_sum = log_sums(x.data(), blocks, &max);
        let columns: Vec<[T; 2]> = max.iter().zip(log_sum.iter()).map(|(&max, &log)| [max, log]).collect();
        let y = Tensor::build(*x.shape(), |out| {
            blocks.map(out, Accum::Replace, x.data(), &columns, |x, [max, log]| (x - max) - log);
        });
        let saved = needs.any().then(|| y.clone());
        (vec![y], saved)
    }

    /// dx = dy - e^y sum dy, the sum along the axis.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let (y, g) = (saved.expect("saved for the only input"), upstream.only());
        let blocks = Blocks::of(y.shape(), self.axis, 1);
        let (len, inner) = (blocks.len(), blocks.inner);
        let sums = blocks.sum(g.data(), &vec![(); blocks.columns()], |g, ()| g);
        sink.accumulate(0, |out, accum| {
            blocks.for_each(
                out,
                0,
                #[inline(always)]
                |o, out, _| {
                    let [y, g] = [&y, &g].map(|t| &t.data()[o * len..][..len]);
                    let sums = &sums[o * inner..][..inner];
                    if let [s] = *sums {
                        put(accum, out.iter_mut().zip(y.iter().zip(g).map(|(&y, &g)| g - y.exp() * s)));
                        return;
                    }
                    let rows = y.chunks_exact(inner).zip(g.chunks_exact(inner));
                    for (out, (y, g)) in out.chunks_exact_mut(inner).zip(rows) {
                        let terms = y.iter().zip(g).zip(sums).map(|((&y, &g), &s)| g - y.exp() * s);
                        put(accum, out.iter_mut().zip(terms));
                    }
                },
            );
        });
    }
}

impl Checked for LogSoftmax {
    fn cases() -> Vec<Case<Self>> {
        let op = |axis| LogSoftmax { axis };
        let x = |shape: &[usize]| Input::uniform("x", shape, -3.0, 3.0);
        vec![
            Case::new("last axis", op(2), [x(&[2, 3, 7])]),
            Case::new("a vector", op(0), [x(&[9])]),
            Case::new("middle axis", op(1), [x(&[2, 5, 3])]),
            Case::new("first axis", op(0), [x(&[4, 3, 2])]),
            Case::new("inner axis of an image", op(1), [x(&[2, 3, 4, 5])]),
            Case::new("one far above", op(0), [Input::values("x", [4], [0.0, 50.0, -50.0, -800.0])]),
            Case::new("one element", op(1), [x(&[3, 1])]).flat(),
            Case::new("nothing", op(0), [x(&[0, 2])]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// The logarithm of the softmax along an axis; the shape stays.
    ///
    /// # Panics
    /// If there is no such axis.
    #[track_caller]
    pub fn log_softmax(&self, axis: usize) -> Self {
        apply1(LogSoftmax { axis }, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    #[test]
    fn it_keeps_what_the_logarithm_of_a_softmax_loses() {
        let x = Var::constant(Tensor::from_vec([3], vec![1e4f32, 0.0, -1e4]));
        assert_eq!(x.log_softmax(0).value().data(), [0.0, -1e4, -2e4]);
    }

    #[test]
    fn along_any_axis_it_is_the_same() {
        let x = Var::constant(Tensor::from_vec([2, 3], vec![1.0f64, 2.0, 3.0, -1.0, 0.5, 0.0]));
        let columns = Var::constant(x.value().permute(&[1, 0])).log_softmax(0).into_value().permute(&[1, 0]);
        let rows = x.log_softmax(1).into_value();
        for (a, b) in columns.data().iter().zip(rows.data()) {
            assert!((a - b).abs() < 1e-15);
        }
        let sum: f64 = rows.data()[..3].iter().map(|y| y.exp()).sum();
        assert!((sum - 1.0).abs() < 1e-15);
    }

    #[test]
    fn minus_infinity_has_probability_0_and_a_row_of_them_is_nan() {
        let low = f64::NEG_INFINITY;
        let x = Tensor::from_vec([2, 3], vec![0.0, low, 0.0, low, low, low]);
        for axis in [1, 0] {
            let turned = |t: &Tensor<f64>| if axis == 1 { t.clone() } else { t.permute(&[1, 0]) };
            let tape = Tape::new();
            let x = tape.leaf(turned(&x));
            let y = x.log_softmax(axis);
            let value = turned(y.value());
            assert_eq!(value.data()[..3], [-std::f64::consts::LN_2, low, -std::f64::consts::LN_2]);
            assert!(value.data()[3..].iter().all(|y| y.is_nan()));
            let mut cotangent = Tensor::zeros([2, 3]);
            cotangent.data_mut()[0] = 1.0;
            let gradients = tape.backward(&[(&y, turned(&cotangent))]);
            let dx = turned(gradients.get(&x).unwrap());
            assert!((dx.data()[0] - 0.5).abs() < 1e-15 && dx.data()[1] == 0.0 && (dx.data()[2] + 0.5).abs() < 1e-15);
            assert!(dx.data()[3..].iter().all(|d| d.is_nan()));
        }
    }

    #[test]
    fn nan_and_plus_infinity_make_nan() {
        for bad in [f32::NAN, f32::INFINITY] {
            let x = Var::constant(Tensor::from_vec([2], vec![1.0, bad]));
            assert!(x.log_softmax(0).value().data().iter().all(|y| y.is_nan()));
        }
    }
}
