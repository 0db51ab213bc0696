//! DrivingStereo's weather sets: foggy, cloudy, rainy, sunny; 500 pictures each.
//!
//! ```text
//! ROOT/WEATHER/left-image-full-size/FRAME.jpg (or .png)   1762 x 800; right-image-full-size the right one
//! ROOT/WEATHER/depth-map-full-size/FRAME.png              16-bit grey, metres times 256
//! ROOT/WEATHER/disparity-map-full-size/FRAME.png          16-bit grey, disparity times 128, at half size times 256
//! ROOT/half-image-calib/DATE.txt                          P_rect_101, P_rect_103, S_rect_101; or beside the pictures
//! ```
//!
//! ROOT may be a WEATHER itself. Full size is taken where it is there, otherwise half; of the maps depth, otherwise
//! disparity. DATE is what a frame's name begins with: ten characters such as 2018-07-16. Where there is no such
//! calibration, f is taken as 2063 pixels at full size and the baseline as 0.5446 m, which are the set's approximate
//! figures.

use std::path::{Path, PathBuf};

use super::{Camera, Found, Still, Stills, Truth, files, folders, stem};
use crate::Result;
use crate::camera::Intrinsics;
use crate::data::kitti::StereoPair;
use crate::formats::picture::check_picture;

/// Size in the folders' names, the steps of a pixel of disparity, and the usual focal length in pixels.
const SIZES: [(&str, f64, f64); 2] = [("full", 128.0, 2063.0), ("half", 256.0, 1031.5)];
/// Metres between the cameras.
const BASELINE: f64 = 0.5446;

fn has_pictures(folder: &Path) -> bool {
    SIZES.iter().any(|(size, ..)| folder.join(format!("left-image-{size}-size")).is_dir())
}

/// The folders of weathers in a folder, or itself.
fn weathers(root: &Path) -> Result<Vec<PathBuf>> {
    if has_pictures(root) {
        return Ok(vec![root.to_owned()]);
    }
    Ok(folders(root)?.into_iter().filter(|folder| has_pictures(folder)).collect())
}

pub(super) fn is(root: &Path) -> Result<bool> {
    Ok(!weathers(root)?.is_empty())
}

pub(super) fn add(stills: &mut Stills, root: &Path, camera: Camera) -> Result<()> {
    for weather in weathers(root)? {
        let of = |what: &str, size: &str| weather.join(format!("{what}-{size}-size"));
        let Some(&(size, steps, focal)) = SIZES.iter().find(|(size, ..)| of("left-image", size).is_dir()) else {
            continue;
        };
        let folder = if weather == root { ".".to_owned() } else { stem(&weather) };
        for picture in files(&of("left-image", size), |name| name.ends_with(".jpg") || name.ends_with(".png"))? {
            let pixels = check_picture(&picture)?;
            let frame = stem(&picture);
            let file = calibration_file(root, &weather, &frame);
            let pair = file.as_deref().map(|file| StereoPair::read(file, ["101", "103"])).transpose()?;
            let (width, height) = (f64::from(pixels.0), f64::from(pixels.1));
            let usual = Intrinsics { fx: focal / width, fy: focal / height, cx: 0.5, cy: 0.5 };
            let (intrinsics, baseline) = pair.map_or((usual, BASELINE), |pair| (pair.intrinsics(), pair.baseline()));
            let place = file.map_or("DrivingStereo's usual f".to_owned(), |file| file.display().to_string());
            let found = || Ok(Found::measured(intrinsics, place.clone()));
            let camera = camera.resolve(root, &weather, pixels, Some(&found))?;
            let focal_baseline = intrinsics.fx * width * baseline;
            let named = |what: &str| of(what, size).join(format!("{frame}.png"));
            let truth = match of("depth-map", size).is_dir() {
                true => Truth::DepthPng(named("depth-map")),
                false => Truth::DisparityPng { path: named("disparity-map"), zero: 0, steps, focal_baseline },
            };
            let right = picture.file_name().map(|name| of("right-image", size).join(name)).filter(|p| p.is_file());
            let name = format!("{folder} {frame}");
            let rows = [0, pixels.1];
            stills.add(Still { name, picture, right, baseline: Some(baseline), camera, rows, truth });
        }
    }
    Ok(())
}

/// The calibration of the day that a frame's name begins with, if it is there.
fn calibration_file(root: &Path, weather: &Path, frame: &str) -> Option<PathBuf> {
    let name = format!("half-image-calib/{}.txt", frame.get(..10)?);
    [weather, root].map(|folder| folder.join(&name)).into_iter().find(|file| file.is_file())
}
