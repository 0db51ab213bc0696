//! The metrics of whatever predicts, on a data set.

use super::camera_height::find_ground;
use super::compare::{Comparison, compare_image};
use super::mean_map::MeanMap;
use super::metrics::Report;
use super::predictions::Predictions;
use super::predictor::Predictor;
use super::protocol::Protocol;
use super::scale::Scale;
use crate::data::DataSource;
use crate::error::{Error, Result};

/// Settings of an evaluation.
#[derive(Clone, Copy, Debug)]
pub struct Evaluation {
    /// Evaluation protocol.
    pub protocol: Protocol,
    /// Scaling of predictions.
    pub scale: Scale,
    /// Flip post-processing: predict on the mirrored picture too, and join both (Monodepth).
    pub flip: bool,
}

/// Something that predicts the samples of a data set.
pub trait Predicts {
    /// Inverse depth of a sample, row-major, positive, up to a factor; and its rows and columns.
    ///
    /// # Errors
    /// If there is none, or it cannot be read.
    fn inverse_depth(&self, data: &dyn DataSource, sample: usize) -> Result<(Vec<f32>, (usize, usize))>;
}

impl<P: Predicts + ?Sized> Predicts for &P {
    fn inverse_depth(&self, data: &dyn DataSource, sample: usize) -> Result<(Vec<f32>, (usize, usize))> {
        (**self).inverse_depth(data, sample)
    }
}

/// A network.
pub struct ByNetwork<'a> {
    /// It.
    pub predictor: &'a Predictor,
    /// Flip post-processing.
    pub flip: bool,
}

impl Predicts for ByNetwork<'_> {
    fn inverse_depth(&self, data: &dyn DataSource, sample: usize) -> Result<(Vec<f32>, (usize, usize))> {
        let image = data.image(sample, 0)?;
        let found = self.predictor.inverse_depth(&image, self.flip);
        if !found.is_whole() {
            return Err(Error::Failed(format!("{}: {}", data.name(sample), self.predictor.why_not_finite(&image))));
        }
        let size = found.size();
        Ok((found.values, size))
    }
}

impl Predicts for Predictions {
    fn inverse_depth(&self, _: &dyn DataSource, sample: usize) -> Result<(Vec<f32>, (usize, usize))> {
        Ok((self.map(sample).unwrap_or_default().to_vec(), self.size))
    }
}

impl Predicts for MeanMap {
    fn inverse_depth(&self, _: &dyn DataSource, _: usize) -> Result<(Vec<f32>, (usize, usize))> {
        Ok((self.inverse_depth.clone(), self.size))
    }
}

/// Outcome for a sample.
#[derive(Clone, Debug)]
pub enum Outcome {
    /// It was compared.
    Compared(Comparison),
    /// It has no ground truth.
    WithoutDepth,
    /// No road was found to measure the camera's height over.
    WithoutScale,
}

/// Compares a sample's prediction with its ground truth.
///
/// # Errors
/// If one of them cannot be read, or is no depth: names the sample.
pub fn compare_sample(by: &dyn Predicts, data: &dyn DataSource, sample: usize, how: Evaluation) -> Result<Outcome> {
    let Some(truth) = data.depth(sample)? else { return Ok(Outcome::WithoutDepth) };
    let (inverse_depth, size) = by.inverse_depth(data, sample)?;
    let (scale, found) = match how.scale {
        Scale::CameraHeight(metres) if inverse_depth.len() == size.0 * size.1 => {
            let Some(ground) = find_ground(&inverse_depth, size, data.intrinsics(sample)) else {
                return Ok(Outcome::WithoutScale);
            };
            let factor = metres / ground.camera_height;
            (Scale::Factor(factor), Some(factor))
        }
        scale => (scale, None),
    };
    let compared = compare_image(&inverse_depth, size, &truth, how.protocol, scale);
    let mut compared = compared.map_err(|e| match e {
        Error::Setting { .. } => e,
        other => Error::Failed(format!("{}: {other}", data.name(sample))),
    })?;
    compared.ratio = compared.ratio.or(found);
    Ok(Outcome::Compared(compared))
}

/// The seven metrics of whatever predicts, on samples of a data set. `seen` is told each sample, how many are done with it,
/// and what was compared. Samples without ground truth, and those without a road where the camera's height gives the scale,
/// are passed over and named in the report.
///
/// # Errors
/// If no sample can be compared, or one cannot be read.
pub fn evaluate_by(
    by: &dyn Predicts,
    data: &dyn DataSource,
    samples: &[usize],
    how: Evaluation,
    mut seen: impl FnMut(usize, usize, Option<&Comparison>),
) -> Result<Report> {
    let (mut results, mut without_depth, mut without_scale) = (Vec::new(), Vec::new(), Vec::new());
    for (i, &sample) in samples.iter().enumerate() {
        let name = data.name(sample);
        match compare_sample(by, data, sample, how)? {
            Outcome::Compared(compared) => {
                results.push((name, compared.metrics()));
                seen(sample, i + 1, Some(&compared));
                continue;
            }
            Outcome::WithoutDepth => without_depth.push(name),
            Outcome::WithoutScale => without_scale.push(name),
        }
        seen(sample, i + 1, None);
    }
    if results.is_empty() {
        let why = match without_scale.len() {
            0 => format!("none of the {} frames has ground-truth depth", samples.len()),
            n => format!("{n} frames show no road to measure the camera's height over: choose another scale"),
        };
        return Err(Error::Failed(format!("nothing to evaluate: {why}")));
    }
    Ok(Report { without_depth, without_scale, ..Report::new(results)? })
}

/// The seven metrics of a network on a data set; `seen` is told how many samples are done. As [`evaluate_by`].
///
/// # Errors
/// As [`evaluate_by`].
pub fn evaluate(
    predictor: &Predictor,
    data: &dyn DataSource,
    samples: &[usize],
    how: Evaluation,
    mut seen: impl FnMut(usize),
) -> Result<Report> {
    evaluate_by(&ByNetwork { predictor, flip: how.flip }, data, samples, how, |_, done, _| seen(done))
}

/// The seven metrics of what another program predicted for every sample of a data set; as [`evaluate`].
///
/// # Errors
/// As [`evaluate`], and if there is not one map for each sample.
pub fn evaluate_predictions(
    predictions: &Predictions,
    data: &dyn DataSource,
    how: Evaluation,
    mut seen: impl FnMut(usize),
) -> Result<Report> {
    predictions.check(data.len())?;
    let samples: Vec<usize> = (0..data.len()).collect();
    evaluate_by(predictions, data, &samples, how, |_, done, _| seen(done))
}

/// The seven metrics of the mean depth map on a data set; as [`evaluate`].
///
/// # Errors
/// As [`evaluate`].
pub fn evaluate_mean_map(map: &MeanMap, data: &dyn DataSource, samples: &[usize], how: Evaluation) -> Result<Report> {
    evaluate_by(map, data, samples, how, |_, _, _| ())
}
