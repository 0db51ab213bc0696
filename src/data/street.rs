//! The embedded street as a data set: every frame that has both neighbours, with its exact depth.

use std::sync::Arc;

use image::RgbImage;

use super::{DataSource, Place};
use crate::camera::Intrinsics;
use crate::depth::DepthMap;
use crate::street::Street;
use crate::{Error, Result};

impl DataSource for Street {
    fn len(&self) -> usize {
        self.samples()
    }

    fn name(&self, sample: usize) -> String {
        let (sequence, frame) = self.locate(sample);
        format!("street seed {}, sequence {sequence}, frame {frame}", self.config().seed)
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

    fn intrinsics(&self, _sample: usize) -> Intrinsics {
        self.config().intrinsics
    }

    fn place(&self, sample: usize) -> Place {
        let (sequence, frame) = self.locate(sample);
        Place { sequence, frame }
    }

    fn depth(&self, sample: usize) -> Result<Option<DepthMap>> {
        let (sequence, frame) = self.locate(sample);
        Ok(Some(self.frame_depth(sequence, frame)))
    }
}
