//! A training run: its folder, and the loop that fills it.
//!
//! `RUN/config.toml` (all of it, to run it again), `log.jsonl` (a line a logged step and a validation), `warnings.jsonl` (a
//! line where a warning of [`health`](super::health) begins or ends), `checkpoints/` (the whole state, and the one before
//! it), `best.safetensors` and `last.safetensors`, `metrics.json`, `images/` (of the last
//! validation), `pages/` (a few of every validation), `views/` ([`views`](super::views) of the last), and if asked for
//! `tensorboard/`.
//!
//! What is computed is never lost: the state is written before anything is measured, and nothing that only concerns
//! reporting ends a training.

mod files;
mod health;

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use serde::Serialize;

pub(super) use files::{BEST, CHECKPOINTS, LAST, PAGES, TENSORBOARD, VIEWS, lock};
use files::{LOCK, write_config};
pub use files::{is_running, load_weights, write_weights};
use health::Health;

use super::health::Warning;
use super::log::{self, Log};
use super::recipe::{RunConfig, read_config};
use super::start::Start;
use super::state::{self, Notes};
use super::tensorboard::Board;
use super::trainer::{StepReport, Trainer};
pub use super::validation::{RunMetrics, Validation};
use crate::data::DataSource;
use crate::data::batch::{Batch, Loader, SkipList};
use crate::error::{Error, Result};
use crate::formats::atomic::{self, check_writable};

/// The samples that a run trains on, validates on and reports on. None is in two of them.
pub struct RunData {
    /// Trained on.
    pub train: Arc<dyn DataSource>,
    /// The photometric loss on these selects the best weights.
    pub validation: Arc<dyn DataSource>,
    /// `metrics.json` reports on these, where there is ground truth.
    pub test: Option<Arc<dyn DataSource>>,
}

/// A logged step.
#[derive(Clone, Debug, Serialize)]
struct StepLine {
    #[serde(flatten)]
    step: StepReport,
    /// Of one step, the mean since the last line.
    seconds: f64,
    /// Waiting for data, of one step.
    data_seconds: f64,
}

/// The things that whoever watches is told.
pub enum Event<'a> {
    /// A phase begins, in words.
    Phase(&'a str),
    /// A step of learning rotations is done: its number, and the mean error in pixels.
    Rotations(u64, f64),
    /// A step is done.
    Step(&'a StepReport),
    /// A checkpoint was saved; its weights are validated next.
    Validating,
    /// Weights were validated.
    Validated(&'a Validation),
    /// A sign that the training goes wrong begins to show, for the first time.
    Health(&'a Warning),
    /// Something could not be measured, and why; training goes on.
    Warning(&'a str),
}

/// How a run ended.
pub enum Ended {
    /// All steps are done.
    Finished(Box<RunMetrics>),
    /// Someone asked it to stop after this step; it can be resumed.
    Interrupted(u64),
}

/// A run's folder.
pub struct Run {
    /// The folder.
    pub folder: PathBuf,
    /// The recipe.
    pub config: RunConfig,
    pub(super) trainer: Trainer,
    pub(super) notes: Notes,
    pub(super) skipped: SkipList,
    /// TensorBoard's events, while they are written.
    pub(super) board: Option<Board>,
    /// Held while this process has the run.
    _lock: File,
}

impl Run {
    /// Makes sure that a run can be written into this folder, which is made if it is missing: to be called before
    /// anything that takes time. A run that was killed before its first state is no obstacle.
    ///
    /// # Errors
    /// If the folder holds something else, or cannot be written into.
    pub fn claim(folder: &Path) -> Result<()> {
        fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
        let entries = fs::read_dir(folder).map_err(|e| Error::io(folder, e))?;
        // What a run leaves that was killed before its first state.
        let begun = |name: &str| ["config.toml", "log.jsonl", LOCK].contains(&name) || atomic::is_aside(name);
        if entries.flatten().any(|entry| !begun(&entry.file_name().to_string_lossy())) {
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
        let lock = lock(folder)?;
        atomic::clean(folder);
        if start.knows_motion {
            // Pose networks that somebody trained know rotations already.
            (config.rotations.share, config.rotations.keep) = (0.0, 0.0);
        }
        let mut trainer = Trainer::of(start.model, start.params, config.plan());
        trainer.freeze(&config.freeze)?;
        write_config(folder, &config)?;
        let run = Run {
            folder: folder.to_owned(),
            config,
            trainer,
            notes: Notes::default(),
            skipped: SkipList::default(),
            board: None,
            _lock: lock,
        };
        run.save()?;
        run.leave_weights()?;
        Ok(run)
    }

    /// A run that was interrupted, where it stood.
    ///
    /// # Errors
    /// As [`resume_with`](Run::resume_with).
    pub fn resume(folder: &Path) -> Result<Self> {
        Self::resume_with(folder, |_| Ok(()), |_| ())
    }

    /// A run that was interrupted or finished, where it stood, with another recipe: more steps, data elsewhere. `change`
    /// gets the recipe; `tell` hears of a damaged state that was passed over for the one before it.
    ///
    /// # Errors
    /// If the folder holds no run, another process has it, or no state can be read.
    pub fn resume_with(
        folder: &Path,
        change: impl FnOnce(&mut RunConfig) -> Result<()>,
        mut tell: impl FnMut(&str),
    ) -> Result<Self> {
        let mut config = read_config(&folder.join("config.toml"))?;
        let before = config.clone();
        change(&mut config)?;
        config.check()?;
        let lock = lock(folder)?;
        for place in
            [folder.to_owned(), folder.join(CHECKPOINTS), folder.join("images"), folder.join(PAGES), folder.join(VIEWS)]
        {
            atomic::clean(place);
        }
        let mut trainer = Trainer::new(config.model(), config.plan());
        trainer.freeze(&config.freeze)?;
        let notes = state::load(&mut trainer, folder, &mut tell)?;
        if config != before {
            write_config(folder, &config)?;
        }
        log::forget_after(folder, trainer.steps(), notes.validated)?;
        let skipped = SkipList::default();
        Ok(Run { folder: folder.to_owned(), config, trainer, notes, skipped, board: None, _lock: lock })
    }

    /// Steps done.
    pub fn steps(&self) -> u64 {
        self.trainer.steps()
    }

    /// The samples that were passed over because a frame of theirs could not be read.
    pub fn skipped(&self) -> &SkipList {
        &self.skipped
    }

    /// The list that loaders put samples on which cannot be read, if those are to be passed over.
    pub(super) fn skip_list(&self) -> Option<SkipList> {
        self.config.skip_bad_frames.then(|| self.skipped.clone())
    }

    /// Trains to the end, or until `stop` says so.
    ///
    /// # Errors
    /// If a step fails (numbers that are not finite, a frame that cannot be read and is not to be passed over) or the state cannot be written. The
    /// state before the failing step is kept.
    pub fn train(&mut self, data: &RunData, stop: impl Fn() -> bool, mut tell: impl FnMut(Event)) -> Result<Ended> {
        for (name, why) in data.train.unreadable().iter().chain(data.validation.unreadable()) {
            self.skipped.add(name, why);
        }
        let mean_map = self.measure_beforehand(data, &mut tell);
        let validation = self.validation_batches(data, &mut tell);
        let mut log = Log::open(&self.folder, log::LOG)?;
        let mut health = Health::open(&self.folder)?;
        self.open_board(&mut tell);
        if !self.learn_rotations(data, &stop, &mut tell)? {
            // The state on disk is that before the first of these steps: they will be taken again.
            return Ok(Ended::Interrupted(0));
        }
        if self.validation_is_due() {
            self.validate(data, &validation, &mut log, &mut tell)?;
        }
        let (making, batch, seed) = (self.config.making(), self.config.batch, self.config.seed);
        let accumulate = self.config.accumulate;
        let passes = self.trainer.steps() * accumulate as u64;
        let mut loader = Loader::start(data.train.clone(), making, batch, seed, passes, self.skip_list())?;
        tell(Event::Phase("training"));
        let (mut since, mut waited, mut counted) = (Instant::now(), 0.0, 0u32);
        while self.trainer.steps() < self.config.steps && !self.patience_is_over() {
            let asked = Instant::now();
            let next: Result<Vec<Batch>> = (0..accumulate).map(|_| loader.next_batch()).collect();
            let report = match next.and_then(|batches| {
                waited += asked.elapsed().as_secs_f64();
                self.step_of(&batches)
            }) {
                Ok(report) => report,
                Err(error) => {
                    // All steps before this one are worth keeping, unless their weights are what failed.
                    if self.trainer.steps() > 0 && self.trainer.check_finite().is_ok() {
                        self.save()?;
                        self.leave_weights()?;
                    }
                    return Err(error);
                }
            };
            counted += 1;
            let last = report.step == self.config.steps;
            if report.step.is_multiple_of(self.config.log_every) || last || report.step == 1 {
                let n = f64::from(counted);
                let (seconds, data_seconds) = (since.elapsed().as_secs_f64() / n, waited / n);
                log.write(&StepLine { step: report, seconds, data_seconds })?;
                self.board_gets(|board, _| board.step(&report, [seconds, data_seconds]), &mut tell);
                health.see(&report, &mut tell)?;
                self.notes.seconds += since.elapsed().as_secs_f64();
                (since, waited, counted) = (Instant::now(), 0.0, 0);
            }
            tell(Event::Step(&report));
            let stopping = stop() && !last;
            if self.checkpoint_is_due() || stopping {
                self.notes.seconds += since.elapsed().as_secs_f64();
                self.save()?;
                if stopping {
                    self.leave_weights()?;
                    return Ok(Ended::Interrupted(report.step));
                }
                tell(Event::Validating);
                self.validate(data, &validation, &mut log, &mut tell)?;
                since = Instant::now();
            }
        }
        drop(loader);
        if self.trainer.steps() < self.config.steps {
            tell(Event::Phase(&format!("stopping: no new best in {} validations", self.notes.since_best)));
        }
        Ok(Ended::Finished(Box::new(self.finish(data, mean_map, &mut log, &mut tell)?)))
    }

    /// Takes a step; where its weights are validated next, TensorBoard gets its gradients.
    fn step_of(&mut self, batches: &[Batch]) -> Result<StepReport> {
        let watched = self.validates_after(self.trainer.steps() + 1);
        let board = self.board.as_mut().filter(|_| watched);
        self.trainer.step_watched(batches, |trainer, gradients| {
            if let Some(board) = board {
                board.see_gradients(trainer, gradients);
            }
        })
    }

    /// Whether validation has found no new best for as long as the configuration waits.
    fn patience_is_over(&self) -> bool {
        self.config.patience.is_some_and(|patience| self.notes.since_best >= patience)
    }

    /// Whether the state is written after the step that was taken last.
    fn checkpoint_is_due(&self) -> bool {
        self.validates_after(self.trainer.steps())
    }

    /// Whether the state is written, and its weights are validated, after a step.
    fn validates_after(&self, step: u64) -> bool {
        step.is_multiple_of(self.config.checkpoint_every) || step == self.config.steps
    }

    /// Whether a checkpoint's weights have not been validated: the run stopped in between.
    fn validation_is_due(&self) -> bool {
        self.trainer.steps() > 0 && self.checkpoint_is_due() && self.notes.validated < self.trainer.steps()
    }

    /// Teaches the pose networks rotations, if the recipe says so and nothing is learnt yet; whether it came to the end.
    fn learn_rotations(
        &mut self,
        data: &RunData,
        stop: &impl Fn() -> bool,
        tell: &mut impl FnMut(Event),
    ) -> Result<bool> {
        if self.trainer.steps() > 0 || self.config.plan().rotations.steps == 0 {
            return Ok(true);
        }
        tell(Event::Phase("teaching the pose network what a rotation looks like"));
        let started = Instant::now();
        let (making, batch, seed) = (self.config.making(), self.config.batch, self.config.seed);
        // The same frames as in training, in another order.
        let mut loader = Loader::start(data.train.clone(), making, batch, seed ^ u64::MAX, 0, self.skip_list())?;
        let learnt = self.trainer.learn_rotations(
            || loader.next_batch(),
            |step, error| {
                tell(Event::Rotations(step, error));
                !stop()
            },
        )?;
        self.notes.seconds += started.elapsed().as_secs_f64();
        Ok(learnt)
    }

    /// Writes the state; what it holds is checked first.
    pub(super) fn save(&self) -> Result<()> {
        state::save(&self.trainer, &self.folder, &self.notes, self.config.keep)
    }

    /// Leaves weights to predict with where no validation has chosen any yet: those that training starts from, or has
    /// reached.
    fn leave_weights(&self) -> Result<()> {
        if self.notes.best.is_some() {
            return Ok(());
        }
        let weights = self.trainer.weights();
        write_weights(&self.folder.join(BEST), &weights, &self.config.setup())
    }
}
