//! The Taylor test: is a gradient right along a direction, without choosing a step?

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
