//! Nearest-neighbour enlargement by a whole factor.

use crate::ops::support::squares::sum_squares;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::simd::copy_run;
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// Nearest-neighbour upsampling: every pixel of [batch, height, width, channels] becomes a square of `scale` x `scale`
/// pixels.
#[derive(Clone, Copy, Debug)]
pub struct UpsampleNearest {
    /// Factor in both directions.
    pub scale: usize,
}

impl<T: Float> Op<T> for UpsampleNearest {
    /// The shape of the input.
    type Saved = Shape;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let Some([_, h, w, _]) = inputs[0].nhwc() else {
            return Err(ShapeError::new("expected x [batch, height, width, channels]"));
        };
        if self.scale == 0 {
            return Err(ShapeError::new("the scale must be at least 1"));
        }
        Ok(vec![inputs[0].with(1, h * self.scale).with(2, w * self.scale)])
    }

    fn algo(&self, _: &[Shape]) -> &'static str {
        if self.scale == 2 { "by_2" } else { "direct" }
    }

    fn traffic(&self, inputs: &[Shape], outputs: &[Shape], needs: &Needs) -> [u64; 2] {
        crate::ops::op::traffic_without_inputs(inputs, outputs, needs)
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Shape) {
        let (x, s) = (inputs[0], self.scale);
        let [_, h, w, c] = x.shape().nhwc().expect("checked by the shape rule");
        let shape = x.shape().with(1, h * s).with(2, w * s);
        let y = Tensor::build(shape, |out| {
            let work = out.len();
            let row = w * s * c;
            if work == 0 {
                return;
            }
            // One row of the input becomes `scale` rows: the first is spread, the others are its copies.
            parallel::for_each_unit(out, s * row, work, |i, out| {
                let (first, copies) = out.split_at_mut(row);
                let x = &x.data()[i * w * c..][..w * c];
                T::dispatch(
                    #[inline(always)]
                    || {
                        for (square, x) in first.chunks_exact_mut(s * c).zip(x.chunks_exact(c)) {
                            square.chunks_exact_mut(c).for_each(|y| copy_run(y, x));
                        }
                    },
                );
                copies.chunks_exact_mut(row).for_each(|copy| copy.copy_from_slice(first));
            });
        });
        (vec![y], *x.shape())
    }

    /// A pixel's gradient is the sum of those of its square.
    fn backward(&self, shape: Shape, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let (g, [_, _, w, c]) = (upstream.only(), shape.nhwc().expect("checked by the shape rule"));
        sink.accumulate(0, |out, accum| sum_squares(out, accum, g.data(), [w, c], self.scale));
    }
}

impl Checked for UpsampleNearest {
    fn cases() -> Vec<Case<Self>> {
        let x = |shape: &[usize]| Input::random("x", shape);
        let by = |scale| UpsampleNearest { scale };
        vec![
            Case::new("twice", by(2), [x(&[2, 3, 5, 8])]),
            Case::new("twice, one channel", by(2), [x(&[2, 3, 5, 1])]),
            Case::new("twice, 17 channels", by(2), [x(&[2, 1, 3, 17])]),
            Case::new("three times", by(3), [x(&[2, 2, 3, 3])]),
            Case::new("not at all", by(1), [x(&[2, 3, 2, 3])]),
            Case::new("empty", by(2), [x(&[2, 0, 2, 3])]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// Enlarges [batch, height, width, channels] by a whole factor: every pixel becomes a square.
    #[track_caller]
    pub fn upsample_nearest(&self, scale: usize) -> Self {
        apply1(UpsampleNearest { scale }, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_become_squares() {
        let x = Var::constant(Tensor::from_vec([1, 1, 2, 2], vec![1.0f32, 2.0, 3.0, 4.0]));
        let y = x.upsample_nearest(2);
        assert_eq!(y.shape().dims(), [1, 2, 4, 2]);
        assert_eq!(y.value().data()[..8], [1.0, 2.0, 1.0, 2.0, 3.0, 4.0, 3.0, 4.0]);
        assert_eq!(y.value().data()[8..], y.value().data()[..8]);
    }
}
