//! Where frames come from: the embedded street, KITTI raw, recordings in folders, single pictures with ground truth; and what is done to them before training.

pub mod apart;
pub mod aside;
pub mod augment;
pub mod batch;
mod cache;
pub mod camera;
pub mod camera_fit;
pub mod check;
pub mod film;
pub mod frames;
pub mod inputs;

pub mod kitti;
pub mod prepared;
pub mod pyramid;
pub mod resize;
pub mod sensor;
pub mod stereo;
pub mod stills;
mod street;
mod truth;

use std::path::Path;
use std::sync::Arc;

use image::RgbImage;

use self::stereo::Sources;
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

    /// The sample that stands at `index` (below [`len`](DataSource::len)) in an epoch, counted from 0. Data that go on
    /// forever show others in every epoch, whose numbers need not be below `len`; all else are the same in all epochs.
    fn of_epoch(&self, _epoch: u64, index: usize) -> usize {
        index
    }

    /// Is told how many samples have been asked for so far, before those of the next step are: data that are made while
    /// training goes on make what comes next.
    fn about_to_read(&self, _position: u64) {}

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

    /// The name of the recording that a sample belongs to: the same whichever list the data were opened with.
    fn recording(&self, sample: usize) -> String {
        self.place(sample).sequence.to_string()
    }

    /// Where the camera of a sample's target frame stood, where that is known: the rows `[R | C]` that map points of the camera
    /// to the frame of the recording, in metres.
    fn pose(&self, _sample: usize) -> Option<[[f64; 4]; 3]> {
        None
    }

    /// Ground-truth depth of the target frame at its own size, where there is one.
    fn depth(&self, sample: usize) -> Result<Option<DepthMap>>;

    /// Whether a depth of 0 is the sky, which is infinitely far, and not unknown.
    fn zero_depth_is_sky(&self) -> bool {
        false
    }

    /// Where the other camera of a stereo pair stands: the x of the shift that maps points of the sample's camera to
    /// points of the other one, in metres. Minus the baseline if the other one stands to the right; `None` if there is none.
    fn other_camera_at(&self, _sample: usize) -> Option<f64> {
        None
    }

    /// The target frame as the other camera of the stereo pair saw it, at the size the networks see.
    ///
    /// # Errors
    /// If there is none, or it cannot be read.
    fn other_image(&self, sample: usize) -> Result<Arc<RgbImage>> {
        Err(no_second_camera(&self.name(sample)))
    }
}

/// That of a sample that is asked for what a second camera saw, and there is none.
fn no_second_camera(sample: &str) -> Error {
    Error::setting("sources", format!("{sample} has no second camera: train with --sources mono"))
}

/// How a folder is opened.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Opening<'a> {
    /// A list of the samples to take; without, all.
    pub list: Option<&'a Path>,
    /// Height and width at which pictures come out.
    pub size: [usize; 2],
    /// The camera that took the pictures.
    pub camera: camera::Camera,
    /// Whether samples with a frame that cannot be read are left out; they are an error otherwise.
    pub skip_bad_frames: bool,
    /// The frames that a sample needs beside the target.
    pub sources: Sources,
    /// A file of [`prepared`] frames; without, that which lies in the folder, if there is one.
    pub prepared: Option<&'a Path>,
    /// How many bytes of resized pictures are kept in memory.
    pub cache_bytes: usize,
}

impl Opening<'_> {
    /// All samples with both neighbours, at a height and width, by the camera that the folder says.
    pub fn of(size: [usize; 2]) -> Self {
        Opening {
            list: None,
            size,
            camera: camera::Camera::Auto,
            skip_bad_frames: false,
            sources: Sources::Mono,
            prepared: None,
            cache_bytes: frames::Options::default().cache_bytes,
        }
    }
}

/// Opens a folder to train on: KITTI raw by its layout ([`kitti`]), or recordings in another one, any folder of frames among
/// them ([`frames`]).
///
/// # Errors
/// If the folder holds single pictures ([`stills`]), as [`Kitti::open`](kitti::Kitti::open) and [`Frames::open`](frames::Frames::open), and if prepared frames do not belong to the
/// folder's ([`Prepared::open`](prepared::Prepared::open)).
pub fn open_folder(root: &Path, opening: Opening) -> Result<Arc<dyn DataSource>> {
    let Opening { list, size, camera, skip_bad_frames, sources, prepared, cache_bytes } = opening;
    if root.is_file() {
        let message = "is a file: expected a folder of frames, or a film (mp4, mov, mkv, ...) for ffmpeg to take apart";
        return Err(Error::file(root, message));
    }
    if !root.is_dir() {
        let message = "expected a folder of frames, or one in the layout of KITTI raw; check the path";
        return Err(Error::file(root, message));
    }
    if kitti::is_kitti(root)? {
        let (neighbours, stereo) = (sources.in_time(), sources.other_camera());
        let usual = kitti::Options::default();
        let options = kitti::Options { camera, skip_bad_frames, neighbours, stereo, cache_bytes, ..usual };
        let mut kitti = kitti::Kitti::open(root, list, size[0], size[1], options)?;
        if let Some(file) = prepared {
            kitti.pictures_mut().take_from(file, root)?;
        }
        return Ok(Arc::new(kitti));
    }
    if let Some(layout) = stills::Layout::of(root)? {
        let message = format!(
            "has the layout of {}: single pictures with ground truth, on which eval measures; training needs frames that \
             follow one another",
            layout.name()
        );
        return Err(Error::file(root, message));
    }
    let (neighbours, stereo) = (sources.in_time(), sources.other_camera());
    let usual = frames::Options::default();
    let options = frames::Options { camera, skip_bad_frames, neighbours, stereo, cache_bytes, ..usual };
    let mut frames = frames::Frames::open(root, list, size, options)?;
    if let Some(file) = prepared {
        frames.pictures_mut().take_from(file, root)?;
    }
    Ok(Arc::new(frames))
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
    fn recording(&self, sample: usize) -> String {
        self.data.recording(self.samples[sample])
    }
    fn pose(&self, sample: usize) -> Option<[[f64; 4]; 3]> {
        self.data.pose(self.samples[sample])
    }
    fn depth(&self, sample: usize) -> Result<Option<DepthMap>> {
        self.data.depth(self.samples[sample])
    }
    fn zero_depth_is_sky(&self) -> bool {
        self.data.zero_depth_is_sky()
    }
    fn other_camera_at(&self, sample: usize) -> Option<f64> {
        self.data.other_camera_at(self.samples[sample])
    }
    fn other_image(&self, sample: usize) -> Result<Arc<RgbImage>> {
        self.data.other_image(self.samples[sample])
    }
}
