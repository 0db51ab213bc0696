//! Where frames come from: the embedded street, KITTI raw, any folder, single pictures with ground truth; and what is done to them before training.

pub mod aside;
pub mod augment;
pub mod batch;
mod cache;
pub mod camera;
pub mod check;
pub mod frames;
pub mod inputs;

pub mod kitti;
pub mod pyramid;
pub mod resize;
pub mod stills;
mod street;

use std::path::Path;
use std::sync::Arc;

use image::RgbImage;

use crate::camera::Intrinsics;
use crate::depth::DepthMap;
use crate::{Error, Result};

/// Where a sample lies in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Place {
    /// The recording: cameras side by side are one.
    pub sequence: usize,
    /// The number of the target frame in it.
    pub frame: usize,
}

/// Samples for training and evaluation: each a target frame with its neighbours in time.
pub trait DataSource: Send + Sync {
    /// How many samples there are.
    fn len(&self) -> usize;

    /// Whether there is none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// A name for messages: drive and frame.
    fn name(&self, sample: usize) -> String;

    /// The frame at `offset` (-1 previous, 0 target, +1 next) of a sample, at the size the networks see.
    fn image(&self, sample: usize, offset: i32) -> Result<Arc<RgbImage>>;

    /// The camera of a sample.
    fn intrinsics(&self, sample: usize) -> Intrinsics;

    /// The camera of a sample's pictures once they are mirrored and `width` pixels wide: its principal point is mirrored
    /// with them.
    fn mirrored_intrinsics(&self, sample: usize, width: usize) -> Intrinsics {
        augment::flip_intrinsics(self.intrinsics(sample), width)
    }

    /// The cameras of all samples in words, each once: intrinsics, and where they were found.
    fn cameras(&self) -> Vec<String> {
        Vec::new()
    }

    /// The samples that were left out when the data were opened because a frame of theirs cannot be read: name, and why.
    fn unreadable(&self) -> &[(String, String)] {
        &[]
    }

    /// Where a sample lies: frames that follow one another in a sequence look alike.
    fn place(&self, sample: usize) -> Place {
        Place { sequence: 0, frame: sample }
    }

    /// Ground-truth depth of the target frame at its own size, where there is one.
    fn depth(&self, sample: usize) -> Result<Option<DepthMap>>;
}

/// Opens a folder to train on: KITTI raw by its layout ([`kitti`]), or any folder of frames ([`frames`]). Of the samples,
/// all with both neighbours, those that a list names, or all; pictures come out at `[height, width]` pixels.
///
/// # Errors
/// As [`Kitti::open`](kitti::Kitti::open) and [`Frames::open`](frames::Frames::open), and for a layout of single pictures
/// ([`stills`]).
pub fn open_folder(
    root: &Path,
    list: Option<&Path>,
    size: [usize; 2],
    camera: camera::Camera,
    skip_bad_frames: bool,
) -> Result<Arc<dyn DataSource>> {
    if root.is_file() {
        let message = "is a file: make a folder of frames of a film, for example with ffmpeg -i FILM -qscale:v 2 -vf \
                       fps=10 FRAMES/%06d.jpg";
        return Err(Error::file(root, message));
    }
    if !root.is_dir() {
        let message = "expected a folder of frames, or one in the layout of KITTI raw; check the path";
        return Err(Error::file(root, message));
    }
    if kitti::is_kitti(root)? {
        let options = kitti::Options { camera, skip_bad_frames, ..kitti::Options::default() };
        return Ok(Arc::new(kitti::Kitti::open(root, list, size[0], size[1], options)?));
    }
    if let Some(layout) = stills::Layout::of(root)? {
        let message = format!(
            "has the layout of {}: single pictures with ground truth, on which eval measures; training needs frames that \
             follow one another",
            layout.name()
        );
        return Err(Error::file(root, message));
    }
    let options = frames::Options { camera, skip_bad_frames, ..frames::Options::default() };
    Ok(Arc::new(frames::Frames::open(root, list, size, options)?))
}

/// Some samples of a data set.
pub struct Subset {
    data: Arc<dyn DataSource>,
    samples: Vec<usize>,
}

impl Subset {
    /// Those with the given indices.
    pub fn new(data: Arc<dyn DataSource>, samples: Vec<usize>) -> Self {
        Subset { data, samples }
    }
}

impl DataSource for Subset {
    fn len(&self) -> usize {
        self.samples.len()
    }
    fn name(&self, sample: usize) -> String {
        self.data.name(self.samples[sample])
    }
    fn image(&self, sample: usize, offset: i32) -> Result<Arc<RgbImage>> {
        self.data.image(self.samples[sample], offset)
    }
    fn intrinsics(&self, sample: usize) -> Intrinsics {
        self.data.intrinsics(self.samples[sample])
    }
    fn mirrored_intrinsics(&self, sample: usize, width: usize) -> Intrinsics {
        self.data.mirrored_intrinsics(self.samples[sample], width)
    }
    fn cameras(&self) -> Vec<String> {
        self.data.cameras()
    }
    fn unreadable(&self) -> &[(String, String)] {
        self.data.unreadable()
    }
    fn place(&self, sample: usize) -> Place {
        self.data.place(self.samples[sample])
    }
    fn depth(&self, sample: usize) -> Result<Option<DepthMap>> {
        self.data.depth(self.samples[sample])
    }
}
