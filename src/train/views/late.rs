//! Views of a run that has left none: of an older version, or one whose views are lost.

use std::path::Path;

use super::place::Place;
use super::{AT_END, AT_VALIDATION, Shown, Views};
use crate::data::batch::{Augment, Making, batch_of_step};
use crate::error::{Error, Result};
use crate::eval::metrics::{Protocol, Scale};
use crate::eval::predictor::{Evaluation, Predictor, evaluate};
use crate::train::data::open_shown;
use crate::train::recipe::read_config;
use crate::train::run::{BEST, LAST, load_weights, lock};
use crate::train::{RunConfig, log};

/// The most samples among which the worst are looked for.
const SAMPLES: usize = 40;

/// Makes the views of a run's last weights, or where there are none of its best ones, and leaves them in its folder: all but
/// the time of a step, which only training tells. `progress` hears of frames that have to be rendered.
///
/// # Errors
/// If the run is being trained, its configuration, weights or data cannot be read, or the folder cannot be written into.
pub fn make_views(folder: &Path, progress: &(dyn Fn(&'static str, usize, usize) + Sync)) -> Result<()> {
    let config = read_config(&folder.join("config.toml"))?;
    let weights = [LAST, BEST].map(|name| folder.join(name)).into_iter().find(|path| path.is_file());
    let weights = weights.ok_or_else(|| {
        let message = format!("holds neither {LAST} nor {BEST}: without weights there is nothing to show");
        Error::file(folder, message)
    })?;
    let _lock = lock(folder)?;
    let (model, params, setup) = load_weights(&weights)?;
    let data = open_shown(&config, progress)?;
    if data.is_empty() {
        return Err(Error::file(folder, "its data hold no frame that was set aside: nothing can be shown"));
    }
    let step = step_of(folder, &config, weights.ends_with(LAST))?;
    let shown = Shown { model: &model, params: &params, setup, data: data.as_ref(), step };
    let place = Place::of(folder)?;
    let plain = Making { augment: Augment { flip: false, jitter: false, sensor: false }, ..config.making() };
    let batch = batch_of_step(shown.data, plain, 1, 0, 0)?;
    let time = place.read(AT_VALIDATION).map_or_else(Vec::new, |before| before.time);
    place.write(AT_VALIDATION, &Views { time, ..shown.of_validation(&place, &config, &batch)? })?;
    let samples: Vec<usize> = (0..data.len()).step_by(data.len().div_ceil(SAMPLES).max(1)).collect();
    let samples: Vec<usize> = samples.into_iter().filter(|&s| matches!(data.depth(s), Ok(Some(_)))).collect();
    let dense = Evaluation { protocol: Protocol::Dense, scale: Scale::Median, flip: false };
    let predictor = Predictor::new(&model, &params, &setup);
    let report = match samples.is_empty() {
        true => None,
        false => Some(evaluate(&predictor, shown.data, &samples, dense, |_| ())?),
    };
    place.write(AT_END, &shown.of_end(&place, &config, report.as_ref())?)
}

/// The step of a run's last weights, or of its best ones, as far as its log tells; 0 otherwise.
fn step_of(folder: &Path, config: &RunConfig, last: bool) -> Result<u64> {
    let found = if last { log::last_step(folder)? } else { log::best_step(folder)? };
    Ok(found.unwrap_or(0).min(config.steps))
}
