//! Rendered streets as data sets, of a given length or endless: every frame that has both neighbours, with its exact depth.

use std::sync::Arc;

use image::RgbImage;

use super::{DataSource, Place, no_second_camera};
use crate::camera::Intrinsics;
use crate::depth::DepthMap;
use crate::street::{Endless, Street, StreetConfig, WorldKind};
use crate::{Error, Result};

/// The name of a sequence. Streets of different seeds share nothing.
fn recording(config: &StreetConfig, sequence: usize) -> String {
    let world = match config.world {
        WorldKind::Street1 => "street",
        WorldKind::Street2 => "street-2",
    };
    format!("{world} seed {}, sequence {sequence}", config.seed)
}

/// The number of the frame at an offset from another one.
fn neighbour(frame: usize, offset: i32, frames: usize, sample: &str) -> Result<usize> {
    frame
        .checked_add_signed(offset as isize)
        .filter(|f| *f < frames)
        .ok_or_else(|| Error::setting("offset", format!("{sample}: no frame at {offset:+}; the sequence has {frames}")))
}

impl DataSource for Street {
    fn len(&self) -> usize {
        self.samples()
    }

    fn name(&self, sample: usize) -> String {
        format!("{}, frame {}", self.recording(sample), self.locate(sample).1)
    }

    fn recording(&self, sample: usize) -> String {
        recording(self.config(), self.locate(sample).0)
    }

    fn image(&self, sample: usize, offset: i32) -> Result<Arc<RgbImage>> {
        let (sequence, frame) = self.locate(sample);
        let frames = self.config().frames;
        let frame = neighbour(frame, offset, frames, &self.name(sample))?;
        Ok(self.frame(sequence, frame).clone())
    }

    fn intrinsics(&self, sample: usize) -> Intrinsics {
        self.camera(self.locate(sample).0)
    }

    fn place(&self, sample: usize) -> Place {
        let (sequence, frame) = self.locate(sample);
        Place { sequence, frame }
    }

    fn zero_depth_is_sky(&self) -> bool {
        true
    }

    fn other_camera_at(&self, _sample: usize) -> Option<f64> {
        let baseline = self.config().baseline;
        (baseline != 0.0).then_some(-baseline)
    }

    fn other_image(&self, sample: usize) -> Result<Arc<RgbImage>> {
        let (sequence, frame) = self.locate(sample);
        let without = || no_second_camera(&self.name(sample));
        self.right_frame(sequence, frame).cloned().ok_or_else(without)
    }

    fn pose(&self, sample: usize) -> Option<[[f64; 4]; 3]> {
        let (sequence, frame) = self.locate(sample);
        Some(self.poses(sequence)[frame].matrix())
    }

    fn depth(&self, sample: usize) -> Result<Option<DepthMap>> {
        let (sequence, frame) = self.locate(sample);
        Ok(Some(self.frame_depth(sequence, frame)))
    }
}

impl DataSource for Endless {
    /// Those of one epoch.
    fn len(&self) -> usize {
        self.samples()
    }

    fn of_epoch(&self, epoch: u64, index: usize) -> usize {
        Endless::of_epoch(self, epoch, index)
    }

    fn about_to_read(&self, position: u64) {
        Endless::about_to_read(self, position);
    }

    fn name(&self, sample: usize) -> String {
        format!("{}, frame {}", self.recording(sample), self.locate(sample).1)
    }

    fn recording(&self, sample: usize) -> String {
        recording(self.config(), self.locate(sample).0)
    }

    fn image(&self, sample: usize, offset: i32) -> Result<Arc<RgbImage>> {
        let (sequence, frame) = self.locate(sample);
        let frame = neighbour(frame, offset, self.config().frames, &self.name(sample))?;
        Ok(self.frame(sequence, frame))
    }

    fn intrinsics(&self, sample: usize) -> Intrinsics {
        self.camera(self.locate(sample).0)
    }

    fn place(&self, sample: usize) -> Place {
        let (sequence, frame) = self.locate(sample);
        Place { sequence, frame }
    }

    fn zero_depth_is_sky(&self) -> bool {
        true
    }

    fn depth(&self, sample: usize) -> Result<Option<DepthMap>> {
        let (sequence, frame) = self.locate(sample);
        Ok(Some(self.frame_depth(sequence, frame)))
    }
}
