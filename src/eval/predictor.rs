//! Depth of pictures, and how good it is against ground truth.

use super::metrics::{MeanMap, Protocol, Report, Scale, evaluate_image, flip_post_process, mirror};
use crate::data::Dataset;
use crate::data::augment::flip;
use crate::data::batch::to_tensor;
use crate::error::{Error, Result};
use crate::monovit::{MonoVit, Setup};
use crate::nn::{Folded, Params};
use image::RgbImage;

/// How to predict and to compare.
#[derive(Clone, Copy, Debug)]
pub struct Evaluation {
    /// Which pixels, which ground truth.
    pub protocol: Protocol,
    /// How a prediction gets its scale.
    pub scale: Scale,
    /// Whether to predict on the mirrored picture too, and to join both (Monodepth's post-processing).
    pub flip: bool,
}

/// A predictor: the networks with weights in evaluation mode.
pub struct Predictor<'a> {
    model: &'a MonoVit,
    params: Folded<f32>,
    nearest: f32,
    farthest: f32,
}

impl<'a> Predictor<'a> {
    /// The networks with these weights; `setup` gives the range of depths.
    pub fn new(model: &'a MonoVit, params: &Params<f32>, setup: &Setup) -> Self {
        let (nearest, farthest) = (setup.min_depth as f32, setup.max_depth as f32);
        Predictor { model, params: Folded::new(params), nearest, farthest }
    }

    /// Sigmoid disparity of a picture whose sides are multiples of 32, row-major.
    pub fn disparity(&self, image: &RgbImage) -> Vec<f32> {
        self.model.predict(&self.params, &to_tensor(&[image])).swap_remove(0).data().to_vec()
    }

    /// Inverse depth (up to scale) of a picture: `1/max + (1/min - 1/max) disparity`.
    pub fn inverse_depth(&self, image: &RgbImage, flipped_too: bool) -> Vec<f32> {
        let (near, far) = (1.0 / self.nearest, 1.0 / self.farthest);
        let scaled = |d: Vec<f32>| -> Vec<f32> { d.into_iter().map(|d| far + (near - far) * d).collect() };
        if !flipped_too {
            return scaled(self.disparity(image));
        }
        let width = image.width() as usize;
        let both = self.model.predict(&self.params, &to_tensor(&[image, &flip(image)])).swap_remove(0);
        let (plain, mirrored) = both.data().split_at(both.len() / 2);
        let mirrored = mirror(&scaled(mirrored.to_vec()), width);
        flip_post_process(&scaled(plain.to_vec()), &mirrored, width)
    }
}

/// The seven metrics of a network on a data set; `seen` is told how many samples are done. Samples without ground truth
/// are passed over and named in the report.
///
/// # Errors
/// If no sample has ground truth, or one cannot be read.
pub fn evaluate(
    predictor: &Predictor,
    data: &dyn Dataset,
    samples: &[usize],
    how: Evaluation,
    seen: impl FnMut(usize),
) -> Result<Report> {
    compare(data, samples, how, seen, |sample| {
        let image = data.image(sample, 0)?;
        Ok((predictor.inverse_depth(&image, how.flip), (image.height() as usize, image.width() as usize)))
    })
}

/// The seven metrics of the mean depth map on a data set; as [`evaluate`].
///
/// # Errors
/// As [`evaluate`].
pub fn evaluate_mean_map(map: &MeanMap, data: &dyn Dataset, samples: &[usize], how: Evaluation) -> Result<Report> {
    compare(data, samples, how, |_| (), |_| Ok((map.inverse_depth.clone(), map.size)))
}

/// Compares predictions (inverse depth and its rows and columns) with the ground truth of those samples that have one.
fn compare(
    data: &dyn Dataset,
    samples: &[usize],
    how: Evaluation,
    mut seen: impl FnMut(usize),
    predict: impl Fn(usize) -> Result<(Vec<f32>, (usize, usize))>,
) -> Result<Report> {
    let (mut results, mut without_depth) = (Vec::new(), Vec::new());
    for (i, &sample) in samples.iter().enumerate() {
        match data.depth(sample)? {
            Some(truth) => {
                let (inverse_depth, size) = predict(sample)?;
                let found = evaluate_image(&inverse_depth, size, &truth, how.protocol, how.scale)?;
                results.push((data.name(sample), found));
            }
            None => without_depth.push(data.name(sample)),
        }
        seen(i + 1);
    }
    if results.is_empty() {
        let message = format!("nothing to evaluate: none of the {} frames has ground-truth depth", samples.len());
        return Err(Error::Failed(message));
    }
    Ok(Report { without_depth, ..Report::new(results)? })
}
