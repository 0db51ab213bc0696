//! Batches: triplets of frames as tensors, augmented, made ahead of time on a thread of their own.
//!
//! What a batch holds is a function of the seed and the step alone, so a resumed run sees what it would have seen. `order`
//! says which samples a step takes, `frames` reads them, `skip` passes over those that cannot be read, `stacks` joins them,
//! `loader` runs ahead.

mod frames;
mod loader;
mod order;
mod skip;
mod stacks;

use image::RgbImage;
use serde::{Deserialize, Serialize};

use super::DataSource;
use super::augment::Jitter;
use super::resize::lanczos;
use super::sensor::Sensor;
use super::stereo::{Baseline, Sources};
use crate::camera::Intrinsics;
use crate::error::Result;
use crate::random::{Random, Stream};
use crate::tensor::Tensor;
use frames::{Frames, depth_of};
pub use loader::Loader;
pub use order::{epoch_and_place, samples_of_step};
pub use skip::SkipList;
use stacks::{SCALES, Seen, Stacks};

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
    data.about_to_read(step * batch as u64);
    let samples = order::of_step(data, batch, seed, step);
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
#[cfg(test)]
mod tests;
