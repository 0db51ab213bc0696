//! The seven depth metrics, under the protocols of the literature.
//!
//! A prediction is a map of inverse depth at the size of the network. It is resized to the ground truth's size, turned
//! into depth, scaled (monocular depth has no scale of its own), cut to [0.001, 80] m and compared where the protocol
//! looks. Each image gives seven numbers; a report is their means over images.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::data::DataSource;
use crate::depth::{DepthMap, resize_bilinear};
use crate::{Error, Result};

/// Least depth that is evaluated, in metres; predictions are clamped to the same range.
pub const MIN_DEPTH: f64 = 1e-3;
/// Greatest depth that is evaluated, in metres.
pub const MAX_DEPTH: f64 = 80.0;
/// The scale of a network trained on stereo pairs whose baseline was called 0.1: KITTI's is 0.54 m.
pub const STEREO_SCALE: f64 = 5.4;

/// Evaluation protocol: which pixels are evaluated, against which ground truth.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Protocol {
    /// 0.001 < depth < 80 m, the whole image: for ground truth without holes.
    Dense,
    /// 0.001 < depth < 80 m within Garg's crop; the ground truth is the LiDAR's x, as in the Eigen tables.
    Eigen,
    /// The same pixels; the ground truth is camera z.
    EigenCameraZ,
    /// Every pixel of the improved ground truth.
    Improved,
}

impl Protocol {
    /// Rows and columns that count in an image of `height x width`, end exclusive.
    fn window(self, height: usize, width: usize) -> [std::ops::Range<usize>; 2] {
        let part = |size: usize, from: f64, to: f64| (from * size as f64) as usize..(to * size as f64) as usize;
        match self {
            Protocol::Dense | Protocol::Improved => [0..height, 0..width],
            Protocol::Eigen | Protocol::EigenCameraZ => {
                [part(height, 0.40810811, 0.99189189), part(width, 0.03594771, 0.96405229)]
            }
        }
    }

    fn keeps(self, metres: f64) -> bool {
        match self {
            Protocol::Improved => metres > 0.0 && metres.is_finite(),
            _ => metres > MIN_DEPTH && metres < MAX_DEPTH,
        }
    }
}

impl fmt::Display for Protocol {
    /// The name that it is chosen by.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Protocol::Dense => "dense",
            Protocol::Eigen => "eigen",
            Protocol::EigenCameraZ => "eigen-camera-z",
            Protocol::Improved => "improved",
        })
    }
}

impl FromStr for Protocol {
    type Err = Error;

    fn from_str(name: &str) -> Result<Protocol> {
        match name {
            "dense" => Ok(Protocol::Dense),
            "eigen" => Ok(Protocol::Eigen),
            "eigen-camera-z" => Ok(Protocol::EigenCameraZ),
            "improved" => Ok(Protocol::Improved),
            _ => {
                let message = format!("expected dense, eigen, eigen-camera-z or improved, found {name:?}");
                Err(Error::setting("protocol", message))
            }
        }
    }
}

/// Scaling of predictions before they are evaluated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Scale {
    /// Times median(ground truth) / median(prediction), for every image on its own, over the pixels that count.
    Median,
    /// Times [`STEREO_SCALE`].
    Stereo,
    /// Times this factor.
    Factor(f64),
}

impl fmt::Display for Scale {
    /// As it is chosen.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Scale::Median => f.write_str("median"),
            Scale::Stereo => f.write_str("stereo"),
            Scale::Factor(factor) => write!(f, "{factor}"),
        }
    }
}

impl FromStr for Scale {
    type Err = Error;

    fn from_str(name: &str) -> Result<Scale> {
        match (name, name.parse::<f64>()) {
            ("median", _) => Ok(Scale::Median),
            ("stereo", _) => Ok(Scale::Stereo),
            (_, Ok(factor)) if factor > 0.0 && factor.is_finite() => Ok(Scale::Factor(factor)),
            _ => {
                let message = format!("expected median, stereo or a number above 0, found {name:?}");
                Err(Error::setting("scale", message))
            }
        }
    }
}

/// The seven metrics, for ground truth g and prediction p in metres.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Metrics {
    /// mean |g - p| / g
    pub abs_rel: f64,
    /// mean (g - p)^2 / g
    pub sq_rel: f64,
    /// sqrt mean (g - p)^2
    pub rmse: f64,
    /// sqrt mean (ln g - ln p)^2
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
        let mut sum = Metrics::default();
        for &(g, p) in pairs {
            let (error, log_error) = (g - p, g.ln() - p.ln());
            let ratio = (g / p).max(p / g);
            sum.abs_rel += error.abs() / g;
            sum.sq_rel += error * error / g;
            sum.rmse += error * error;
            sum.rmse_log += log_error * log_error;
            sum.a1 += f64::from(u8::from(ratio < 1.25));
            sum.a2 += f64::from(u8::from(ratio < 1.25 * 1.25));
            sum.a3 += f64::from(u8::from(ratio < 1.25 * 1.25 * 1.25));
        }
        if pairs.is_empty() {
            return None;
        }
        let mean = Metrics::from_array(sum.to_array().map(|s| s / pairs.len() as f64));
        Some(Metrics { rmse: mean.rmse.sqrt(), rmse_log: mean.rmse_log.sqrt(), ..mean })
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

/// Evaluation of one image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageMetrics {
    /// Number of pixels evaluated.
    pub pixels: usize,
    /// The factor of the median scaling; `None` under another scaling, or without a pixel.
    pub ratio: Option<f64>,
    /// The metrics; `None` if not a single pixel counted.
    pub metrics: Option<Metrics>,
}

/// Compares a prediction with ground truth: `inverse_depth` holds `h * w` values in inverse depth units (row-major,
/// `size = (h, w)`, the network's), `ground_truth` metres at its own size.
///
/// # Errors
/// If the sizes are empty or do not fit, or an inverse depth is not a positive finite number.
pub fn evaluate_image(
    inverse_depth: &[f32],
    size: (usize, usize),
    ground_truth: &DepthMap,
    protocol: Protocol,
    scale: Scale,
) -> Result<ImageMetrics> {
    let (height, width) = (ground_truth.height, ground_truth.width);
    check_map("prediction", inverse_depth.len(), size)?;
    check_map("ground truth", ground_truth.metres.len(), (height, width))?;
    if let Some(i) = inverse_depth.iter().position(|d| !(*d > 0.0 && d.is_finite())) {
        let (row, column, value) = (i / size.1, i % size.1, inverse_depth[i]);
        let message = format!("the prediction at row {row}, column {column} is {value}: not a positive inverse depth");
        return Err(Error::Failed(message));
    }
    let resized = resize_bilinear(inverse_depth, size, (height, width));
    let [rows, columns] = protocol.window(height, width);
    let mut pairs = Vec::new();
    for row in rows {
        for i in columns.clone().map(|column| row * width + column) {
            let metres = f64::from(ground_truth.metres[i]);
            if protocol.keeps(metres) {
                pairs.push((metres, 1.0 / resized[i]));
            }
        }
    }
    let ratio = match scale {
        Scale::Median => median(pairs.iter().map(|p| p.0).collect())
            .zip(median(pairs.iter().map(|p| p.1).collect()))
            .map(|(truth, prediction)| truth / prediction),
        Scale::Stereo | Scale::Factor(_) => None,
    };
    let factor = match scale {
        Scale::Median => ratio.unwrap_or(1.0),
        Scale::Stereo => STEREO_SCALE,
        Scale::Factor(factor) => factor,
    };
    for pair in &mut pairs {
        pair.1 = (pair.1 * factor).clamp(MIN_DEPTH, MAX_DEPTH);
    }
    Ok(ImageMetrics { pixels: pairs.len(), ratio, metrics: Metrics::of(&pairs) })
}

fn check_map(what: &str, values: usize, (height, width): (usize, usize)) -> Result<()> {
    if values == 0 || values != height * width {
        let message = format!("the {what} has {values} values, expected {height} rows of {width}");
        return Err(Error::Failed(message));
    }
    Ok(())
}

/// The median; of an even number of values the mean of the middle two. `None` of none.
pub fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    if values.is_empty() {
        return None;
    }
    let (below, &mut upper, _) = values.select_nth_unstable_by(middle, f64::total_cmp);
    // The lower of the middle two is the largest of what lies below.
    let lower = below.iter().copied().max_by(f64::total_cmp).filter(|_| middle * 2 == values.len());
    Some(lower.map_or(upper, |lower| (lower + upper) / 2.0))
}

/// Flip post-processing: joins the prediction `left` of an image with `right`, the prediction of the mirrored image
/// mirrored back; rows of `width` values. Either is trusted least at the border where its own disocclusions lie: at
/// the left border the result is `right`, at the right border `left`, within 5 % it fades, and in between it is their
/// mean.
///
/// # Panics
/// If the maps differ in length or are not rows of `width`.
pub fn flip_post_process(left: &[f32], right: &[f32], width: usize) -> Vec<f32> {
    assert_eq!(left.len(), right.len(), "flip_post_process: two maps of one size expected");
    assert!(width > 0 && left.len().is_multiple_of(width), "flip_post_process: rows of {width} expected");
    // 1 at the left border, 0 from a tenth of the width on.
    let ramp = |i: usize| {
        let x = i as f64 / (width - 1).max(1) as f64;
        1.0 - (20.0 * (x - 0.05)).clamp(0.0, 1.0)
    };
    let ramps: Vec<(f64, f64)> = (0..width).map(|i| (ramp(i), ramp(width - 1 - i))).collect();
    let pairs = left.iter().zip(right).zip(ramps.iter().cycle());
    pairs
        .map(|((&l, &r), &(at_left, at_right))| {
            let (l, r) = (f64::from(l), f64::from(r));
            (at_right * l + at_left * r + (1.0 - at_left - at_right) * (l + r) / 2.0) as f32
        })
        .collect()
}

/// A map mirrored left to right, rows of `width` values.
///
/// # Panics
/// If the map is not rows of `width`.
pub fn mirror(map: &[f32], width: usize) -> Vec<f32> {
    assert!(width > 0 && map.len().is_multiple_of(width), "mirror: rows of {width} expected");
    map.chunks_exact(width).flat_map(|row| row.iter().rev().copied()).collect()
}

/// Evaluation of one image of a [`Report`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PerImage {
    /// Drive and frame.
    pub name: String,
    /// Number of pixels evaluated.
    pub pixels: usize,
    /// The factor of the median scaling.
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
    /// The median of the scaling factors; `None` (null) unless scaled by medians.
    pub ratio_median: Option<f64>,
    /// The standard deviation of the factors over their median: how far the scale wanders from image to image.
    pub ratio_std: Option<f64>,
    /// Each image.
    pub per_image: Vec<PerImage>,
    /// The images whose ground truth has not a single pixel that counts: they are in none of the numbers.
    pub without_pixels: Vec<String>,
    /// The images that have no ground truth at all: they are in none of the numbers either.
    pub without_depth: Vec<String>,
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
        })
    }
}

/// Of the whole population (divided by n).
fn standard_deviation(values: impl ExactSizeIterator<Item = f64> + Clone) -> f64 {
    let n = values.len() as f64;
    let mean = values.clone().sum::<f64>() / n;
    (values.map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt()
}

/// Baseline predictor: the mean of the inverse depth maps of the training frames, whatever the picture.
#[derive(Clone, Debug, PartialEq)]
pub struct MeanMap {
    /// Rows and columns: the first ground truth's.
    pub size: (usize, usize),
    /// Row-major inverse depths (1/m) within the range of the networks, [0.01, 10].
    pub inverse_depth: Vec<f32>,
}

/// The range of the networks' inverse depth: depth from 0.1 to 100.
const FARTHEST: f64 = 0.01;
const NEAREST: f64 = 10.0;

impl MeanMap {
    /// The mean over ground-truth maps of 1/depth where depth is known and 0.01 (100 m) elsewhere. Maps of another
    /// size than the first one's are resized to it.
    ///
    /// # Errors
    /// If there is no map, a map is empty, or reading one failed.
    pub fn of(maps: impl IntoIterator<Item = Result<DepthMap>>) -> Result<MeanMap> {
        let (mut size, mut sum, mut count) = ((0, 0), Vec::new(), 0u32);
        for map in maps {
            let map = map?;
            let own = (map.height, map.width);
            check_map("ground truth", map.metres.len(), own)?;
            let known = |metres: f32| metres > 0.0 && metres.is_finite();
            let inverse = |&m: &f32| {
                if known(m) { 1.0 / m.max(MIN_DEPTH as f32) } else { FARTHEST as f32 }
            };
            let inverse: Vec<f32> = map.metres.iter().map(inverse).collect();
            if count == 0 {
                size = own;
                sum = vec![0.0; inverse.len()];
            }
            let at_size = resize_bilinear(&inverse, own, size);
            sum.iter_mut().zip(at_size).for_each(|(s, v): (&mut f64, f64)| *s += v);
            count += 1;
        }
        if count == 0 {
            return Err(Error::Failed("no mean depth map: no frame has ground-truth depth".to_owned()));
        }
        let mean = |s: &f64| (s / f64::from(count)).clamp(FARTHEST, NEAREST) as f32;
        Ok(MeanMap { size, inverse_depth: sum.iter().map(mean).collect() })
    }

    /// [`MeanMap::of`] the target frames of a data set (the one that a network is trained on).
    pub fn of_dataset(data: &dyn DataSource) -> Result<MeanMap> {
        MeanMap::of((0..data.len()).filter_map(|sample| data.depth(sample).transpose()))
    }
}

#[cfg(test)]
mod tests;
