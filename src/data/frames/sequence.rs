//! A recording whose pictures were looked at: its camera is known.

use std::path::{Path, PathBuf};

use super::Options;
use super::recording::{FrameFiles, Recording, name_of};
use crate::Result;
use crate::camera::Intrinsics;
use crate::data::camera::Found;
use crate::data::kitti::Side;
use crate::depth::DepthMap;

/// Frames of one camera, in order.
pub(super) struct Sequence {
    name: String,
    side: Option<Side>,
    /// The name of the recording, which cameras side by side share.
    pub(super) recording: String,
    pub(super) frames: Vec<FrameFiles>,
    /// Of the rows that are used.
    pub(super) camera: Found,
    /// The x of the shift of points to the other camera, in metres, where pairs are asked for and known.
    pub(super) other_at: Option<f64>,
    other_found: String,
    used_rows: f64,
}

impl Sequence {
    /// Finds the camera of a recording whose pictures have a size, and where the other camera stands.
    ///
    /// # Errors
    /// If nothing is known of the camera, or what is said cannot be.
    pub(super) fn new(
        root: &Path,
        recording: Recording,
        size: (u32, u32),
        used_rows: f64,
        options: Options,
    ) -> Result<Sequence> {
        let Recording { name, side, path, frames, calibration, other_at } = recording;
        let calibrated = calibration.map(|read| move || read(size));
        let calibrated = calibrated.as_ref().map(|read| read as &dyn Fn() -> Result<Found>);
        let mut camera = options.camera.resolve(root, &path, size, calibrated)?;
        if !camera.published {
            camera.intrinsics = of_upper_rows(camera.intrinsics, used_rows);
        }
        let paired = options.stereo && frames.iter().any(|frame| frame.other.is_some());
        let (other_at, other_found) = match other_at.filter(|_| paired) {
            Some(read) => read().map(|(metres, place)| (Some(metres), place))?,
            None => (None, String::new()),
        };
        let recording = name.clone();
        Ok(Sequence { name, side, recording, frames, camera, other_at, other_found, used_rows })
    }

    pub(super) fn name_of(&self, frame: usize) -> String {
        name_of(&self.name, &self.frames[frame].label, self.side)
    }

    /// The frame at an offset in time of another one.
    pub(super) fn at(&self, frame: usize, offset: i32) -> Option<usize> {
        let there = frame.checked_add_signed(offset as isize)?;
        let number = self.frames[frame].number.checked_add_signed(offset as isize)?;
        (self.frames.get(there)?.number == number).then_some(there)
    }

    /// Where a frame's depth was looked for, if it is not there.
    pub(super) fn missing_depth(&self, frame: usize) -> Option<PathBuf> {
        match &self.frames[frame].depth {
            Some(depth) => Some(depth.path().to_owned()).filter(|path| !path.is_file()),
            None => Some(self.frames[frame].picture.clone()),
        }
    }

    /// The depth of a frame, of the rows that are used, if it is there.
    pub(super) fn depth(&self, frame: usize) -> Result<Option<DepthMap>> {
        let Some(depth) = self.frames[frame].depth.as_ref().filter(|depth| depth.path().is_file()) else {
            return Ok(None);
        };
        let mut map = depth.read()?;
        map.height = used(map.height, self.used_rows);
        map.metres.truncate(map.width * map.height);
        Ok(Some(map))
    }

    pub(super) fn pair_in_words(&self) -> Option<String> {
        let metres = self.other_at?.abs();
        Some(format!("pairs {metres:.4} m apart ({})", self.other_found))
    }
}

/// How many of `rows` are used, of which `share` is.
pub(in crate::data) fn used(rows: usize, share: f64) -> usize {
    ((rows as f64 * share).round() as usize).clamp(1, rows.max(1))
}

/// The camera of a share of a picture's rows, from the top: what is measured in heights grows.
fn of_upper_rows(camera: Intrinsics, share: f64) -> Intrinsics {
    Intrinsics { fy: camera.fy / share, cy: camera.cy / share, ..camera }
}
