//! Views of a run's weights for its page: errors beside the truth, warped neighbours and auto-masks, attention, time by op,
//! the camera's path, the worst samples.
//!
//! They lie in `views/`, with two lists of them: `validation.json` (written at validations) and `end.json`.

mod kinds;
mod place;

use std::collections::BTreeMap;

use image::RgbImage;
use serde::{Deserialize, Serialize};

use kinds::{attention_group, error_group, path};
use place::Place;

use super::run::Run;
use super::trainer::transforms;
use crate::data::DataSource;
use crate::data::batch::{Batch, to_images};
use crate::error::Result;
use crate::eval::metrics::Report;
use crate::eval::predictor::Predictor;
use crate::monovit::loss::{Reprojection, photometric};
use crate::networks::{DepthNetwork, Setup};
use crate::nn::{Context, Params};
use crate::report::map::{UNKNOWN, draw_map};
use crate::tensor::{Tensor, Var, profile};

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
}

impl Run {
    /// Leaves the views of a validation.
    pub(super) fn view_validation(&self, shown: &Shown, batch: &Batch) -> Result<()> {
        let place = Place::of(&self.folder)?;
        let predictor = Predictor::new(shown.model, shown.params, &shown.setup);
        let mut groups = Vec::new();
        for i in 0..SAMPLES.min(shown.data.len()) {
            let sample = i * shown.data.len() / SAMPLES;
            groups.extend(error_group(
                &place,
                &predictor,
                shown.data,
                sample,
                &format!("error{i}"),
                "Depth and its error",
            )?);
        }
        groups.extend(self.warps(&place, shown, batch)?);
        groups.extend(attention_group(&place, shown)?);
        let time = match place.read(AT_VALIDATION) {
            Some(before) if !before.time.is_empty() => before.time,
            _ => self.time_by_op(batch)?,
        };
        place.write(AT_VALIDATION, &Views { step: self.trainer.steps(), groups, time, ..Views::default() })
    }

    /// Leaves the views of the end: the camera's path, and the samples with the greatest errors.
    pub(super) fn view_end(&self, shown: &Shown, report: Option<&Report>) -> Result<()> {
        let place = Place::of(&self.folder)?;
        let predictor = Predictor::new(shown.model, shown.params, &shown.setup);
        let mut worst: Vec<_> = report.map_or(Vec::new(), |report| report.per_image.iter().collect());
        worst.sort_by(|a, b| b.metrics.abs_rel.total_cmp(&a.metrics.abs_rel));
        let mut groups = Vec::new();
        for (i, image) in worst.iter().take(3).enumerate() {
            let Some(sample) = (0..shown.data.len()).find(|&s| shown.data.name(s) == image.name) else { continue };
            groups.extend(error_group(&place, &predictor, shown.data, sample, &format!("worst{i}"), "Worst samples")?);
        }
        let scale = report.and_then(|report| report.ratio_median);
        let path = if self.config.sources.in_time() { path(shown, scale.unwrap_or(1.0))? } else { Vec::new() };
        place.write(
            AT_END,
            &Views { step: self.trainer.steps(), groups, path, metres: scale.is_some(), ..Views::default() },
        )
    }

    /// The neighbours of a batch's first sample, warped into its target, and the pixels that auto-masking leaves in.
    fn warps(&self, place: &Place, shown: &Shown, batch: &Batch) -> Result<Option<Group>> {
        let (c, config) = (Context::inference(shown.params), self.config.loss);
        let target = Var::constant(batch.target.clone());
        let disparity = shown.model.disparities(&c, &target).swap_remove(0);
        let depth = disparity.disparity_to_depth(config.min_depth, config.max_depth);
        let plain = Var::constant(batch.pyramid[0].clone());
        let mut views = vec![place.photo("warp-target", "Target", &to_images(&batch.pyramid[0])[0])?];
        let (mut moved, mut still) = (Vec::new(), Vec::new());
        for (i, transform) in transforms(shown.model, &c, batch, &target).iter().enumerate() {
            let source = Var::constant(batch.sources[i].clone());
            let warped = source.warp(&depth, transform, &batch.intrinsics, config.consistent_grid);
            let title = format!("Source {}", i + 1);
            views.push(place.photo(&format!("warp-source{i}"), &title, &to_images(&batch.sources[i])[0])?);
            let picture = &to_images(warped.value())[0];
            views.push(place.photo(&format!("warp-warped{i}"), &format!("{title}, warped"), picture)?);
            moved.push(photometric(&warped, &plain, &config).into_value());
            still.push(photometric(&source, &plain, &config).into_value());
        }
        let picture = &to_images(&batch.pyramid[0])[0];
        let (w, h) = picture.dimensions();
        let pixels = (w * h) as usize;
        let least = |maps: &[Tensor<f32>], i: usize| {
            let errors = maps.iter().map(|map| map.data()[i]);
            if config.reprojection == Reprojection::Minimum {
                errors.fold(f32::INFINITY, f32::min)
            } else {
                errors.sum::<f32>() / maps.len().max(1) as f32
            }
        };
        if moved.is_empty() {
            return Ok(None);
        }
        let errors: Vec<f64> = (0..pixels).map(|i| f64::from(least(&moved, i))).collect();
        let map = draw_map(&errors, (h as usize, w as usize), (w, h), [0.0, 0.3]);
        views.push(place.map("warp-error", "Photometric error, warped", &map, ["0".into(), "0.3".into()])?);
        let kept: Vec<bool> = (0..pixels).map(|i| least(&moved, i) < least(&still, i)).collect();
        let share = kept.iter().filter(|kept| **kept).count() as f64 / pixels as f64;
        let mask = RgbImage::from_fn(w, h, |x, y| match kept[(y * w + x) as usize] {
            true => *picture.get_pixel(x, y),
            false => UNKNOWN,
        });
        let title = format!("Auto-mask: {:.0} % of the pixels are left in, the others grey", 100.0 * share);
        views.push(place.picture("warp-mask", &title, &mask)?);
        Ok(Some(Group { kind: "Warped neighbours and auto-mask".into(), about: "a validation sample".into(), views }))
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
