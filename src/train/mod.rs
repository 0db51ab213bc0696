//! Training: the recipe, what it starts from, the step, and the run that keeps it all in a folder.

pub mod cost;
pub mod data;
pub mod fit;
pub mod freeze;
pub mod health;
pub mod layers;
mod log;
pub mod recipe;
mod recipes;
pub mod rotations;
pub mod run;
pub mod schedule;
pub mod start;
mod state;
mod tensorboard;
pub mod trainer;
mod validation;
pub mod views;
pub mod vitals;

pub use recipe::{OptimConfig, Plan, RunConfig};
pub use trainer::{StepReport, Trainer};

use std::path::Path;

use crate::error::{Error, Result};
use run::{Ended, Event, Run, RunMetrics};

/// Trains to the end in a new folder, on the data that the configuration names, and returns what `metrics.json` says.
///
/// ```no_run
/// use parallax::train::{RunConfig, train};
///
/// let config = RunConfig { steps: 1000, ..RunConfig::usual() };
/// let metrics = train(config, "runs/mine".as_ref(), |_| ())?;
/// println!("{:?}", metrics.after);
/// # Ok::<(), parallax::Error>(())
/// ```
///
/// # Errors
/// If the configuration, the folder or the data cannot be used, or a step fails.
pub fn train(mut config: RunConfig, folder: &Path, tell: impl FnMut(Event)) -> Result<RunMetrics> {
    config.check()?;
    cost::check_memory(&config)?;
    Run::claim(folder)?;
    let data = data::open(&config, &|_, _, _| ())?;
    config.set_epoch(data.train.len());
    match Run::create(folder, config)?.train(&data, || false, tell)? {
        Ended::Finished(metrics) => Ok(*metrics),
        Ended::Interrupted(step) => Err(Error::Failed(format!("stopped after step {step}"))),
    }
}
