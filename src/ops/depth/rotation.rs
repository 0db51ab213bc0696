//! Rotations from axis-angle vectors: the exponential map, right in value and gradient at the identity too.

use crate::ops::support::put::put_rounded;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var};

/// Rotation matrix of an axis-angle vector: `R [batch, 3, 3] = exp([v]x)` of `v [batch, 3]`, by Rodrigues' formula `I +
/// a [v]x + b [v]x^2` with `a = sin t / t`, `b = (1 - cos t) / t^2`, `t = |v|`.
///
/// It is computed in f64 for either element type: there are few of them, and one switch to the series serves both.
#[derive(Clone, Copy, Debug)]
pub struct AxisAngleToRotation;

/// a, b, and their derivatives by s = t^2.
struct Coefficients {
    a: f64,
    b: f64,
    da: f64,
    db: f64,
}

impl Coefficients {
    /// Below s = 1/4 by their power series in s, of which eight terms leave less than a rounding error; above, the
    /// closed forms lose at most two digits of f64 (in `db`) to cancellation.
    fn at(s: f64) -> Self {
        if s < 0.25 {
            // a = sum (-s)^k / (2k+1)!, b = sum (-s)^k / (2k+2)!; Horner's scheme, derivatives alongside.
            let (mut a, mut b, mut da, mut db) = (0.0, 0.0, 0.0, 0.0);
            let mut factorial = [1.0; 20];
            for i in 1..factorial.len() {
                factorial[i] = factorial[i - 1] * i as f64;
            }
            for k in (0..9).rev() {
                let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
                da = da * s + a;
                db = db * s + b;
                a = a * s + sign / factorial[2 * k + 1];
                b = b * s + sign / factorial[2 * k + 2];
            }
            return Coefficients { a, b, da, db };
        }
        let t = s.sqrt();
        let half = (0.5 * t).sin();
        let (a, b) = (t.sin() / t, 2.0 * half * half / s);
        Coefficients { a, b, da: (t.cos() - a) / (2.0 * s), db: (0.5 * a - b) / s }
    }
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// The rotation by |v| about v.
pub(crate) fn rotation(v: [f64; 3]) -> [[f64; 3]; 3] {
    let s = dot(v, v);
    let Coefficients { a, b, .. } = Coefficients::at(s);
    // [v]x^2 = v v^T - s I.
    let cross = [[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]];
    std::array::from_fn(|i| {
        std::array::from_fn(|j| {
            let square = v[i] * v[j] - if i == j { s } else { 0.0 };
            (if i == j { 1.0 } else { 0.0 }) + a * cross[i][j] + b * square
        })
    })
}

/// The gradient by v, from that by the rotation.
///
/// With G = dL/dR and w the vector for which `<G, [v]x> = w . v`, also `<G, [v]x^2> = v^T G v - s tr G`. Hence
/// `dv = a w + b ((G + G^T) v - 2 tr G v) + 2 v (a' w . v + b' (v^T G v - s tr G))`, primes being derivatives by s.
pub(crate) fn rotation_gradient(v: [f64; 3], g: [[f64; 3]; 3]) -> [f64; 3] {
    let s = dot(v, v);
    let Coefficients { a, b, da, db } = Coefficients::at(s);
    let w = [g[2][1] - g[1][2], g[0][2] - g[2][0], g[1][0] - g[0][1]];
    let trace = g[0][0] + g[1][1] + g[2][2];
    let gv: [f64; 3] = std::array::from_fn(|i| dot(g[i], v));
    let gtv: [f64; 3] = std::array::from_fn(|i| g[0][i] * v[0] + g[1][i] * v[1] + g[2][i] * v[2]);
    let by_s = da * dot(w, v) + db * (dot(v, gv) - s * trace);
    std::array::from_fn(|i| a * w[i] + b * (gv[i] + gtv[i] - 2.0 * trace * v[i]) + 2.0 * v[i] * by_s)
}

/// Three numbers of any element type.
pub(crate) fn vector<T: Float>(x: &[T]) -> [f64; 3] {
    [x[0].f64(), x[1].f64(), x[2].f64()]
}

impl<T: Float> Op<T> for AxisAngleToRotation {
    type Saved = Tensor<T>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        match *inputs[0].dims() {
            [batch, 3] => Ok(vec![[batch, 3, 3].into()]),
            _ => Err(ShapeError::new("expected axis-angle vectors [batch, 3]")),
        }
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Tensor<T>) {
        let v = inputs[0];
        let y = Tensor::build([v.dims()[0], 3, 3], |out| {
            for (out, v) in out.chunks_exact_mut(9).zip(v.data().chunks_exact(3)) {
                put_rounded(out, Accum::Replace, rotation(vector(v)).into_iter().flatten());
            }
        });
        (vec![y], v.clone())
    }

    /// See `rotation_gradient`.
    fn backward(&self, v: Tensor<T>, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        sink.accumulate(0, |out, accum| {
            let samples = out.chunks_exact_mut(3).zip(v.data().chunks_exact(3)).zip(g.data().chunks_exact(9));
            for ((out, v), g) in samples {
                let g = [vector(&g[..3]), vector(&g[3..6]), vector(&g[6..])];
                put_rounded(out, accum, rotation_gradient(vector(v), g));
            }
        });
    }
}

impl Checked for AxisAngleToRotation {
    fn cases() -> Vec<Case<Self>> {
        let op = AxisAngleToRotation;
        vec![
            Case::new("any angle", op, [Input::uniform("v", [4, 3], -2.0, 2.0)]),
            Case::new("exactly 0", op, [Input::values("v", [2, 3], [0.0; 6])]),
            Case::new("small", op, [Input::uniform("v", [3, 3], -1e-3, 1e-3)]),
            Case::new("where the series ends", op, [Input::values("v", [2, 3], [0.5, 1e-9, 0.0, 0.49, 0.0, -0.09])]),
            Case::new("half a turn", op, [Input::values("v", [1, 3], [0.0, std::f64::consts::PI, 0.0])]),
            Case::new("no vector", op, [Input::random("v", [0, 3])]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// Rotation matrices `[batch, 3, 3]` of axis-angle vectors `[batch, 3]` (radians): the exponential map.
    #[track_caller]
    pub fn axis_angle_to_rotation(&self) -> Self {
        apply1(AxisAngleToRotation, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_series_meets_the_closed_form() {
        let (below, above) = (Coefficients::at(0.25 - 1e-12), Coefficients::at(0.25));
        for (x, y) in [(below.a, above.a), (below.b, above.b), (below.da, above.da), (below.db, above.db)] {
            assert!((x - y).abs() < 1e-13 * (1.0 + x.abs()), "{x} and {y}");
        }
        let zero = Coefficients::at(0.0);
        assert_eq!((zero.a, zero.b, zero.da, zero.db), (1.0, 0.5, -1.0 / 6.0, -1.0 / 24.0));
    }

    #[test]
    fn a_rotation_is_orthogonal_and_turns_the_right_way() {
        for v in [[0.3, -1.2, 2.0], [1e-9, 0.0, 0.0], [0.1, 0.2, -0.3]] {
            let r = rotation(v);
            for i in 0..3 {
                for j in 0..3 {
                    let expected = if i == j { 1.0 } else { 0.0 };
                    assert!((dot(r[i], r[j]) - expected).abs() < 1e-14);
                }
                assert!((dot(r[i], v) - v[i]).abs() < 1e-14, "the axis stays");
            }
        }
        let quarter = rotation([0.0, 0.0, std::f64::consts::FRAC_PI_2]);
        assert!((quarter[1][0] - 1.0).abs() < 1e-15, "x turns to y about z");
    }
}
