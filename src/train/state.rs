//! The whole state of a training, to go on from: weights, moments, averages, steps, and notes on the run.
//!
//! `checkpoints/state.safetensors` is replaced only when the next one is whole on the disk, and stays as
//! `previous.safetensors`: if one is damaged, the other is taken. Where more than two are to be kept, each is there under
//! the name of its step, too: to go on from one, put it in the place of `state.safetensors`.

use std::collections::{BTreeMap, HashMap};
use std::fs::{self, File};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::run::CHECKPOINTS;
use super::trainer::Trainer;
use crate::error::{Error, Result};
use crate::eval::metrics::Metrics;
use crate::formats::atomic::{write_atomically, write_bytes_atomically};
use crate::formats::bounded::{MAX_SETTINGS, read_text};
use crate::formats::safetensors;
use crate::tensor::Tensor;

/// What is known of a run beside its tensors.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Notes {
    /// The photometric error of the best weights so far; none before the first validation.
    pub(super) best: Option<f64>,
    /// Seconds of training.
    pub(super) seconds: f64,
    /// The starting weights on test data.
    pub(super) before: Option<Metrics>,
    /// The last step whose weights were validated.
    #[serde(default)]
    pub(super) validated: u64,
    /// Validations since the best one.
    #[serde(default)]
    pub(super) since_best: u64,
}

/// [`Notes`] with the step of the state that they belong to.
#[derive(Serialize, Deserialize)]
struct Dated {
    step: u64,
    notes: Notes,
}

impl Notes {
    /// Writes them beside the state of a step, which need not be written again for them.
    pub(super) fn write(&self, folder: &Path, step: u64) -> Result<()> {
        let dated = Dated { step, notes: self.clone() };
        let text = serde_json::to_string(&dated).map_err(|e| Error::Failed(format!("the notes: {e}")))?;
        write_bytes_atomically(folder.join(CHECKPOINTS).join(NOTES), text.as_bytes())
    }
}

const STATE: &str = "state.safetensors";
const PREVIOUS: &str = "previous.safetensors";
const NEXT: &str = "next.safetensors";
const NOTES: &str = "notes.json";

/// Writes the state of a run, and removes what is older than the `keep` newest.
///
/// # Errors
/// If a number in it is not finite: the parameter is named, and the state on disk stays. If it cannot be written.
pub(super) fn save(trainer: &Trainer, folder: &Path, notes: &Notes, keep: usize) -> Result<()> {
    trainer.check_finite()?;
    let folder = folder.join(CHECKPOINTS);
    let notes = serde_json::to_string(notes).map_err(|e| Error::Failed(format!("the state: {e}")))?;
    let [state, next, previous] = [STATE, NEXT, PREVIOUS].map(|name| folder.join(name));
    trainer.save(&next, HashMap::from([("run".into(), notes)]))?;
    if state.exists() {
        fs::rename(&state, &previous).map_err(|e| Error::io(&previous, e))?;
    }
    fs::rename(&next, &state).map_err(|e| Error::io(&state, e))?;
    if keep == 1 && previous.exists() {
        fs::remove_file(&previous).map_err(|e| Error::io(&previous, e))?;
    }
    keep_under_steps(&folder, trainer.steps(), keep)
}

/// The beginning of the name of a state that is kept under its step.
const STEP: &str = "step-";

/// Keeps the newest state under its step, too, where more are wanted than the newest and the one before it, and removes
/// the oldest of those.
fn keep_under_steps(folder: &Path, step: u64, keep: usize) -> Result<()> {
    if keep > 2 {
        let named = folder.join(format!("{STEP}{step:08}.safetensors"));
        if named.exists() {
            fs::remove_file(&named).map_err(|e| Error::io(&named, e))?;
        }
        let state = folder.join(STATE);
        // A second name costs no space; some file systems have none.
        if fs::hard_link(&state, &named).is_err() {
            write_atomically(&named, |out| std::io::copy(&mut File::open(&state)?, out).map(drop))?;
        }
    }
    let entries = fs::read_dir(folder).map_err(|e| Error::io(folder, e))?;
    let is_named = |path: &PathBuf| {
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        let number = name.strip_prefix(STEP).and_then(|rest| rest.strip_suffix(".safetensors"));
        number.is_some_and(|number| number.parse::<u64>().is_ok())
    };
    let mut named: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).filter(is_named).collect();
    named.sort();
    let kept = if keep > 2 { keep } else { 0 };
    for old in &named[..named.len().saturating_sub(kept)] {
        fs::remove_file(old).map_err(|e| Error::io(old, e))?;
    }
    Ok(())
}

/// Reads the newest state of a run that is whole into a trainer; `tell` hears of those that are not.
///
/// # Errors
/// If there is none: what is wrong with the newest.
pub(super) fn load(trainer: &mut Trainer, folder: &Path, tell: &mut impl FnMut(&str)) -> Result<Notes> {
    let folder = folder.join(CHECKPOINTS);
    let mut first = None;
    // A run that was killed between two renames has its newest state under the name of the next.
    for name in [STATE, NEXT, PREVIOUS] {
        let path = folder.join(name);
        if name != STATE && !path.exists() {
            continue;
        }
        match read(trainer, &path) {
            Ok(mut notes) => {
                if let Some(error) = first {
                    tell(&format!("{error}; going on from {} at step {}", path.display(), trainer.steps()));
                    // The next state takes the damaged one's place, not that of the one that is whole.
                    let state = folder.join(STATE);
                    if name != STATE && state.exists() {
                        fs::remove_file(&state).map_err(|e| Error::io(&state, e))?;
                    }
                }
                let beside = read_text(&folder.join(NOTES), MAX_SETTINGS, "notes on a run").ok();
                let dated = beside.and_then(|text| serde_json::from_str::<Dated>(&text).ok());
                if let Some(dated) = dated.filter(|d| d.step == trainer.steps()) {
                    notes = dated.notes;
                }
                return Ok(notes);
            }
            Err(error) => first = first.or(Some(error)),
        }
    }
    Err(first.unwrap_or_else(|| Error::file(&folder, "holds no state of a training")))
}

fn read(trainer: &mut Trainer, path: &Path) -> Result<Notes> {
    let mut metadata = trainer.load(path)?;
    let notes = metadata.remove("run").unwrap_or_default();
    serde_json::from_str(&notes).map_err(|e| Error::file(path, format!("its notes on the run: {e}")))
}

impl Trainer {
    /// Checks that weights, moments and averages are finite.
    ///
    /// # Errors
    /// Names the step and the parameter.
    pub fn check_finite(&self) -> Result<()> {
        for (id, p) in self.params.iter() {
            let moments = self.adamw.moments[id.index()].iter().flatten();
            let average = self.average.iter().map(|a| &a.values[id.index()]);
            if let Some(which) = std::iter::once(&p.value).chain(average).chain(moments).position(|t| !t.is_finite()) {
                let what = if which == 0 { "" } else { "what the optimiser keeps of " };
                let message = format!(
                    "step {}: {what}{} is not finite after the step: is a learning rate too high? The last good state is kept",
                    self.adamw.steps,
                    p.name()
                );
                return Err(Error::Failed(message));
            }
        }
        Ok(())
    }

    /// Writes the whole state: weights, moments, average, step.
    pub fn save(&self, path: &Path, metadata: HashMap<String, String>) -> Result<()> {
        let mut tensors: BTreeMap<String, Tensor<f32>> = BTreeMap::new();
        for (id, p) in self.params.iter() {
            tensors.insert(format!("weights/{}", p.name()), p.value.clone());
            if let Some([m, v]) = &self.adamw.moments[id.index()] {
                tensors.insert(format!("first_moment/{}", p.name()), m.clone());
                tensors.insert(format!("second_moment/{}", p.name()), v.clone());
            }
            if let Some(average) = &self.average {
                tensors.insert(format!("average/{}", p.name()), average.values[id.index()].clone());
            }
        }
        let mut metadata = metadata;
        metadata.insert("steps".into(), self.adamw.steps.to_string());
        safetensors::write(path, &tensors, metadata)
    }

    /// Goes on from a state written by [`save`](Trainer::save); returns the file's metadata. If anything is wrong nothing
    /// is changed but what the next state overwrites.
    pub fn load(&mut self, path: &Path) -> Result<HashMap<String, String>> {
        let mut contents = safetensors::read::<f32>(path)?;
        let broken = |what: &str| Error::file(path, format!("{what}: not a training state of this configuration"));
        let steps = contents.metadata.get("steps").and_then(|s| s.parse().ok());
        self.adamw.steps = steps.ok_or_else(|| broken("the number of steps is missing"))?;
        let ids: Vec<_> = self.params.iter().map(|(id, p)| (id, p.name().to_owned(), *p.value.shape())).collect();
        for (id, name, shape) in ids {
            let mut take = |kind: &str| match contents.tensors.remove(&format!("{kind}/{name}")) {
                Some(t) if *t.shape() != shape => Err(broken(&format!("{kind}/{name} has shape {}", t.shape()))),
                found => Ok(found),
            };
            self.params.set(id, take("weights")?.ok_or_else(|| broken(&format!("{name} is missing")))?);
            self.adamw.moments[id.index()] = match (take("first_moment")?, take("second_moment")?) {
                (Some(m), Some(v)) => Some([m, v]),
                _ => None,
            };
            if let Some(average) = &mut self.average {
                average.values[id.index()] =
                    take("average")?.ok_or_else(|| broken("the averaged weights are missing"))?;
            }
        }
        Ok(contents.metadata)
    }
}
