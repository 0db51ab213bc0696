//! The Taylor test: is a gradient right along a direction, without choosing a step?

use super::function::{Function, OfVars};
use super::{Options, gradients};
use crate::random::{Random, Stream};
use crate::tensor::{Tensor, Var};

/// How fast the remainder of the first-order Taylor expansion goes away: with r(h) = |f(x + h d) - f(x) - h g.d|, the
/// slope of log r over log h, between the given steps.
///
/// It is 2 where the gradient is right (only the curvature is left) and 1 where it is wrong (a multiple of h is left).
/// `at` gives f(x + h d) for a step h, and `derivative` is g.d. A remainder of exactly zero counts as infinitely fast.
///
/// ```
/// use parallax::gradcheck::taylor_slope;
/// let f = |h: f64| (0.3 + h).exp();
/// let right = taylor_slope(f, 0.3f64.exp(), [1e-2, 1e-3]);
/// let wrong = taylor_slope(f, 1.01 * 0.3f64.exp(), [1e-2, 1e-3]);
/// assert!((right - 2.0).abs() < 0.01 && wrong < 1.8);
/// ```
pub fn taylor_slope(at: impl Fn(f64) -> f64, derivative: f64, [large, small]: [f64; 2]) -> f64 {
    let centre = at(0.0);
    let remainder = |h: f64| (at(h) - centre - h * derivative).abs();
    let (r_large, r_small) = (remainder(large), remainder(small));
    if r_small == 0.0 { f64::INFINITY } else { (r_large / r_small).ln() / (large / small).ln() }
}

/// The Taylor test of a function: the slope of the remainder along a random direction of all inputs together (normal
/// numbers), for random cotangents, between the given steps. `None` if no output is tracked.
///
/// It says nothing of a function that is straight along the direction: its remainder is rounding alone.
///
/// ```
/// use parallax::gradcheck::{taylor, Options};
/// use parallax::tensor::Tensor;
/// let x = Tensor::from_vec([2], vec![0.3, -0.7]);
/// let slope = taylor(|v| vec![v[0].exp()], &[x], &Options::default(), [1e-2, 1e-3]).unwrap();
/// assert!((slope - 2.0).abs() < 0.05);
/// ```
pub fn taylor(
    f: impl Fn(&[Var<f64>]) -> Vec<Var<f64>>,
    inputs: &[Tensor<f64>],
    options: &Options,
    steps: [f64; 2],
) -> Option<f64> {
    let tracked = options.tracked(inputs.len());
    let found = gradients(&f, inputs, options)?;
    let mut random = Random::of(options.seed, Stream::TaylorDirections);
    let mut draw = |x: &Tensor<f64>| Tensor::build(*x.shape(), |d| d.iter_mut().for_each(|d| *d = random.normal()));
    let directions: Vec<_> = found.inputs.iter().zip(inputs).map(|(g, x)| g.as_ref().map(|_| draw(x))).collect();
    let dot = |a: &Tensor<f64>, b: &Tensor<f64>| a.data().iter().zip(b.data()).map(|(a, b)| a * b).sum::<f64>();
    let derivative =
        found.inputs.iter().zip(&directions).filter_map(|(g, d)| Some(dot(g.as_ref()?, d.as_ref()?))).sum();
    let at = |h: f64| -> f64 {
        let mut moved = inputs.to_vec();
        for (x, d) in moved.iter_mut().zip(&directions) {
            if let Some(d) = d {
                x.data_mut().iter_mut().zip(d.data()).for_each(|(x, d)| *x += h * d);
            }
        }
        let outputs = OfVars::new(&f, &tracked).recorded(&moved);
        outputs.iter().zip(&found.cotangents).filter_map(|((y, _), c)| Some(dot(y, c.as_ref()?))).sum()
    };
    Some(taylor_slope(at, derivative, steps))
}
