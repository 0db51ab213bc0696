//! Which camera took the pictures: what the user says, a `camera.toml` among the data, the calibration, or KITTI's constants.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::augment::flip_intrinsics;
use crate::camera::Intrinsics;
use crate::formats::bounded::{MAX_SETTINGS, read_text};
use crate::formats::picture::is_size;
use crate::{Error, Result};

/// The intrinsics that samples carry.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "kind", deny_unknown_fields)]
pub enum Camera {
    /// The first of these that is there: `camera.toml` in the drive's folder or one above it up to the data's, the day's
    /// `calib_cam_to_cam.txt`, and, for pictures of KITTI's aspect alone, the published constants.
    #[default]
    Auto,
    /// The constants of the published training, whatever the drive: [`Intrinsics::KITTI`]. As there they hold for mirrored
    /// pictures, too: their centre is a convention, not a measurement.
    KittiPublished,
    /// `P_rect_02` or `P_rect_03` of the day's `calib_cam_to_cam.txt`, over `S_rect`.
    Calibrated,
    /// A field of view, square pixels, and the principal point in the middle.
    Fov {
        /// Degrees across.
        degrees: f64,
    },
    /// Focal lengths and principal point in pixels of the pictures as they are stored.
    Pixels {
        /// Horizontal focal length.
        fx: f64,
        /// Vertical focal length.
        fy: f64,
        /// Horizontal principal point.
        cx: f64,
        /// Vertical principal point.
        cy: f64,
    },
}

/// A camera that was found.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Found {
    pub(super) intrinsics: Intrinsics,
    /// Where it was found, in words.
    pub(super) place: String,
    /// Whether these are the published constants, and not what somebody measured.
    pub(super) published: bool,
}

impl Found {
    pub(super) fn measured(intrinsics: Intrinsics, place: impl Into<String>) -> Found {
        Found { intrinsics, place: place.into(), published: false }
    }

    fn published(place: impl Into<String>) -> Found {
        Found { intrinsics: Intrinsics::KITTI, place: place.into(), published: true }
    }
}

/// Cameras in words, each once.
pub(super) fn in_words<'a>(cameras: impl Iterator<Item = &'a Found>) -> Vec<String> {
    let mut said: Vec<String> = Vec::new();
    for Found { intrinsics: k, place, .. } in cameras {
        let line = format!("fx {:.4}, fy {:.4}, cx {:.4}, cy {:.4} of the size: {place}", k.fx, k.fy, k.cx, k.cy);
        if !said.contains(&line) {
            said.push(line);
        }
    }
    said
}

/// The camera of a sample's pictures once they are mirrored and `width` pixels wide. The published constants stay as they
/// are, as in the published training.
pub(super) fn mirrored(camera: &Found, width: usize) -> Intrinsics {
    if camera.published { camera.intrinsics } else { flip_intrinsics(camera.intrinsics, width) }
}

/// Width over height of KITTI's pictures.
const KITTI_ASPECT: f64 = 1242.0 / 375.0;

/// The name of the file that says which camera took the pictures beside it.
const FILE: &str = "camera.toml";

/// The content of `camera.toml`: a field of view, or focal lengths and principal point in pixels of a size; and where the
/// files of frames lie ([`frames`](super::frames)).
#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CameraFile {
    width: Option<f64>,
    height: Option<f64>,
    fx: Option<f64>,
    fy: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    fov: Option<f64>,
    /// Pattern of the pictures that are frames.
    pub(super) frames: Option<String>,
    /// Pattern of the right camera's pictures.
    pub(super) right: Option<String>,
    /// Pattern of depth maps.
    pub(super) depth: Option<String>,
    /// Metres between the cameras.
    pub(super) baseline: Option<f64>,
}

/// The `camera.toml` in a folder or the nearest one above it up to `root`, if there is one.
///
/// # Errors
/// If it cannot be read.
pub(super) fn file_of(root: &Path, folder: &Path) -> Result<Option<(PathBuf, CameraFile)>> {
    let above = folder.ancestors().take_while(|folder| folder.starts_with(root));
    let Some(path) = above.map(|folder| folder.join(FILE)).find(|file| file.is_file()) else { return Ok(None) };
    let text = read_text(&path, MAX_SETTINGS, "a camera")?;
    let said = toml::from_str(&text).map_err(|e| Error::file(&path, e.to_string()))?;
    Ok(Some((path, said)))
}

impl Camera {
    /// The intrinsics of a drive's pictures, which are `width x height`, and where they were found; `root` is the folder
    /// of all data, `calibration` what the data set's own files say, where it has any.
    ///
    /// # Errors
    /// If nothing is known of the camera, or what is said cannot be.
    pub(super) fn resolve(
        self,
        root: &Path,
        drive: &Path,
        (width, height): (u32, u32),
        calibration: Option<&dyn Fn() -> Result<Found>>,
    ) -> Result<Found> {
        let size = [f64::from(width), f64::from(height)];
        match self {
            Camera::KittiPublished => Ok(Found::published("KITTI's published constants")),
            Camera::Calibrated => match calibration {
                Some(calibrated) => calibrated(),
                None => Err(Error::file(
                    drive,
                    "has no calibration: expected calib_cam_to_cam.txt in the folder of its day",
                )),
            },
            Camera::Fov { degrees } => {
                let found = of_fov(degrees, size).map_err(|why| Error::setting("camera.degrees", why))?;
                Ok(Found::measured(found, format!("a field of view of {degrees} degrees")))
            }
            Camera::Pixels { fx, fy, cx, cy } => {
                let found = of_pixels([fx, fy, cx, cy], size).map_err(|why| Error::setting("camera", why))?;
                Ok(Found::measured(found, "the intrinsics that were given"))
            }
            Camera::Auto => {
                if let Some((file, said)) = file_of(root, drive)? {
                    let found = said.intrinsics(size).map_err(|why| Error::file(&file, why))?;
                    return Ok(Found::measured(found, file.display().to_string()));
                }
                if let Some(calibrated) = calibration {
                    return calibrated();
                }
                if ((size[0] / size[1]) / KITTI_ASPECT - 1.0).abs() < 0.1 {
                    return Ok(Found::published("KITTI's published constants, for want of a calibration"));
                }
                let message = format!(
                    "nothing says which camera took these pictures of {width}x{height}: write {FILE} into this folder or \
                     one above it (width, height, fx, fy, cx, cy in pixels, or fov in degrees across), or give --fov, \
                     --intrinsics or --camera kitti-published"
                );
                Err(Error::file(drive, message))
            }
        }
    }
}

/// The camera that a `camera.toml` in a picture's folder, or the nearest one above it up to `root`, tells of pictures of
/// `[width, height]` pixels; nothing if there is no such file, or it says where frames lie and nothing of the camera.
///
/// # Errors
/// If the file cannot be read, or is for pictures of another aspect; the file is named.
pub fn told_beside(picture: &Path, root: &Path, size: [f64; 2]) -> Result<Option<Intrinsics>> {
    let Some((file, said)) = file_of(root, picture.parent().unwrap_or(root))? else { return Ok(None) };
    match said.says_nothing() {
        true => Ok(None),
        false => said.intrinsics(size).map(Some).map_err(|why| Error::file(&file, why)),
    }
}

impl CameraFile {
    /// Whether it has no word on the camera.
    fn says_nothing(&self) -> bool {
        [self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.fov].iter().all(Option::is_none)
    }

    /// Intrinsics of pictures of a size, `[width, height]`; why they cannot be, if they cannot.
    fn intrinsics(&self, size: [f64; 2]) -> Result<Intrinsics, String> {
        match *self {
            CameraFile { fov: Some(fov), fx: None, fy: None, cx: None, cy: None, .. } => of_fov(fov, size),
            CameraFile {
                width: Some(w),
                height: Some(h),
                fx: Some(fx),
                fy: Some(fy),
                cx: Some(cx),
                cy: Some(cy),
                fov: None,
                ..
            } => {
                if !is_size(w, h) {
                    Err(format!("is for pictures of {w}x{h}: expected whole pixels, at most 100 megapixels"))
                } else if ((w / h) / (size[0] / size[1]) - 1.0).abs() > 0.02 {
                    Err(format!("is for pictures of {w}x{h}, but these have {}x{}: another aspect", size[0], size[1]))
                } else {
                    of_pixels([fx, fy, cx, cy], [w, h])
                }
            }
            _ => Err("expected width, height, fx, fy, cx and cy in pixels, or fov in degrees across".into()),
        }
    }
}

/// Square pixels, the principal point between the middle ones.
fn of_fov(degrees: f64, [width, height]: [f64; 2]) -> Result<Intrinsics, String> {
    if !(degrees > 0.0 && degrees < 180.0) {
        return Err(format!("a field of view of {degrees} degrees: expected more than 0 and less than 180"));
    }
    let focal = 0.5 * width / (degrees / 2.0).to_radians().tan();
    of_pixels([focal, focal, (width - 1.0) / 2.0, (height - 1.0) / 2.0], [width, height])
}

/// Intrinsics of a picture of a size from pixels; why they cannot be, if they cannot.
pub(super) fn of_pixels([fx, fy, cx, cy]: [f64; 4], [width, height]: [f64; 2]) -> Result<Intrinsics, String> {
    let focal = |f: f64| f > 0.0 && f.is_finite();
    if !(focal(fx) && focal(fy) && width > 0.0 && height > 0.0) {
        return Err(format!("focal lengths {fx}, {fy} of {width}x{height} pixels: expected numbers above 0"));
    }
    if !((0.0..=width).contains(&cx) && (0.0..=height).contains(&cy)) {
        return Err(format!("a principal point at {cx}, {cy}, outside the picture of {width}x{height}"));
    }
    Ok(Intrinsics { fx: fx / width, fy: fy / height, cx: cx / width, cy: cy / height })
}

#[cfg(test)]
mod tests {
    use std::fs::{self, File};

    use super::*;

    const SIZE: (u32, u32) = (800, 600);

    /// What a drive's camera is found to be, with a `camera.toml` in the drive's folder.
    fn found(text: Option<&str>, camera: Camera) -> Result<(Intrinsics, String)> {
        resolved(text, camera, SIZE).map(|found| (found.intrinsics, found.place))
    }

    fn resolved(text: Option<&str>, camera: Camera, size: (u32, u32)) -> Result<Found> {
        let place = tempfile::tempdir().unwrap();
        let drive = place.path().join("day/drive");
        fs::create_dir_all(&drive).unwrap();
        if let Some(text) = text {
            fs::write(drive.join(FILE), text).unwrap();
        }
        camera.resolve(place.path(), &drive, size, None)
    }

    #[test]
    fn a_camera_file_is_exact_and_holds_for_any_size_of_its_aspect() {
        let text = "width = 1600\nheight = 1200\nfx = 1000\nfy = 990\ncx = 820.5\ncy = 580";
        let (camera, place) = found(Some(text), Camera::Auto).unwrap();
        let expected = Intrinsics { fx: 0.625, fy: 0.825, cx: 820.5 / 1600.0, cy: 580.0 / 1200.0 };
        assert_eq!(camera, expected);
        assert!(place.ends_with(FILE));
        let (wide, _) = found(Some("fov = 90"), Camera::Auto).unwrap();
        assert!((wide.fx - 0.5).abs() < 1e-12 && (wide.fy - 400.0 / 600.0).abs() < 1e-12);
        assert_eq!((wide.cx, wide.cy), (399.5 / 800.0, 299.5 / 600.0));
    }

    #[test]
    fn what_the_user_says_wins_and_nothing_known_is_refused() {
        let file = Some("fov = 90");
        let said = Camera::Pixels { fx: 400.0, fy: 300.0, cx: 200.0, cy: 150.0 };
        assert_eq!(found(file, said).unwrap().0, Intrinsics { fx: 0.5, fy: 0.5, cx: 0.25, cy: 0.25 });
        assert_eq!(found(file, Camera::KittiPublished).unwrap().0, Intrinsics::KITTI);
        let error = found(None, Camera::Auto).unwrap_err().to_string();
        assert!(error.contains("drive") && error.contains("800x600") && error.contains("--fov"), "{error}");
    }

    #[test]
    fn a_camera_file_that_is_too_long_is_not_read() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join(FILE);
        File::create(&path).unwrap().set_len(1 << 40).unwrap();
        let error = file_of(place.path(), place.path()).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains(FILE) && error.contains("a camera of more than 1048576"), "{error}");
    }

    #[test]
    fn only_the_published_constants_by_name_count_as_published() {
        let kitti = (1242, 375);
        let published = |text, camera| resolved(text, camera, kitti).unwrap().published;
        assert!(published(None, Camera::Auto) && published(Some("fov = 90"), Camera::KittiPublished));
        // The same numbers, measured.
        let [fx, fy, cx, cy] = [0.58 * 1242.0, 1.92 * 375.0, 621.0, 187.5];
        assert!(!published(None, Camera::Pixels { fx, fy, cx, cy }));
        assert!(!published(Some("fov = 90"), Camera::Auto) && !published(None, Camera::Fov { degrees: 80.0 }));
    }

    #[test]
    fn a_camera_that_cannot_be_is_refused_by_file() {
        for text in [
            "",
            "fov = 0",
            "fov = 200",
            "fov = nan",
            "fov = 60\nfx = 3",
            "width = 800\nheight = 600\nfx = 500\nfy = 500\ncx = 400",
            "width = 800\nheight = 600\nfx = -500\nfy = 500\ncx = 400\ncy = 300",
            "width = 800\nheight = 600\nfx = 500\nfy = inf\ncx = 400\ncy = 300",
            "width = 800\nheight = 600\nfx = 500\nfy = 500\ncx = 900\ncy = 300",
            "width = 800\nheight = 300\nfx = 500\nfy = 500\ncx = 400\ncy = 200",
            "focal = 3",
            // Sizes that no picture has.
            "width = 1e9\nheight = 7.5e8\nfx = 500\nfy = 500\ncx = 400\ncy = 300",
            "width = 800.5\nheight = 600.375\nfx = 500\nfy = 500\ncx = 400\ncy = 300",
            "width = nan\nheight = nan\nfx = 500\nfy = 500\ncx = 400\ncy = 300",
        ] {
            let error = found(Some(text), Camera::Auto).unwrap_err().to_string();
            assert!(error.contains(FILE), "{text}: {error}");
        }
    }
}
