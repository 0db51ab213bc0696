//! Single pictures with ground-truth depth, to be measured on: KITTI 2015, Make3D, DrivingStereo, Middlebury 2014.
//!
//! [`Layout::of`] tells which of them a folder holds. There are no neighbours in time, so nothing is trained on them.

mod driving_stereo;
mod kitti2015;
mod make3d;
mod middlebury;
#[cfg(test)]
mod tests;

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::{RgbImage, imageops};

use super::camera::{self, Camera, Found};
use super::inputs::natural_order;
use super::kitti::LeftOut;
use super::resize::lanczos;
use super::truth::Truth;
use super::{DataSource, Place};
use crate::camera::Intrinsics;
use crate::depth::DepthMap;
use crate::formats::bounded::read_text;
use crate::formats::picture::read_picture;
use crate::{Error, Result};

/// A list of a million pictures has fewer bytes.
const MAX_LIST: u64 = 64 << 20;

/// A layout of single pictures with ground truth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// `training/image_2/NNNNNN_10.png`, `training/disp_occ_0/NNNNNN_10.png`.
    Kitti2015,
    /// `Test134/img-*.jpg`, `Gridlaserdata/depth_sph_corr-*.mat`.
    Make3d,
    /// `WEATHER/left-image-full-size`, `WEATHER/depth-map-full-size`, or half.
    DrivingStereo,
    /// `SCENE/im0.png`, `SCENE/disp0GT.pfm` or `disp0.pfm`, `SCENE/calib.txt`.
    Middlebury,
}

impl Layout {
    /// All, in the order in which a folder is compared with them.
    pub const ALL: [Layout; 4] = [Layout::Kitti2015, Layout::Make3d, Layout::DrivingStereo, Layout::Middlebury];

    /// The layout of a folder, if it is one of these.
    ///
    /// # Errors
    /// If the folder cannot be read.
    pub fn of(root: &Path) -> Result<Option<Layout>> {
        for layout in Layout::ALL {
            let is = match layout {
                Layout::Kitti2015 => kitti2015::is(root),
                Layout::Make3d => make3d::is(root),
                Layout::DrivingStereo => driving_stereo::is(root)?,
                Layout::Middlebury => middlebury::is(root)?,
            };
            if is {
                return Ok(Some(layout));
            }
        }
        Ok(None)
    }

    /// The name of the data set.
    pub fn name(self) -> &'static str {
        match self {
            Layout::Kitti2015 => "KITTI 2015",
            Layout::Make3d => "Make3D",
            Layout::DrivingStereo => "DrivingStereo",
            Layout::Middlebury => "Middlebury 2014",
        }
    }
}

/// A picture with ground truth.
#[derive(Clone, Debug)]
struct Still {
    /// `FOLDER PICTURE`, as lists write it.
    name: String,
    picture: PathBuf,
    right: Option<PathBuf>,
    /// Metres between the cameras.
    baseline: Option<f64>,
    camera: Found,
    /// The rows of the stored picture that are used, from and to.
    rows: [u32; 2],
    truth: Truth,
}

/// Single pictures with ground truth as a [`DataSource`].
pub struct Stills {
    layout: Layout,
    stills: Vec<Still>,
    left_out: LeftOut,
    size: [u32; 2],
}

impl Stills {
    /// Opens a folder of a layout: the pictures that a list names (lines `FOLDER PICTURE`, the picture without its ending),
    /// or all that have ground truth. Pictures come out at `[height, width]` pixels.
    ///
    /// # Errors
    /// If a picture's header cannot be read, a calibration is wrong, nothing is known of the camera, no picture has ground
    /// truth, or a list names one that is not there.
    pub fn open(
        layout: Layout,
        root: &Path,
        list: Option<&Path>,
        [height, width]: [usize; 2],
        camera: Camera,
    ) -> Result<Stills> {
        let side = |name: &str, pixels: usize| match u32::try_from(pixels) {
            Ok(pixels) if (1..=1 << 14).contains(&pixels) => Ok(pixels),
            _ => Err(Error::setting(name, format!("expected 1 to {} pixels, found {pixels}", 1 << 14))),
        };
        let size = [side("height", height)?, side("width", width)?];
        let mut found = Stills { layout, stills: Vec::new(), left_out: LeftOut::default(), size };
        match layout {
            Layout::Kitti2015 => kitti2015::add(&mut found, root, camera)?,
            Layout::Make3d => make3d::add(&mut found, root, camera)?,
            Layout::DrivingStereo => driving_stereo::add(&mut found, root, camera)?,
            Layout::Middlebury => middlebury::add(&mut found, root, camera)?,
        }
        if found.stills.is_empty() {
            let LeftOut { without_depth, first_depth, .. } = &found.left_out;
            let missing = first_depth.as_ref().map_or_else(String::new, |path| {
                format!("; the ground truth of the first was looked for at {}", path.display())
            });
            let message = format!(
                "has the layout of {}, but none of its {without_depth} pictures has ground truth{missing}",
                layout.name()
            );
            return Err(Error::file(root, message));
        }
        if let Some(list) = list {
            found.keep_listed(list)?;
        }
        Ok(found)
    }

    /// Which layout the folder has.
    pub fn layout(&self) -> Layout {
        self.layout
    }

    /// The pictures that lack ground truth; of a list, none.
    pub fn left_out(&self) -> &LeftOut {
        &self.left_out
    }

    /// The picture of the right camera, and the metres between the cameras, where both are known.
    ///
    /// # Panics
    /// If there is no such sample.
    pub fn right(&self, sample: usize) -> Option<(&Path, f64)> {
        let still = &self.stills[sample];
        Some((still.right.as_deref()?, still.baseline?))
    }

    /// Adds a picture if its ground truth is there.
    fn add(&mut self, still: Still) {
        if still.truth.path().is_file() {
            self.stills.push(still);
        } else {
            self.left_out.without_depth += 1;
            self.left_out.first_depth.get_or_insert_with(|| still.truth.path().to_owned());
        }
    }

    /// Keeps the pictures that a list names, in its order.
    fn keep_listed(&mut self, list: &Path) -> Result<()> {
        let text = read_text(list, MAX_LIST, "a list of pictures")?;
        let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
        let known: HashMap<&str, &Still> = self.stills.iter().map(|still| (still.name.as_str(), still)).collect();
        let mut kept = Vec::new();
        for (i, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
            let name = line.split_whitespace().collect::<Vec<_>>().join(" ");
            let Some(&still) = known.get(name.as_str()) else {
                let example = self.stills.first().map_or("", |still| still.name.as_str());
                let message = format!(
                    "line {}: expected FOLDER PICTURE of a picture with ground truth, such as `{example}`; found {:?}",
                    i + 1,
                    line.trim()
                );
                return Err(Error::file(list, message));
            };
            kept.push(still.clone());
        }
        if kept.is_empty() {
            return Err(Error::file(list, "no samples: every line is blank; expected lines FOLDER PICTURE"));
        }
        self.stills = kept;
        self.left_out = LeftOut::default();
        Ok(())
    }
}

impl DataSource for Stills {
    fn len(&self) -> usize {
        self.stills.len()
    }

    fn name(&self, sample: usize) -> String {
        self.stills[sample].name.clone()
    }

    fn image(&self, sample: usize, offset: i32) -> Result<Arc<RgbImage>> {
        let Still { picture: path, rows, .. } = &self.stills[sample];
        if offset != 0 {
            let message = format!("has no frame at {offset:+}: {} holds single pictures", self.layout.name());
            return Err(Error::file(path, message));
        }
        let picture = read_picture(path)?;
        let cropped = imageops::crop_imm(&picture, 0, rows[0], picture.width(), rows[1] - rows[0]).to_image();
        let [height, width] = self.size;
        Ok(Arc::new(lanczos(&cropped, width, height)))
    }

    fn intrinsics(&self, sample: usize) -> Intrinsics {
        self.stills[sample].camera.intrinsics
    }

    fn cameras(&self) -> Vec<String> {
        camera::in_words(self.stills.iter().map(|still| &still.camera))
    }

    /// No two pictures are of one recording.
    fn place(&self, sample: usize) -> Place {
        Place { sequence: sample, frame: 0 }
    }

    fn depth(&self, sample: usize) -> Result<Option<DepthMap>> {
        self.stills[sample].truth.read().map(Some)
    }
}

/// The files of a folder that `wanted` takes by their names, in the order in which people number them.
fn files(folder: &Path, wanted: impl Fn(&str) -> bool) -> Result<Vec<PathBuf>> {
    names(folder, |path, name| path.is_file() && wanted(name))
}

/// The folders in a folder, in order, but for hidden ones.
fn folders(folder: &Path) -> Result<Vec<PathBuf>> {
    names(folder, |path, name| path.is_dir() && !name.starts_with('.'))
}

fn names(folder: &Path, wanted: impl Fn(&Path, &str) -> bool) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).map_err(|e| Error::io(folder, e))? {
        let path = entry.map_err(|e| Error::io(folder, e))?.path();
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default().to_owned();
        if wanted(&path, &name) {
            found.push((name, path));
        }
    }
    found.sort_by(|a, b| natural_order(&a.0, &b.0));
    Ok(found.into_iter().map(|(_, path)| path).collect())
}

/// The name of a file or folder, without an ending.
fn stem(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}
