//! Bilinear resizing of images, without antialiasing.

use super::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// `[B, H, W, C] -> [B, height, width, C]`. Output i reads the input at `(i + 1/2) in / out - 1/2`, held within the
/// image; with `align_corners` at `i (in - 1) / (out - 1)`.
#[derive(Clone, Copy, Debug)]
pub struct ResizeBilinear {
    /// The new height.
    pub height: usize,
    /// The new width.
    pub width: usize,
    /// Whether corner pixels keep their places.
    pub align_corners: bool,
}

/// Two neighbours and the weight of the second.
type Tap<T> = (usize, usize, T);

impl ResizeBilinear {
    fn taps<T: Float>(&self, input: usize, output: usize) -> Vec<Tap<T>> {
        let at = |i: usize| match self.align_corners {
            true => i as f64 * (input - 1) as f64 / (output.max(2) - 1) as f64,
            false => ((i as f64 + 0.5) * input as f64 / output as f64 - 0.5).max(0.0),
        };
        (0..output)
            .map(|i| {
                let x = at(i);
                let below = (x as usize).min(input - 1);
                (below, (below + 1).min(input - 1), T::of(x - below as f64))
            })
            .collect()
    }
}

impl<T: Float> Op<T> for ResizeBilinear {
    type Saved = Shape;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let Some([b, h, w, c]) = inputs[0].nhwc() else {
            return Err(ShapeError::new("expected x [batch, height, width, channels]"));
        };
        if h * w * self.height * self.width == 0 {
            return Err(ShapeError::new("an empty image has no pixels to read or to make"));
        }
        Ok(vec![Shape::new(&[b, self.height, self.width, c])])
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Shape) {
        let x = inputs[0];
        let [b, h, w, c] = x.shape().nhwc().expect("checked by the shape rule");
        let (rows, columns) = (self.taps::<T>(h, self.height), self.taps::<T>(w, self.width));
        let y = Tensor::build([b, self.height, self.width, c], |out| {
            let work = 8 * out.len();
            parallel::for_each_chunk(out, self.width * c, work, |r, out| {
                let image = &x.data()[(r / self.height) * h * w * c..][..h * w * c];
                let (above, below, t) = rows[r % self.height];
                let (above, below) = (&image[above * w * c..][..w * c], &image[below * w * c..][..w * c]);
                for (out, &(left, right, s)) in out.chunks_exact_mut(c).zip(&columns) {
                    let corners = above[left * c..].iter().zip(&above[right * c..]);
                    let corners = corners.zip(below[left * c..].iter().zip(&below[right * c..]));
                    for (y, ((&a, &b), (&c, &d))) in out.iter_mut().zip(corners) {
                        let (top, bottom) = (a + s * (b - a), c + s * (d - c));
                        *y = top + t * (bottom - top);
                    }
                }
            });
        });
        (vec![y], *x.shape())
    }

    /// Every output is a weighted sum of four inputs: each gets the gradient with its weight.
    fn backward(&self, shape: Shape, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let [_, h, w, c] = shape.nhwc().expect("an image");
        let (rows, columns) = (self.taps::<T>(h, self.height), self.taps::<T>(w, self.width));
        sink.accumulate(0, |out, accum| {
            parallel::for_each_chunk(out, h * w * c, 8 * g.len(), |b, out| {
                if accum == Accum::Replace {
                    out.fill(T::ZERO);
                }
                let g = &g.data()[b * self.height * self.width * c..][..self.height * self.width * c];
                for (g, &(above, below, t)) in g.chunks_exact(self.width * c).zip(&rows) {
                    for (g, &(left, right, s)) in g.chunks_exact(c).zip(&columns) {
                        let corners = [
                            (above, left, (T::ONE - t) * (T::ONE - s)),
                            (above, right, (T::ONE - t) * s),
                            (below, left, t * (T::ONE - s)),
                            (below, right, t * s),
                        ];
                        for (y, x, weight) in corners {
                            let out = &mut out[(y * w + x) * c..][..c];
                            out.iter_mut().zip(g).for_each(|(d, &g)| *d += weight * g);
                        }
                    }
                }
            });
        });
    }
}

impl Checked for ResizeBilinear {
    fn cases() -> Vec<Case<Self>> {
        let op = |height, width, align_corners| ResizeBilinear { height, width, align_corners };
        let x = |shape: [usize; 4]| Input::random("x", shape);
        vec![
            Case::new("twice as large", op(6, 8, false), [x([2, 3, 4, 2])]),
            Case::new("odd factors", op(7, 5, false), [x([1, 3, 4, 1])]),
            Case::new("smaller", op(3, 2, false), [x([1, 5, 7, 3])]),
            Case::new("aligned corners", op(7, 5, true), [x([2, 3, 4, 1])]),
            Case::new("to one pixel", op(1, 1, true), [x([1, 3, 4, 1])]),
            Case::new("of one pixel", op(3, 2, false), [x([2, 1, 1, 2])]),
        ]
    }
}

impl<T: Float> Var<T> {
    /// Bilinear resizing to `height` x `width`.
    #[track_caller]
    pub fn resize_bilinear(&self, height: usize, width: usize, align_corners: bool) -> Self {
        apply1(ResizeBilinear { height, width, align_corners }, &[self])
    }
}
