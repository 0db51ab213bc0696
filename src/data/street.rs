//! The embedded street as a data set: every frame that has both neighbours, with its exact depth.

use std::sync::Arc;

use image::RgbImage;

use super::{DataSource, Place, no_second_camera};
use crate::camera::Intrinsics;
use crate::depth::DepthMap;
use crate::street::{Street, StreetConfig, WorldKind};
use crate::{Error, Result};

impl DataSource for Street {
    fn len(&self) -> usize {
        self.samples()
    }

    fn name(&self, sample: usize) -> String {
        format!("{}, frame {}", self.recording(sample), self.locate(sample).1)
    }

    /// Streets of different seeds share nothing.
    fn recording(&self, sample: usize) -> String {
        let StreetConfig { world, seed, .. } = self.config();
        let world = match world {
            WorldKind::Street1 => "street",
            WorldKind::Street2 => "street-2",
        };
        format!("{world} seed {seed}, sequence {}", self.locate(sample).0)
    }

    fn image(&self, sample: usize, offset: i32) -> Result<Arc<RgbImage>> {
        let (sequence, frame) = self.locate(sample);
        let frames = self.config().frames;
        match frame.checked_add_signed(offset as isize).filter(|f| *f < frames) {
            Some(frame) => Ok(self.frame(sequence, frame).clone()),
            None => {
                let message = format!("{}: no frame at {offset:+}; the sequence has {frames}", self.name(sample));
                Err(Error::setting("offset", message))
            }
        }
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

    fn depth(&self, sample: usize) -> Result<Option<DepthMap>> {
        let (sequence, frame) = self.locate(sample);
        Ok(Some(self.frame_depth(sequence, frame)))
    }
}
