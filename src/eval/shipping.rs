//! Measurements of weights that are about to be shipped: how their depths become metres, and what rounding changes.

use super::evaluate::{Evaluation, evaluate};
use super::metrics::{Metrics, Protocol, Report, Scale, median};
use super::predictor::Predictor;
use super::scale::KITTI_CAMERA_HEIGHT;
use crate::camera::Intrinsics;
use crate::data::DataSource;
use crate::error::{Error, Result};
use crate::street::{Street, StreetConfig};
use crate::weights::Metres;

/// The seed of the streets that are measured on. No run trains, validates or reports on them by itself.
const SEED: u64 = 6_000_000;

/// The widths of view, in degrees, and the aspects (width over height) of the pictures that the lens' influence is
/// measured with: phones and dashboard cameras lie between them.
const VIEWS: [f64; 3] = [60.0, 81.5, 100.0];
const ASPECTS: [f64; 3] = [10.0 / 3.0, 16.0 / 9.0, 4.0 / 3.0];

/// The height of the street's camera over the road, in metres.
pub const STREET_CAMERA_HEIGHT: f64 = KITTI_CAMERA_HEIGHT;

/// A network measured on rendered streets.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// How its depths become metres.
    pub metres: Metres,
    /// How far the factor wanders from picture to picture of the street's own camera: standard deviation over median.
    pub wandering: f64,
    /// How far the formula is from the factor measured with another camera: the largest ratio of the two, less 1.
    pub formula_off: f64,
    /// The metrics with the street's own camera, each picture scaled by its median.
    pub metrics: Metrics,
    /// The pictures of each camera.
    pub images: usize,
}

/// The streets that are measured on, as the network sees the pictures of this camera.
pub fn streets(predictor: &Predictor, camera: Intrinsics, sequences: usize) -> Street {
    let setup = predictor.setup();
    let config = StreetConfig {
        height: setup.height,
        width: setup.width,
        sequences,
        frames: 5,
        seed: SEED,
        intrinsics: camera,
        ..StreetConfig::default()
    };
    Street::render(&config, None)
}

/// The metrics of a network on some streets, each picture scaled by its median.
///
/// # Errors
/// If its depths are not finite.
pub fn on_streets(predictor: &Predictor, street: &Street) -> Result<Report> {
    let how = Evaluation { protocol: Protocol::Dense, scale: Scale::Median, flip: false };
    evaluate(predictor, street, &(0..street.len()).collect::<Vec<_>>(), how, |_| ())
}

/// Measures how a network's depths become metres, on `sequences` rendered streets for each of ten cameras.
///
/// # Errors
/// If its depths are not finite.
pub fn calibrate(predictor: &Predictor, sequences: usize) -> Result<Calibration> {
    let own = Intrinsics::KITTI;
    let factor_of = |report: &Report| {
        report.ratio_median.ok_or_else(|| Error::Failed("the streets gave no factor: no pixel counts".into()))
    };
    let report = on_streets(predictor, &streets(predictor, own, sequences))?;
    let factor = factor_of(&report)?;
    // Logarithms of the two ratios of focal lengths, and of the factors.
    let mut found = Vec::new();
    for aspect in ASPECTS {
        for view in VIEWS {
            let fx = 0.5 / (view / 2.0f64).to_radians().tan();
            let camera = Intrinsics { fx, fy: fx * aspect, ..own };
            let measured = factor_of(&on_streets(predictor, &streets(predictor, camera, sequences))?)?;
            found.push([(fx / own.fx).ln(), (camera.fy / own.fy).ln(), (measured / factor).ln()]);
        }
    }
    let (by_width, by_height) = exponents(&found);
    let off = found.iter().map(|[x, y, z]| (by_width * x + by_height * y - z).abs().exp() - 1.0);
    Ok(Calibration {
        metres: Metres { factor, camera: own, camera_height: STREET_CAMERA_HEIGHT, by_width, by_height },
        wandering: report.ratio_std.unwrap_or(0.0),
        formula_off: off.fold(0.0, f64::max),
        metrics: report.metrics,
        images: report.images,
    })
}

/// Least squares of `z = a x + b y`.
fn exponents(found: &[[f64; 3]]) -> (f64, f64) {
    let sum = |i: usize, j: usize| found.iter().map(|row| row[i] * row[j]).sum::<f64>();
    let determinant = sum(0, 0) * sum(1, 1) - sum(0, 1) * sum(0, 1);
    let a = (sum(0, 2) * sum(1, 1) - sum(1, 2) * sum(0, 1)) / determinant;
    let b = (sum(1, 2) * sum(0, 0) - sum(0, 2) * sum(0, 1)) / determinant;
    (a, b)
}

/// How much depth moves between two sets of weights: relative differences over all pixels.
#[derive(Clone, Copy, Debug)]
pub struct Moved {
    /// The mean.
    pub mean: f64,
    /// The median over pictures of the largest in a picture.
    pub largest_in_a_picture: f64,
}

/// Compares the depths of two networks on every sample of some streets.
///
/// # Errors
/// If a picture cannot be read.
pub fn moved(one: &Predictor, other: &Predictor, street: &Street) -> Result<Moved> {
    let (mut sum, mut pixels, mut largest) = (0.0, 0, Vec::new());
    for sample in 0..street.len() {
        let image = street.image(sample, 0)?;
        let (a, b) = (one.inverse_depth(&image, false), other.inverse_depth(&image, false));
        let off: Vec<f64> =
            a.values.iter().zip(&b.values).map(|(a, b)| (f64::from(*a) / f64::from(*b) - 1.0).abs()).collect();
        sum += off.iter().sum::<f64>();
        pixels += off.len();
        largest.push(off.into_iter().fold(0.0, f64::max));
    }
    Ok(Moved { mean: sum / pixels.max(1) as f64, largest_in_a_picture: median(largest).unwrap_or(0.0) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponents_are_found_where_they_are_exact() {
        let rows: Vec<[f64; 3]> =
            [(0.1, -0.4), (0.3, 0.2), (-0.2, -0.5)].map(|(x, y)| [x, y, 0.25 * x + 0.7 * y]).to_vec();
        let (a, b) = exponents(&rows);
        assert!((a - 0.25).abs() < 1e-12 && (b - 0.7).abs() < 1e-12, "{a} {b}");
    }
}
