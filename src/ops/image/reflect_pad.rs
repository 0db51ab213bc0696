//! Padding by reflection.

use crate::ops::support::put::begin_sum;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::random::Random;
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// Reflection padding: adds rows and columns to [batch, height, width, channels], mirrored about the outermost pixels,
/// which are not repeated: `c b | a b c d | c b`.
#[derive(Clone, Copy, Debug)]
pub struct ReflectPad {
    /// Columns added on the left.
    pub left: usize,
    /// Columns added on the right.
    pub right: usize,
    /// Rows added at the top.
    pub top: usize,
    /// Rows added at the bottom.
    pub bottom: usize,
}

/// The index that position `at` of the padded line shows, of `n`.
#[inline(always)]
fn reflected(at: usize, before: usize, n: usize) -> usize {
    let i = at.abs_diff(before);
    if i < n { i } else { 2 * (n - 1) - i }
}

/// The positions of the padded line, in order, that show index `i` of `n`: itself, and at most one on either side.
#[inline(always)]
fn images(i: usize, before: usize, n: usize, after: usize) -> [Option<usize>; 3] {
    let left = (i > 0 && i <= before).then(|| before - i);
    let right = (i + 1 < n && n - 1 - i <= after).then(|| before + 2 * (n - 1) - i);
    [left, Some(before + i), right]
}

impl<T: Float> Op<T> for ReflectPad {
    /// The shape of x.
    type Saved = Shape;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let Some([_, h, w, _]) = inputs[0].nhwc() else {
            return Err(ShapeError::new("expected x [batch, height, width, channels]"));
        };
        let ReflectPad { left, right, top, bottom } = *self;
        if left.max(right) >= w || top.max(bottom) >= h {
            return Err(ShapeError::new(format!(
                "padding {left}, {right}, {top}, {bottom} must be less than the image in the same direction"
            )));
        }
        Ok(vec![inputs[0].with(1, top + h + bottom).with(2, left + w + right)])
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Shape) {
        let ReflectPad { left, right, top, bottom } = *self;
        let x = inputs[0];
        let [_, h, w, c] = x.shape().nhwc().expect("checked by the shape rule");
        let (oh, ow) = (top + h + bottom, left + w + right);
        let y = Tensor::build(x.shape().with(1, oh).with(2, ow), |out| {
            let work = out.len();
            parallel::for_each_unit(out, ow * c, work, |i, out| {
                let row = (i / oh * h + reflected(i % oh, top, h)) * w * c;
                let x = &x.data()[row..][..w * c];
                out[left * c..(left + w) * c].copy_from_slice(x);
                for at in (0..left).chain(left + w..ow) {
                    out[at * c..][..c].copy_from_slice(&x[reflected(at, left, w) * c..][..c]);
                }
            });
        });
        (vec![y], *x.shape())
    }

    /// A pixel's gradient is the sum over the places that show it.
    fn backward(&self, shape: Shape, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let ReflectPad { left, top, bottom, .. } = *self;
        let g = upstream.only();
        let [_, oh, ow, c] = g.shape().nhwc().expect("an image");
        let [_, h, w, _] = shape.nhwc().expect("an image");
        sink.accumulate(0, |out, accum| {
            let work = g.len();
            parallel::for_each_unit(out, w * c, work, |i, out| {
                begin_sum(out, accum);
                for row in images(i % h, top, h, bottom).into_iter().flatten() {
                    let g = &g.data()[(i / h * oh + row) * ow * c..][..ow * c];
                    out.iter_mut().zip(&g[left * c..]).for_each(|(d, &g)| *d += g);
                    for at in (0..left).chain(left + w..ow) {
                        let d = &mut out[reflected(at, left, w) * c..][..c];
                        d.iter_mut().zip(&g[at * c..]).for_each(|(d, &g)| *d += g);
                    }
                }
            });
        });
    }
}

impl Checked for ReflectPad {
    fn cases() -> Vec<Case<Self>> {
        let x = |shape: &[usize]| Input::random("x", shape);
        let op = |[left, right, top, bottom]: [usize; 4]| ReflectPad { left, right, top, bottom };
        vec![
            Case::new("one on each side", op([1; 4]), [x(&[2, 4, 5, 3])]),
            Case::new("one pixel shown on both sides", op([1; 4]), [x(&[2, 3, 3, 8])]),
            Case::new("each side another", op([3, 2, 1, 2]), [x(&[2, 3, 5, 1])]),
            Case::new("two pixels", op([1, 1, 1, 1]), [x(&[1, 2, 2, 17])]),
            Case::new("nothing", op([0; 4]), [x(&[2, 1, 1, 3])]),
            Case::new("no image", op([1; 4]), [x(&[0, 3, 3, 2])]).flat(),
        ]
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        let [left, right, top, bottom] = [0; 4].map(|_| random.extreme(0, 5));
        let image = [random.extreme(1, 3), random.extreme(1, 6), random.extreme(1, 6), random.pick(&[1, 3, 8, 17])];
        Some(Case::drawn(ReflectPad { left, right, top, bottom }, [Input::random("x", image)]))
    }
}

impl<T: Float> Var<T> {
    /// Adds [left, right, top, bottom] mirrored columns and rows to [batch, height, width, channels], fewer than there
    /// are; the outermost pixels are not repeated.
    #[track_caller]
    pub fn reflect_pad(&self, [left, right, top, bottom]: [usize; 4]) -> Self {
        apply1(ReflectPad { left, right, top, bottom }, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_outermost_pixel_is_the_mirror() {
        let x = Var::constant(Tensor::from_vec([1, 1, 4, 1], vec![1.0f32, 2.0, 3.0, 4.0]));
        assert_eq!(x.reflect_pad([2, 3, 0, 0]).value().data(), [3.0, 2.0, 1.0, 2.0, 3.0, 4.0, 3.0, 2.0, 1.0]);
        let x = x.reshape([1, 4, 1, 1]);
        assert_eq!(x.reflect_pad([0, 0, 1, 2]).value().data(), [2.0, 1.0, 2.0, 3.0, 4.0, 3.0, 2.0]);
    }

    #[test]
    fn images_invert_the_reflection() {
        for (before, n, after) in [(0, 1, 0), (1, 2, 1), (2, 3, 2), (3, 5, 4), (0, 4, 3)] {
            for i in 0..n {
                let all: Vec<usize> = images(i, before, n, after).into_iter().flatten().collect();
                let expected: Vec<usize> =
                    (0..before + n + after).filter(|&at| reflected(at, before, n) == i).collect();
                assert_eq!(all, expected);
            }
        }
    }
}
