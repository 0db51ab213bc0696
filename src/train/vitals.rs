//! Figures of a training step's health: the disparity, the motion, where warped samples fall, gradients by part.
//!
//! Everything is computed from values that the step has anyway; pixels are looked at every fourth row and column.

use serde::{Deserialize, Serialize};

use crate::monovit::loss::LossConfig;
use crate::tensor::Tensor;

/// Rows and columns between two pixels that are looked at.
const STRIDE: usize = 4;
/// A disparity (sigmoid) this near to 0 or 1 counts as saturated. With depths from 0.1 to 100 that is beyond 50, or below
/// 0.1001.
const SATURATED: f64 = 1e-3;

/// The state of the networks in a step, as figures of a log line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Vitals {
    /// The mean disparity at full size (the sigmoid's value, in (0, 1)).
    pub disparity: f64,
    /// The standard deviation of the disparity over the batch, divided by its mean.
    pub disparity_spread: f64,
    /// The share of pixels whose disparity is within 0.001 of either end of the sigmoid.
    pub saturated: f64,
    /// The length of the predicted translation times the mean inverse depth of its target, so that the unknown scale
    /// cancels; the median over the pairs of the batch.
    pub translation: f64,
    /// How far warped samples lie from their pixels, in pixels: the median over the pixels of all pairs.
    pub flow: f64,
    /// The share of warped samples that lie inside the source picture, in front of its camera.
    pub inside: f64,
}

/// Inputs of [`Vitals`].
pub struct Signs<'a> {
    /// The disparity at full size, `[B, H, W, 1]`.
    pub disparity: &'a Tensor<f32>,
    /// For each source the transforms from the target camera, `[B, 3, 4]`.
    pub transforms: &'a [Tensor<f32>],
    /// fx, fy, cx, cy of each sample, in pixels.
    pub intrinsics: &'a [[f64; 4]],
}

impl Vitals {
    /// The figures of one batch; `config` says which depths a disparity stands for.
    ///
    /// # Panics
    /// If the shapes are not those that [`Signs`] names.
    pub fn of(signs: &Signs, config: &LossConfig) -> Self {
        let [batch, height, width, _] = signs.disparity.shape().nhwc().expect("disparities [B, H, W, 1]");
        let (near, far) = (1.0 / config.min_depth, 1.0 / config.max_depth);
        let inverse = |disparity: f64| far + (near - far) * disparity;
        let disparities = Moments::of(signs.disparity.data());
        let saturated = |x: &&f32| f64::from(**x) < SATURATED || f64::from(**x) > 1.0 - SATURATED;
        let at_an_end = signs.disparity.data().iter().filter(saturated).count();
        let (mut translations, mut flows, mut inside, mut all) = (Vec::new(), Vec::new(), 0usize, 0usize);
        let planes = signs.disparity.data().chunks_exact((height * width).max(1));
        for (sample, plane) in planes.enumerate().take(batch) {
            let mean_inverse = inverse(Moments::of(plane).mean);
            for transform in signs.transforms {
                let t: [f64; 12] = std::array::from_fn(|i| f64::from(transform.data()[12 * sample + i]));
                translations.push((t[3] * t[3] + t[7] * t[7] + t[11] * t[11]).sqrt() * mean_inverse);
                let view = Projection { transform: t, intrinsics: signs.intrinsics[sample] };
                for y in (0..height).step_by(STRIDE) {
                    for x in (0..width).step_by(STRIDE) {
                        all += 1;
                        let inverse_depth = inverse(f64::from(plane[y * width + x]));
                        let Some([u, v]) = view.of([x as f64, y as f64], inverse_depth) else { continue };
                        flows.push((u - x as f64).hypot(v - y as f64));
                        let within = |at: f64, size: usize| (-0.5..=size as f64 - 0.5).contains(&at);
                        inside += usize::from(within(u, width) && within(v, height));
                    }
                }
            }
        }
        Vitals {
            disparity: disparities.mean,
            disparity_spread: disparities.deviation / disparities.mean.max(f64::MIN_POSITIVE),
            saturated: at_an_end as f64 / signs.disparity.len().max(1) as f64,
            translation: median(&mut translations),
            flow: median(&mut flows),
            inside: inside as f64 / all.max(1) as f64,
        }
    }
}

/// The way of a target's pixels into a source picture.
struct Projection {
    /// Rows of `[R | t]`, from the target camera to the source's.
    transform: [f64; 12],
    /// fx, fy, cx, cy, in pixels.
    intrinsics: [f64; 4],
}

impl Projection {
    /// The source pixel that shows what the target shows at a pixel; nothing for what lies behind the source camera.
    fn of(&self, [x, y]: [f64; 2], inverse_depth: f64) -> Option<[f64; 2]> {
        let [fx, fy, cx, cy] = self.intrinsics;
        let ray = [(x - cx) / fx, (y - cy) / fy, 1.0];
        // Divided by the depth, which has a limit where the depth has none.
        let row = |i: usize| {
            let r = &self.transform[4 * i..4 * i + 4];
            r[0] * ray[0] + r[1] * ray[1] + r[2] * ray[2] + r[3] * inverse_depth
        };
        let [a, b, z] = [row(0), row(1), row(2)];
        (z > 1e-9).then(|| [fx * a / z + cx, fy * b / z + cy])
    }
}

/// Mean and standard deviation.
struct Moments {
    mean: f64,
    deviation: f64,
}

impl Moments {
    fn of(numbers: &[f32]) -> Self {
        let n = numbers.len().max(1) as f64;
        let mean = numbers.iter().map(|&x| f64::from(x)).sum::<f64>() / n;
        let variance = numbers.iter().map(|&x| (f64::from(x) - mean).powi(2)).sum::<f64>() / n;
        Moments { mean, deviation: variance.sqrt() }
    }
}

/// The median, the greater of two; 0 of nothing.
pub(super) fn median(numbers: &mut [f64]) -> f64 {
    if numbers.is_empty() {
        return 0.0;
    }
    let middle = numbers.len() / 2;
    *numbers.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [32, 64];

    fn constant(disparity: f32) -> Tensor<f32> {
        Tensor::full([1, SIZE[0], SIZE[1], 1], disparity)
    }

    fn shift(x: f32, z: f32) -> Tensor<f32> {
        Tensor::from_vec([1, 3, 4], vec![1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, z])
    }

    fn vitals(disparity: &Tensor<f32>, transforms: &[Tensor<f32>]) -> Vitals {
        let intrinsics = [[40.0, 40.0, 31.5, 15.5]];
        Vitals::of(&Signs { disparity, transforms, intrinsics: &intrinsics }, &LossConfig::default())
    }

    /// Depth 2 is inverse depth 0.5 = 0.01 + 9.99 d. A camera that moves by 0.8 sideways sees it 40 * 0.8 / 2 = 16 pixels
    /// further on, a quarter of the width.
    #[test]
    fn a_plane_moves_by_focal_length_times_baseline_over_depth() {
        let plane = constant(0.49 / 9.99);
        let found = vitals(&plane, &[shift(0.8, 0.0)]);
        assert!((found.flow - 16.0).abs() < 1e-4, "{found:?}");
        assert!((found.translation - 0.4).abs() < 1e-6, "{found:?}");
        // The columns 0, 4, ..., 44 of 0, 4, ..., 60 stay inside.
        assert!((found.inside - 12.0 / 16.0).abs() < 1e-12, "{found:?}");
        assert!((found.disparity - 0.49 / 9.99).abs() < 1e-6 && found.disparity_spread < 1e-5, "{found:?}");
        assert_eq!(found.saturated, 0.0);
    }

    #[test]
    fn the_translation_is_the_median_over_pairs_and_what_lies_behind_is_not_inside() {
        let plane = constant(0.49 / 9.99);
        let found = vitals(&plane, &[shift(0.0, 0.2), shift(0.0, 1.0), shift(0.0, -3.0)]);
        assert!((found.translation - 0.5).abs() < 1e-6, "{found:?}");
        assert!(found.inside < 2.0 / 3.0 + 1e-12, "the third camera has passed the plane: {found:?}");
    }

    #[test]
    fn spread_and_saturation_are_those_of_the_pixels() {
        // Three quarters at the far end, a quarter at 0.4: mean 0.1, deviation sqrt(0.04 - 0.01).
        let n = SIZE[0] * SIZE[1];
        let disparity =
            Tensor::from_vec([1, SIZE[0], SIZE[1], 1], (0..n).map(|i| if i % 4 == 0 { 0.4 } else { 0.0 }).collect());
        let found = vitals(&disparity, &[]);
        assert!((found.disparity - 0.1).abs() < 1e-6, "{found:?}");
        assert!((found.disparity_spread - 3f64.sqrt()).abs() < 1e-5, "{found:?}");
        assert_eq!((found.saturated, found.flow, found.translation), (0.75, 0.0, 0.0));
    }
}
