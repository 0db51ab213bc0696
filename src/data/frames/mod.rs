//! Recordings in files, frame after frame: any folder of pictures, KITTI odometry, Cityscapes' video.
//!
//! A layout ([`Layout`]) says which files belong together; one file of this folder for each. [`Frames`] is the data set that
//! they make.

mod cityscapes;
mod folder;
mod list;
mod odometry;
mod recording;
mod sequence;
#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::RgbImage;

use self::recording::Recording;
use self::sequence::Sequence;
pub(super) use self::sequence::used;
use super::cache::Pictures;
use super::camera::{self, Camera};
use super::inputs::natural_order_of_paths;
use super::kitti::LeftOut;
use super::{DataSource, Place, no_second_camera};
use crate::camera::Intrinsics;
use crate::depth::DepthMap;
use crate::{Error, Result};

/// How recordings lie in a folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// Every folder that holds pictures is a recording.
    Folder,
    /// `sequences/NN/image_2/000000.png`, `sequences/NN/calib.txt`.
    KittiOdometry,
    /// `leftImg8bit_sequence/SPLIT/CITY/CITY_SEQ_FRAME_leftImg8bit.png`.
    Cityscapes,
}

impl Layout {
    /// The layout of a folder.
    ///
    /// # Errors
    /// If the folder cannot be read.
    pub fn of(root: &Path) -> Result<Layout> {
        Ok(if cityscapes::is(root) {
            Layout::Cityscapes
        } else if odometry::is(root)? {
            Layout::KittiOdometry
        } else {
            Layout::Folder
        })
    }

    /// Its name in messages.
    pub fn name(self) -> &'static str {
        match self {
            Layout::Folder => "a folder of frames",
            Layout::KittiOdometry => "KITTI odometry",
            Layout::Cityscapes => "Cityscapes",
        }
    }

    /// Which share of a picture's rows is used, from the top.
    pub(super) fn used_rows(self) -> f64 {
        match self {
            Layout::Folder | Layout::KittiOdometry => 1.0,
            Layout::Cityscapes => cityscapes::USED_ROWS,
        }
    }

    fn recordings(self, root: &Path) -> Result<Vec<Recording>> {
        match self {
            Layout::Folder => folder::recordings(root),
            Layout::KittiOdometry => odometry::recordings(root),
            Layout::Cityscapes => cityscapes::recordings(root),
        }
    }
}

/// How a folder is opened.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Every sample needs its previous and next frame (training); otherwise the target frame alone (evaluation).
    pub neighbours: bool,
    /// Every sample needs the frame of the other camera ([`DataSource::other_image`]).
    pub stereo: bool,
    /// Every sample needs a depth map.
    pub with_depth: bool,
    /// Whose intrinsics; [`Camera::Auto`] asks `camera.toml`, then the calibration.
    pub camera: Camera,
    /// Whether samples are left out whose pictures cannot be read, by their headers; otherwise they are an error.
    pub skip_bad_frames: bool,
    /// How many bytes of resized pictures are kept in memory.
    pub cache_bytes: usize,
}

impl Default for Options {
    /// For training: with neighbours, the camera that the data say, a cache of 1 GiB.
    fn default() -> Self {
        Options {
            neighbours: true,
            stereo: false,
            with_depth: false,
            camera: Camera::Auto,
            skip_bad_frames: false,
            cache_bytes: 1 << 30,
        }
    }
}

/// A frame: the index of its sequence, and its own in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Spot {
    sequence: usize,
    frame: usize,
}

/// Recordings of a folder as a [`DataSource`].
pub struct Frames {
    layout: Layout,
    sequences: Vec<Sequence>,
    /// Of each sequence the first one of its recording: cameras side by side are one.
    first_of: Vec<usize>,
    samples: Vec<Spot>,
    unreadable: Vec<(String, String)>,
    left_out: LeftOut,
    pictures: Pictures<PathBuf>,
}

impl Frames {
    /// Opens the frames that a list names, or all. Lines are `FOLDER FRAME` (a sequence's folder below the root, `.` for the
    /// root, and a picture's name without its ending: `drive_b 0001`); of the other layouts `FOLDER FRAME SIDE` (`9 0 l`,
    /// `train/aachen/aachen_000000 5 l`). Pictures come out at `height x width` pixels.
    ///
    /// # Errors
    /// Everything is checked here: that there are sequences long enough, that pictures' headers can be read and have one
    /// size in a sequence, that the camera is known, that a list names frames that are there.
    pub fn open(root: &Path, list: Option<&Path>, [height, width]: [usize; 2], options: Options) -> Result<Frames> {
        let layout = Layout::of(root)?;
        let recordings = layout.recordings(root)?;
        let pictures = Pictures::new(height, width, options.cache_bytes)?;
        let mut found = Frames {
            layout,
            sequences: Vec::new(),
            first_of: Vec::new(),
            samples: Vec::new(),
            unreadable: Vec::new(),
            left_out: LeftOut::default(),
            pictures: pictures.with_rows(layout.used_rows()).with_prepared(root)?,
        };
        for recording in recordings {
            found.add(root, recording, options)?;
        }
        if let Some(list) = list {
            found.samples = list::keep(list, layout, &found)?;
        }
        if found.samples.is_empty() {
            return Err(Error::file(root, found.why_nothing(options)));
        }
        Ok(found)
    }

    /// Adds a recording, and its samples.
    fn add(&mut self, root: &Path, recording: Recording, options: Options) -> Result<()> {
        let headers = recording.headers(options.stereo, options.skip_bad_frames)?;
        self.unreadable.extend(headers.unreadable);
        let Some(size) = headers.size else { return Ok(()) };
        let sequence = Sequence::new(root, recording, size, self.layout.used_rows(), options)?;
        let offsets: &[i32] = if options.neighbours { &[0, -1, 1] } else { &[0] };
        for frame in 0..sequence.frames.len() {
            let around = || offsets.iter().map(|&offset| sequence.at(frame, offset));
            if around().any(|there| there.is_some_and(|frame| !headers.whole[frame])) {
                continue;
            }
            if around().any(|there| there.is_none()) || (options.stereo && sequence.frames[frame].other.is_none()) {
                self.left_out.without_pictures += 1;
            } else if let Some(missing) = sequence.missing_depth(frame).filter(|_| options.with_depth) {
                self.left_out.without_depth += 1;
                self.left_out.first_depth.get_or_insert(missing);
            } else {
                self.samples.push(Spot { sequence: self.sequences.len(), frame });
            }
        }
        let first = self.sequences.iter().position(|other| other.recording == sequence.recording);
        self.first_of.push(first.unwrap_or(self.sequences.len()));
        self.sequences.push(sequence);
        Ok(())
    }

    pub(super) fn pictures_mut(&mut self) -> &mut Pictures<PathBuf> {
        &mut self.pictures
    }

    /// Frames that lack a neighbour, the other camera's frame or the depth map, which were asked for.
    pub fn left_out(&self) -> &LeftOut {
        &self.left_out
    }

    /// Why there is no sample.
    fn why_nothing(&self, options: Options) -> String {
        let frames: usize = self.sequences.iter().map(|s| s.frames.len()).sum();
        let sequences = self.sequences.len();
        if let Some((_, why)) = self.unreadable.first() {
            return format!("no frame is left; the first that cannot be read: {why}");
        }
        let paired = self.sequences.iter().flat_map(|s| &s.frames).any(|frame| frame.other.is_some());
        let needs = if options.stereo && !paired {
            match self.layout {
                Layout::Folder => {
                    "the right camera's picture: right/NAME in its folder, or where right = \"PATTERN\" in camera.toml says; \
                     to train on one camera, --sources mono"
                }
                Layout::KittiOdometry => "the picture of image_3; to train on one camera, --sources mono",
                Layout::Cityscapes => "the picture of rightImg8bit_sequence; to train on one camera, --sources mono",
            }
        } else if options.neighbours && self.left_out.without_depth == 0 {
            "a frame before it and one after it in the same folder: three frames at least"
        } else if options.with_depth {
            match self.layout {
                Layout::Folder => "a depth map: depth/NAME.png in its folder, 16-bit grey, metres times 256",
                Layout::KittiOdometry => "a depth map, and KITTI odometry has none",
                Layout::Cityscapes => "a disparity map: disparity_sequence/SPLIT/CITY/..._disparity.png, or disparity",
            }
        } else {
            "nothing else"
        };
        format!("{frames} pictures in {sequences} sequences, and no sample among them: each needs {needs}")
    }

    fn name_of(&self, spot: Spot) -> String {
        self.sequences[spot.sequence].name_of(spot.frame)
    }

    /// The file of the frame at `offset` of a sample.
    fn file(&self, sample: usize, offset: i32) -> Result<&Path> {
        let Spot { sequence, frame } = self.samples[sample];
        let sequence = &self.sequences[sequence];
        match sequence.at(frame, offset) {
            Some(there) => Ok(&sequence.frames[there].picture),
            None => {
                let message = format!("has no frame at {offset:+}");
                Err(Error::file(&sequence.frames[frame].picture, message))
            }
        }
    }

    fn sequence(&self, sample: usize) -> &Sequence {
        &self.sequences[self.samples[sample].sequence]
    }
}

/// The pictures below a folder that are frames of a camera, in order, whichever layout of this module it has.
///
/// # Errors
/// If the folder cannot be read or holds no picture.
pub(super) fn picture_files(root: &Path) -> Result<Vec<PathBuf>> {
    let frames = Layout::of(root)?.recordings(root)?.into_iter().flat_map(|recording| recording.frames);
    let mut files: Vec<PathBuf> = frames.flat_map(|frame| [Some(frame.picture), frame.other]).flatten().collect();
    files.sort_by(|a, b| natural_order_of_paths(a, b));
    files.dedup();
    Ok(files)
}

impl DataSource for Frames {
    fn len(&self) -> usize {
        self.samples.len()
    }

    fn name(&self, sample: usize) -> String {
        self.name_of(self.samples[sample])
    }

    fn image(&self, sample: usize, offset: i32) -> Result<Arc<RgbImage>> {
        let file = self.file(sample, offset)?;
        self.pictures.get(file.to_owned(), || Ok(file.to_owned()))
    }

    fn intrinsics(&self, sample: usize) -> Intrinsics {
        self.sequence(sample).camera.intrinsics
    }

    fn mirrored_intrinsics(&self, sample: usize, width: usize) -> Intrinsics {
        camera::mirrored(&self.sequence(sample).camera, width)
    }

    fn cameras(&self) -> Vec<String> {
        let mut words = camera::in_words(self.sequences.iter().map(|sequence| &sequence.camera));
        for pair in self.sequences.iter().filter_map(Sequence::pair_in_words) {
            if !words.contains(&pair) {
                words.push(pair);
            }
        }
        words
    }

    fn unreadable(&self) -> &[(String, String)] {
        &self.unreadable
    }

    fn place(&self, sample: usize) -> Place {
        let Spot { sequence, frame } = self.samples[sample];
        Place { sequence: self.first_of[sequence], frame: self.sequences[sequence].frames[frame].number }
    }

    fn recording(&self, sample: usize) -> String {
        self.sequence(sample).recording.clone()
    }

    fn depth(&self, sample: usize) -> Result<Option<DepthMap>> {
        let Spot { sequence, frame } = self.samples[sample];
        self.sequences[sequence].depth(frame)
    }

    fn other_camera_at(&self, sample: usize) -> Option<f64> {
        self.sequence(sample).other_at
    }

    fn other_image(&self, sample: usize) -> Result<Arc<RgbImage>> {
        let Spot { sequence, frame } = self.samples[sample];
        match &self.sequences[sequence].frames[frame].other {
            Some(file) => self.pictures.get(file.clone(), || Ok(file.clone())),
            None => Err(no_second_camera(&self.name(sample))),
        }
    }
}
