//! Views of a run's weights for its page: errors beside the truth, warped neighbours and auto-masks, attention, time by op,
//! the camera's path, the worst samples.
//!
//! They lie in `views/`, with two lists of them: `validation.json` (written at validations) and `end.json`.

mod kinds;
mod late;
mod path;
mod place;
mod warps;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use kinds::{attention_group, error_group};
pub use late::make_views;
use path::path;
use place::Place;
use warps::warps;

use super::recipe::RunConfig;
use super::run::Run;
use crate::data::DataSource;
use crate::data::batch::Batch;
use crate::error::Result;
use crate::eval::metrics::Report;
use crate::eval::predictor::Predictor;
use crate::networks::{DepthNetwork, Setup};
use crate::nn::Params;
use crate::tensor::profile;

/// The list that validations write.
pub const AT_VALIDATION: &str = "validation.json";
/// The list that the end of a run writes.
pub const AT_END: &str = "end.json";

/// How many samples are shown of a kind.
const SAMPLES: usize = 2;

/// A list of views.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Views {
    /// The step of the weights.
    pub step: u64,
    /// Pictures.
    pub groups: Vec<Group>,
    /// Seconds of a training step by op, longest first; the first validation of a run measures it.
    pub time: Vec<(String, f64)>,
    /// The camera from above: x (right) and z (forward) of every frame, relative to the first.
    pub path: Vec<[f64; 2]>,
    /// The way that the camera really went, likewise, in metres; empty where that is not known.
    pub true_path: Vec<[f64; 2]>,
    /// The root of the mean squared distance between both, in metres, once the one is laid over the other as well as it can
    /// be; nothing where the true one is not known, or either does not move.
    pub path_error: Option<f64>,
    /// Whether the path is in metres, otherwise in the unit of predicted depth.
    pub metres: bool,
}

/// Pictures that belong together.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Group {
    /// The kind of view.
    pub kind: String,
    /// The sample's name, and figures of it.
    pub about: String,
    /// The pictures.
    pub views: Vec<View>,
}

/// A picture.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct View {
    /// The file's name in `views/`.
    pub file: String,
    /// A title for it.
    pub title: String,
    /// The meanings of the colour bar's dark and bright end, of a map in magma.
    pub bar: Option<[String; 2]>,
}

/// Weights and data to show.
pub(super) struct Shown<'a> {
    pub model: &'a DepthNetwork,
    pub params: &'a Params<f32>,
    pub setup: Setup,
    pub data: &'a dyn DataSource,
    /// The step of the weights.
    pub step: u64,
}

impl Shown<'_> {
    /// The views of a validation, without the time of a step; warped neighbours are those of a batch's first sample.
    fn of_validation(&self, place: &Place, config: &RunConfig, batch: &Batch) -> Result<Views> {
        let predictor = Predictor::new(self.model, self.params, &self.setup);
        let mut groups = Vec::new();
        for i in 0..SAMPLES.min(self.data.len()) {
            let sample = i * self.data.len() / SAMPLES;
            let name = format!("error{i}");
            groups.extend(error_group(place, &predictor, self.data, sample, &name, "Depth and its error")?);
        }
        groups.extend(warps(place, self, config.loss, batch)?);
        groups.extend(attention_group(place, self)?);
        Ok(Views { step: self.step, groups, ..Views::default() })
    }

    /// The views of the end: the camera's path, and the samples of a report with the greatest errors.
    fn of_end(&self, place: &Place, config: &RunConfig, report: Option<&Report>) -> Result<Views> {
        let predictor = Predictor::new(self.model, self.params, &self.setup);
        let mut worst: Vec<_> = report.map_or(Vec::new(), |report| report.per_image.iter().collect());
        worst.sort_by(|a, b| b.metrics.abs_rel.total_cmp(&a.metrics.abs_rel));
        let mut groups = Vec::new();
        for (i, image) in worst.iter().take(3).enumerate() {
            let Some(sample) = (0..self.data.len()).find(|&s| self.data.name(s) == image.name) else { continue };
            groups.extend(error_group(place, &predictor, self.data, sample, &format!("worst{i}"), "Worst samples")?);
        }
        let views = Views { step: self.step, groups, ..Views::default() };
        let scale = report.and_then(|report| report.ratio_median);
        if config.sources.in_time() { path(self, scale, views) } else { Ok(views) }
    }
}

impl Run {
    /// Leaves the views of a validation.
    pub(super) fn view_validation(&self, shown: &Shown, batch: &Batch) -> Result<Views> {
        let place = Place::of(&self.folder)?;
        let mut views = shown.of_validation(&place, &self.config, batch)?;
        views.time = match place.read(AT_VALIDATION) {
            Some(before) if !before.time.is_empty() => before.time,
            _ => self.time_by_op(batch)?,
        };
        place.write(AT_VALIDATION, &views)?;
        Ok(views)
    }

    /// Leaves the views of the end.
    pub(super) fn view_end(&self, shown: &Shown, report: Option<&Report>) -> Result<()> {
        let place = Place::of(&self.folder)?;
        place.write(AT_END, &shown.of_end(&place, &self.config, report)?)
    }

    /// The time of a step's ops and other parts, forward and backward; no weight is changed.
    fn time_by_op(&self, batch: &Batch) -> Result<Vec<(String, f64)>> {
        let (done, profile) = profile::profile(|| self.trainer.rehearse(batch));
        done?;
        let mut times: BTreeMap<&str, f64> = BTreeMap::new();
        for entry in &profile.ops {
            *times.entry(entry.op).or_default() += (entry.forward + entry.backward).as_secs_f64();
        }
        for phase in &profile.phases {
            *times.entry(phase.name).or_default() += phase.time.as_secs_f64();
        }
        let rest = profile.total.saturating_sub(profile.accounted()).as_secs_f64();
        let mut times: Vec<(String, f64)> = times.into_iter().map(|(name, t)| (name.to_owned(), t)).collect();
        times.push(("not in any op".into(), rest));
        times.sort_by(|a, b| b.1.total_cmp(&a.1));
        Ok(times)
    }
}
