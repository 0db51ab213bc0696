//! KITTI 2015 (stereo and scene flow): 200 pairs with disparity of static and moving things.
//!
//! ```text
//! ROOT/training/image_2/000000_10.png     the left picture; image_3 the right one
//! ROOT/training/disp_occ_0/000000_10.png  16-bit grey, disparity times 256, 0 for none
//! ROOT/training/calib_cam_to_cam/000000.txt
//! ```
//!
//! Without the calibration, that of 2011_09_26 is taken: f 721.5377 pixels, baseline 0.5327 m.

use std::path::Path;

use super::{Camera, Found, Still, Stills, Truth, files, stem};
use crate::Result;
use crate::camera::Intrinsics;
use crate::data::kitti::StereoPair;
use crate::formats::picture::check_picture;

/// Focal length in pixels, 2011_09_26.
const FOCAL: f64 = 721.5377;
/// Metres between the cameras, 2011_09_26.
const BASELINE: f64 = 0.5327;

pub(super) fn is(root: &Path) -> bool {
    root.join("training/image_2").is_dir() && root.join("training/disp_occ_0").is_dir()
}

pub(super) fn add(stills: &mut Stills, root: &Path, camera: Camera) -> Result<()> {
    let folder = root.join("training");
    for picture in files(&folder.join("image_2"), |name| name.ends_with("_10.png"))? {
        let size = check_picture(&picture)?;
        let frame = stem(&picture);
        let file = folder.join("calib_cam_to_cam").join(frame.replace("_10", ".txt"));
        let pair = if file.is_file() { Some(StereoPair::read(&file, ["02", "03"])?) } else { None };
        let (width, height) = (f64::from(size.0), f64::from(size.1));
        let usual = Intrinsics { fx: FOCAL / width, fy: FOCAL / height, cx: 609.5593 / width, cy: 172.854 / height };
        let (intrinsics, baseline) = pair.map_or((usual, BASELINE), |pair| (pair.intrinsics(), pair.baseline()));
        let place =
            if file.is_file() { file.display().to_string() } else { "the calibration of 2011_09_26".to_owned() };
        let camera = camera.resolve(root, &folder, size, Some(&|| Ok(Found::measured(intrinsics, place.clone()))))?;
        let name = picture.file_name().unwrap_or_default();
        let right = Some(folder.join("image_3").join(name)).filter(|path| path.is_file());
        let truth = Truth::DisparityPng {
            zero: 0,
            path: folder.join("disp_occ_0").join(name),
            steps: 256.0,
            focal_baseline: intrinsics.fx * width * baseline,
        };
        let (name, rows) = (format!("training {frame}"), [0, size.1]);
        stills.add(Still { name, picture, right, baseline: Some(baseline), camera, rows, truth });
    }
    Ok(())
}
