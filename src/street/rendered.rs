//! The street as a dataset: sequences rendered once, kept as pictures; depth is cast again when it is asked for.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use image::RgbImage;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::camera::{Pose, winding};
use super::draw::Draw;
use super::sequence::{PATH, Sequence, usual_path};
use super::world::World;
use crate::camera::Intrinsics;
use crate::depth::DepthMap;

/// The worlds that sequences are rendered from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WorldKind {
    /// The embedded street, which figures are compared on.
    #[default]
    #[serde(rename = "street-1")]
    Street1,
    /// Roads of many kinds, each with a camera of its own around the configuration's; for networks that are to see real
    /// pictures.
    #[serde(rename = "street-2")]
    Street2,
}

/// Settings of the rendered street: size, number of sequences and frames, seed, camera.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StreetConfig {
    /// Height of the pictures in pixels.
    pub height: usize,
    /// Width of the pictures in pixels.
    pub width: usize,
    /// How many sequences, each a street of its own.
    pub sequences: usize,
    /// Frames of each sequence; the first and the last are only neighbours.
    pub frames: usize,
    /// Everything follows from it.
    pub seed: u64,
    /// Which world.
    pub world: WorldKind,
    /// Whether every sequence of `street-2` has a lens of its own around `intrinsics`.
    pub own_lenses: bool,
    /// Whether other cars drive too: self-supervision takes a static world, so this is off by default.
    pub moving_cars: bool,
    /// The camera.
    pub intrinsics: Intrinsics,
    /// How far to the right a second camera stands, in metres; without one if 0.
    pub baseline: f64,
}

impl Default for StreetConfig {
    fn default() -> Self {
        StreetConfig {
            height: 96,
            width: 320,
            sequences: 40,
            frames: 24,
            seed: 0,
            world: WorldKind::Street1,
            own_lenses: false,
            moving_cars: false,
            intrinsics: Intrinsics::KITTI,
            baseline: 0.0,
        }
    }
}

/// Rendered streets, with exact depth and poses. A sample is a frame that has both neighbours.
pub struct Street {
    config: StreetConfig,
    sequences: Vec<Sequence>,
}

impl Street {
    /// Renders all sequences, on rayon's threads; the pictures are the same for any number of them. `progress` gets the
    /// number of frames done and of all, from any thread.
    pub fn render(config: &StreetConfig, progress: Option<&(dyn Fn(usize, usize) + Sync)>) -> Street {
        Street::film(config, &|k, world| usual_path(config, k, world), progress)
    }

    /// Renders the streets of `config` along paths that wind, `rate` degrees a frame to one side, then to the other. All else
    /// is as in [`Street::render`].
    pub fn render_winding(
        config: &StreetConfig,
        rate: f64,
        progress: Option<&(dyn Fn(usize, usize) + Sync)>,
    ) -> Street {
        let path = |k: usize, world: &World| {
            let mut draw = Draw::new(config.seed, k as u64, PATH);
            let speed = draw.range(0.55, 0.95);
            winding(&mut draw, config.frames, world.lane, rate, speed)
        };
        Street::film(config, &path, progress)
    }

    /// Renders the streets of `config` along given paths, one a sequence: camera poses, one a frame. Its `sequences` and
    /// `frames` are those of the paths. All else is as in [`Street::render`]; nothing keeps a path out of walls.
    ///
    /// # Panics
    /// If the paths differ in length.
    pub fn render_along(
        config: &StreetConfig,
        paths: &[Vec<Pose>],
        progress: Option<&(dyn Fn(usize, usize) + Sync)>,
    ) -> Street {
        let frames = paths.first().map_or(0, Vec::len);
        assert!(paths.iter().all(|path| path.len() == frames), "render_along: paths of one length expected");
        let config = StreetConfig { sequences: paths.len(), frames, ..config.clone() };
        Street::film(&config, &|k, _| paths[k].clone(), progress)
    }

    /// Renders every sequence along the path that `path` gives for its number and its world.
    fn film(
        config: &StreetConfig,
        path: &(dyn Fn(usize, &World) -> Vec<Pose> + Sync),
        progress: Option<&(dyn Fn(usize, usize) + Sync)>,
    ) -> Street {
        let cameras = if config.baseline == 0.0 { 1 } else { 2 };
        let total = config.sequences * config.frames * cameras;
        let done = AtomicUsize::new(0);
        let one_more = || {
            let done = done.fetch_add(1, Ordering::Relaxed) + 1;
            if let Some(progress) = progress {
                progress(done, total);
            }
        };
        let sequence = |k: usize| Sequence::film(config, k, path, &one_more);
        Street { config: config.clone(), sequences: (0..config.sequences).into_par_iter().map(sequence).collect() }
    }

    /// Settings with which it was rendered.
    pub fn config(&self) -> &StreetConfig {
        &self.config
    }

    /// The camera of a sequence. Panics if there is no such sequence.
    pub fn camera(&self, sequence: usize) -> Intrinsics {
        self.sequences[sequence].intrinsics
    }

    /// The camera's poses in a sequence, one a frame. Panics if there is no such sequence.
    pub fn poses(&self, sequence: usize) -> &[Pose] {
        &self.sequences[sequence].poses
    }

    /// A frame of a sequence. Panics if there is none such.
    pub fn frame(&self, sequence: usize, frame: usize) -> &Arc<RgbImage> {
        &self.sequences[sequence].images[frame]
    }

    /// A frame of a sequence as the second camera saw it, if there is one. Panics if there is no such frame.
    pub fn right_frame(&self, sequence: usize, frame: usize) -> Option<&Arc<RgbImage>> {
        let sequence = &self.sequences[sequence];
        (!sequence.right.is_empty()).then(|| &sequence.right[frame])
    }

    /// The depth of a frame at the pixels' centres: camera z in metres, 0 for the sky. Panics if there is none such.
    pub fn frame_depth(&self, sequence: usize, frame: usize) -> DepthMap {
        self.sequences[sequence].depth(&self.config, frame)
    }

    /// How many samples there are: frames that have both neighbours.
    pub fn samples(&self) -> usize {
        self.sequences.len() * self.config.frames.saturating_sub(2)
    }

    /// The sequence and the frame of a sample. Panics if there is no such sample.
    pub fn locate(&self, sample: usize) -> (usize, usize) {
        assert!(sample < self.samples(), "the street has {} samples, not one numbered {sample}", self.samples());
        let each = self.config.frames - 2;
        (sample / each, sample % each + 1)
    }

    /// The rows `[R | t]` that map points of a sample's camera to the camera of its neighbour at `offset`, in metres.
    /// Panics if the sequence has no such frame.
    pub fn relative_pose(&self, sample: usize, offset: i32) -> [[f64; 4]; 3] {
        let (sequence, frame) = self.locate(sample);
        let poses = self.poses(sequence);
        let source = frame.checked_add_signed(offset as isize).and_then(|f| poses.get(f));
        let source = source.unwrap_or_else(|| panic!("sequence {sequence} has no frame {frame}{offset:+}"));
        poses[frame].relative_to(source)
    }
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;
