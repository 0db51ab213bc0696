//! The images of a batch while it grows.

use std::sync::Arc;

use image::RgbImage;

use super::frames::Frames;
use super::{Batch, to_tensor};
use crate::data::augment::Jitter;
use crate::data::resize::lanczos;
use crate::data::sensor::Sensor;
use crate::data::stereo::Baseline;
use crate::tensor::Tensor;

/// Scales of the target that the loss looks at.
pub(super) const SCALES: usize = 4;
/// How the networks see the frames of a sample.
pub(super) struct Seen {
    pub(super) jitter: Option<Jitter>,
    pub(super) sensor: Option<Sensor>,
}

impl Seen {
    fn of(&self, image: &Arc<RgbImage>, frame: u64) -> Arc<RgbImage> {
        let jittered = self.jitter.as_ref().map_or_else(|| image.clone(), |jitter| Arc::new(jitter.apply(image)));
        self.sensor.as_ref().map_or(jittered.clone(), |sensor| Arc::new(sensor.apply(&jittered, frame)))
    }
}

/// The images of a batch while it grows.
#[derive(Default)]
pub(super) struct Stacks {
    pyramids: [Vec<Arc<RgbImage>>; SCALES],
    target: Vec<Arc<RgbImage>>,
    plain_neighbours: [Vec<Arc<RgbImage>>; 2],
    neighbours: [Vec<Arc<RgbImage>>; 2],
    other: Vec<Arc<RgbImage>>,
    shifts: Vec<f64>,
    pub(super) intrinsics: Vec<[f64; 4]>,
    pub(super) depths: Vec<Vec<f32>>,
}

impl Stacks {
    pub(super) fn add(&mut self, frames: Frames, seen: &Seen, baseline: Baseline) {
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

    pub(super) fn batch(self) -> Batch {
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
