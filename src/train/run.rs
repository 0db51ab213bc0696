//! A training run: its configuration, its folder, and the loop that fills it.
//!
//! `RUN/config.toml` (all of it, to run it again), `log.jsonl` (a line a logged step), `checkpoints/` (the whole state),
//! `best.safetensors`, `metrics.json`, `images/`.

use std::collections::HashMap;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use serde::{Deserialize, Serialize};

use super::recipe::{RunConfig, read_config};
use super::start::Start;
use super::trainer::{StepReport, Trainer};
use crate::data::Dataset;
use crate::data::batch::{Augment, Batch, Loader, batch_of_step};
use crate::error::{Error, Result};
use crate::eval::metrics::{MeanMap, Metrics, Protocol, Scale};
use crate::eval::predictor::{Evaluation, Predictor, evaluate, evaluate_mean_map};
use crate::formats::atomic::{check_writable, write_bytes_atomically};
use crate::formats::safetensors;
use crate::monovit::{MonoVit, Setup};
use crate::nn::Params;
use crate::report::colormap::disparity_to_image;
use crate::weights;
use crate::weights::{Need, Weights};

/// What a run trains, validates and reports on. No sample is in two of them.
pub struct RunData {
    /// Trained on.
    pub train: Arc<dyn Dataset>,
    /// The photometric loss on these selects the best weights.
    pub validation: Arc<dyn Dataset>,
    /// `metrics.json` reports on these, where there is ground truth.
    pub test: Option<Arc<dyn Dataset>>,
}

/// `metrics.json`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RunMetrics {
    /// The weights as they start.
    pub before: Metrics,
    /// The best weights.
    pub after: Metrics,
    /// The mean depth map of the training data, where its depth is known.
    pub mean_map: Option<Metrics>,
    /// The time of the training loop, in seconds.
    pub seconds: f64,
    /// Its steps.
    pub steps: u64,
    /// How many images were compared.
    pub images: usize,
    /// What was compared, in words.
    pub test: String,
}

/// A logged step.
#[derive(Clone, Debug, Serialize)]
struct LogLine {
    #[serde(flatten)]
    step: StepReport,
    /// Of one step, the mean since the last line.
    seconds: f64,
    /// Waiting for data, of one step.
    data_seconds: f64,
}

/// What the loop tells whoever watches.
pub enum Event<'a> {
    /// A phase begins, in words.
    Phase(&'a str),
    /// A step of learning rotations is done: its number, and the mean error in pixels.
    Rotations(u64, f64),
    /// A step is done.
    Step(&'a StepReport),
    /// Weights were validated.
    Validated(&'a Validated),
}

/// What validation found.
pub struct Validated {
    /// After this step.
    pub step: u64,
    /// The photometric error, which the best weights are chosen by.
    pub photometric: f64,
    /// Whether it is the lowest so far.
    pub best: bool,
    /// Abs Rel with median scaling, where there is ground truth: to be seen, not to choose by.
    pub abs_rel: Option<f64>,
}

/// How a run ended.
pub enum Ended {
    /// All steps are done.
    Finished(Option<Box<RunMetrics>>),
    /// Someone asked it to stop; it can be resumed.
    Interrupted(u64),
}

/// A run's folder.
pub struct Run {
    /// The folder.
    pub folder: PathBuf,
    /// What it runs.
    pub config: RunConfig,
    trainer: Trainer,
    /// The photometric error of the best weights so far; none before the first validation.
    best: Option<f64>,
    /// Seconds of training before this process.
    seconds: f64,
    before: Option<Metrics>,
}

/// What a state file says beside the tensors.
#[derive(Serialize, Deserialize)]
struct StateNotes {
    best: Option<f64>,
    seconds: f64,
    before: Option<Metrics>,
}

impl Run {
    /// Makes sure that a run can be written into this folder, which is made if it is missing: to be called before
    /// anything that takes time.
    ///
    /// # Errors
    /// If the folder holds something, or cannot be written into.
    pub fn claim(folder: &Path) -> Result<()> {
        fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
        let mut entries = fs::read_dir(folder).map_err(|e| Error::io(folder, e))?;
        if entries.next().is_some() {
            let message = "is not empty: give another folder with --out, or go on with --resume";
            return Err(Error::file(folder, message));
        }
        check_writable(folder)
    }

    /// A new run in an empty or missing folder.
    pub fn create(folder: &Path, config: RunConfig) -> Result<Self> {
        config.check()?;
        let start = Start::of(&config)?;
        Self::create_from(folder, config, start)
    }

    /// A new run whose starting weights are at hand.
    pub fn create_from(folder: &Path, mut config: RunConfig, start: Start) -> Result<Self> {
        config.check()?;
        Self::claim(folder)?;
        if start.knows_motion {
            // Pose networks that somebody trained know rotations already.
            config.rotations.share = 0.0;
            config.rotations.keep = 0.0;
        }
        let text = toml::to_string(&config).map_err(|e| Error::Failed(format!("the configuration: {e}")))?;
        write_bytes_atomically(folder.join("config.toml"), text.as_bytes())?;
        let trainer = Trainer::of(start.model, start.params, config.plan());
        let run = Self::of(folder, config, trainer);
        run.save()?;
        Ok(run)
    }

    /// A run that was interrupted, where it stood.
    pub fn resume(folder: &Path) -> Result<Self> {
        let path = folder.join("config.toml");
        let config = read_config(&path)?;
        config.check().map_err(|e| Error::file(&path, e.to_string()))?;
        let trainer = Trainer::new(config.model(), config.plan());
        let mut run = Self::of(folder, config, trainer);
        let state = run.state_file();
        run.trainer.load(&state)?;
        let notes = safetensors::read::<f32>(&state)?.metadata.remove("run").unwrap_or_default();
        let notes: StateNotes =
            serde_json::from_str(&notes).map_err(|e| Error::file(&state, format!("its notes on the run: {e}")))?;
        (run.best, run.seconds, run.before) = (notes.best, notes.seconds, notes.before);
        // Lines that were logged after the state was written will be logged again.
        let log = folder.join("log.jsonl");
        if let Ok(text) = fs::read_to_string(&log) {
            let done = run.trainer.steps();
            let step =
                |line: &&str| serde_json::from_str::<serde_json::Value>(line).ok().and_then(|v| v["step"].as_u64());
            let kept: String =
                text.lines().filter(|l| step(l).is_some_and(|s| s <= done)).flat_map(|l| [l, "\n"]).collect();
            write_bytes_atomically(&log, kept.as_bytes())?;
        }
        Ok(run)
    }

    fn of(folder: &Path, config: RunConfig, trainer: Trainer) -> Self {
        Run { folder: folder.to_owned(), config, trainer, best: None, seconds: 0.0, before: None }
    }

    fn state_file(&self) -> PathBuf {
        self.folder.join("checkpoints/state.safetensors")
    }

    /// Steps done.
    pub fn steps(&self) -> u64 {
        self.trainer.steps()
    }

    /// Trains to the end, or until `stop` says so.
    pub fn train(&mut self, data: &RunData, stop: impl Fn() -> bool, mut tell: impl FnMut(Event)) -> Result<Ended> {
        let test: Option<(&dyn Dataset, Vec<usize>)> =
            data.test.as_deref().map(|t| (t, (0..t.len()).collect::<Vec<_>>()));
        if let (Some((test, samples)), None) = (&test, self.before) {
            tell(Event::Phase("measuring the untrained network"));
            let predictor = Predictor::new(&self.trainer.model, &self.trainer.params, &self.config.setup());
            self.before = Some(evaluate(&predictor, *test, samples, DENSE, |_| ())?.metrics);
        }
        // Before training, so that ground truth that cannot be read costs no run.
        let mean_map = match &test {
            Some((test, samples)) => mean_map(data.train.as_ref(), *test, samples)?,
            None => None,
        };
        let validation = self.validation_batches(data)?;
        let (augment, batch, seed) = (self.config.augment, self.config.batch, self.config.seed);
        let mut loader = Loader::start(data.train.clone(), augment, batch, seed, self.trainer.steps())?;
        let log_path = self.folder.join("log.jsonl");
        let log = fs::OpenOptions::new().create(true).append(true).open(&log_path);
        let mut log = log.map_err(|e| Error::io(&log_path, e))?;

        if self.trainer.steps() == 0 && self.config.plan().rotations.steps > 0 {
            tell(Event::Phase("teaching the pose network what a rotation looks like"));
            let started = Instant::now();
            // The same frames as in training, in another order.
            let mut loader = Loader::start(data.train.clone(), augment, batch, seed ^ u64::MAX, 0)?;
            let learnt = self.trainer.learn_rotations(
                || loader.next_batch(),
                |step, error| {
                    tell(Event::Rotations(step, error));
                    !stop()
                },
            )?;
            if !learnt {
                // The state on disk is that before the first of these steps: they will be taken again.
                return Ok(Ended::Interrupted(0));
            }
            self.seconds += started.elapsed().as_secs_f64();
        }
        tell(Event::Phase("training"));
        let (mut since, mut waited, mut counted) = (Instant::now(), 0.0, 0u32);
        while self.trainer.steps() < self.config.steps {
            let asked = Instant::now();
            let batch = loader.next_batch()?;
            waited += asked.elapsed().as_secs_f64();
            let report = self.trainer.step(&batch)?;
            counted += 1;
            let last = report.step == self.config.steps;
            if report.step.is_multiple_of(self.config.log_every) || last || report.step == 1 {
                let n = f64::from(counted);
                let line =
                    LogLine { step: report, seconds: since.elapsed().as_secs_f64() / n, data_seconds: waited / n };
                let text = serde_json::to_string(&line).map_err(|e| Error::Failed(format!("the log: {e}")))?;
                writeln!(log, "{text}").map_err(|e| Error::io(&log_path, e))?;
                self.seconds += since.elapsed().as_secs_f64();
                (since, waited, counted) = (Instant::now(), 0.0, 0);
            }
            tell(Event::Step(&report));
            let stopping = stop() && !last;
            if report.step.is_multiple_of(self.config.checkpoint_every) || last || stopping {
                self.seconds += since.elapsed().as_secs_f64();
                if !stopping {
                    self.keep_if_best(data, &validation, report.step, &mut tell)?;
                }
                self.save()?;
                since = Instant::now();
            }
            if stopping {
                return Ok(Ended::Interrupted(report.step));
            }
        }
        drop(loader);
        Ok(Ended::Finished(self.finish(data, test, mean_map, &mut tell)?.map(Box::new)))
    }

    /// A fixed set of batches without augmentation.
    fn validation_batches(&self, data: &RunData) -> Result<Vec<Batch>> {
        let plain = Augment { flip: false, jitter: false };
        let size = self.config.batch.min(data.validation.len());
        let count = (data.validation.len() / size.max(1)).min(10) as u64;
        (0..count).map(|step| batch_of_step(data.validation.as_ref(), plain, size, 0, step)).collect()
    }

    fn keep_if_best(
        &mut self,
        data: &RunData,
        batches: &[Batch],
        step: u64,
        tell: &mut impl FnMut(Event),
    ) -> Result<()> {
        let weights = self.trainer.weights();
        let photometric = self.trainer.validate(&weights, batches);
        let best = self.best.is_none_or(|b| photometric < b);
        if best {
            self.best = Some(photometric);
            write_weights(&self.folder.join("best.safetensors"), &weights, &self.config.setup())?;
        }
        let samples = forty_of(data.validation.len());
        let predictor = Predictor::new(&self.trainer.model, &weights, &self.config.setup());
        let abs_rel = match data.validation.depth(0)? {
            Some(_) => Some(evaluate(&predictor, data.validation.as_ref(), &samples, DENSE, |_| ())?.metrics.abs_rel),
            None => None,
        };
        tell(Event::Validated(&Validated { step, photometric, best, abs_rel }));
        Ok(())
    }

    fn save(&self) -> Result<()> {
        let notes = StateNotes { best: self.best, seconds: self.seconds, before: self.before };
        let notes = serde_json::to_string(&notes).map_err(|e| Error::Failed(format!("the state: {e}")))?;
        self.trainer.save(&self.state_file(), HashMap::from([("run".into(), notes)]))
    }

    fn finish(
        &self,
        data: &RunData,
        test: Option<(&dyn Dataset, Vec<usize>)>,
        mean_map: Option<Metrics>,
        tell: &mut impl FnMut(Event),
    ) -> Result<Option<RunMetrics>> {
        tell(Event::Phase("measuring the best weights"));
        let (model, params, _) = load_weights(&self.folder.join("best.safetensors"))?;
        let predictor = Predictor::new(&model, &params, &self.config.setup());
        let shown: &dyn Dataset = test.as_ref().map_or(data.validation.as_ref(), |(t, _)| *t);
        self.write_images(&predictor, shown)?;
        let Some((test, samples)) = test else { return Ok(None) };
        let after = evaluate(&predictor, test, &samples, DENSE, |_| ())?;
        let metrics = RunMetrics {
            before: self.before.unwrap_or_default(),
            after: after.metrics,
            mean_map,
            seconds: self.seconds,
            steps: self.trainer.steps(),
            images: after.images,
            test: format!("{} and {} more", test.name(0), samples.len() - 1),
        };
        let text = serde_json::to_string_pretty(&metrics).map_err(|e| Error::Failed(format!("the metrics: {e}")))?;
        write_bytes_atomically(self.folder.join("metrics.json"), text.as_bytes())?;
        Ok(Some(metrics))
    }

    /// A few pictures with their predicted disparity (and the true one, where it is known) below.
    fn write_images(&self, predictor: &Predictor, data: &dyn Dataset) -> Result<()> {
        let count = data.len().min(8);
        for i in 0..count {
            let sample = i * data.len() / count;
            let image = data.image(sample, 0)?;
            let (w, h) = image.dimensions();
            let mut rows =
                vec![image.as_ref().clone(), disparity_to_image(&predictor.disparity(&image), w as usize, h as usize)];
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
            let path = self.folder.join(format!("images/{i:02}.png"));
            let mut bytes = std::io::Cursor::new(Vec::new());
            sheet
                .write_to(&mut bytes, image::ImageFormat::Png)
                .map_err(|e| Error::file(&path, format!("could not be encoded: {e}")))?;
            write_bytes_atomically(&path, bytes.get_ref())?;
        }
        Ok(())
    }
}

/// What the mean depth map of the training data is worth; nothing, if its depth is not known.
fn mean_map(train: &dyn Dataset, test: &dyn Dataset, samples: &[usize]) -> Result<Option<Metrics>> {
    if train.depth(0)?.is_none() {
        return Ok(None);
    }
    let map = MeanMap::of_dataset(train)?;
    Ok(Some(evaluate_mean_map(&map, test, samples, DENSE)?.metrics))
}

/// How a run measures depth: every pixel with ground truth, at the truth's median.
const DENSE: Evaluation = Evaluation { protocol: Protocol::Dense, scale: Scale::Median, flip: false };

/// At most forty samples, evenly over all.
fn forty_of(len: usize) -> Vec<usize> {
    (0..len).step_by(len.div_ceil(40).max(1)).collect()
}

/// Writes weights for use: PyTorch's names and layouts, their setup in the metadata.
pub fn write_weights(path: &Path, params: &Params<f32>, setup: &Setup) -> Result<()> {
    safetensors::write(path, &safetensors::export(params), setup.metadata()?)
}

/// Reads weights to predict depth with: a run's folder, or a file or folder of any kind that [`weights::load`] reads.
pub fn load_weights(path: &Path) -> Result<(MonoVit, Params<f32>, Setup)> {
    let Weights { model, params, setup, .. } = weights::load(&[path.to_owned()], Need::Depth, false)?;
    Ok((model, params, setup))
}
