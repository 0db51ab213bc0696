//! One prediction against one ground truth, by the rules of a protocol: the pairs of depths that count.

use super::metrics::{ImageMetrics, Metrics};
use super::protocol::{Logarithm, Protocol, Resize};
use super::scale::{STEREO_SCALE, Scale};
use super::statistics::median;
use crate::depth::{DepthMap, resize_bilinear};
use crate::{Error, Result};

/// A pixel that counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    /// Row in the ground truth.
    pub row: usize,
    /// Column in the ground truth.
    pub column: usize,
    /// Its true depth in metres.
    pub truth: f64,
    /// Its predicted depth in metres, scaled and cut to the protocol's range.
    pub prediction: f64,
}

/// Pixels of an image that are compared.
#[derive(Clone, Debug, PartialEq)]
pub struct Comparison {
    /// Height and width of the ground truth.
    pub size: (usize, usize),
    /// The pixels that count, row by row.
    pub pairs: Vec<Pair>,
    /// The factor that was found for this image; `None` if it was given, or without a pixel.
    pub ratio: Option<f64>,
    /// Factor on predicted depths.
    pub factor: f64,
    /// The logarithm of RMSE log.
    pub logarithm: Logarithm,
}

impl Comparison {
    /// The metrics of the pixels that count.
    pub fn metrics(&self) -> ImageMetrics {
        let metrics = Metrics::of_pairs(self.pairs.iter().map(|p| (p.truth, p.prediction)), self.logarithm);
        ImageMetrics { pixels: self.pairs.len(), ratio: self.ratio, metrics }
    }
}

/// Compares a prediction with ground truth: `inverse_depth` holds `h * w` values in inverse depth units (row-major,
/// `size = (h, w)`, the network's), `ground_truth` metres at its own size.
///
/// # Errors
/// If the sizes are empty or do not fit, an inverse depth is not a positive finite number, the protocol is for ground truth
/// of another size, or the scale is the camera's height, for which a factor has to be found first.
pub fn compare_image(
    inverse_depth: &[f32],
    size: (usize, usize),
    ground_truth: &DepthMap,
    protocol: Protocol,
    scale: Scale,
) -> Result<Comparison> {
    let (height, width) = (ground_truth.height, ground_truth.width);
    check_map("prediction", inverse_depth.len(), size)?;
    check_map("ground truth", ground_truth.metres.len(), (height, width))?;
    if let Some(i) = inverse_depth.iter().position(|d| !(*d > 0.0 && d.is_finite())) {
        let (row, column, value) = (i / size.1, i % size.1, inverse_depth[i]);
        let message = format!("the prediction at row {row}, column {column} is {value}: not a positive inverse depth");
        return Err(Error::Failed(message));
    }
    let rules = protocol.rules();
    let windows = rules.windows(height, width)?;
    let [shown, across] = &windows.shown;
    let resized = match rules.resize {
        Resize::Bilinear => resize_bilinear(inverse_depth, size, (shown.len(), across.len())),
        Resize::Nearest => resize_nearest(inverse_depth, size, (shown.len(), across.len())),
    };
    let [rows, columns] = windows.counted;
    let mut pairs = Vec::new();
    for row in rows {
        for column in columns.clone() {
            let truth = f64::from(ground_truth.metres[row * width + column]);
            if rules.keeps(truth) {
                let inverse = resized[(row - shown.start) * across.len() + column - across.start];
                pairs.push(Pair { row, column, truth, prediction: 1.0 / inverse });
            }
        }
    }
    let (factor, ratio) = factor(&pairs, scale)?;
    let [nearest, farthest] = rules.clamp;
    for pair in &mut pairs {
        pair.prediction = (pair.prediction * factor).clamp(nearest, farthest);
    }
    Ok(Comparison { size: (height, width), pairs, ratio, factor, logarithm: rules.logarithm })
}

/// [`compare_image`], and the metrics of what counts.
///
/// # Errors
/// As [`compare_image`].
pub fn evaluate_image(
    inverse_depth: &[f32],
    size: (usize, usize),
    ground_truth: &DepthMap,
    protocol: Protocol,
    scale: Scale,
) -> Result<ImageMetrics> {
    Ok(compare_image(inverse_depth, size, ground_truth, protocol, scale)?.metrics())
}

/// The factor of predictions, and the same if it was found from these pairs.
fn factor(pairs: &[Pair], scale: Scale) -> Result<(f64, Option<f64>)> {
    match scale {
        Scale::Median => {
            let ratio = median(pairs.iter().map(|p| p.truth).collect())
                .zip(median(pairs.iter().map(|p| p.prediction).collect()))
                .map(|(truth, prediction)| truth / prediction);
            Ok((ratio.unwrap_or(1.0), ratio))
        }
        Scale::Stereo => Ok((STEREO_SCALE, None)),
        Scale::Factor(factor) => Ok((factor, None)),
        Scale::CameraHeight(_) => {
            let message = "the factor of the camera's height is found with its intrinsics, for each image beforehand";
            Err(Error::setting("scale", message))
        }
    }
}

/// Makes sure that a map has as many values as its size says.
pub(super) fn check_map(what: &str, values: usize, (height, width): (usize, usize)) -> Result<()> {
    if values == 0 || values != height * width {
        let message = format!("the {what} has {values} values, expected {height} rows of {width}");
        return Err(Error::Failed(message));
    }
    Ok(())
}

/// The value at `floor(i from / to)` along either axis, as OpenCV's nearest neighbour.
fn resize_nearest(map: &[f32], from: (usize, usize), to: (usize, usize)) -> Vec<f64> {
    let at = |i: usize, from: usize, to: usize| i * from / to;
    let row = |y: usize| &map[at(y, from.0, to.0) * from.1..][..from.1];
    (0..to.0).flat_map(|y| (0..to.1).map(move |x| f64::from(row(y)[at(x, from.1, to.1)]))).collect()
}

#[cfg(test)]
mod tests;
