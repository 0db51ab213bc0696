//! Cityscapes' video: snippets of thirty frames.
//!
//! ```text
//! ROOT/leftImg8bit_sequence/SPLIT/CITY/CITY_SEQ_FRAME_leftImg8bit.png     rightImg8bit_sequence is the right camera
//! ROOT/camera/SPLIT/CITY/CITY_SEQ_FRAME_camera.json                       of one frame of each snippet, or of its street
//! ROOT/disparity_sequence/SPLIT/CITY/CITY_SEQ_FRAME_disparity.png         or disparity, of one frame of each snippet
//! ```
//!
//! A snippet is the frames of one `CITY_SEQ` whose numbers follow one another. The lower quarter of the pictures, which shows
//! the car's own bonnet, is cut off; intrinsics and depth follow.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::recording::{Calibration, FrameFiles, OtherAt, Recording};
use crate::data::camera::{Found, of_pixels};
use crate::data::inputs::find_pictures;
use crate::data::kitti::Side;
use crate::data::truth::Truth;
use crate::formats::bounded::{MAX_SETTINGS, read_text};
use crate::{Error, Result};

/// The share of rows above the bonnet.
pub(super) const USED_ROWS: f64 = 0.75;

const LEFT: [&str; 2] = ["leftImg8bit_sequence", "leftImg8bit"];
const RIGHT: [&str; 2] = ["rightImg8bit_sequence", "rightImg8bit"];
/// The size of the pictures that calibrations are made for.
const SIZE: [f64; 2] = [2048.0, 1024.0];

pub(super) fn is(root: &Path) -> bool {
    root.join(LEFT[0]).is_dir()
}

/// The part of a calibration file that is used.
#[derive(Deserialize)]
struct CameraFile {
    intrinsic: Intrinsic,
    extrinsic: Extrinsic,
}

#[derive(Deserialize)]
struct Intrinsic {
    fx: f64,
    fy: f64,
    u0: f64,
    v0: f64,
}

#[derive(Deserialize)]
struct Extrinsic {
    baseline: f64,
}

impl CameraFile {
    fn read(path: &Path) -> Result<CameraFile> {
        let text = read_text(path, MAX_SETTINGS, "a calibration")?;
        let found: CameraFile = serde_json::from_str(&text).map_err(|e| Error::file(path, e.to_string()))?;
        match found.extrinsic.baseline {
            baseline if baseline > 0.0 && baseline.is_finite() => Ok(found),
            other => Err(Error::file(path, format!("extrinsic.baseline: expected metres above 0, found {other}"))),
        }
    }
}

/// The frames of one `CITY_SEQ`: `SPLIT/CITY/CITY_SEQ`, and the pictures by their numbers.
type Streets = BTreeMap<String, BTreeMap<u32, PathBuf>>;

pub(super) fn recordings(root: &Path) -> Result<Vec<Recording>> {
    let mut streets = Streets::new();
    for picture in find_pictures(&[root.join(LEFT[0])], Path::new(""))?.pictures {
        let (Some(folder), Some(stem)) = (picture.name.parent(), picture.name.file_name().and_then(|n| n.to_str()))
        else {
            continue;
        };
        let Some((street, number)) = street_and_number(stem) else {
            let message = format!("expected a name like aachen_000000_000019_{}.png", LEFT[1]);
            return Err(Error::file(picture.path, message));
        };
        streets.entry(folder.join(street).display().to_string()).or_default().insert(number, picture.path);
    }
    let mut found = Vec::new();
    for (name, frames) in streets {
        let cameras = numbered(root, "camera", &name, "camera.json")?;
        for snippet in consecutive(frames) {
            found.extend(snippet_of(root, &name, snippet, &cameras));
        }
    }
    Ok(found)
}

/// `aachen_000000` and 19 of `aachen_000000_000019_leftImg8bit`.
fn street_and_number(stem: &str) -> Option<(&str, u32)> {
    let (street, number) = stem.strip_suffix(LEFT[1])?.strip_suffix('_')?.rsplit_once('_')?;
    Some((street, number.parse().ok()?))
}

/// Runs of numbers that follow one another.
fn consecutive(frames: BTreeMap<u32, PathBuf>) -> Vec<BTreeMap<u32, PathBuf>> {
    let mut runs: Vec<BTreeMap<u32, PathBuf>> = Vec::new();
    for (number, path) in frames {
        match runs.last_mut() {
            Some(run) if run.last_key_value().is_some_and(|(&last, _)| number - last == 1) => {
                run.insert(number, path);
            }
            _ => runs.push(BTreeMap::from([(number, path)])),
        }
    }
    runs
}

/// Files of a street in one of the data set's folders, `CITY_SEQ_FRAME_ENDING`, by their frames.
fn numbered(root: &Path, folder: &str, street: &str, ending: &str) -> Result<BTreeMap<u32, PathBuf>> {
    let prefix = root.join(folder).join(street);
    let (Some(folder), Some(street)) = (prefix.parent(), prefix.file_name().and_then(|name| name.to_str())) else {
        return Ok(BTreeMap::new());
    };
    if !folder.is_dir() {
        return Ok(BTreeMap::new());
    }
    let mut found = BTreeMap::new();
    for entry in fs::read_dir(folder).map_err(|e| Error::io(folder, e))? {
        let path = entry.map_err(|e| Error::io(folder, e))?.path();
        let number = path.file_name().and_then(|name| name.to_str()).and_then(|name| {
            name.strip_prefix(street)?.strip_prefix('_')?.strip_suffix(ending)?.strip_suffix('_')?.parse().ok()
        });
        if let Some(number) = number {
            found.insert(number, path);
        }
    }
    Ok(found)
}

/// A snippet's left frames, and its right ones, if they are there.
fn snippet_of(
    root: &Path,
    name: &str,
    left: BTreeMap<u32, PathBuf>,
    cameras: &BTreeMap<u32, PathBuf>,
) -> Vec<Recording> {
    let (Some((&first, _)), Some((&last, _))) = (left.first_key_value(), left.last_key_value()) else {
        return Vec::new();
    };
    // One car took a street, and the same camera.
    let camera = cameras.range(first..=last).next().or_else(|| cameras.first_key_value()).map(|(_, path)| path.clone());
    let file = |folder: &str, number: u32, ending: &str| root.join(folder).join(format!("{name}_{number:06}_{ending}"));
    // Where the right pictures, and disparity, would be.
    let right = |number: u32| Some(file(RIGHT[0], number, &format!("{}.png", RIGHT[1]))).filter(|path| path.is_file());
    let disparity = |number: u32| {
        let places = ["disparity_sequence", "disparity"].map(|folder| file(folder, number, "disparity.png"));
        places.iter().find(|path| path.is_file()).unwrap_or(&places[0]).clone()
    };
    let truth = camera.as_ref().and_then(|path| CameraFile::read(path).ok()).map(|camera| {
        let focal_baseline = camera.intrinsic.fx * camera.extrinsic.baseline;
        move |number| Truth::DisparityPng { path: disparity(number), steps: 256.0, zero: 1, focal_baseline }
    });
    let rights: BTreeMap<u32, PathBuf> = left.keys().filter_map(|&number| Some((number, right(number)?))).collect();
    let expected = file("camera", first, "camera.json");
    let recording = |side: Side, own: &BTreeMap<u32, PathBuf>, other: &BTreeMap<u32, PathBuf>| Recording {
        name: name.to_owned(),
        side: Some(side),
        path: root.to_owned(),
        frames: own
            .iter()
            .map(|(&number, picture)| FrameFiles {
                number: number as usize,
                label: number.to_string(),
                picture: picture.clone(),
                other: other.get(&number).cloned(),
                depth: truth.as_ref().filter(|_| side == Side::Left).map(|truth| truth(number)),
            })
            .collect(),
        calibration: Some(camera_of(camera.clone(), expected.clone())),
        other_at: Some(other_at(camera.clone(), expected.clone(), side)),
    };
    let mut found = vec![recording(Side::Left, &left, &rights)];
    if !rights.is_empty() {
        found.push(recording(Side::Right, &rights, &left));
    }
    found
}

/// The calibration of a snippet, or the error that there is none.
fn read_camera(camera: Option<&PathBuf>, expected: &Path) -> Result<(CameraFile, String)> {
    match camera {
        Some(path) => Ok((CameraFile::read(path)?, path.display().to_string())),
        None => {
            let message = "no frame of this snippet has a calibration: expected a file like this one (Cityscapes' camera \
                           package), or give --intrinsics or --fov";
            Err(Error::file(expected, message))
        }
    }
}

fn camera_of(camera: Option<PathBuf>, expected: PathBuf) -> Calibration {
    Box::new(move |_| {
        let (CameraFile { intrinsic: Intrinsic { fx, fy, u0, v0 }, .. }, place) =
            read_camera(camera.as_ref(), &expected)?;
        let found =
            of_pixels([fx, fy, u0, v0], SIZE).map_err(|why| Error::file(&place, format!("intrinsic: {why}")))?;
        Ok(Found::measured(found, place))
    })
}

fn other_at(camera: Option<PathBuf>, expected: PathBuf, side: Side) -> OtherAt {
    Box::new(move || {
        let (CameraFile { extrinsic: Extrinsic { baseline }, .. }, place) = read_camera(camera.as_ref(), &expected)?;
        Ok((if side == Side::Left { -baseline } else { baseline }, place))
    })
}
