//! KITTI raw, in its own layout:
//!
//! ```text
//! ROOT/DATE/calib_cam_to_cam.txt, calib_velo_to_cam.txt
//! ROOT/DATE/DRIVE/image_02/data/0000000005.png (or .jpg, .jpeg, .webp); image_03 is the right camera
//! ROOT/DATE/DRIVE/proj_depth/groundtruth/image_02/0000000005.png
//! ROOT/DATE/DRIVE/velodyne_points/data/0000000005.bin
//! ```
//!
//! Whatever can be wrong with a data set is found by [`Kitti::open`], before any time is spent on training.

mod calibration;
mod lidar;
mod scan;
mod split;

use std::collections::{BTreeMap, HashMap, HashSet, btree_map};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::RgbImage;

use crate::formats::depth_png::read_depth_png;
pub use calibration::Calibration;
pub(super) use calibration::{CalibrationLines, StereoPair};
pub use lidar::{DepthAxis, project_scan, read_scan};
pub use split::{Side, SplitLine, read_split};

use super::cache::Pictures;
use super::camera::{self, Camera};
use super::{DataSource, Place};
use crate::camera::Intrinsics;
use crate::depth::DepthMap;
use crate::formats::picture::check_picture;
use crate::{Error, Result};

/// How far apart KITTI's colour cameras are where no calibration says it, in metres.
const BASELINE: f64 = 0.54;

/// Where ground-truth depth comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum GroundTruth {
    /// For every frame the first of these that is there: the depth PNG, the projected scan (camera z), none.
    #[default]
    Auto,
    /// The improved ground truth, `proj_depth/groundtruth`: every sample must have it.
    Improved,
    /// The projected LiDAR scan: every sample must have it, and its day the calibration.
    Lidar(DepthAxis),
    /// None.
    Off,
}

impl GroundTruth {
    fn name(self) -> &'static str {
        match self {
            GroundTruth::Auto => "any ground truth",
            GroundTruth::Improved => "the improved ground truth",
            GroundTruth::Lidar(_) => "the LiDAR scan",
            GroundTruth::Off => "no ground truth",
        }
    }
}

/// How a data set is opened.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Every sample needs its previous and next frame (training); otherwise the target frame alone (evaluation).
    pub neighbours: bool,
    /// Every sample needs the frame of the other camera ([`DataSource::other_image`]).
    pub stereo: bool,
    /// Whose intrinsics.
    pub camera: Camera,
    /// Which depth.
    pub ground_truth: GroundTruth,
    /// Whether samples are left out whose pictures cannot be read, by their headers; otherwise they are an error.
    pub skip_bad_frames: bool,
    /// How many bytes of resized pictures are kept in memory; beyond them frames are decoded each time.
    pub cache_bytes: usize,
}

impl Default for Options {
    /// For training: with neighbours, the camera that the data say, any depth there is, a cache of 1 GiB.
    fn default() -> Self {
        Options {
            neighbours: true,
            stereo: false,
            camera: Camera::Auto,
            ground_truth: GroundTruth::Auto,
            skip_bad_frames: false,
            cache_bytes: 1 << 30,
        }
    }
}

/// One frame of one camera of one drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Frame {
    /// Index of the drive.
    drive: usize,
    number: u32,
    side: Side,
}

impl Frame {
    fn at(self, offset: i32) -> Option<Frame> {
        Some(Frame { number: self.number.checked_add_signed(offset)?, ..self })
    }
}

/// A drive: one recording.
struct Drive {
    /// As in split lists, `DATE/DRIVE`.
    folder: String,
    path: PathBuf,
    /// The frames that are there, left and right: number and file name.
    frames: [BTreeMap<u32, String>; 2],
    /// The calibration of its day, where something needs it.
    calibration: Option<Arc<Calibration>>,
}

impl Drive {
    /// The frames of a camera: number and file name.
    fn frames(&self, side: Side) -> &BTreeMap<u32, String> {
        match side {
            Side::Left => &self.frames[0],
            Side::Right => &self.frames[1],
        }
    }

    /// The file of a frame; where there is none, the path as a PNG as the error.
    fn picture(&self, number: u32, side: Side) -> Result<PathBuf, PathBuf> {
        let folder = self.path.join(side.folder()).join("data");
        match self.frames(side).get(&number) {
            Some(name) => Ok(folder.join(name)),
            None => Err(folder.join(format!("{number:010}.png"))),
        }
    }

    fn depth_png(&self, frame: Frame) -> PathBuf {
        let folder = self.path.join("proj_depth/groundtruth").join(frame.side.folder());
        folder.join(format!("{:010}.png", frame.number))
    }

    fn scan(&self, frame: Frame) -> PathBuf {
        self.path.join("velodyne_points/data").join(format!("{:010}.bin", frame.number))
    }

    /// The folder of the day, which holds the calibration.
    fn day(&self) -> &Path {
        self.path.parent().unwrap_or(&self.path)
    }
}

/// KITTI raw as a [`DataSource`].
pub struct Kitti {
    drives: Vec<Drive>,
    samples: Vec<Frame>,
    options: Options,
    /// Of each drive and side.
    cameras: BTreeMap<(usize, Side), camera::Found>,
    /// How far apart the two colour cameras of each drive are, in metres, and where that was found, where pairs are asked
    /// for.
    baselines: BTreeMap<usize, (f64, String)>,
    left_out: LeftOut,
    unreadable: Vec<(String, String)>,
    pictures: Pictures<Frame>,
}

/// Frames of a folder that are no samples.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LeftOut {
    /// How many lack a neighbour or the other camera's frame, which were asked for.
    pub without_pictures: usize,
    /// How many have all pictures and lack the ground truth that was asked for.
    pub without_depth: usize,
    /// Where the first one's ground truth was looked for.
    pub first_depth: Option<PathBuf>,
}

/// Whether a folder has the layout of KITTI raw: a drive with a folder of frames of a colour camera.
///
/// # Errors
/// If the folder cannot be read.
pub fn is_kitti(root: &Path) -> Result<bool> {
    Ok(!scan::drives(root)?.is_empty())
}

impl Kitti {
    /// Opens the samples that `split` lists (lines `FOLDER FRAME SIDE`), or all that are under `root`: left and right
    /// camera, frames in order, those that have what `options` ask for. Pictures come out at `height x width` pixels.
    ///
    /// # Errors
    /// Everything is checked here: lines that cannot be read or that point nowhere (with file and line number),
    /// missing neighbours, pictures whose header does not decode or that exceed 100 megapixels, missing or malformed
    /// calibration and ground truth where they are asked for.
    pub fn open(root: &Path, split: Option<&Path>, height: usize, width: usize, options: Options) -> Result<Kitti> {
        if !root.is_dir() {
            return Err(Error::file(root, "expected a folder in the layout of KITTI raw, found none; check the path"));
        }
        let mut kitti = Kitti {
            drives: Vec::new(),
            samples: Vec::new(),
            options,
            cameras: BTreeMap::new(),
            baselines: BTreeMap::new(),
            left_out: LeftOut::default(),
            unreadable: Vec::new(),
            pictures: Pictures::new(height, width, options.cache_bytes)?.with_prepared(root)?,
        };
        match split {
            Some(split) => kitti.take_split(root, split)?,
            None => kitti.take_everything(root)?,
        }
        kitti.find_cameras(root)?;
        if options.stereo {
            kitti.find_baselines()?;
        }
        Ok(kitti)
    }

    /// Finds how far apart the cameras of every drive are that there are samples of.
    fn find_baselines(&mut self) -> Result<()> {
        let drives: HashSet<usize> = self.samples.iter().map(|frame| frame.drive).collect();
        for drive in drives {
            let day = self.drives[drive].day();
            let found = match Calibration::has_cameras(day) {
                true => (
                    Calibration::read(day, false)?.baseline(day)?,
                    day.join(calibration::CAMERAS).display().to_string(),
                ),
                false => (BASELINE, format!("KITTI's usual: {} has no {}", day.display(), calibration::CAMERAS)),
            };
            self.baselines.insert(drive, found);
        }
        Ok(())
    }

    /// Finds the camera of every drive and side that there are samples of.
    fn find_cameras(&mut self, root: &Path) -> Result<()> {
        for sample in 0..self.samples.len() {
            let Frame { drive, side, .. } = self.samples[sample];
            if let btree_map::Entry::Vacant(place) = self.cameras.entry((drive, side)) {
                let frame = self.samples[sample];
                let path = self.drives[drive].picture(frame.number, side).unwrap_or_else(|expected| expected);
                let size = check_picture(&path)?;
                let calibrated = || calibrated(self.drives[drive].day(), side);
                let calibration: Option<&dyn Fn() -> Result<camera::Found>> =
                    Calibration::has_cameras(self.drives[drive].day()).then_some(&calibrated as _);
                place.insert(self.options.camera.resolve(root, &self.drives[drive].path, size, calibration)?);
            }
        }
        Ok(())
    }

    fn take_split(&mut self, root: &Path, split: &Path) -> Result<()> {
        let mut drives = HashMap::new();
        let mut days = HashMap::new();
        let mut checked = HashSet::new();
        let lines = read_split(split)?;
        if lines.is_empty() {
            return Err(Error::file(split, "no samples: every line is blank; expected lines FOLDER FRAME SIDE"));
        }
        let mut lacking = None;
        for line in lines {
            let at = |message: String| Error::file(split, format!("line {}: {message}", line.number));
            let drive = match drives.get(&line.folder) {
                Some(&drive) => drive,
                None => {
                    let path = root.join(&line.folder);
                    if !path.is_dir() {
                        return Err(at(format!("no such drive: expected the folder {}", path.display())));
                    }
                    self.add_drive(&line.folder, path, &mut days)?;
                    drives.insert(line.folder.clone(), self.drives.len() - 1);
                    self.drives.len() - 1
                }
            };
            let frame = Frame { drive, number: line.frame, side: line.side };
            if let Err(error) = self.check_pictures(frame, &mut checked) {
                // That a frame is not there is a fault of the list.
                if !(self.options.skip_bad_frames && self.has_pictures(frame)) {
                    return Err(at(error.to_string()));
                }
                self.unreadable.push((self.name_of(frame), error.to_string()));
                continue;
            }
            if let Some(missing) = self.missing_truth(frame) {
                // The others are counted before this is reported.
                lacking.get_or_insert((line.number, missing));
                self.left_out.without_depth += 1;
                continue;
            }
            match self.check_truth(frame) {
                Ok(()) => self.samples.push(frame),
                Err(error) if self.options.skip_bad_frames => {
                    self.unreadable.push((self.name_of(frame), error.to_string()));
                }
                Err(error) => return Err(at(error.to_string())),
            }
        }
        let Some((number, missing)) = lacking else {
            return match (self.samples.is_empty(), self.unreadable.first()) {
                (true, Some((_, why))) => {
                    Err(Error::file(split, format!("no frame of it can be read; the first: {why}")))
                }
                _ => Ok(()),
            };
        };
        let (what, without) = (self.options.ground_truth.name(), self.left_out.without_depth);
        let message = format!(
            "line {number}: {}: {what} of this frame is missing ({without} of the list's {} frames lack it); use a list \
             of the frames that have it",
            missing.display(),
            self.samples.len() + without
        );
        Err(Error::file(split, message))
    }

    fn take_everything(&mut self, root: &Path) -> Result<()> {
        let mut days = HashMap::new();
        let mut checked = HashSet::new();
        for (folder, path) in scan::drives(root)? {
            self.add_drive(&folder, path, &mut days)?;
            let drive = self.drives.len() - 1;
            for side in [Side::Left, Side::Right] {
                let numbers: Vec<u32> = self.drives[drive].frames(side).keys().copied().collect();
                for number in numbers {
                    let frame = Frame { drive, number, side };
                    if !self.has_pictures(frame) {
                        self.left_out.without_pictures += 1;
                    } else if let Some(missing) = self.missing_truth(frame) {
                        self.left_out.without_depth += 1;
                        self.left_out.first_depth.get_or_insert(missing);
                    } else {
                        match self.check_pictures(frame, &mut checked).and_then(|()| self.check_truth(frame)) {
                            Ok(()) => self.samples.push(frame),
                            Err(error) if self.options.skip_bad_frames => {
                                self.unreadable.push((self.name_of(frame), error.to_string()));
                            }
                            Err(error) => return Err(error),
                        }
                    }
                }
            }
        }
        if self.samples.is_empty() {
            return Err(Error::file(root, self.why_nothing()));
        }
        Ok(())
    }

    /// Why no frame that was looked for is a sample.
    fn why_nothing(&self) -> String {
        let wanted = match (self.options.neighbours, self.options.stereo) {
            (true, true) => " with both neighbours and the other camera's frame",
            (true, false) => " with both neighbours",
            (false, true) => " with the other camera's frame",
            (false, false) => "",
        };
        if let Some((_, why)) = self.unreadable.first() {
            return format!("none of {} frames{wanted} can be read; the first: {why}", self.unreadable.len());
        }
        let LeftOut { without_pictures, without_depth, first_depth } = &self.left_out;
        match (without_pictures, first_depth) {
            (0, None) => format!(
                "no frames{wanted} found in the layout of KITTI raw; expected files like \
                 DATE/DRIVE/image_02/data/0000000000.png"
            ),
            (without, None) => format!("no frames{wanted} found: all {without} frames that are there lack one"),
            (without, Some(path)) => {
                let others = match without {
                    0 => String::new(),
                    n => format!(", and {n} more lack a neighbour or the other camera's frame"),
                };
                format!(
                    "there are frames, but no ground-truth depth: {without_depth} frames lack it{others}; {} was looked \
                     for where the first one's should be, {}",
                    self.options.ground_truth.name(),
                    path.display()
                )
            }
        }
    }

    /// The frames that are there and are no samples, because something that was asked for is missing; of a list, none.
    pub fn left_out(&self) -> &LeftOut {
        &self.left_out
    }

    fn add_drive(&mut self, folder: &str, path: PathBuf, days: &mut HashMap<PathBuf, Arc<Calibration>>) -> Result<()> {
        let frames = |side: Side| scan::frames(&path.join(side.folder()).join("data"));
        let frames = [frames(Side::Left)?, frames(Side::Right)?];
        let mut drive = Drive { folder: folder.to_owned(), path, frames, calibration: None };
        let day = drive.day().to_owned();
        let with_lidar = match self.options.ground_truth {
            GroundTruth::Lidar(_) => true,
            // Depth that nobody insists on does not make the calibration a duty.
            GroundTruth::Auto => Calibration::is_in(&day),
            GroundTruth::Improved | GroundTruth::Off => false,
        };
        if with_lidar {
            if !days.contains_key(&day) {
                days.insert(day.clone(), Arc::new(Calibration::read(&day, with_lidar)?));
            }
            drive.calibration = days.get(&day).cloned();
        }
        self.drives.push(drive);
        Ok(())
    }

    /// The frames that a sample needs.
    fn needed(&self, frame: Frame) -> impl Iterator<Item = Option<Frame>> {
        let offsets: &[i32] = if self.options.neighbours { &[0, -1, 1] } else { &[0] };
        let other = Frame { side: frame.side.other(), ..frame };
        offsets.iter().map(move |&offset| frame.at(offset)).chain(self.options.stereo.then_some(Some(other)))
    }

    /// Whether all pictures are there that a sample needs.
    fn has_pictures(&self, frame: Frame) -> bool {
        let drive = &self.drives[frame.drive];
        self.needed(frame).all(|f| f.is_some_and(|f| drive.picture(f.number, f.side).is_ok()))
    }

    /// The file of the ground truth that a sample needs, if it is not there.
    fn missing_truth(&self, frame: Frame) -> Option<PathBuf> {
        let drive = &self.drives[frame.drive];
        let file = match self.options.ground_truth {
            GroundTruth::Improved => drive.depth_png(frame),
            GroundTruth::Lidar(_) => drive.scan(frame),
            GroundTruth::Auto | GroundTruth::Off => return None,
        };
        (!file.is_file()).then_some(file)
    }

    /// Checks the pictures that a sample needs; `checked` remembers those that several samples share.
    fn check_pictures(&self, frame: Frame, checked: &mut HashSet<Frame>) -> Result<()> {
        let drive = &self.drives[frame.drive];
        for needed in self.needed(frame) {
            let Some(needed) = needed else {
                let message = format!("frame {} has no previous frame; take it off the list", frame.number);
                return Err(Error::file(&drive.path, message));
            };
            if !checked.contains(&needed) {
                check_picture(&self.picture_path(needed, frame)?)?;
                checked.insert(needed);
            }
        }
        Ok(())
    }

    /// Checks the file of a sample's ground truth, which is there.
    fn check_truth(&self, frame: Frame) -> Result<()> {
        let drive = &self.drives[frame.drive];
        match self.options.ground_truth {
            GroundTruth::Improved => check_picture(&drive.depth_png(frame)).map(drop),
            GroundTruth::Lidar(_) => lidar::check_scan(&drive.scan(frame)),
            GroundTruth::Auto | GroundTruth::Off => Ok(()),
        }
    }

    pub(super) fn pictures_mut(&mut self) -> &mut Pictures<impl Eq + std::hash::Hash + use<>> {
        &mut self.pictures
    }

    /// As the line of a split list: `FOLDER FRAME SIDE`.
    fn name_of(&self, frame: Frame) -> String {
        format!("{} {} {}", self.drives[frame.drive].folder, frame.number, frame.side.letter())
    }

    /// The file of `frame`; where there is none the message says what it is to `target`.
    fn picture_path(&self, frame: Frame, target: Frame) -> Result<PathBuf> {
        self.drives[frame.drive].picture(frame.number, frame.side).map_err(|expected| {
            let what = match i64::from(frame.number) - i64::from(target.number) {
                _ if frame.side != target.side => "the other camera's frame".to_owned(),
                0 => "the frame".to_owned(),
                -1 => format!("the frame before frame {}", target.number),
                1 => format!("the frame after frame {}", target.number),
                offset => format!("the frame at {offset:+} of frame {}", target.number),
            };
            let message = format!("{what} is missing; expected this file, or the same as .jpg, .jpeg or .webp");
            Error::file(expected, message)
        })
    }

    /// The file of the frame at `offset` of a sample.
    pub fn path(&self, sample: usize, offset: i32) -> Result<PathBuf> {
        let target = self.samples[sample];
        self.picture_path(self.at(target, offset)?, target)
    }

    fn at(&self, target: Frame, offset: i32) -> Result<Frame> {
        target.at(offset).ok_or_else(|| {
            let message = format!("frame {} has no frame at {offset:+}", target.number);
            Error::file(&self.drives[target.drive].path, message)
        })
    }

    fn camera(&self, sample: usize) -> &camera::Found {
        let frame = self.samples[sample];
        &self.cameras[&(frame.drive, frame.side)]
    }

    /// Which camera a sample was taken with.
    pub fn side(&self, sample: usize) -> Side {
        self.samples[sample].side
    }

    fn picture(&self, frame: Frame, target: Frame) -> Result<Arc<RgbImage>> {
        self.pictures.get(frame, || self.picture_path(frame, target))
    }

    fn scan_depth(&self, frame: Frame, axis: DepthAxis) -> Result<DepthMap> {
        let drive = &self.drives[frame.drive];
        let lidar = drive.calibration.as_ref().and_then(|c| Some((c, c.lidar_to_image(frame.side)?)));
        let Some((calibration, projection)) = lidar else {
            return Err(Error::file(drive.day(), "a LiDAR scan needs calib_cam_to_cam.txt and calib_velo_to_cam.txt"));
        };
        let points = read_scan(&drive.scan(frame))?;
        let (width, height) = calibration.size;
        Ok(project_scan(&points, &projection, width, height, axis))
    }
}

/// Camera of a side, from the calibration of its day.
fn calibrated(day: &Path, side: Side) -> Result<camera::Found> {
    let found = Calibration::intrinsics_of(day, side)?;
    Ok(camera::Found::measured(found, day.join(calibration::CAMERAS).display().to_string()))
}

impl DataSource for Kitti {
    fn len(&self) -> usize {
        self.samples.len()
    }

    fn name(&self, sample: usize) -> String {
        self.name_of(self.samples[sample])
    }

    fn unreadable(&self) -> &[(String, String)] {
        &self.unreadable
    }

    fn image(&self, sample: usize, offset: i32) -> Result<Arc<RgbImage>> {
        let target = self.samples[sample];
        self.picture(self.at(target, offset)?, target)
    }

    fn intrinsics(&self, sample: usize) -> Intrinsics {
        self.camera(sample).intrinsics
    }

    fn mirrored_intrinsics(&self, sample: usize, width: usize) -> Intrinsics {
        camera::mirrored(self.camera(sample), width)
    }

    fn cameras(&self) -> Vec<String> {
        let mut words = camera::in_words(self.cameras.values());
        let pairs = self.baselines.values().map(|(metres, found)| format!("pairs {metres:.4} m apart ({found})"));
        for pair in pairs {
            if !words.contains(&pair) {
                words.push(pair);
            }
        }
        words
    }

    fn place(&self, sample: usize) -> Place {
        let frame = self.samples[sample];
        Place { sequence: frame.drive, frame: frame.number as usize }
    }

    fn other_camera_at(&self, sample: usize) -> Option<f64> {
        let frame = self.samples[sample];
        let (baseline, _) = self.baselines.get(&frame.drive)?;
        Some(if frame.side == Side::Left { -baseline } else { *baseline })
    }

    fn other_image(&self, sample: usize) -> Result<Arc<RgbImage>> {
        let target = self.samples[sample];
        self.picture(Frame { side: target.side.other(), ..target }, target)
    }

    fn recording(&self, sample: usize) -> String {
        self.drives[self.samples[sample].drive].folder.clone()
    }

    fn depth(&self, sample: usize) -> Result<Option<DepthMap>> {
        let frame = self.samples[sample];
        let drive = &self.drives[frame.drive];
        match self.options.ground_truth {
            GroundTruth::Improved => read_depth_png(&drive.depth_png(frame)).map(Some),
            GroundTruth::Lidar(axis) => self.scan_depth(frame, axis).map(Some),
            GroundTruth::Auto if drive.depth_png(frame).is_file() => read_depth_png(&drive.depth_png(frame)).map(Some),
            GroundTruth::Auto
                if drive.calibration.as_ref().is_some_and(|c| c.has_lidar()) && drive.scan(frame).is_file() =>
            {
                self.scan_depth(frame, DepthAxis::CameraZ).map(Some)
            }
            GroundTruth::Auto | GroundTruth::Off => Ok(None),
        }
    }
}

#[cfg(test)]
mod tests;
