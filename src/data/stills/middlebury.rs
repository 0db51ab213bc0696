//! Middlebury 2014: indoor scenes with dense disparity.
//!
//! ```text
//! ROOT/SCENE/im0.png, im1.png             the left and the right picture
//! ROOT/SCENE/disp0GT.pfm or disp0.pfm     disparity of the left one, infinite for none
//! ROOT/SCENE/calib.txt                    cam0=[f 0 cx; 0 f cy; 0 0 1], doffs in pixels, baseline in millimetres
//! ```
//!
//! ROOT may be a SCENE itself. Depth is `baseline f / (disparity + doffs)`.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::{Camera, Found, Still, Stills, Truth, folders, stem};
use crate::camera::Intrinsics;
use crate::formats::bounded::{MAX_SETTINGS, read_text};
use crate::formats::picture::check_picture;
use crate::{Error, Result};

fn is_scene(folder: &Path) -> bool {
    ["im0.png", "im1.png", "calib.txt"].iter().all(|name| folder.join(name).is_file())
}

/// The scenes in a folder, or itself.
fn scenes(root: &Path) -> Result<Vec<PathBuf>> {
    if is_scene(root) {
        return Ok(vec![root.to_owned()]);
    }
    Ok(folders(root)?.into_iter().filter(|folder| is_scene(folder)).collect())
}

pub(super) fn is(root: &Path) -> Result<bool> {
    Ok(!scenes(root)?.is_empty())
}

pub(super) fn add(stills: &mut Stills, root: &Path, camera: Camera) -> Result<()> {
    for scene in scenes(root)? {
        let picture = scene.join("im0.png");
        let size @ (width, height) = check_picture(&picture)?;
        let file = scene.join("calib.txt");
        let Calib { focal, centre, offset, baseline } = Calib::read(&file)?;
        let measured = || {
            let (w, h) = (f64::from(width), f64::from(height));
            let intrinsics = Intrinsics { fx: focal / w, fy: focal / h, cx: centre[0] / w, cy: centre[1] / h };
            Ok(Found::measured(intrinsics, file.display().to_string()))
        };
        let camera = camera.resolve(root, &scene, size, Some(&measured))?;
        let maps = ["disp0GT.pfm", "disp0.pfm"].map(|name| scene.join(name));
        let [first, other] = maps;
        let path = if other.is_file() && !first.is_file() { other } else { first };
        let truth = Truth::DisparityPfm { path, focal_baseline: focal * baseline, offset };
        let folder = if scene == root { ".".to_owned() } else { stem(&scene) };
        let right = Some(scene.join("im1.png")).filter(|path| path.is_file());
        let (name, rows) = (format!("{folder} im0"), [0, height]);
        stills.add(Still { name, picture, right, baseline: Some(baseline), camera, rows, truth });
    }
    Ok(())
}

/// The entries of `calib.txt`.
struct Calib {
    /// In pixels.
    focal: f64,
    /// The principal point of the left camera, in pixels.
    centre: [f64; 2],
    /// Horizontal distance of the principal points, in pixels.
    offset: f64,
    /// In metres.
    baseline: f64,
}

impl Calib {
    fn read(path: &Path) -> Result<Calib> {
        let text = read_text(path, MAX_SETTINGS, "a calibration")?;
        let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
        let mut values: HashMap<&str, &str> = HashMap::new();
        for (key, value) in text.lines().filter_map(|line| line.split_once('=')) {
            if values.insert(key.trim(), value.trim()).is_some() {
                return Err(Error::file(path, format!("{}: stands there twice; leave one line of it", key.trim())));
            }
        }
        let numbers = |key: &str, expected: &str, count: usize| -> Result<Vec<f64>> {
            let value = values.get(key).copied().unwrap_or("no such line");
            let words = value.split(|c: char| c.is_whitespace() || "[];".contains(c)).filter(|word| !word.is_empty());
            let found: Option<Vec<f64>> = words.map(|word| word.parse().ok().filter(|n: &f64| n.is_finite())).collect();
            let wrong = || Error::file(path, format!("{key}: expected {expected}, found {value:?}"));
            found.filter(|found| found.len() == count).ok_or_else(wrong)
        };
        let camera = numbers("cam0", "[f 0 cx; 0 f cy; 0 0 1] in pixels", 9)?;
        let offset = numbers("doffs", "the distance of the principal points in pixels", 1)?;
        let baseline = numbers("baseline", "millimetres between the cameras", 1)?;
        let (&[focal, _, x, _, _, y, ..], &[offset], &[baseline]) =
            (camera.as_slice(), offset.as_slice(), baseline.as_slice())
        else {
            return Err(Error::file(path, "expected cam0, doffs and baseline"));
        };
        if focal <= 0.0 || baseline <= 0.0 {
            let message = format!("expected f and baseline above 0, found {focal} and {baseline}");
            return Err(Error::file(path, message));
        }
        Ok(Calib { focal, centre: [x, y], offset, baseline: baseline / 1000.0 })
    }
}
