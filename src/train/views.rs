//! Views of a run's weights for its page: errors beside the truth, warped neighbours and auto-masks, attention, time by op,
//! the camera's path, the worst samples.
//!
//! They lie in `views/`, with two lists of them: `validation.json` (written at validations) and `end.json`.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use image::RgbImage;
use image::codecs::jpeg::JpegEncoder;
use serde::{Deserialize, Serialize};

use super::run::{Run, VIEWS};
use super::trainer::transforms;
use crate::data::DataSource;
use crate::data::batch::{Batch, to_images, to_tensor};
use crate::error::{Error, Result};
use crate::eval::attention::attention;
use crate::eval::metrics::Report;
use crate::eval::odometry::{Odometry, joined};
use crate::eval::predictor::Predictor;
use crate::eval::trajectory::Pose;
use crate::formats::atomic::write_bytes_atomically;
use crate::formats::png::write_png;
use crate::monovit::loss::{Reprojection, photometric};
use crate::monovit::{MonoVit, Setup};
use crate::nn::{Context, Params};
use crate::report::map::{UNKNOWN, draw_map, draw_values};
use crate::report::overlay::{Overlay, mark};
use crate::tensor::{Tensor, Var, profile};

/// The list that validations write.
pub const AT_VALIDATION: &str = "validation.json";
/// The list that the end of a run writes.
pub const AT_END: &str = "end.json";

/// How many samples are shown of a kind.
const SAMPLES: usize = 2;
/// The most frames of the camera's path.
const PATH: usize = 100;
/// The error, as a share of the true depth, that is brightest.
const WORST: f64 = 0.5;
/// Query pixels of attention: row and column, as shares of the picture.
const QUERIES: [[f64; 2]; 3] = [[0.8, 0.5], [0.55, 0.2], [0.5, 0.75]];

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
    pub model: &'a MonoVit,
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

/// A frame, its predicted depth, the true one, and the error as a share of it; nothing where there is no truth.
fn error_group(
    place: &Place,
    predictor: &Predictor,
    data: &dyn DataSource,
    sample: usize,
    name: &str,
    kind: &str,
) -> Result<Option<Group>> {
    let Some(truth) = data.depth(sample)? else { return Ok(None) };
    let image = data.image(sample, 0)?;
    let size = image.dimensions();
    let found = predictor.inverse_depth(&image, false).resized(truth.height, truth.width, 1.0);
    let known: Vec<usize> = (0..truth.metres.len()).filter(|&i| (1e-3..=80.0).contains(&truth.metres[i])).collect();
    if known.is_empty() || !found.is_whole() {
        return Ok(None);
    }
    let scale = median(known.iter().map(|&i| f64::from(truth.metres[i])))
        / median(known.iter().map(|&i| 1.0 / f64::from(found.values[i])));
    let depth = |i: usize| scale / f64::from(found.values[i]);
    let error = |i: usize| (depth(i) - f64::from(truth.metres[i])).abs() / f64::from(truth.metres[i]);
    let dims = (truth.height, truth.width);
    let near = known.iter().map(|&i| truth.metres[i]).fold(f32::INFINITY, f32::min).max(1.0);
    let range = [0.0, 1.0 / f64::from(near)];
    let bar = || ["far".to_owned(), format!("{near:.1} m")];
    let reach = if known.len() * 3 < truth.metres.len() { 2 } else { 0 };
    let draw = |of: &dyn Fn(usize) -> f64, range| {
        draw_values(known.iter().map(|&i| (i / dims.1, i % dims.1, of(i))), dims, size, range, reach)
    };
    let whole: Vec<f64> = (0..truth.metres.len()).map(|i| 1.0 / depth(i)).collect();
    let mean = known.iter().map(|&i| error(i)).sum::<f64>() / known.len() as f64;
    let views = vec![
        place.photo(&format!("{name}-frame"), "Frame", &image)?,
        place.map(
            &format!("{name}-depth"),
            "Predicted depth, at the truth's median",
            &draw_map(&whole, dims, size, range),
            bar(),
        )?,
        place.map(
            &format!("{name}-truth"),
            "True depth",
            &draw(&|i| 1.0 / f64::from(truth.metres[i]), range),
            bar(),
        )?,
        place.map(
            &format!("{name}-error"),
            "Error over true depth",
            &draw(&error, [0.0, WORST]),
            ["0".into(), format!("{:.0} % and more", 100.0 * WORST)],
        )?,
    ];
    Ok(Some(Group { kind: kind.into(), about: format!("{}, Abs Rel {mean:.3}", data.name(sample)), views }))
}

/// The places that a few pixels of the first sample look at; nothing in networks without transformer paths.
fn attention_group(place: &Place, shown: &Shown) -> Result<Option<Group>> {
    let image = shown.data.image(0, 0)?;
    let (w, h) = image.dimensions();
    let (seen, overlay) = (to_tensor(&[&image]), Overlay::new(&image));
    let mut views = Vec::new();
    for (i, [y, x]) in QUERIES.into_iter().enumerate() {
        let pixel = [(y * f64::from(h)) as usize, (x * f64::from(w)) as usize];
        let found = attention(shown.model, shown.params, &seen, pixel);
        // The last layer of the first path, at 1/8 of the picture: fine enough to be seen.
        let Some(rows) = found.rows.iter().rfind(|rows| rows.stage == 1 && rows.path == 0) else { continue };
        let map = rows.mean();
        let &[rows, columns] = map.dims() else { unreachable!("maps have two dimensions") };
        let mut made = overlay.signed(map.data(), (rows, columns));
        mark(&mut made, pixel[1] as f32, pixel[0] as f32);
        views.push(place.photo(
            &format!("attention{i}"),
            &format!("Pixel {}, {} (ring)", pixel[1], pixel[0]),
            &made,
        )?);
    }
    let about =
        format!("{}: warm is looked at, cold is looked away from (last layer at 1/8 of the size)", shown.data.name(0));
    Ok((!views.is_empty()).then(|| Group { kind: "Attention of query pixels".into(), about, views }))
}

/// The camera's path over frames that follow one another, from above; empty if there are no such frames at the beginning.
fn path(shown: &Shown, scale: f64) -> Result<Vec<[f64; 2]>> {
    let data = shown.data;
    let follows = |&sample: &usize| {
        let (a, b) = (data.place(sample), data.place(sample + 1));
        data.recording(sample) == data.recording(sample + 1) && b.sequence == a.sequence && b.frame == a.frame + 1
    };
    let count = (0..data.len().saturating_sub(1)).take_while(follows).take(PATH).count();
    let odometry = Odometry::new(shown.model, shown.params, &shown.setup);
    let motion = |i: usize| odometry.motion(&*data.image(i, 0)?, &*data.image(i + 1, 0)?);
    let motions: Vec<Pose> = (0..count).map(motion).collect::<Result<_>>()?;
    let place = |pose: Pose| [pose.position()[0], pose.position()[2]];
    Ok(if count == 0 { Vec::new() } else { joined(&motions, scale).into_iter().map(place).collect() })
}

/// The middle of some numbers.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_unstable_by(f64::total_cmp);
    values[values.len() / 2]
}

/// The folder of views.
struct Place(PathBuf);

impl Place {
    fn of(run: &Path) -> Result<Self> {
        let folder = run.join(VIEWS);
        fs::create_dir_all(&folder).map_err(|e| Error::io(&folder, e))?;
        Ok(Place(folder))
    }

    fn read(&self, list: &str) -> Option<Views> {
        serde_json::from_slice(&fs::read(self.0.join(list)).ok()?).ok()
    }

    fn write(&self, list: &str, views: &Views) -> Result<()> {
        let text = serde_json::to_string(views).map_err(|e| Error::Failed(format!("the views: {e}")))?;
        write_bytes_atomically(self.0.join(list), text.as_bytes())
    }

    /// A photograph, as JPEG.
    fn photo(&self, name: &str, title: &str, picture: &RgbImage) -> Result<View> {
        let file = format!("{name}.jpg");
        let path = self.0.join(&file);
        let mut jpeg = Vec::new();
        let made = picture.write_with_encoder(JpegEncoder::new_with_quality(&mut jpeg, 85));
        made.map_err(|e| Error::file(&path, format!("could not be made: {e}")))?;
        write_bytes_atomically(&path, &jpeg)?;
        Ok(View { file, title: title.into(), bar: None })
    }

    /// A picture, as PNG.
    fn picture(&self, name: &str, title: &str, picture: &RgbImage) -> Result<View> {
        let file = format!("{name}.png");
        write_png(self.0.join(&file), picture)?;
        Ok(View { file, title: title.into(), bar: None })
    }

    /// A map in magma, as PNG.
    fn map(&self, name: &str, title: &str, picture: &RgbImage, bar: [String; 2]) -> Result<View> {
        Ok(View { bar: Some(bar), ..self.picture(name, title, picture)? })
    }
}
