//! Batches: triplets of frames as tensors, augmented, made ahead of time on a thread of their own.
//!
//! What a batch holds is a function of the seed and the step alone, so a resumed run sees what it would have seen.

use std::collections::HashSet;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use image::RgbImage;
use serde::{Deserialize, Serialize};

use super::DataSource;
use super::augment::{Jitter, flip};
use super::resize::lanczos;
use super::sensor::Sensor;
use super::stereo::{Baseline, Sources};
use crate::camera::Intrinsics;
use crate::error::{Error, Result};
use crate::random::{Random, Stream};
use crate::tensor::Tensor;

/// What is done to samples before training.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Augment {
    /// Mirror a sample with probability 1/2.
    pub flip: bool,
    /// Change its colours with probability 1/2: the networks see the changed images, the loss the plain ones.
    pub jitter: bool,
    /// Show the networks what [another camera or another weather](super::sensor) would have made of it; the loss the plain
    /// images.
    pub sensor: bool,
}

impl Default for Augment {
    fn default() -> Self {
        Augment { flip: true, jitter: true, sensor: false }
    }
}

/// How samples become batches.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Making {
    /// Augmentation of samples.
    pub augment: Augment,
    /// The frames that targets are compared with.
    pub sources: Sources,
    /// The unit of the distance between two cameras.
    pub baseline: Baseline,
    /// Whether batches hold the targets' depth.
    pub depth: bool,
}

impl From<Augment> for Making {
    /// Of neighbours in time alone.
    fn from(augment: Augment) -> Self {
        Making { augment, ..Making::default() }
    }
}

/// A batch of targets and what they are compared with, images as `[B, h, w, 3]` in [0, 1].
#[derive(Clone, Debug)]
pub struct Batch {
    /// The plain target at 1, 1/2, 1/4, 1/8 of its size.
    pub pyramid: Vec<Tensor<f32>>,
    /// The plain sources: previous and next frame if there are [`neighbours`](Batch::neighbours), the other camera's
    /// if there are [`shifts`](Batch::shifts); in this order.
    pub sources: Vec<Tensor<f32>>,
    /// The target as the networks see it.
    pub target: Tensor<f32>,
    /// The previous and the next frame as the networks see them, if targets are compared with them.
    pub neighbours: Option<[Tensor<f32>; 2]>,
    /// The x of the shift from each sample's camera to the other one, if targets are compared with its frames: points
    /// move by it, in the unit of depth. Mirrored with the pictures.
    pub shifts: Option<Vec<f64>>,
    /// fx, fy, cx, cy of each sample in pixels.
    pub intrinsics: Vec<[f64; 4]>,
    /// The targets' depth `[B, h, w, 1]` in metres, if it is asked for: 0 where it is unknown, infinite in the sky.
    pub depth: Option<Tensor<f32>>,
}

impl Batch {
    /// Targets and their neighbours in time, which the networks see as they are.
    pub fn in_time(pyramid: Vec<Tensor<f32>>, neighbours: [Tensor<f32>; 2], intrinsics: Vec<[f64; 4]>) -> Self {
        let (target, sources) = (pyramid[0].clone(), neighbours.to_vec());
        Batch { pyramid, sources, target, neighbours: Some(neighbours), shifts: None, intrinsics, depth: None }
    }

    /// The sources at 1/2, 1/4, 1/8 of their size, made like the target's pyramid: for each scale all sources,
    /// `[B, h, w, 3]`.
    pub fn smaller_sources(&self) -> Vec<Vec<Tensor<f32>>> {
        let mut images: Vec<_> = self.sources.iter().map(to_images).collect();
        let smaller = (1..SCALES).map(|_| {
            for image in images.iter_mut().flatten() {
                *image = lanczos(image, image.width() / 2, image.height() / 2);
            }
            images.iter().map(|of| to_tensor(&of.iter().collect::<Vec<_>>())).collect()
        });
        smaller.collect()
    }

    /// The rows `[R | t]` that map points of the targets' cameras to the other ones, `[B, 3, 4]`, if targets are
    /// compared with what those saw: rectified cameras look the same way, and stand beside one another.
    pub fn to_other_camera(&self) -> Option<Tensor<f32>> {
        let shifts = self.shifts.as_ref()?;
        let rows = |&x: &f64| [1.0, 0.0, 0.0, x as f32, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        Some(Tensor::from_vec([shifts.len(), 3, 4], shifts.iter().flat_map(rows).collect()))
    }
}

/// The 8-bit images that a tensor was made of by [`to_tensor`].
pub(crate) fn to_images(tensor: &Tensor<f32>) -> Vec<RgbImage> {
    let [_, h, w, _] = tensor.shape().nhwc().expect("images");
    let image = |pixels: &[f32]| {
        let bytes = pixels.iter().map(|&x| (x * 255.0).round() as u8).collect();
        RgbImage::from_raw(w as u32, h as u32, bytes).expect("three bytes a pixel")
    };
    tensor.data().chunks_exact(3 * h * w).map(image).collect()
}

/// Images of one size side by side, as `[B, h, w, 3]` in [0, 1].
///
/// # Panics
/// If their sizes differ.
pub fn to_tensor(images: &[&RgbImage]) -> Tensor<f32> {
    let (w, h) = images.first().map_or((0, 0), |i| i.dimensions());
    assert!(images.iter().all(|i| i.dimensions() == (w, h)), "images of one size");
    Tensor::build([images.len(), h as usize, w as usize, 3], |out| {
        let bytes = images.iter().flat_map(|i| i.as_raw());
        out.iter_mut().zip(bytes).for_each(|(x, &b)| *x = b as f32 * (1.0 / 255.0));
    })
}

/// Intrinsics in pixels: fx, fy, cx, cy.
pub fn in_pixels(camera: Intrinsics, width: usize, height: usize) -> [f64; 4] {
    let (w, h) = (width as f64, height as f64);
    [camera.fx * w, camera.fy * h, camera.cx * w, camera.cy * h]
}

/// The samples of a step: every epoch is a new order of all samples; a batch may straddle two.
pub fn samples_of_step(len: usize, batch: usize, seed: u64, step: u64) -> Vec<usize> {
    let mut orders: Vec<(u64, Vec<usize>)> = Vec::new();
    let positions = (step * batch as u64..).take(batch);
    positions
        .map(|at| {
            let epoch = at / len as u64;
            if orders.last().is_none_or(|(e, _)| *e != epoch) {
                let mut order: Vec<usize> = (0..len).collect();
                Random::of(seed, Stream::Order(epoch)).shuffle(&mut order);
                orders.push((epoch, order));
            }
            orders[orders.len() - 1].1[(at % len as u64) as usize]
        })
        .collect()
}

/// Scales of the target that the loss looks at.
const SCALES: usize = 4;

/// The samples that are passed over because a frame of theirs cannot be read; shared by all that read them.
#[derive(Clone, Debug, Default)]
pub struct SkipList(Arc<Mutex<Skipped>>);

#[derive(Debug, Default)]
struct Skipped {
    names: HashSet<String>,
    first: Option<String>,
}

impl SkipList {
    fn skipped(&self) -> MutexGuard<'_, Skipped> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a sample by its name, and why; whether it is new.
    pub fn add(&self, name: &str, why: &str) -> bool {
        let mut skipped = self.skipped();
        skipped.first.get_or_insert_with(|| format!("{name}: {why}"));
        skipped.names.insert(name.to_owned())
    }

    /// How many samples are passed over.
    pub fn count(&self) -> usize {
        self.skipped().names.len()
    }

    /// The first of them, and why.
    pub fn first(&self) -> Option<String> {
        self.skipped().first.clone()
    }

    fn has(&self, name: &str) -> bool {
        self.skipped().names.contains(name)
    }

    /// The frames of a sample, or of the next one after it that can be read.
    fn read(&self, data: &dyn DataSource, sample: usize, sources: Sources) -> Result<(usize, Frames)> {
        for sample in (sample..data.len()).chain(0..sample) {
            let name = data.name(sample);
            if self.has(&name) {
                continue;
            }
            match Frames::read(data, sample, sources) {
                Ok(frames) => return Ok((sample, frames)),
                Err(error) => drop(self.add(&name, &error.to_string())),
            }
        }
        let first = self.first().unwrap_or_default();
        Err(Error::Failed(format!("none of the {} samples can be read; the first: {first}", data.len())))
    }
}

/// The frames of a sample.
struct Frames {
    target: Arc<RgbImage>,
    /// The previous and the next one.
    neighbours: Option<[Arc<RgbImage>; 2]>,
    /// The other camera's, and the x of the shift to it in metres.
    other: Option<(Arc<RgbImage>, f64)>,
}

impl Frames {
    fn read(data: &dyn DataSource, sample: usize, sources: Sources) -> Result<Frames> {
        let neighbours = || Ok::<_, Error>([data.image(sample, -1)?, data.image(sample, 1)?]);
        let neighbours = sources.in_time().then(neighbours).transpose()?;
        let other = match sources.other_camera() {
            true => {
                let image = data.other_image(sample)?;
                let unknown =
                    || Error::setting("sources", format!("{}: its second camera stands nowhere", data.name(sample)));
                Some((image, data.other_camera_at(sample).ok_or_else(unknown)?))
            }
            false => None,
        };
        Ok(Frames { target: data.image(sample, 0)?, neighbours, other })
    }

    /// As in a mirror: what stood to the right stands to the left.
    fn mirrored(self) -> Frames {
        let flip = |image: Arc<RgbImage>| Arc::new(flip(&image));
        Frames {
            target: flip(self.target),
            neighbours: self.neighbours.map(|both| both.map(flip)),
            other: self.other.map(|(image, shift)| (flip(image), -shift)),
        }
    }
}

/// The batch of a step (from 0).
///
/// # Errors
/// If a frame cannot be read.
pub fn batch_of_step(
    data: &dyn DataSource,
    making: impl Into<Making>,
    batch: usize,
    seed: u64,
    step: u64,
) -> Result<Batch> {
    assemble(data, making.into(), batch, seed, step, None)
}

/// The batch of a step (from 0), in which the next sample that can be read stands for one that cannot: that is put on the
/// list. All other samples, and what is done to them, are as in [`batch_of_step`].
///
/// # Errors
/// If no sample can be read.
pub fn batch_of_readable(
    data: &dyn DataSource,
    making: impl Into<Making>,
    batch: usize,
    seed: u64,
    step: u64,
    skip: &SkipList,
) -> Result<Batch> {
    assemble(data, making.into(), batch, seed, step, Some(skip))
}

fn assemble(
    data: &dyn DataSource,
    making: Making,
    batch: usize,
    seed: u64,
    step: u64,
    skip: Option<&SkipList>,
) -> Result<Batch> {
    let Making { augment, sources, baseline, depth } = making;
    let samples = samples_of_step(data.len(), batch, seed, step);
    let mut random = Random::of(seed, Stream::Augmentation(step));
    let mut stacks = Stacks::default();
    for sample in samples {
        let (mirrored, jitter) = (random.coin() && augment.flip, Jitter::draw(random.chacha()));
        let jitter = jitter.filter(|_| augment.jitter);
        let sensor = augment.sensor.then(|| Sensor::draw(random.chacha()));
        let (sample, frames) = match skip {
            Some(skip) => skip.read(data, sample, sources)?,
            None => (sample, Frames::read(data, sample, sources)?),
        };
        let frames = if mirrored { frames.mirrored() } else { frames };
        let (w, h) = frames.target.dimensions();
        let camera = if mirrored { data.mirrored_intrinsics(sample, w as usize) } else { data.intrinsics(sample) };
        stacks.intrinsics.push(in_pixels(camera, w as usize, h as usize));
        if depth {
            stacks.depths.push(depth_of(data, sample, [h as usize, w as usize], mirrored)?);
        }
        stacks.add(frames, &Seen { jitter, sensor }, baseline);
    }
    Ok(stacks.batch())
}

/// The depth of a sample's target at `[h, w]` pixels, the nearest ones of the ground truth: metres, 0 for unknown, infinite
/// for the sky; unknown everywhere if there is none.
///
/// # Errors
/// If it cannot be read.
fn depth_of(data: &dyn DataSource, sample: usize, [h, w]: [usize; 2], mirrored: bool) -> Result<Vec<f32>> {
    let Some(map) = data.depth(sample)? else { return Ok(vec![0.0; h * w]) };
    let sky = if data.zero_depth_is_sky() { f32::INFINITY } else { 0.0 };
    let pixel = |y: usize, x: usize| {
        let x = if mirrored { w - 1 - x } else { x };
        let nearest = |at: usize, of: usize, size: usize| ((2 * at + 1) * size / (2 * of)).min(size - 1);
        let metres = map.metres[nearest(y, h, map.height) * map.width + nearest(x, w, map.width)];
        if metres > 0.0 { metres } else { sky }
    };
    Ok((0..h).flat_map(|y| (0..w).map(move |x| (y, x))).map(|(y, x)| pixel(y, x)).collect())
}

/// How the networks see the frames of a sample.
struct Seen {
    jitter: Option<Jitter>,
    sensor: Option<Sensor>,
}

impl Seen {
    fn of(&self, image: &Arc<RgbImage>, frame: u64) -> Arc<RgbImage> {
        let jittered = self.jitter.as_ref().map_or_else(|| image.clone(), |jitter| Arc::new(jitter.apply(image)));
        self.sensor.as_ref().map_or(jittered.clone(), |sensor| Arc::new(sensor.apply(&jittered, frame)))
    }
}

/// The images of a batch while it grows.
#[derive(Default)]
struct Stacks {
    pyramids: [Vec<Arc<RgbImage>>; SCALES],
    target: Vec<Arc<RgbImage>>,
    plain_neighbours: [Vec<Arc<RgbImage>>; 2],
    neighbours: [Vec<Arc<RgbImage>>; 2],
    other: Vec<Arc<RgbImage>>,
    shifts: Vec<f64>,
    intrinsics: Vec<[f64; 4]>,
    depths: Vec<Vec<f32>>,
}

impl Stacks {
    fn add(&mut self, frames: Frames, seen: &Seen, baseline: Baseline) {
        self.target.push(seen.of(&frames.target, 0));
        let mut smaller = frames.target;
        for (scale, pyramid) in self.pyramids.iter_mut().enumerate() {
            if scale > 0 {
                smaller = Arc::new(lanczos(&smaller, smaller.width() / 2, smaller.height() / 2));
            }
            pyramid.push(smaller.clone());
        }
        for (i, image) in frames.neighbours.into_iter().flatten().enumerate() {
            self.neighbours[i].push(seen.of(&image, 1 + i as u64));
            self.plain_neighbours[i].push(image);
        }
        if let Some((image, metres)) = frames.other {
            self.other.push(image);
            self.shifts.push(baseline.shift(metres));
        }
    }

    fn batch(self) -> Batch {
        let tensor = |images: Vec<Arc<RgbImage>>| to_tensor(&images.iter().map(Arc::as_ref).collect::<Vec<_>>());
        let size = self.target[0].dimensions();
        let depth = (!self.depths.is_empty()).then(|| {
            let shape = [self.depths.len(), size.1 as usize, size.0 as usize, 1];
            Tensor::from_vec(shape, self.depths.concat())
        });
        let sources = self.plain_neighbours.into_iter().chain([self.other]).filter(|images| !images.is_empty());
        Batch {
            sources: sources.map(tensor).collect(),
            pyramid: self.pyramids.map(tensor).into(),
            target: tensor(self.target),
            neighbours: (!self.neighbours[0].is_empty()).then(|| self.neighbours.map(tensor)),
            shifts: (!self.shifts.is_empty()).then_some(self.shifts),
            intrinsics: self.intrinsics,
            depth,
        }
    }
}

/// A thread that makes the batches of consecutive steps, a few ahead.
pub struct Loader {
    batches: Option<Receiver<Result<Batch>>>,
    thread: Option<JoinHandle<()>>,
    /// Why there are no more batches.
    stopped: Option<Error>,
}

/// An error that says the same.
fn again(error: &Error) -> Error {
    match error {
        Error::Io { path, source } => Error::io(path, std::io::Error::new(source.kind(), source.to_string())),
        Error::File { path, message } => Error::file(path, message),
        Error::Setting { name, message } => Error::setting(name, message),
        Error::Failed(message) => Error::Failed(message.clone()),
    }
}

impl Loader {
    /// Starts at `first_step` (from 0). A sample that cannot be read is an error; with a list to `skip` it is put there,
    /// and another one stands for it.
    ///
    /// # Errors
    /// If there are fewer samples than a batch holds.
    pub fn start(
        data: Arc<dyn DataSource>,
        making: impl Into<Making>,
        batch: usize,
        seed: u64,
        first_step: u64,
        skip: Option<SkipList>,
    ) -> Result<Self> {
        if batch == 0 || data.len() < batch {
            let message = format!("{batch} samples a batch, but the data holds {}: make it smaller", data.len());
            return Err(Error::setting("batch", message));
        }
        let making = making.into();
        let (send, batches) = sync_channel(3);
        let thread = std::thread::spawn(move || {
            for step in first_step.. {
                let make = || assemble(data.as_ref(), making, batch, seed, step, skip.as_ref());
                // A panic becomes an error of this step, not a thread that is gone.
                let made = catch_unwind(AssertUnwindSafe(make)).unwrap_or_else(|_| {
                    let samples = samples_of_step(data.len(), batch, seed, step);
                    let names: Vec<String> = samples.into_iter().map(|sample| data.name(sample)).collect();
                    Err(Error::Failed(format!(
                        "the batch of step {} could not be made ({})",
                        step + 1,
                        names.join(", ")
                    )))
                });
                let last = made.is_err();
                // The other end hangs up when training is over.
                if send.send(made).is_err() || last {
                    break;
                }
            }
        });
        Ok(Loader { batches: Some(batches), thread: Some(thread), stopped: None })
    }

    /// The next batch.
    ///
    /// # Errors
    /// If it could not be made; from then on always the same.
    pub fn next_batch(&mut self) -> Result<Batch> {
        if let Some(error) = &self.stopped {
            return Err(again(error));
        }
        let batches = self.batches.as_ref().expect("there until dropped");
        let stopped = |_| Err(Error::Failed("the thread that makes batches has stopped".into()));
        let next = batches.recv().unwrap_or_else(stopped);
        self.stopped = next.as_ref().err().map(again);
        next
    }
}

impl Drop for Loader {
    fn drop(&mut self) {
        self.batches = None;
        if let Some(thread) = self.thread.take() {
            // A panic there was reported by the missing batch already.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::street::{Street, StreetConfig};
    use crate::tensor::Var;

    #[test]
    fn smaller_sources_are_made_like_the_pyramid_of_the_target() {
        let config = StreetConfig { height: 64, width: 96, sequences: 1, frames: 5, ..StreetConfig::default() };
        let street = Street::render(&config, None);
        let plain = Augment { flip: false, jitter: false, sensor: false };
        let mut batch = batch_of_step(&street, plain, 2, 0, 0).unwrap();
        batch.sources[1] = batch.pyramid[0].clone();
        let smaller = batch.smaller_sources();
        assert_eq!(smaller.len(), 3);
        for (scale, of) in smaller.iter().enumerate() {
            let [previous, next] = &of[..] else { panic!("two sources") };
            assert!(next.same_bits(&batch.pyramid[scale + 1]), "scale {}", scale + 1);
            assert!(!previous.same_bits(next));
        }
    }

    /// The mean difference between a batch's targets and its next frames, warped by true depths and poses, sample by
    /// sample.
    fn warped_with_the_truth(street: &Street, batch: &Batch, samples: &[usize], mirrored: &[bool]) -> Vec<f64> {
        let (height, width) = (street.config().height, street.config().width);
        let (mut depths, mut poses) = (Vec::new(), Vec::new());
        for (&sample, &mirrored) in samples.iter().zip(mirrored) {
            let depth = street.depth(sample).unwrap().unwrap();
            let metres: Vec<f32> = depth.metres.iter().map(|&m| if m > 0.0 { m } else { 500.0 }).collect();
            depths.extend(if mirrored { crate::eval::metrics::mirror(&metres, width) } else { metres });
            // With x the other way round on both sides.
            let sign = |axis: usize| if mirrored && axis == 0 { -1.0 } else { 1.0 };
            for (i, row) in street.relative_pose(sample, 1).iter().enumerate() {
                poses.extend((0..4).map(|j| (row[j] * sign(i) * sign(j)) as f32));
            }
        }
        let tensor =
            |shape: &[usize], values: &[f32]| Var::constant(Tensor::build(shape, |out| out.copy_from_slice(values)));
        let depth = tensor(&[samples.len(), height, width, 1], &depths);
        let pose = tensor(&[samples.len(), 3, 4], &poses);
        let warped = Var::constant(batch.sources[1].clone()).warp(&depth, &pose, &batch.intrinsics, true);
        let each = 3 * height * width;
        let pairs = warped.value().data().chunks(each).zip(batch.pyramid[0].data().chunks(each));
        let sum = |(a, b): (&[f32], &[f32])| a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs())).sum::<f64>();
        pairs.map(|pair| sum(pair) / each as f64).collect()
    }

    #[test]
    fn known_depth_is_mirrored_with_the_pictures_and_the_sky_is_far() {
        let street = Street::render(&StreetConfig { sequences: 2, frames: 6, ..StreetConfig::default() }, None);
        let making = |flip: bool, depth: bool| Making {
            augment: Augment { flip, jitter: false, sensor: false },
            depth,
            ..Making::default()
        };
        let of = |flip: bool| batch_of_step(&street, making(flip, true), 4, 0, 0).unwrap();
        let (plain, mixed) = (of(false), of(true));
        assert!(batch_of_step(&street, making(false, false), 4, 0, 0).unwrap().depth.is_none());
        let (plain_depth, mixed_depth) = (plain.depth.unwrap(), mixed.depth.unwrap());
        assert_eq!(plain_depth.shape().dims(), [4, 96, 320, 1]);
        let (pictures, each) = (plain.pyramid[0].data(), 96 * 320);
        for (i, &sample) in samples_of_step(street.len(), 4, 0, 0).iter().enumerate() {
            let truth = street.depth(sample).unwrap().unwrap().metres;
            let far: Vec<f32> = truth.iter().map(|&m| if m > 0.0 { m } else { f32::INFINITY }).collect();
            assert_eq!(plain_depth.data()[i * each..][..each], far);
            let mirrored = pictures[3 * i * each..][..3 * each] != mixed.pyramid[0].data()[3 * i * each..][..3 * each];
            let expected = if mirrored { crate::eval::metrics::mirror(&far, 320) } else { far };
            assert_eq!(mixed_depth.data()[i * each..][..each], expected);
        }
    }

    #[test]
    fn a_sensor_changes_what_the_networks_see_and_not_what_the_loss_compares() {
        let street = Street::render(&StreetConfig { sequences: 1, frames: 6, ..StreetConfig::default() }, None);
        let of = |sensor: bool| batch_of_step(&street, Augment { flip: true, jitter: false, sensor }, 1, 0, 0).unwrap();
        let (plain, sensed) = (of(false), of(true));
        assert!(plain.pyramid[0].same_bits(&sensed.pyramid[0]) && plain.sources[1].same_bits(&sensed.sources[1]));
        assert!(!plain.target.same_bits(&sensed.target) && sensed.target.same_bits(&of(true).target));
    }

    #[test]
    fn a_mirrored_street_warps_as_well_as_the_street() {
        let street = Street::render(&StreetConfig { sequences: 2, frames: 6, ..StreetConfig::default() }, None);
        let samples = samples_of_step(street.len(), 4, 0, 0);
        let of = |flip: bool| batch_of_step(&street, Augment { flip, jitter: false, sensor: false }, 4, 0, 0).unwrap();
        let (plain, mixed) = (of(false), of(true));
        let each = 3 * 96 * 320;
        let parts = plain.pyramid[0].data().chunks(each).zip(mixed.pyramid[0].data().chunks(each));
        let mirrored: Vec<bool> = parts.map(|(a, b)| a != b).collect();
        assert!(mirrored.contains(&true) && mirrored.contains(&false), "{mirrored:?}");
        let found = warped_with_the_truth(&street, &plain, &samples, &[false; 4]);
        let again = warped_with_the_truth(&street, &mixed, &samples, &mirrored);
        for (a, b) in found.iter().zip(&again) {
            assert!((a / b - 1.0).abs() < 1e-4, "{found:?} {again:?}");
        }
        // A pixel beside the true principal point is seen: the comparison above is worth something.
        let mut beside = mixed;
        for (k, &mirrored) in beside.intrinsics.iter_mut().zip(&mirrored) {
            assert_eq!(k[2], if mirrored { 159.0 } else { 160.0 });
            k[2] = 160.0;
        }
        let beside = warped_with_the_truth(&street, &beside, &samples, &mirrored);
        assert!(beside.iter().zip(&again).zip(&mirrored).all(|((a, b), &m)| (a != b) == m), "{beside:?} {again:?}");
    }

    /// The mean difference between targets and what the other camera saw, warped by true depths and `metres` to it.
    fn warped_from_the_other_camera(street: &Street, batch: &Batch, samples: &[usize], mirrored: &[bool]) -> f64 {
        let (height, width) = (street.config().height, street.config().width);
        let mut depths = Vec::new();
        for (&sample, &mirrored) in samples.iter().zip(mirrored) {
            let depth = street.depth(sample).unwrap().unwrap();
            let metres: Vec<f32> = depth.metres.iter().map(|&m| if m > 0.0 { m } else { 500.0 }).collect();
            depths.extend(if mirrored { crate::eval::metrics::mirror(&metres, width) } else { metres });
        }
        let depth = Var::constant(Tensor::from_vec([samples.len(), height, width, 1], depths));
        let transform = Var::constant(batch.to_other_camera().unwrap());
        let other = batch.sources.last().unwrap().clone();
        let warped = Var::constant(other).warp(&depth, &transform, &batch.intrinsics, true);
        let pairs = warped.value().data().iter().zip(batch.pyramid[0].data());
        pairs.map(|(a, b)| f64::from((a - b).abs())).sum::<f64>() / batch.pyramid[0].len() as f64
    }

    #[test]
    fn the_other_camera_of_a_pair_is_where_the_batch_says_also_in_a_mirror() {
        let config = StreetConfig { sequences: 2, frames: 5, baseline: 0.54, ..StreetConfig::default() };
        let street = Street::render(&config, None);
        let samples = samples_of_step(street.len(), 4, 0, 0);
        let of = |flip: bool, sources: Sources| {
            let augment = Augment { flip, jitter: false, sensor: false };
            batch_of_step(&street, Making { augment, sources, ..Making::default() }, 4, 0, 0).unwrap()
        };
        let (plain, mixed) = (of(false, Sources::Both), of(true, Sources::Both));
        let each = 3 * 96 * 320;
        let parts = plain.pyramid[0].data().chunks(each).zip(mixed.pyramid[0].data().chunks(each));
        let mirrored: Vec<bool> = parts.map(|(a, b)| a != b).collect();
        assert!(mirrored.contains(&true) && mirrored.contains(&false), "{mirrored:?}");
        let shifts: Vec<f64> = mirrored.iter().map(|&m| if m { 0.54 } else { -0.54 }).collect();
        assert_eq!(mixed.shifts.as_ref(), Some(&shifts));

        let good = warped_from_the_other_camera(&street, &plain, &samples, &[false; 4]);
        let again = warped_from_the_other_camera(&street, &mixed, &samples, &mirrored);
        assert!((good / again - 1.0).abs() < 1e-3, "{good} {again}");
        // The wrong side, or another distance, is seen.
        for factor in [-1.0, 0.0, 0.8, 1.25] {
            let mut wrong = plain.clone();
            wrong.shifts.iter_mut().flatten().for_each(|shift| *shift *= factor);
            let wrong = warped_from_the_other_camera(&street, &wrong, &samples, &[false; 4]);
            assert!(wrong > 1.2 * good, "{factor}: {wrong} {good}");
        }

        let (stereo, mono) = (of(true, Sources::Stereo), of(true, Sources::Mono));
        assert_eq!((mono.sources.len(), mixed.sources.len(), stereo.sources.len()), (2, 3, 1));
        assert!(mono.shifts.is_none() && stereo.neighbours.is_none());
        assert!(stereo.sources[0].same_bits(&mixed.sources[2]) && mono.sources[1].same_bits(&mixed.sources[1]));
        assert!(mono.target.same_bits(&stereo.target));
    }

    #[test]
    fn a_street_of_one_camera_has_no_pairs() {
        let config = StreetConfig { height: 32, width: 64, sequences: 1, frames: 4, ..StreetConfig::default() };
        let making = Making { sources: Sources::Stereo, ..Making::default() };
        let error = batch_of_step(&Street::render(&config, None), making, 1, 0, 0).unwrap_err().to_string();
        assert!(error.contains("frame 1 has no second camera") || error.contains("frame 2 has no second"), "{error}");
        assert!(error.contains("--sources mono"), "{error}");
    }

    /// A street of which some samples cannot be read.
    struct Damaged(Street, fn(usize) -> bool);

    impl DataSource for Damaged {
        fn len(&self) -> usize {
            self.0.len()
        }
        fn name(&self, sample: usize) -> String {
            format!("sample {sample}")
        }
        fn image(&self, sample: usize, offset: i32) -> Result<Arc<RgbImage>> {
            match (self.1)(sample) && offset == 1 {
                true => Err(Error::file("lost.png", format!("number {sample} cannot be decoded"))),
                false => self.0.image(sample, offset),
            }
        }
        fn intrinsics(&self, sample: usize) -> Intrinsics {
            self.0.intrinsics(sample)
        }
        fn depth(&self, _sample: usize) -> Result<Option<crate::depth::DepthMap>> {
            Ok(None)
        }
    }

    fn damaged(bad: fn(usize) -> bool) -> Arc<Damaged> {
        let config = StreetConfig { height: 64, width: 96, sequences: 1, frames: 8, ..StreetConfig::default() };
        Arc::new(Damaged(Street::render(&config, None), bad))
    }

    #[test]
    fn what_stopped_the_batches_is_said_as_often_as_it_is_asked() {
        let mut loader = Loader::start(damaged(|_| true), Augment::default(), 2, 0, 0, None).unwrap();
        let first = loader.next_batch().unwrap_err();
        assert!(matches!(&first, Error::File { path, .. } if path.ends_with("lost.png")), "{first}");
        for _ in 0..3 {
            let later = loader.next_batch().unwrap_err();
            assert!(matches!(later, Error::File { .. }));
            assert_eq!(later.to_string(), first.to_string());
        }
    }

    #[test]
    fn samples_that_cannot_be_read_are_passed_over_and_counted() {
        let bad = |sample| sample == 1 || sample == 2;
        let (data, skip) = (damaged(bad), SkipList::default());
        let plain = Augment { flip: true, jitter: false, sensor: false };
        let mut loader = Loader::start(data.clone(), plain, 3, 5, 0, Some(skip.clone())).unwrap();
        let again = SkipList::default();
        for step in 0..4 {
            let batch = loader.next_batch().unwrap();
            // The others are what they would be without; 3 stands for 1 and 2.
            let whole = batch_of_step(&data.0, plain, 3, 5, step).unwrap();
            let known = batch_of_readable(data.as_ref(), plain, 3, 5, step, &again).unwrap();
            assert!(batch.sources[1].same_bits(&known.sources[1]), "whether it is known beforehand is no matter");
            let each = 3 * 64 * 96;
            for (i, sample) in samples_of_step(6, 3, 5, step).into_iter().enumerate() {
                let of = |batch: &Batch| batch.pyramid[0].data()[i * each..][..each].to_vec();
                assert_eq!(of(&batch) == of(&whole), !bad(sample), "sample {sample}");
                if bad(sample) {
                    let three = data.0.image(3, 0).unwrap();
                    let both = [to_tensor(&[&three]), to_tensor(&[&flip(&three)])];
                    assert!(both.iter().any(|image| image.data() == of(&batch)));
                }
            }
        }
        assert_eq!(skip.count(), 2);
        let first = skip.first().unwrap();
        assert!(first.starts_with("sample ") && first.contains("lost.png") && first.contains("decoded"), "{first}");

        let error = batch_of_readable(damaged(|_| true).as_ref(), plain, 1, 0, 0, &SkipList::default()).unwrap_err();
        assert!(error.to_string().contains("none of the 6 samples can be read"), "{error}");
    }

    #[test]
    fn every_epoch_sees_every_sample_once() {
        let seen: Vec<usize> = (0..5).flat_map(|step| samples_of_step(10, 4, 3, step)).collect();
        for epoch in seen.chunks(10) {
            let mut sorted = epoch.to_vec();
            sorted.sort_unstable();
            assert_eq!(sorted, (0..10).collect::<Vec<_>>());
        }
        assert_ne!(seen[..10], seen[10..], "a new order each epoch");
    }
}
