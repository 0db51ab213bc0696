//! Any folder of frames: PNG, JPEG or WebP pictures in the order in which people number them.
//!
//! ```text
//! ROOT/camera.toml           which camera took them: see `data::camera`
//! ROOT/frame_0001.jpg ..     a sequence
//! ROOT/depth/frame_0001.png  depth of that frame, if there is any: 16-bit grey, metres times 256, 0 for unknown
//! ROOT/right/frame_0001.jpg  the right camera's picture of that frame, if there is any
//! ROOT/drive_b/0001.jpg ..   another sequence, which may have a camera.toml, depth and right pictures of its own
//! ```
//!
//! Every folder that holds pictures is a sequence, wherever below the root it lies. `camera.toml` may say which of its
//! pictures are frames, and where depth and right pictures lie, by [patterns](Pattern), and how far apart the cameras are:
//!
//! ```text
//! frames = "left_{}"         # default "{}": all
//! right = "right_{}"         # default "right/{}"; "../right/{}" for folders beside each other
//! depth = "../depth/{}"      # default "depth/{}"
//! baseline = 0.12            # metres
//! ```
//!
//! All pictures of a sequence have one size. Frames that follow one another should be a fraction of a second apart:
//! neighbours are what depth is learnt from.

use std::collections::{BTreeMap, HashSet};
use std::ffi::OsStr;
use std::path::{Component, Path, PathBuf};

use super::recording::{FrameFiles, OtherAt, Recording};
use crate::data::camera::{self, CameraFile};
use crate::data::inputs::{ENDINGS, find_pictures};
use crate::data::truth::Truth;
use crate::{Error, Result};

/// The folder of a sequence's depth maps, where no pattern says another.
const DEPTH: &str = "depth";

/// Whether a folder has the name of one of KITTI's cameras.
fn is_kitti_camera(name: &OsStr) -> bool {
    ["image_00", "image_01", "image_02", "image_03"].iter().any(|known| name == *known)
}

/// How the files of a frame are named: a path below its folder without an ending, in which `{}` stands for the frame.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Pattern {
    before: String,
    after: String,
}

impl Pattern {
    fn parse(text: &str) -> Result<Pattern, String> {
        let wrong = |why: &str| Err(format!("{text:?}: {why}; expected a path such as \"right/{{}}\""));
        match text.split("{}").collect::<Vec<_>>().as_slice() {
            _ if Path::new(text).is_absolute() => wrong("starts at the root of the file system"),
            [before, after] => Ok(Pattern { before: (*before).to_owned(), after: (*after).to_owned() }),
            _ => wrong("{} has to stand there once, for the name of the frame"),
        }
    }

    /// The part of a name that `{}` stands for, if the name has this form.
    fn variable<'a>(&self, name: &'a str) -> Option<&'a str> {
        name.strip_prefix(&self.before)?.strip_suffix(&self.after).filter(|variable| !variable.is_empty())
    }

    /// The path for a frame of a folder, without an ending and without `..`.
    fn path(&self, folder: &Path, variable: &str) -> PathBuf {
        let mut path = PathBuf::new();
        for part in folder.join(format!("{}{variable}{}", self.before, self.after)).components() {
            match part {
                Component::ParentDir if matches!(path.components().next_back(), Some(Component::Normal(_))) => {
                    path.pop();
                }
                Component::CurDir => {}
                part => path.push(part),
            }
        }
        path
    }
}

/// Where the files of a folder's frames lie.
struct Arrangement {
    frames: Pattern,
    right: Pattern,
    depth: Pattern,
    /// Metres between the cameras, and the file that says it.
    baseline: Option<(f64, String)>,
}

impl Arrangement {
    /// As the nearest `camera.toml` says.
    fn of(root: &Path, folder: &Path) -> Result<Arrangement> {
        let (file, said) = camera::file_of(root, folder)?.unwrap_or_default();
        let CameraFile { frames, right, depth, baseline, .. } = said;
        let pattern = |name: &str, said: Option<String>, usual: &str| {
            Pattern::parse(said.as_deref().unwrap_or(usual))
                .map_err(|why| Error::file(&file, format!("{name} = {why}")))
        };
        let baseline = match baseline {
            Some(metres) if !(metres > 0.0 && metres.is_finite()) => {
                let message = format!("baseline = {metres}: expected metres between the cameras, above 0");
                return Err(Error::file(&file, message));
            }
            said => said.map(|metres| (metres, file.display().to_string())),
        };
        Ok(Arrangement {
            frames: pattern("frames", frames, "{}")?,
            right: pattern("right", right, "right/{}")?,
            depth: pattern("depth", depth, "depth/{}")?,
            baseline,
        })
    }
}

pub(super) fn recordings(root: &Path) -> Result<Vec<Recording>> {
    let mut folders: BTreeMap<PathBuf, Vec<PathBuf>> = BTreeMap::new();
    // Nothing is written: no folder is left out.
    let pictures = find_pictures(&[root.to_owned()], Path::new("")).map_err(with_layouts)?.pictures;
    for picture in pictures {
        let folder = picture.path.parent().unwrap_or(root).to_owned();
        if folder.file_name().is_none_or(|name| name != DEPTH) || folder == root {
            folders.entry(folder).or_default().push(picture.path);
        }
    }
    let mut found = Vec::new();
    // The folders of depth maps and right pictures are no sequences of their own.
    let mut belonging = HashSet::new();
    for (path, pictures) in folders {
        if path.ends_with("data") && path.parent().is_some_and(|p| p.file_name().is_some_and(is_kitti_camera)) {
            let message = "is a camera of KITTI raw, in a drive that does not lie at DATE/DRIVE below the folder that was \
                           given: give the folder that holds the dates";
            return Err(Error::file(path, message));
        }
        let arrangement = Arrangement::of(root, &path)?;
        let mut frames = Vec::new();
        for picture in pictures {
            let stem = picture.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            let Some(variable) = arrangement.frames.variable(&stem) else { continue };
            let other = with_ending(&arrangement.right.path(&path, variable), &picture);
            let mut depth = arrangement.depth.path(&path, variable).into_os_string();
            depth.push(".png");
            let depth = PathBuf::from(depth);
            for file in [other.as_ref(), Some(&depth).filter(|file| file.is_file())].into_iter().flatten() {
                belonging.extend(file.parent().filter(|folder| *folder != path).map(Path::to_owned));
            }
            let number = frames.len();
            frames.push(FrameFiles { number, label: stem, picture, other, depth: Some(Truth::DepthPng(depth)) });
        }
        let name = match path.strip_prefix(root).unwrap_or(&path) {
            below if below.as_os_str().is_empty() => ".".to_owned(),
            below => below.display().to_string(),
        };
        let other_at = Some(other_at(path.clone(), arrangement.baseline));
        found.push(Recording { name, side: None, path, frames, calibration: None, other_at });
    }
    found.retain(|recording| !recording.frames.is_empty() && !belonging.contains(&recording.path));
    if found.is_empty() {
        return Err(Error::file(root, "no picture is a frame by the pattern frames = \"..\" of camera.toml"));
    }
    Ok(found)
}

/// The error that a folder holds no pictures, with the layouts that are known.
fn with_layouts(error: Error) -> Error {
    match error {
        Error::File { path, message } => Error::File {
            path,
            message: format!(
                "{message}; layouts that are known: frames of any names in folders, KITTI raw \
                 (DATE/DRIVE/image_02/data), KITTI odometry (sequences/NN/image_2), Cityscapes (leftImg8bit_sequence), and \
                 for eval KITTI 2015, Make3D, DrivingStereo and Middlebury 2014"
            ),
        },
        other => other,
    }
}

/// The picture at a path that lacks its ending: one like that of another picture, else any, if it is there.
fn with_ending(path: &Path, like: &Path) -> Option<PathBuf> {
    let like = like.extension().and_then(OsStr::to_str);
    let named = |ending: &str| {
        let mut name = path.as_os_str().to_owned();
        name.push(".");
        name.push(ending);
        PathBuf::from(name)
    };
    like.into_iter().chain(ENDINGS).map(named).find(|file| file != path && file.is_file())
}

/// The right camera stands to the right.
fn other_at(path: PathBuf, baseline: Option<(f64, String)>) -> OtherAt {
    Box::new(move || match &baseline {
        Some((metres, place)) => Ok((-metres, place.clone())),
        None => {
            let message = "has pictures of a right camera, and nothing says how far from the left one it stands: write \
                           baseline = METRES into camera.toml, or train with --sources mono";
            Err(Error::file(&path, message))
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_are_paths_with_one_place_for_the_frame() {
        let path = |pattern: &str| Pattern::parse(pattern).unwrap().path(Path::new("data/left"), "0001");
        assert_eq!(path("right/{}"), Path::new("data/left/right/0001"));
        assert_eq!(path("../right/{}_r"), Path::new("data/right/0001_r"));
        assert_eq!(path("./{}"), Path::new("data/left/0001"));
        let frames = Pattern::parse("left_{}").unwrap();
        assert_eq!((frames.variable("left_0001"), frames.variable("right_0001")), (Some("0001"), None));
        assert_eq!(frames.variable("left_"), None);
        for wrong in ["right/", "{}/{}", "/right/{}"] {
            assert!(Pattern::parse(wrong).unwrap_err().contains(wrong), "{wrong}");
        }
    }
}
