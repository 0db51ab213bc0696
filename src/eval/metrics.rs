//! The seven depth metrics: of an image, and their means over a set of images.
//!
//! A prediction is a map of inverse depth at the size of the network. It is resized to the ground truth's size, turned
//! into depth, scaled (monocular depth has no scale of its own), cut to a range and compared where the protocol looks
//! ([`compare_image`](super::compare::compare_image)). Each image gives seven numbers; a report is their means over images.

use serde::{Deserialize, Serialize};

pub use super::compare::evaluate_image;
pub use super::flip::{flip_post_process, mirror};
pub use super::mean_map::MeanMap;
use super::protocol::Logarithm;
pub use super::protocol::{MAX_DEPTH, MIN_DEPTH, Protocol};
pub use super::scale::{STEREO_SCALE, Scale};
pub use super::statistics::median;
use super::statistics::standard_deviation;
use crate::{Error, Result};

/// The seven metrics, for ground truth g and prediction p in metres.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Metrics {
    /// mean |g - p| / g
    pub abs_rel: f64,
    /// mean (g - p)^2 / g
    pub sq_rel: f64,
    /// sqrt mean (g - p)^2
    pub rmse: f64,
    /// sqrt mean (ln g - ln p)^2; under [`Protocol::Make3d`] with log10.
    pub rmse_log: f64,
    /// The share of pixels with max(g/p, p/g) < 1.25.
    pub a1: f64,
    /// ... < 1.25^2.
    pub a2: f64,
    /// ... < 1.25^3.
    pub a3: f64,
}

impl Metrics {
    /// The metrics of pairs (g, p) of positive depths; `None` without a pair.
    pub fn of(pairs: &[(f64, f64)]) -> Option<Metrics> {
        Self::of_pairs(pairs.iter().copied(), Logarithm::Natural)
    }

    /// [`Metrics::of`] any pairs, RMSE log to a base.
    pub fn of_pairs(pairs: impl IntoIterator<Item = (f64, f64)>, logarithm: Logarithm) -> Option<Metrics> {
        let mut sums = Sums::default();
        pairs.into_iter().for_each(|(g, p)| sums.add(g, p));
        sums.metrics(logarithm)
    }

    /// abs_rel, sq_rel, rmse, rmse_log, a1, a2, a3.
    pub fn to_array(self) -> [f64; 7] {
        [self.abs_rel, self.sq_rel, self.rmse, self.rmse_log, self.a1, self.a2, self.a3]
    }

    /// The reverse of [`Metrics::to_array`].
    pub fn from_array([abs_rel, sq_rel, rmse, rmse_log, a1, a2, a3]: [f64; 7]) -> Metrics {
        Metrics { abs_rel, sq_rel, rmse, rmse_log, a1, a2, a3 }
    }

    /// The mean of each metric over images; `None` without one.
    pub fn mean(images: impl IntoIterator<Item = Metrics>) -> Option<Metrics> {
        let (mut sum, mut count) = ([0.0; 7], 0);
        for image in images {
            sum.iter_mut().zip(image.to_array()).for_each(|(s, m)| *s += m);
            count += 1;
        }
        (count > 0).then(|| Metrics::from_array(sum.map(|s| s / f64::from(count))))
    }
}

/// The sums that metrics are means of, over any number of pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sums {
    /// Before division and roots.
    sums: Metrics,
    pixels: usize,
}

impl Sums {
    /// Adds a pixel: its true and its predicted depth in metres, both positive.
    pub fn add(&mut self, g: f64, p: f64) {
        let (error, log_error) = (g - p, g.ln() - p.ln());
        let ratio = (g / p).max(p / g);
        let sum = &mut self.sums;
        sum.abs_rel += error.abs() / g;
        sum.sq_rel += error * error / g;
        sum.rmse += error * error;
        sum.rmse_log += log_error * log_error;
        sum.a1 += f64::from(u8::from(ratio < 1.25));
        sum.a2 += f64::from(u8::from(ratio < 1.25 * 1.25));
        sum.a3 += f64::from(u8::from(ratio < 1.25 * 1.25 * 1.25));
        self.pixels += 1;
    }

    /// How many pixels were added.
    pub fn pixels(&self) -> usize {
        self.pixels
    }

    /// The metrics of the pixels, each with the same weight; `None` without one.
    pub fn metrics(&self, logarithm: Logarithm) -> Option<Metrics> {
        if self.pixels == 0 {
            return None;
        }
        let mean = Metrics::from_array(self.sums.to_array().map(|s| s / self.pixels as f64));
        let base = match logarithm {
            Logarithm::Natural => 1.0,
            Logarithm::Ten => std::f64::consts::LN_10,
        };
        Some(Metrics { rmse: mean.rmse.sqrt(), rmse_log: mean.rmse_log.sqrt() / base, ..mean })
    }
}

/// Evaluation of one image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageMetrics {
    /// Number of pixels evaluated.
    pub pixels: usize,
    /// The factor that was found for this image; `None` if it was given, or without a pixel.
    pub ratio: Option<f64>,
    /// The metrics; `None` if not a single pixel counted.
    pub metrics: Option<Metrics>,
}

/// Evaluation of one image of a [`Report`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PerImage {
    /// Drive and frame.
    pub name: String,
    /// Number of pixels evaluated.
    pub pixels: usize,
    /// The factor that was found for this image.
    pub ratio: Option<f64>,
    /// The seven metrics.
    #[serde(flatten)]
    pub metrics: Metrics,
}

/// Evaluation of a set of images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// Number of images that the means are over.
    pub images: usize,
    /// The means over images.
    #[serde(flatten)]
    pub metrics: Metrics,
    /// The median of the scaling factors; `None` (null) if they were given.
    pub ratio_median: Option<f64>,
    /// The standard deviation of the factors over their median: how far the scale wanders from image to image.
    pub ratio_std: Option<f64>,
    /// Each image.
    pub per_image: Vec<PerImage>,
    /// The images whose ground truth has not a single pixel that counts: they are in none of the numbers.
    pub without_pixels: Vec<String>,
    /// The images that have no ground truth at all: they are in none of the numbers either.
    pub without_depth: Vec<String>,
    /// The images that got no scale, because no road was found to measure the camera's height over: likewise.
    #[serde(default)]
    pub without_scale: Vec<String>,
}

impl Report {
    /// Gathers named images.
    ///
    /// # Errors
    /// If no image has a pixel that counts.
    pub fn new(images: impl IntoIterator<Item = (String, ImageMetrics)>) -> Result<Report> {
        let (mut per_image, mut without_pixels) = (Vec::new(), Vec::new());
        for (name, ImageMetrics { pixels, ratio, metrics }) in images {
            match metrics {
                Some(metrics) => per_image.push(PerImage { name, pixels, ratio, metrics }),
                None => without_pixels.push(name),
            }
        }
        let Some(metrics) = Metrics::mean(per_image.iter().map(|image| image.metrics)) else {
            let message = match without_pixels.len() {
                0 => "nothing to evaluate: no image has ground-truth depth".to_owned(),
                n => {
                    format!("nothing to evaluate: of {n} images none has ground-truth depth that this protocol counts")
                }
            };
            return Err(Error::Failed(message));
        };
        let ratios: Vec<f64> = per_image.iter().filter_map(|image| image.ratio).collect();
        let ratio_median = median(ratios.clone());
        let ratio_std = ratio_median.map(|m| standard_deviation(ratios.iter().map(|r| r / m)));
        Ok(Report {
            images: per_image.len(),
            metrics,
            ratio_median,
            ratio_std,
            per_image,
            without_pixels,
            without_depth: Vec::new(),
            without_scale: Vec::new(),
        })
    }
}

#[cfg(test)]
mod tests;
