//! The numeric side: finite differences, one coordinate after the other.

use crate::tensor::{Tensor, Var};

/// The difference quotients of one input, element by element.
#[derive(Clone, Debug)]
pub struct Differences {
    /// (f(x + h) - f(x - h)) / 2h: exact up to h^2.
    pub central: Vec<f64>,
    /// (f(x + h) - f(x)) / h.
    pub right: Vec<f64>,
    /// (f(x) - f(x - h)) / h.
    pub left: Vec<f64>,
}

impl Differences {
    /// The elements where the one-sided quotients disagree, beside a gradient of the given size.
    ///
    /// A smooth function's differ by its curvature times the step; at a kink they differ by the jump of the slope.
    pub fn kinks(&self, scale: f64) -> Vec<usize> {
        let apart = |&k: &usize| {
            let (right, left) = (self.right[k], self.left[k]);
            (right - left).abs() > 1e-2 * scale.max(left.abs()).max(right.abs())
        };
        (0..self.central.len()).filter(apart).collect()
    }
}

/// The difference quotients of `f`, met with `cotangents`, for every tracked input; `None` for the others.
///
/// The step is `step` times max(1, |x|).
///
/// # Errors
/// If the outputs have other shapes than the cotangents.
pub fn differences(
    f: impl Fn(&[Var<f64>]) -> Vec<Var<f64>>,
    inputs: &[Tensor<f64>],
    tracked: &[usize],
    cotangents: &[Option<Tensor<f64>>],
    step: f64,
) -> Result<Vec<Option<Differences>>, String> {
    let evaluate = |inputs: &[Tensor<f64>]| -> Vec<Tensor<f64>> {
        let constants: Vec<_> = inputs.iter().cloned().map(Var::constant).collect();
        f(&constants).into_iter().map(Var::into_value).collect()
    };
    let centre = evaluate(inputs);
    let fits = |(y, c): (&Tensor<f64>, &Option<Tensor<f64>>)| c.as_ref().is_none_or(|c| c.shape() == y.shape());
    if centre.len() != cotangents.len() || !centre.iter().zip(cotangents).all(fits) {
        return Err("the outputs have other shapes when nothing is tracked".into());
    }
    let mut found = vec![None; inputs.len()];
    for &i in tracked {
        let n = inputs[i].len();
        let mut moved = inputs.to_vec();
        let mut d =
            Differences { central: Vec::with_capacity(n), right: Vec::with_capacity(n), left: Vec::with_capacity(n) };
        for k in 0..n {
            let x = inputs[i].data()[k];
            let h = step * x.abs().max(1.0);
            // The step that is really taken, after rounding.
            let (up, down) = (x + h, x - h);
            moved[i].data_mut()[k] = up;
            let above = evaluate(&moved);
            moved[i].data_mut()[k] = down;
            let below = evaluate(&moved);
            moved[i].data_mut()[k] = x;
            d.right.push(slope(&above, &centre, cotangents, up - x));
            d.left.push(slope(&centre, &below, cotangents, x - down));
            d.central.push(slope(&above, &below, cotangents, up - down));
        }
        found[i] = Some(d);
    }
    Ok(found)
}

/// The difference of two outputs, met with the cotangents, over the step.
fn slope(above: &[Tensor<f64>], below: &[Tensor<f64>], cotangents: &[Option<Tensor<f64>>], step: f64) -> f64 {
    let mut sum = 0.0;
    for ((a, b), c) in above.iter().zip(below).zip(cotangents) {
        if let Some(c) = c {
            // An infinity that does not move has no slope of its own, and must not become NaN.
            let difference = |(&a, &b): (&f64, &f64)| if a == b { 0.0 } else { a - b };
            sum += a.data().iter().zip(b.data()).map(difference).zip(c.data()).map(|(d, c)| d * c).sum::<f64>();
        }
    }
    sum / step
}
