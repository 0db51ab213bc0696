//! The self-supervised loss (MonoViT, section 3.4; Monodepth2, section 3): how well the neighbours, warped into the
//! target by the predicted depth and motion, look like it.

use serde::{Deserialize, Serialize};

use super::shake::Shake;
use crate::random::Random;
use crate::tensor::{Float, Tensor, Var, trace};

/// The settings of the loss.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LossConfig {
    /// Disparity 1 means this depth.
    pub min_depth: f64,
    /// Disparity 0 means this depth.
    pub max_depth: f64,
    /// The share of SSIM in the photometric error; the rest is the absolute difference.
    pub ssim: f64,
    /// The weight of the smoothness term at full size; halved with every scale.
    pub smoothness: f64,
    /// Whether pixels that an unwarped neighbour explains better are left out.
    pub auto_mask: bool,
    /// The number of steps before auto-masking sets in. While the motion is not known yet, a warped neighbour explains
    /// hardly any pixel better than an unwarped one, and masking would leave little to learn from.
    pub auto_mask_after: u64,
    /// The deviation of the noise that decides between equal errors.
    pub tie_break: f64,
    /// Whether the sampling grid is made for the convention it is sampled with (pixel centres), instead of the
    /// published combination (made for aligned corners, sampled without).
    pub consistent_grid: bool,
    /// Known rotations for the pose network, at the beginning; not where training starts from given weights.
    pub shake: Shake,
}

impl Default for LossConfig {
    fn default() -> Self {
        LossConfig {
            min_depth: 0.1,
            max_depth: 100.0,
            ssim: 0.85,
            smoothness: 1e-3,
            auto_mask: true,
            auto_mask_after: 0,
            tie_break: 1e-5,
            consistent_grid: false,
            shake: Shake::default(),
        }
    }
}

/// What the loss compares: plain images, not the jittered ones that the networks see.
pub struct Views<T: Float> {
    /// The target at 1, 1/2, 1/4, 1/8 of its size, `[B, h, w, 3]`.
    pub pyramid: Vec<Var<T>>,
    /// The neighbours, `[B, H, W, 3]`.
    pub sources: Vec<Var<T>>,
    /// fx, fy, cx, cy of each sample, in pixels.
    pub intrinsics: Vec<[f64; 4]>,
}

/// The loss and what it is made of (means over the scales).
pub struct Loss<T: Float> {
    /// The number to go down from.
    pub total: Var<T>,
    /// The mean of the per-pixel minimum of photometric errors.
    pub photometric: f64,
    /// The same over warped neighbours alone.
    pub warped: f64,
    /// The same over unwarped neighbours alone: what standing still would give.
    pub unwarped: f64,
    /// The smoothness term, weighted.
    pub smoothness: f64,
    /// The share of pixels that a warped neighbour explains best: what auto-masking leaves in.
    pub auto_mask: f64,
}

/// Normal numbers to break ties with, drawn once; every use starts at a random place among them.
pub struct TieBreak<T> {
    numbers: Vec<T>,
}

impl<T: Float> TieBreak<T> {
    /// Numbers of the given deviation.
    pub fn new(deviation: f64, random: &mut Random) -> Self {
        // A prime length, so that images of any size are cut from it at ever different places.
        TieBreak { numbers: (0..65_521).map(|_| T::of(deviation * random.normal())).collect() }
    }

    fn add(&self, x: &Tensor<T>, random: &mut Random) -> Tensor<T> {
        let first = random.below(self.numbers.len());
        let noise = self.numbers[first..].iter().chain(self.numbers.iter().cycle());
        Tensor::build(*x.shape(), |out| out.iter_mut().zip(x.data()).zip(noise).for_each(|((o, &x), &n)| *o = x + n))
    }
}

/// The photometric error `[B, H, W, 1]` of a prediction: `ssim (1 - SSIM) / 2 + (1 - ssim) |difference|`, means over
/// the channels.
pub fn photometric<T: Float>(prediction: &Var<T>, target: &Var<T>, config: &LossConfig) -> Var<T> {
    prediction.photometric(target, config.ssim)
}

/// The loss of disparities `[B, h, w, 1]` at (up to) four scales, and of transforms `[B, 3, 4]` that map points of the
/// target camera into each source's.
///
/// With `ties`, equal errors are told apart by noise; without, the first candidate wins.
#[track_caller]
pub fn loss<T: Float>(
    disparities: &[Var<T>],
    transforms: &[Var<T>],
    views: &Views<T>,
    config: &LossConfig,
    mut ties: Option<(&TieBreak<T>, &mut Random)>,
) -> Loss<T> {
    let target = &views.pyramid[0];
    let [_, height, width, _] = target.shape().nhwc().expect("an image");
    let still: Vec<Var<T>> = views.sources.iter().map(|s| photometric(s, target, config)).collect();
    let unwarped = mean_minimum(&still);

    let mut parts = Vec::new();
    let (mut sum_photometric, mut sum_warped, mut sum_smoothness, mut sum_mask) = (0.0, 0.0, 0.0, 0.0);
    for (scale, disparity) in disparities.iter().enumerate() {
        let full = match scale {
            0 => disparity.clone(),
            _ => disparity.resize_bilinear(height, width, false),
        };
        let depth = full.disparity_to_depth(config.min_depth, config.max_depth);
        let mut candidates: Vec<Var<T>> = views
            .sources
            .iter()
            .zip(transforms)
            .map(|(source, transform)| {
                let warped = source.warp(&depth, transform, &views.intrinsics, config.consistent_grid);
                photometric(&warped, target, config)
            })
            .collect();
        let warped = candidates.len();
        sum_warped += mean_minimum(&candidates);
        if config.auto_mask {
            candidates.extend(still.iter().map(|error| match &mut ties {
                Some((ties, random)) => {
                    Var::constant(trace::phase("noise against ties", || ties.add(error.value(), random)))
                }
                None => error.clone(),
            }));
        }
        let (error, winner) = Var::min_reprojection(&candidates.iter().collect::<Vec<_>>());
        let smoothness = disparity.smoothness(&views.pyramid[scale]);
        let weight = config.smoothness / (1u64 << scale) as f64;
        sum_photometric += error.value().item().f64();
        sum_smoothness += weight * smoothness.value().item().f64();
        let count = || winner.data().iter().filter(|w| w.f64() < warped as f64).count();
        let kept = trace::phase("pixels that auto-masking leaves", count);
        sum_mask += kept as f64 / winner.len().max(1) as f64;
        parts.push(error + smoothness.affine(weight, 0.0));
    }
    let scales = parts.len() as f64;
    let total = parts.into_iter().reduce(|a, b| a + b).expect("at least one scale").affine(1.0 / scales, 0.0);
    Loss {
        total,
        photometric: sum_photometric / scales,
        warped: sum_warped / scales,
        unwarped,
        smoothness: sum_smoothness / scales,
        auto_mask: sum_mask / scales,
    }
}

/// The mean of the per-pixel minimum of error maps, as a number (0 for no maps).
fn mean_minimum<T: Float>(errors: &[Var<T>]) -> f64 {
    let maps: Vec<Var<T>> = errors.iter().map(Var::detach).collect();
    if maps.is_empty() { 0.0 } else { Var::min_reprojection(&maps.iter().collect::<Vec<_>>()).0.value().item().f64() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_neighbour_like_the_target_needs_no_warp() {
        let image = Tensor::build([1, 32, 32, 3], |out| {
            out.iter_mut().enumerate().for_each(|(i, x)| *x = ((i * 7919) % 101) as f64 / 101.0)
        });
        let views = Views {
            pyramid: vec![image.clone().into()],
            sources: vec![image.clone().into(), image.into()],
            intrinsics: vec![[18.0, 60.0, 16.0, 16.0]],
        };
        let disparity = Var::constant(Tensor::full([1, 32, 32, 1], 0.3));
        let still = Var::pose_matrix(&Tensor::zeros([1, 3]).into(), &Tensor::zeros([1, 3]).into(), false);
        let config = LossConfig { consistent_grid: true, ..LossConfig::default() };
        let found = loss(&[disparity], &[still.clone(), still], &views, &config, None);
        assert!(found.unwarped.abs() < 1e-12 && found.warped < 1e-6, "{} {}", found.unwarped, found.warped);
        assert!(found.smoothness.abs() < 1e-12, "a constant disparity is smooth");
    }
}
