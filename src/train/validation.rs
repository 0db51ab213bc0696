//! How good the weights of a run are: on validation data as it goes on, on test data before and after.

use std::fs;
use std::path::Path;
use std::time::Instant;

use image::codecs::jpeg::JpegEncoder;
use serde::{Deserialize, Serialize};

use super::log::Log;
use super::run::{BEST, Event, LAST, PAGES, Run, RunData, load_weights, write_weights};
use super::views::Shown;
use crate::data::DataSource;
use crate::data::batch::{Augment, Batch, Making, batch_of_readable, batch_of_step};
use crate::error::{Error, Result};
use crate::eval::metrics::{MeanMap, Metrics, Protocol, Report, Scale};
use crate::eval::predictor::{Evaluation, Predictor, evaluate, evaluate_mean_map};
use crate::formats::atomic::write_bytes_atomically;
use crate::formats::png::write_png;
use crate::report::colormap::disparity_to_image;
use crate::tensor::profile;

/// `metrics.json`: what is known of it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RunMetrics {
    /// The weights as they started, where there is ground truth.
    pub before: Option<Metrics>,
    /// The best weights, where there is ground truth.
    pub after: Option<Metrics>,
    /// The mean depth map of the training data, where depth is known of it and of the test data.
    pub mean_map: Option<Metrics>,
    /// The time of the training loop, in seconds.
    pub seconds: f64,
    /// Its steps.
    pub steps: u64,
    /// How many images were compared.
    pub images: usize,
    /// What was compared, in words; empty if nothing was.
    pub test: String,
    /// How many samples were passed over because a frame of theirs could not be read.
    #[serde(default)]
    pub skipped: usize,
    /// The first of them, and why.
    #[serde(default)]
    pub first_skipped: Option<String>,
}

/// The figures of a validation, a line of the log.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Validation {
    /// The step after which the weights were validated.
    pub validated: u64,
    /// The photometric error, the minimum over warped and unwarped neighbours: the best weights are chosen by it.
    pub photometric: f64,
    /// The photometric error of warped neighbours alone.
    pub warped: f64,
    /// The photometric error of unwarped neighbours alone.
    pub unwarped: f64,
    /// Whether the photometric error is the lowest so far.
    pub best: bool,
    /// Abs Rel with median scaling, where there is ground truth: to be seen, not to choose by.
    pub abs_rel: Option<f64>,
    /// The share of pixels within a factor of 1.25, likewise.
    pub a1: Option<f64>,
}

/// The time that a run's page took at a validation or at the end, a line of the log.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
struct PageLine {
    /// The step after which the weights were shown.
    page: u64,
    /// Pictures, views, and whoever is told of the validation and writes the page, in seconds.
    seconds: f64,
    /// The training loop so far, in seconds.
    trained: f64,
}

/// How many pictures of every validation are kept.
const KEPT: usize = 3;
/// How a run measures depth: every pixel with ground truth, at the truth's median.
const DENSE: Evaluation = Evaluation { protocol: Protocol::Dense, scale: Scale::Median, flip: false };

impl Run {
    /// A fixed set of batches without augmentation; none if a frame cannot be read, which is told.
    pub(super) fn validation_batches(&self, data: &RunData, tell: &mut impl FnMut(Event)) -> Vec<Batch> {
        let plain = Making { augment: Augment { flip: false, jitter: false, sensor: false }, ..self.config.making() };
        let size = self.config.batch.min(data.validation.len());
        let count = data.validation.len().checked_div(size).unwrap_or(0).min(10) as u64;
        let samples = data.validation.as_ref();
        let batches = (0..count).map(|step| match self.skip_list() {
            Some(skip) => batch_of_readable(samples, plain, size, 0, step, &skip),
            None => batch_of_step(samples, plain, size, 0, step),
        });
        let found = told("validation data", batches.collect::<Result<Vec<_>>>(), tell).unwrap_or_default();
        if found.is_empty() {
            tell(Event::Warning("there is no validation data: the last weights will count as the best"));
            if self.config.patience.is_some() {
                tell(Event::Warning("patience has no effect without validation data"));
            }
        }
        found
    }

    /// Measures what there is to be measured before the first step: the starting weights, and (returned) what the mean
    /// depth map of the training data is worth.
    pub(super) fn measure_beforehand(&mut self, data: &RunData, tell: &mut impl FnMut(Event)) -> Option<Metrics> {
        let test = data.test.as_deref()?;
        let samples: Vec<usize> = (0..test.len()).collect();
        if self.notes.before.is_none() && self.trainer.steps() == 0 {
            tell(Event::Phase("measuring the starting weights"));
            let predictor = Predictor::new(&self.trainer.model, &self.trainer.params, &self.config.setup());
            let report = evaluate(&predictor, test, &samples, DENSE, |_| ());
            self.notes.before = told("the starting weights", report, tell).map(|r| r.metrics);
        }
        // A training set without depth has no mean map, which is nothing to be told.
        if (0..data.train.len()).all(|sample| matches!(data.train.depth(sample), Ok(None))) {
            return None;
        }
        let map = told("the mean depth map", MeanMap::of_dataset(data.train.as_ref()), tell)?;
        told("the mean depth map", evaluate_mean_map(&map, test, &samples, DENSE), tell).map(|r| r.metrics)
    }

    /// Validates the weights, keeps them if they are the best so far, and notes that it is done.
    pub(super) fn validate(
        &mut self,
        data: &RunData,
        batches: &[Batch],
        log: &mut Log,
        tell: &mut impl FnMut(Event),
    ) -> Result<()> {
        let step = self.trainer.steps();
        let mut seen = None;
        if !batches.is_empty() {
            let weights = self.trainer.weights();
            let [photometric, warped, unwarped] = self.trainer.validate(&weights, batches);
            if !photometric.is_finite() {
                let culprit = profile::first_not_finite(|| self.trainer.validate(&weights, batches));
                let culprit = culprit.map_or_else(String::new, |culprit| format!("; {culprit}"));
                let message = format!("step {step}: the photometric error on validation data is not finite{culprit}");
                tell(Event::Warning(&message));
            }
            // A number that is none is never the best.
            let best = photometric.is_finite() && self.notes.best.is_none_or(|b| photometric < b);
            self.notes.since_best = if best { 0 } else { self.notes.since_best + 1 };
            if best {
                self.notes.best = Some(photometric);
                write_weights(&self.folder.join(BEST), &weights, &self.config.setup())?;
            }
            let predictor = Predictor::new(&self.trainer.model, &weights, &self.config.setup());
            let metrics = validation_depth(&predictor, data.validation.as_ref(), tell).map(|r| r.metrics);
            let (abs_rel, a1) = (metrics.map(|m| m.abs_rel), metrics.map(|m| m.a1));
            let line = Validation { validated: step, photometric, warped, unwarped, best, abs_rel, a1 };
            log.write(&line)?;
            let began = Instant::now();
            let shown = data.test.as_deref().unwrap_or(data.validation.as_ref());
            told("pictures", write_images(&self.folder, &predictor, shown, Some(step)), tell);
            let setup = self.config.setup();
            let shown = Shown { model: &self.trainer.model, params: &weights, setup, data: shown, step };
            let views = told("views of the weights", self.view_validation(&shown, &batches[0]), tell);
            // Whoever hears of it finds the pictures there.
            tell(Event::Validated(&line));
            log.write(&self.page_line(began))?;
            seen = Some((line, weights, views.unwrap_or_default()));
        }
        self.notes.validated = step;
        self.notes.write(&self.folder, step)?;
        // After the note: what a run that is killed here has not written yet is missing there, and never doubled.
        if let Some((line, weights, views)) = seen {
            self.board_gets(|board, run| board.validation(run, &line, &weights, &views), tell);
        }
        Ok(())
    }

    /// The time since the run began to make what its page shows.
    fn page_line(&self, began: Instant) -> PageLine {
        PageLine { page: self.trainer.steps(), seconds: began.elapsed().as_secs_f64(), trained: self.notes.seconds }
    }

    /// Measures the best weights, and writes pictures and `metrics.json`.
    pub(super) fn finish(
        &mut self,
        data: &RunData,
        mean_map: Option<Metrics>,
        log: &mut Log,
        tell: &mut impl FnMut(Event),
    ) -> Result<RunMetrics> {
        tell(Event::Phase("measuring the best weights"));
        let best = self.folder.join(BEST);
        write_weights(&self.folder.join(LAST), &self.trainer.weights(), &self.config.setup())?;
        if self.notes.best.is_none() {
            write_weights(&best, &self.trainer.weights(), &self.config.setup())?;
        }
        let (model, params, setup) = load_weights(&best)?;
        let predictor = Predictor::new(&model, &params, &setup);
        let shown = data.test.as_deref().unwrap_or(data.validation.as_ref());
        let began = Instant::now();
        told("pictures", write_images(&self.folder, &predictor, shown, None), tell);
        let mut page = self.page_line(began);
        let report = data.test.as_deref().and_then(|test| {
            let samples: Vec<usize> = (0..test.len()).collect();
            told("the best weights", evaluate(&predictor, test, &samples, DENSE, |_| ()), tell)
        });
        let began = Instant::now();
        let shown = Shown { model: &model, params: &params, setup, data: shown, step: self.trainer.steps() };
        told("views of the best weights", self.view_end(&shown, report.as_ref()), tell);
        page.seconds += began.elapsed().as_secs_f64();
        log.write(&page)?;
        let images = report.as_ref().map_or(0, |r| r.images);
        let first = report.as_ref().and_then(|r| r.per_image.first()).map(|image| image.name.as_str());
        let metrics = RunMetrics {
            before: self.notes.before,
            after: report.as_ref().map(|r| r.metrics),
            mean_map,
            seconds: self.notes.seconds,
            steps: self.trainer.steps(),
            images,
            test: first.map_or(String::new(), |first| format!("{first} and {} more", images - 1)),
            skipped: self.skipped.count(),
            first_skipped: self.skipped.first(),
        };
        let text = serde_json::to_string_pretty(&metrics).map_err(|e| Error::Failed(format!("the metrics: {e}")))?;
        write_bytes_atomically(self.folder.join("metrics.json"), text.as_bytes())?;
        self.board_gets(|board, run| board.end(run.trainer.steps(), &metrics), tell);
        Ok(metrics)
    }
}

/// Depth on at most forty validation samples, evenly over all, as far as there is ground truth.
fn validation_depth(predictor: &Predictor, data: &dyn DataSource, tell: &mut impl FnMut(Event)) -> Option<Report> {
    let samples: Vec<usize> = (0..data.len()).step_by(data.len().div_ceil(40).max(1)).collect();
    let has_depth = |&sample: &usize| !matches!(data.depth(sample), Ok(None));
    let samples: Vec<usize> = samples.into_iter().filter(has_depth).collect();
    if samples.is_empty() {
        return None;
    }
    told("depth on validation data", evaluate(predictor, data, &samples, DENSE, |_| ()), tell)
}

/// What was measured; of a failure that is told, nothing.
fn told<T>(what: &str, found: Result<T>, tell: &mut impl FnMut(Event)) -> Option<T> {
    found.inspect_err(|e| tell(Event::Warning(&format!("{what} could not be measured: {e}")))).ok()
}

/// A few pictures with their predicted disparity (and the true one, where it is known) below; the first of them are kept
/// under the step, too, if it is given.
fn write_images(folder: &Path, predictor: &Predictor, data: &dyn DataSource, step: Option<u64>) -> Result<()> {
    let count = data.len().min(8);
    for i in 0..count {
        let sample = i * data.len() / count;
        let image = data.image(sample, 0)?;
        let (w, h) = image.dimensions();
        let mut rows = vec![
            image.as_ref().clone(),
            disparity_to_image(&predictor.disparity(&image).values, w as usize, h as usize),
        ];
        if let Some(truth) = data.depth(sample)?
            && (truth.width, truth.height) == (w as usize, h as usize)
        {
            let inverse: Vec<f32> = truth.metres.iter().map(|&m| if m > 0.0 { 1.0 / m } else { 0.0 }).collect();
            rows.push(disparity_to_image(&inverse, truth.width, truth.height));
        }
        let mut sheet = image::RgbImage::new(w, h * rows.len() as u32);
        for (r, row) in rows.iter().enumerate() {
            image::imageops::replace(&mut sheet, row, 0, i64::from(h) * r as i64);
        }
        let path = folder.join(format!("images/{i:02}.png"));
        write_png(&path, &sheet)?;
        if let Some(step) = step.filter(|_| i < KEPT) {
            let path = folder.join(PAGES).join(format!("{step:07}-{i}.jpg"));
            let mut jpeg = Vec::new();
            let written = sheet.write_with_encoder(JpegEncoder::new_with_quality(&mut jpeg, 85));
            written.map_err(|e| Error::file(&path, format!("could not be made: {e}")))?;
            fs::create_dir_all(folder.join(PAGES)).map_err(|e| Error::io(&path, e))?;
            write_bytes_atomically(&path, &jpeg)?;
        }
    }
    Ok(())
}
