//! KITTI odometry.
//!
//! ```text
//! ROOT/sequences/09/calib.txt             P0: to P3: the projections of the four cameras
//! ROOT/sequences/09/image_2/000000.png    the left colour camera; image_3 is the right one
//! ROOT/poses/09.txt                       for eval --poses
//! ```
//!
//! Where only the grey cameras are there (`image_0`, `image_1`), they are the pair.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use super::recording::{Calibration, FrameFiles, OtherAt, Recording};
use crate::data::camera::{Found, of_pixels};
use crate::data::inputs::{ENDINGS, natural_order};
use crate::data::kitti::{CalibrationLines, Side};
use crate::{Error, Result};

/// The calibration of a sequence.
const CALIBRATION: &str = "calib.txt";
/// Left and right: colour, and grey.
const PAIRS: [[usize; 2]; 2] = [[2, 3], [0, 1]];

/// Whether a folder holds sequences, or is one.
pub(super) fn is(root: &Path) -> Result<bool> {
    Ok(!sequences(root)?.is_empty())
}

/// The sequences of a folder: below `sequences`, below the folder itself, or the folder itself; with the names that lists
/// have for them.
fn sequences(root: &Path) -> Result<Vec<(String, PathBuf)>> {
    if !root.is_dir() {
        return Ok(Vec::new());
    }
    if is_sequence(root) {
        let name = fs::canonicalize(root).ok().and_then(|path| Some(path.file_name()?.to_string_lossy().into_owned()));
        return Ok(vec![(name.unwrap_or_else(|| ".".to_owned()), root.to_owned())]);
    }
    let above = Some(root.join("sequences")).filter(|folder| folder.is_dir()).unwrap_or_else(|| root.to_owned());
    let mut found = Vec::new();
    for entry in fs::read_dir(&above).map_err(|e| Error::io(&above, e))? {
        let path = entry.map_err(|e| Error::io(&above, e))?.path();
        if is_sequence(&path) {
            found.push((path.file_name().unwrap_or_default().to_string_lossy().into_owned(), path));
        }
    }
    found.sort_by(|a, b| natural_order(&a.0, &b.0));
    Ok(found)
}

/// A camera's folder beside the calibration.
fn is_sequence(path: &Path) -> bool {
    path.join(CALIBRATION).is_file() && PAIRS.iter().flatten().any(|&camera| camera_folder(path, camera).is_dir())
}

fn camera_folder(sequence: &Path, camera: usize) -> PathBuf {
    sequence.join(format!("image_{camera}"))
}

pub(super) fn recordings(root: &Path) -> Result<Vec<Recording>> {
    let mut found = Vec::new();
    for (name, path) in sequences(root)? {
        let there = |pair: &&[usize; 2]| pair.iter().any(|&camera| camera_folder(&path, camera).is_dir());
        let Some(&pair) = PAIRS.iter().find(there) else { continue };
        let frames = [numbered(&camera_folder(&path, pair[0]))?, numbered(&camera_folder(&path, pair[1]))?];
        for (i, side) in [Side::Left, Side::Right].into_iter().enumerate() {
            if frames[i].is_empty() {
                continue;
            }
            let frame = |(&number, picture): (&u32, &PathBuf)| FrameFiles {
                number: number as usize,
                label: number.to_string(),
                picture: picture.clone(),
                other: frames[1 - i].get(&number).cloned(),
                depth: None,
            };
            found.push(Recording {
                name: name.clone(),
                side: Some(side),
                path: path.clone(),
                frames: frames[i].iter().map(frame).collect(),
                calibration: Some(camera_of(path.join(CALIBRATION), pair[i])),
                other_at: Some(other_at(path.join(CALIBRATION), pair, side)),
            });
        }
    }
    if found.is_empty() {
        let message = "has the layout of KITTI odometry, and no frames: expected sequences/NN/image_2/000000.png";
        return Err(Error::file(root, message));
    }
    Ok(found)
}

/// The pictures of a camera by their numbers; none if the folder is not there.
fn numbered(folder: &Path) -> Result<BTreeMap<u32, PathBuf>> {
    let mut found = BTreeMap::new();
    if !folder.is_dir() {
        return Ok(found);
    }
    for entry in fs::read_dir(folder).map_err(|e| Error::io(folder, e))? {
        let path = entry.map_err(|e| Error::io(folder, e))?.path();
        let is_picture = |path: &Path| {
            let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default();
            ENDINGS.iter().any(|known| ending.eq_ignore_ascii_case(known)) && path.is_file()
        };
        let digits = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
        if digits.bytes().all(|b| b.is_ascii_digit())
            && let Ok(number) = digits.parse()
            && is_picture(&path)
        {
            // Of a frame that is there more than once, the first by name.
            let kept = found.entry(number).or_insert_with(|| path.clone());
            if path < *kept {
                *kept = path;
            }
        }
    }
    Ok(found)
}

fn projection(path: &Path, camera: usize) -> Result<[f64; 12]> {
    CalibrationLines::read(path.to_owned())?.numbers(&format!("P{camera}"))
}

fn camera_of(path: PathBuf, camera: usize) -> Calibration {
    Box::new(move |(width, height)| {
        let p = projection(&path, camera)?;
        let size = [f64::from(width), f64::from(height)];
        let found = of_pixels([p[0], p[5], p[2], p[6]], size)
            .map_err(|why| Error::file(&path, format!("P{camera}: {why}; restore the file")))?;
        Ok(Found::measured(found, path.display().to_string()))
    })
}

/// `(P_left[3] - P_right[3]) / f` metres to the right of the left camera.
fn other_at(path: PathBuf, [left, right]: [usize; 2], side: Side) -> OtherAt {
    Box::new(move || {
        let (p, q) = (projection(&path, left)?, projection(&path, right)?);
        let baseline = (p[3] - q[3]) / p[0];
        if !(baseline > 0.0 && baseline.is_finite()) {
            let message =
                format!("by P{left} and P{right} the right camera stands {baseline} m to the right of the left one");
            return Err(Error::file(&path, message));
        }
        Ok((if side == Side::Left { -baseline } else { baseline }, path.display().to_string()))
    })
}
