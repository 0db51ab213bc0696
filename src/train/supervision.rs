//! Known depth as a second teacher, for streets that are rendered.

use crate::monovit::loss::LossConfig;
use crate::tensor::{Float, Tensor, Var};

/// The mean over all pixels of `|log D - log D*|`, with `D` the depth of the full-size disparity `[B, H, W, 1]` (Sigmoid,
/// in (0, 1)) and `D*` the known depth in metres, cut to the range that the network can say.
pub fn log_depth_error<T: Float>(disparity: &Var<T>, known: &Tensor<T>, config: &LossConfig) -> Var<T> {
    let (min, max) = (config.min_depth, config.max_depth);
    let known = Var::constant(known.clone()).clamp(min, max).log();
    (disparity.disparity_to_depth(min, max).log() - known).abs().mean_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error(disparities: &[f64], known: &[f64]) -> f64 {
        let of = |x: &[f64]| Tensor::from_vec([1, 1, x.len(), 1], x.to_vec());
        log_depth_error(&Var::constant(of(disparities)), &of(known), &LossConfig::default()).value().item()
    }

    #[test]
    fn the_right_depth_costs_nothing_and_a_double_one_the_log_of_two() {
        let LossConfig { min_depth, max_depth, .. } = LossConfig::default();
        let disparity = |depth: f64| (1.0 / depth - 1.0 / max_depth) / (1.0 / min_depth - 1.0 / max_depth);
        let depths = [2.0, 10.0, 50.0];
        let right = depths.map(disparity);
        assert!(error(&right, &depths) < 1e-9);
        assert!((error(&right, &depths.map(|d| 0.5 * d)) - 2f64.ln()).abs() < 1e-9);
    }
}
