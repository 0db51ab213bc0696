//! Rigid transforms from axis-angle and translation.

use super::rotation::{rotation, rotation_gradient, vector};
use crate::ops::support::put::put_rounded;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var};

/// Rigid transform `[R | t]` as `[batch, 3, 4]`, from axis-angle `[batch, 3]` and translation `[batch, 3]`; or its
/// inverse `[R^T | -R^T t]`.
#[derive(Clone, Copy, Debug)]
pub struct PoseMatrix {
    /// Whether the result is the inverse transform.
    pub invert: bool,
}

fn transpose(r: [[f64; 3]; 3]) -> [[f64; 3]; 3] {
    std::array::from_fn(|i| std::array::from_fn(|j| r[j][i]))
}

fn times(r: [[f64; 3]; 3], t: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| r[i][0] * t[0] + r[i][1] * t[1] + r[i][2] * t[2])
}

impl PoseMatrix {
    fn matrix(self, v: [f64; 3], t: [f64; 3]) -> ([[f64; 3]; 3], [f64; 3]) {
        let r = rotation(v);
        if !self.invert {
            return (r, t);
        }
        let r = transpose(r);
        (r, times(r, t).map(|x| -x))
    }
}

impl<T: Float> Op<T> for PoseMatrix {
    /// Axis-angle and translation.
    type Saved = (Tensor<T>, Tensor<T>);

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        match (inputs[0].dims(), inputs[1].dims()) {
            ([batch, 3], [other, 3]) if batch == other => Ok(vec![[*batch, 3, 4].into()]),
            _ => Err(ShapeError::new("expected axis-angle [batch, 3] and translation [batch, 3]")),
        }
    }

    fn algo(&self, _: &[Shape]) -> &'static str {
        if self.invert { "inverse" } else { "direct" }
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let (v, t) = (inputs[0], inputs[1]);
        let y = Tensor::build([v.dims()[0], 3, 4], |out| {
            let samples = out.chunks_exact_mut(12).zip(v.data().chunks_exact(3)).zip(t.data().chunks_exact(3));
            for ((out, v), t) in samples {
                let (r, t) = self.matrix(vector(v), vector(t));
                for ((out, r), t) in out.chunks_exact_mut(4).zip(r).zip(t) {
                    put_rounded(out, Accum::Replace, r.into_iter().chain([t]));
                }
            }
        });
        (vec![y], (v.clone(), t.clone()))
    }

    /// `[R | t]`: each part has its own. The inverse, of y = -R^T t besides: dR = G^T - t dy^T, dt = -R dy.
    fn backward(&self, (v, t): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let sample = |i: usize| {
            let g = &g.data()[12 * i..][..12];
            let by_matrix = [vector(&g[..3]), vector(&g[4..7]), vector(&g[8..11])];
            let by_last = [g[3].f64(), g[7].f64(), g[11].f64()];
            (vector(&v.data()[3 * i..]), vector(&t.data()[3 * i..]), by_matrix, by_last)
        };
        sink.accumulate(0, |out, accum| {
            for (i, out) in out.chunks_exact_mut(3).enumerate() {
                let (v, t, mut by_matrix, by_last) = sample(i);
                if self.invert {
                    by_matrix = transpose(by_matrix);
                    for (row, t) in by_matrix.iter_mut().zip(t) {
                        row.iter_mut().zip(by_last).for_each(|(d, y)| *d -= t * y);
                    }
                }
                put_rounded(out, accum, rotation_gradient(v, by_matrix));
            }
        });
        sink.accumulate(1, |out, accum| {
            for (i, out) in out.chunks_exact_mut(3).enumerate() {
                let (v, _, _, by_last) = sample(i);
                let dt = if self.invert { times(rotation(v), by_last).map(|x| -x) } else { by_last };
                put_rounded(out, accum, dt);
            }
        });
    }
}

impl Checked for PoseMatrix {
    fn cases() -> Vec<Case<Self>> {
        let mut cases = Vec::new();
        for invert in [false, true] {
            let op = PoseMatrix { invert };
            let t = |batch: usize| Input::random("t", [batch, 3]);
            cases.extend([
                Case::new("any pose", op, [Input::uniform("v", [3, 3], -1.5, 1.5), t(3)]),
                Case::new("no rotation", op, [Input::values("v", [2, 3], [0.0; 6]), t(2)]),
                Case::new("no sample", op, [Input::random("v", [0, 3]), t(0)]).flat(),
            ]);
        }
        cases
    }
}

impl<T: Float> Var<T> {
    /// The rigid transforms `[R | t]`, `[batch, 3, 4]`, of axis-angle vectors and translations `[batch, 3]`; with
    /// `invert`, the inverse transforms `[R^T | -R^T t]`.
    #[track_caller]
    pub fn pose_matrix(axis_angle: &Self, translation: &Self, invert: bool) -> Self {
        apply1(PoseMatrix { invert }, &[axis_angle, translation])
    }
}
