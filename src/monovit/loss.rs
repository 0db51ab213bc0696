//! The self-supervised loss (MonoViT, section 3.4; Monodepth2, section 3): how well the neighbours, warped into the
//! target by the predicted depth and motion, look like it.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::supervision::depth_error;
use crate::error::{Error, Result};
use crate::random::Random;
use crate::tensor::{Float, Tensor, Var, profile};

/// How a pixel's photometric errors over its source frames are combined.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
pub enum Reprojection {
    /// The smallest: a source that does not see the pixel is left out (Monodepth2, section 3.2).
    #[default]
    Minimum,
    /// Their mean, as before Monodepth2. Auto-masking then takes the smaller of two means: of the warped sources, and
    /// of the unwarped ones.
    Average,
}

/// Resolution at which the loss of the smaller disparities is computed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
pub enum Scales {
    /// All are resized to full size (Monodepth2, section 3.3).
    #[default]
    Full,
    /// Each at its own, with target, sources and camera of that size, as in Monodepth.
    Own,
}

/// The settings of the loss.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LossConfig {
    /// Least depth, that of disparity 1.
    pub min_depth: f64,
    /// Greatest depth, that of disparity 0.
    pub max_depth: f64,
    /// Weight of SSIM in the photometric error, in [0, 1]; the rest is the absolute difference. With 0 SSIM is not
    /// computed.
    pub ssim: f64,
    /// How a pixel's errors over its source frames are combined.
    pub reprojection: Reprojection,
    /// Resolution at which the loss of the smaller disparities is computed.
    pub scales: Scales,
    /// The weight of the smoothness term at full size; halved with every scale.
    pub smoothness: f64,
    /// Auto-masking: whether pixels that an unwarped neighbour explains better are left out.
    pub auto_mask: bool,
    /// Standard deviation of the noise that decides between equal errors.
    pub tie_break: f64,
    /// Weight of [`depth_error`]: supervision by known depth, where the data know it (the
    /// street), with which predicted depth is in metres; 0, as published: none.
    pub depth_supervision: f64,
    /// Whether the sampling grid is made for the convention it is sampled with (pixel centres), instead of the
    /// published combination (made for aligned corners, sampled without).
    pub consistent_grid: bool,
}

impl Default for LossConfig {
    fn default() -> Self {
        LossConfig {
            min_depth: 0.1,
            max_depth: 100.0,
            ssim: 0.85,
            reprojection: Reprojection::Minimum,
            scales: Scales::Full,
            smoothness: 1e-3,
            auto_mask: true,
            tie_break: 1e-5,
            depth_supervision: 0.0,
            consistent_grid: false,
        }
    }
}

impl LossConfig {
    /// Checks that a loss can be computed.
    ///
    /// # Errors
    /// Names the field that cannot be used: depths that are no range, a share outside [0, 1], a negative weight.
    pub fn check(&self) -> Result<()> {
        let refuse = |field: &str, message: String| Err(Error::setting(format!("loss.{field}"), message));
        check_depths("loss.min_depth", self.min_depth, self.max_depth)?;
        if !(0.0..=1.0).contains(&self.ssim) {
            return refuse("ssim", format!("{} is not a share from 0 to 1", self.ssim));
        }
        let weights = [
            ("smoothness", self.smoothness),
            ("tie_break", self.tie_break),
            ("depth_supervision", self.depth_supervision),
        ];
        for (field, weight) in weights {
            if !(weight >= 0.0 && weight.is_finite()) {
                return refuse(field, format!("{weight} is not a number from 0"));
            }
        }
        Ok(())
    }
}

/// Images that the loss compares: the plain ones, not the jittered ones that the networks see.
pub struct Views<T: Float> {
    /// The target at 1, 1/2, 1/4, 1/8 of its size, `[B, h, w, 3]`.
    pub pyramid: Vec<Var<T>>,
    /// The neighbours, `[B, H, W, 3]`.
    pub sources: Vec<Var<T>>,
    /// The neighbours at 1/2, 1/4, 1/8 of their size, needed for [`Scales::Own`] alone: for each scale all sources.
    pub smaller_sources: Vec<Vec<Var<T>>>,
    /// fx, fy, cx, cy of each sample, in pixels.
    pub intrinsics: Vec<[f64; 4]>,
    /// The target's depth `[B, H, W, 1]` in metres (0: unknown, infinite: the sky), for
    /// [`depth_supervision`](LossConfig::depth_supervision).
    pub depth: Option<Tensor<T>>,
}

impl<T: Float> Views<T> {
    /// These targets with some of the sources.
    ///
    /// # Panics
    /// If there are not so many.
    pub fn of_sources(&self, which: Range<usize>) -> Self {
        Views {
            pyramid: self.pyramid.clone(),
            sources: self.sources[which.clone()].to_vec(),
            smaller_sources: self.smaller_sources.iter().map(|sources| sources[which.clone()].to_vec()).collect(),
            intrinsics: self.intrinsics.clone(),
            depth: self.depth.clone(),
        }
    }
}

/// The loss and what it is made of (means over the scales).
pub struct Loss<T: Float> {
    /// The total loss, a scalar: what training minimises.
    pub total: Var<T>,
    /// The mean of the per-pixel minimum of photometric errors.
    pub photometric: f64,
    /// The same over warped neighbours alone.
    pub warped: f64,
    /// The same over unwarped neighbours alone: what standing still would give.
    pub unwarped: f64,
    /// The smoothness term, weighted.
    pub smoothness: f64,
    /// Share of pixels that auto-masking leaves in: those that a warped neighbour explains best.
    pub auto_mask: f64,
    /// The distance to known depth ([`depth_error`]), not weighted; 0 where none is asked
    /// for.
    pub depth_error: f64,
}

impl<T: Float> Loss<T> {
    /// The mean of two losses of the same disparities, and of all they are made of.
    pub fn and(self, other: Self) -> Self {
        let mean = |of: fn(&Self) -> f64| 0.5 * (of(&self) + of(&other));
        Loss {
            photometric: mean(|loss| loss.photometric),
            warped: mean(|loss| loss.warped),
            unwarped: mean(|loss| loss.unwarped),
            smoothness: mean(|loss| loss.smoothness),
            auto_mask: mean(|loss| loss.auto_mask),
            depth_error: mean(|loss| loss.depth_error),
            total: (&self.total + &other.total).affine(0.5, 0.0),
        }
    }
}

/// Gaussian noise that breaks ties, drawn once; every use starts at a random place in it.
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
///
/// # Panics
/// If [`Scales::Own`] is asked for without the smaller sources.
#[track_caller]
pub fn loss<T: Float>(
    disparities: &[Var<T>],
    transforms: &[Var<T>],
    views: &Views<T>,
    config: &LossConfig,
    mut ties: Option<(&TieBreak<T>, &mut Random)>,
) -> Loss<T> {
    let [_, height, width, _] = views.pyramid[0].shape().nhwc().expect("an image");
    let still = |sources: &[Var<T>], target: &Var<T>| -> Vec<Var<T>> {
        let errors = sources.iter().map(|s| photometric(s, target, config)).collect();
        config.reprojection.candidates(errors)
    };
    let unwarped = still(&views.sources, &views.pyramid[0]);

    let mut parts = Vec::new();
    let (mut sum_photometric, mut sum_warped, mut sum_smoothness, mut sum_mask) = (0.0, 0.0, 0.0, 0.0);
    let mut sum_depth = 0.0;
    for (scale, disparity) in disparities.iter().enumerate() {
        let own = scale > 0 && config.scales == Scales::Own;
        let (target, sources) = match own {
            true => (&views.pyramid[scale], views.smaller_sources.get(scale - 1).expect("sources of every scale")),
            false => (&views.pyramid[0], &views.sources),
        };
        let size = if own { 0.5f64.powi(scale as i32) } else { 1.0 };
        let intrinsics: Vec<_> = views.intrinsics.iter().map(|k| k.map(|pixels| size * pixels)).collect();
        let sized = match own || scale == 0 {
            true => disparity.clone(),
            false => disparity.resize_bilinear(height, width, false),
        };
        let depth = sized.disparity_to_depth(config.min_depth, config.max_depth);
        let errors = sources.iter().zip(transforms).map(|(source, transform)| {
            let warped = source.warp(&depth, transform, &intrinsics, config.consistent_grid);
            photometric(&warped, target, config)
        });
        let mut candidates = config.reprojection.candidates(errors.collect());
        let warped = candidates.len();
        sum_warped += mean_minimum(&candidates);
        if config.auto_mask {
            let unwarped = if own { still(sources, target) } else { unwarped.clone() };
            candidates.extend(unwarped.into_iter().map(|error| match &mut ties {
                Some((ties, random)) => {
                    Var::constant(profile::phase("noise against ties", || ties.add(error.value(), random)))
                }
                None => error,
            }));
        }
        let (error, winner) = Var::min_reprojection(&candidates.iter().collect::<Vec<_>>());
        let smoothness = disparity.smoothness(&views.pyramid[scale]);
        let weight = config.smoothness / (1u64 << scale) as f64;
        sum_photometric += error.value().item().f64();
        sum_smoothness += weight * smoothness.value().item().f64();
        let count = || winner.data().iter().filter(|w| w.f64() < warped as f64).count();
        let kept = profile::phase("pixels that auto-masking leaves", count);
        sum_mask += kept as f64 / winner.len().max(1) as f64;
        let mut part = error + smoothness.affine(weight, 0.0);
        if let Some(known) = views.depth.as_ref().filter(|_| config.depth_supervision > 0.0 && !own) {
            let error = depth_error(&depth, known, [config.min_depth, config.max_depth]);
            sum_depth += error.value().item().f64();
            part = part + error.affine(config.depth_supervision, 0.0);
        }
        parts.push(part);
    }
    let scales = parts.len() as f64;
    let total = parts.into_iter().reduce(|a, b| a + b).expect("at least one scale").affine(1.0 / scales, 0.0);
    Loss {
        total,
        photometric: sum_photometric / scales,
        warped: sum_warped / scales,
        unwarped: mean_minimum(&unwarped),
        smoothness: sum_smoothness / scales,
        auto_mask: sum_mask / scales,
        depth_error: sum_depth / scales,
    }
}

impl Reprojection {
    /// What of the error maps of a group of sources stands for election in each pixel.
    fn candidates<T: Float>(self, errors: Vec<Var<T>>) -> Vec<Var<T>> {
        let share = 1.0 / errors.len().max(1) as f64;
        match self {
            Reprojection::Minimum => errors,
            Reprojection::Average => {
                errors.into_iter().reduce(|a, b| a + b).map(|sum| sum.affine(share, 0.0)).into_iter().collect()
            }
        }
    }
}

/// The mean of the per-pixel minimum of error maps, as a number (0 for no maps).
fn mean_minimum<T: Float>(errors: &[Var<T>]) -> f64 {
    let maps: Vec<Var<T>> = errors.iter().map(Var::detach).collect();
    if maps.is_empty() { 0.0 } else { Var::min_reprojection(&maps.iter().collect::<Vec<_>>()).0.value().item().f64() }
}

/// Checks a range of depths.
///
/// # Errors
/// If it is empty, or reaches 0 or infinity.
pub(crate) fn check_depths(field: &str, min: f64, max: f64) -> Result<()> {
    if min > 0.0 && min < max && max.is_finite() {
        return Ok(());
    }
    Err(Error::setting(field, format!("{min} to {max} is no range of depths above 0")))
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
            smaller_sources: vec![],
            intrinsics: vec![[18.0, 60.0, 16.0, 16.0]],
            depth: None,
        };
        let disparity = Var::constant(Tensor::full([1, 32, 32, 1], 0.3));
        let still = Var::pose_matrix(&Tensor::zeros([1, 3]).into(), &Tensor::zeros([1, 3]).into(), false);
        let config = LossConfig { consistent_grid: true, ..LossConfig::default() };
        let found = loss(&[disparity], &[still.clone(), still], &views, &config, None);
        assert!(found.unwarped.abs() < 1e-12 && found.warped < 1e-6, "{} {}", found.unwarped, found.warped);
        assert!(found.smoothness.abs() < 1e-12, "a constant disparity is smooth");
    }

    fn image(size: [usize; 4], seed: u64) -> Var<f64> {
        let mut random = Random::new(seed, 0);
        Var::constant(Tensor::build(size, |out| out.iter_mut().for_each(|x| *x = random.unit())))
    }

    /// Two scales of noise, two sources that have moved.
    fn noise() -> (Vec<Var<f64>>, Vec<Var<f64>>, Views<f64>) {
        let (full, half) = ([2, 16, 24, 3], [2, 8, 12, 3]);
        let views = Views {
            pyramid: vec![image(full, 1), image(half, 2)],
            sources: vec![image(full, 3), image(full, 4)],
            smaller_sources: vec![vec![image(half, 5), image(half, 6)]],
            intrinsics: vec![[14.0, 18.0, 12.0, 8.0], [15.0, 17.0, 11.0, 8.5]],
            depth: None,
        };
        let disparities = vec![image([2, 16, 24, 1], 7), image([2, 8, 12, 1], 8)];
        let pose = |x: f64| {
            let numbers = |x: f64| Var::constant(Tensor::from_vec([2, 3], [x, -x, 0.5 * x].repeat(2)));
            Var::pose_matrix(&numbers(0.1 * x), &numbers(x), false)
        };
        (disparities, vec![pose(0.1), pose(-0.07)], views)
    }

    #[test]
    fn the_average_is_that_of_the_losses_of_single_sources() {
        let (disparities, transforms, views) = noise();
        let config = LossConfig { auto_mask: false, smoothness: 0.0, ..LossConfig::default() };
        let average = LossConfig { reprojection: Reprojection::Average, ..config };
        let of = |which: usize| {
            let views = Views {
                pyramid: views.pyramid.clone(),
                sources: vec![views.sources[which].clone()],
                smaller_sources: vec![],
                intrinsics: views.intrinsics.clone(),
                depth: None,
            };
            loss(&disparities, &transforms[which..=which], &views, &config, None).photometric
        };
        let found = loss(&disparities, &transforms, &views, &average, None);
        let expected = 0.5 * (of(0) + of(1));
        assert!((found.photometric - expected).abs() < 1e-12, "{} for {expected}", found.photometric);
        assert!((found.warped - expected).abs() < 1e-12 && found.auto_mask == 1.0);
        // The smaller of two means, pixel by pixel, is at most the mean of either.
        let masked = loss(&disparities, &transforms, &views, &LossConfig { auto_mask: true, ..average }, None);
        assert!(masked.photometric < masked.warped.min(masked.unwarped), "{}", masked.photometric);
        assert!(loss(&disparities, &transforms, &views, &config, None).photometric < expected, "the minimum is less");
    }

    #[test]
    fn a_scale_at_its_own_size_is_a_full_size_of_smaller_images() {
        let (disparities, transforms, views) = noise();
        let own = LossConfig { scales: Scales::Own, smoothness: 0.0, ..LossConfig::default() };
        let smaller = Views {
            pyramid: views.pyramid[1..].to_vec(),
            sources: views.smaller_sources[0].clone(),
            smaller_sources: vec![],
            intrinsics: views.intrinsics.iter().map(|k| k.map(|pixels| 0.5 * pixels)).collect(),
            depth: None,
        };
        let first = loss(&disparities[..1], &transforms, &views, &own, None).photometric;
        let second = loss(&disparities[1..], &transforms, &smaller, &own, None).photometric;
        let found = loss(&disparities, &transforms, &views, &own, None).photometric;
        assert!((found - 0.5 * (first + second)).abs() < 1e-12, "{found} for {first} and {second}");
        let full = loss(&disparities, &transforms, &views, &LossConfig { scales: Scales::Full, ..own }, None);
        assert!((found - full.photometric).abs() > 1e-6, "not the same as at full size");
    }

    #[test]
    fn two_losses_join_into_their_mean() {
        let (disparities, transforms, views) = noise();
        let config = LossConfig::default();
        let of = |which: Range<usize>| {
            loss(&disparities, &transforms[which.clone()], &views.of_sources(which), &config, None)
        };
        let (first, second, both) = (of(0..1), of(1..2), of(0..1).and(of(1..2)));
        let value = |loss: &Loss<f64>| loss.total.value().item();
        assert!((value(&both) - 0.5 * (value(&first) + value(&second))).abs() < 1e-15);
        assert!((both.photometric - 0.5 * (first.photometric + second.photometric)).abs() < 1e-15);
        assert!((both.auto_mask - 0.5 * (first.auto_mask + second.auto_mask)).abs() < 1e-15);
        let together = loss(&disparities, &transforms, &views, &config, None);
        assert!(together.photometric < both.photometric, "the least over both is less");
    }

    #[test]
    fn settings_that_cannot_be_are_named() {
        let refused = |config: LossConfig| config.check().unwrap_err().to_string();
        let usual = LossConfig::default();
        usual.check().unwrap();
        assert!(refused(LossConfig { ssim: 1.5, ..usual }).contains("loss.ssim: 1.5"));
        assert!(refused(LossConfig { ssim: f64::NAN, ..usual }).contains("loss.ssim"));
        assert!(refused(LossConfig { min_depth: 0.0, ..usual }).contains("loss.min_depth"));
        assert!(refused(LossConfig { min_depth: 200.0, ..usual }).contains("200 to 100"));
        assert!(refused(LossConfig { smoothness: -1.0, ..usual }).contains("loss.smoothness"));
    }
}
