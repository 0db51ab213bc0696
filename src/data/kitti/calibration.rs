//! The calibration of a day: `calib_cam_to_cam.txt` and `calib_velo_to_cam.txt`, lines `KEY: numbers`.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::Side;
use crate::camera::Intrinsics;
use crate::data::camera::of_pixels;
use crate::formats::bounded::{MAX_SETTINGS, read_text};
use crate::formats::picture::is_size;
use crate::{Error, Result};

pub(super) const CAMERAS: &str = "calib_cam_to_cam.txt";
const LIDAR: &str = "calib_velo_to_cam.txt";

/// What KITTI's calibration says about the two colour cameras and the LiDAR.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    /// Width and height of the rectified pictures, `S_rect_02`.
    pub size: (usize, usize),
    /// Left and right: width and height (`S_rect_0c`) and the 3x4 projection (`P_rect_0c`), row-major.
    cameras: [Projection; 2],
    /// `R_rect_00` times LiDAR to camera 0, 4x4 row-major.
    lidar_to_rectified: Option<[f64; 16]>,
}

#[derive(Clone, Debug, PartialEq)]
struct Projection {
    size: [f64; 2],
    matrix: [f64; 12],
}

impl Projection {
    fn read(entries: &CalibrationLines, camera: &str) -> Result<Self> {
        let size = entries.size(&format!("S_rect_{camera}"))?;
        Ok(Projection { size, matrix: entries.numbers(&format!("P_rect_{camera}"))? })
    }

    fn intrinsics(&self) -> Intrinsics {
        let Projection { size: [width, height], matrix: p } = self;
        Intrinsics { fx: p[0] / width, fy: p[5] / height, cx: p[2] / width, cy: p[6] / height }
    }
}

impl Calibration {
    /// Whether the folder of a day has both files.
    pub fn is_in(day: &Path) -> bool {
        day.join(CAMERAS).is_file() && day.join(LIDAR).is_file()
    }

    /// Whether the folder of a day says which cameras were used.
    pub fn has_cameras(day: &Path) -> bool {
        day.join(CAMERAS).is_file()
    }

    /// The measured intrinsics of one camera, whatever the file says of the other: `P_rect` over `S_rect`.
    pub fn intrinsics_of(day: &Path, side: Side) -> Result<Intrinsics> {
        let entries = CalibrationLines::read(day.join(CAMERAS))?;
        let camera = match side {
            Side::Left => "02",
            Side::Right => "03",
        };
        let Projection { size, matrix: p } = Projection::read(&entries, camera)?;
        of_pixels([p[0], p[5], p[2], p[6]], size)
            .map_err(|why| Error::file(&entries.path, format!("P_rect_{camera}: {why}; restore the file")))
    }

    /// Reads the files in the folder of a day; that of the LiDAR only `with_lidar`.
    pub fn read(day: &Path, with_lidar: bool) -> Result<Calibration> {
        let cameras = CalibrationLines::read(day.join(CAMERAS))?;
        let cameras_of_sides = [Projection::read(&cameras, "02")?, Projection::read(&cameras, "03")?];
        let [width, height] = cameras_of_sides[0].size;
        let lidar_to_rectified = match with_lidar {
            false => None,
            true => {
                let lidar = CalibrationLines::read(day.join(LIDAR))?;
                let rectify = rigid(cameras.numbers("R_rect_00")?, [0.0; 3]);
                Some(product(&rectify, &rigid(lidar.numbers("R")?, lidar.numbers("T")?)))
            }
        };
        Ok(Calibration { size: (width as usize, height as usize), cameras: cameras_of_sides, lidar_to_rectified })
    }

    /// Whether it was read with the LiDAR.
    pub fn has_lidar(&self) -> bool {
        self.lidar_to_rectified.is_some()
    }

    fn camera(&self, side: Side) -> &Projection {
        match side {
            Side::Left => &self.cameras[0],
            Side::Right => &self.cameras[1],
        }
    }

    /// The measured intrinsics: `P_rect` over `S_rect`.
    pub fn intrinsics(&self, side: Side) -> Intrinsics {
        self.camera(side).intrinsics()
    }

    /// How far the right colour camera stands from the left one, in metres: `(P2x - P3x) / f`, of projections that differ
    /// in nothing else that matters to a pair.
    ///
    /// # Errors
    /// If they do: other focal lengths or principal points by more than a hundredth of a pixel, or the cameras in one
    /// place or changed over. Names the file in the folder of a day.
    pub fn baseline(&self, day: &Path) -> Result<f64> {
        let [left, right] = self.cameras.each_ref().map(|camera| camera.matrix);
        let wrong = |message: String| Err(Error::file(day.join(CAMERAS), message));
        if let Some(i) = [0, 2, 5, 6].into_iter().find(|&i| (left[i] - right[i]).abs() > 0.01) {
            let message = "a pair needs rectified cameras of one focal length and principal point";
            return wrong(format!("P_rect_02 has {} where P_rect_03 has {}: {message}", left[i], right[i]));
        }
        let baseline = (left[3] - right[3]) / left[0];
        match baseline > 0.0 && baseline.is_finite() {
            true => Ok(baseline),
            false => wrong(format!(
                "by P_rect_02 and P_rect_03 the right camera stands {baseline} m to the right of the left one"
            )),
        }
    }

    /// `P_rect_0c R_rect_00 Tr`, 3x4 row-major: from LiDAR coordinates (metres; x forward, y left, z up) to
    /// homogeneous pixels, whose third coordinate is camera z. `None` if the calibration was read without the LiDAR.
    pub fn lidar_to_image(&self, side: Side) -> Option<[f64; 12]> {
        Some(product(&self.camera(side).matrix, self.lidar_to_rectified.as_ref()?))
    }
}

/// Two rectified cameras side by side, from a calibration file.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::data) struct StereoPair {
    left: Projection,
    right: Projection,
}

impl StereoPair {
    /// Reads `S_rect_C` and `P_rect_C` of the left and the right camera.
    ///
    /// # Errors
    /// If one is missing, stands there twice or cannot be, or the right camera is not to the right of the left one.
    pub(in crate::data) fn read(path: &Path, [left, right]: [&str; 2]) -> Result<StereoPair> {
        let entries = CalibrationLines::read(path.to_owned())?;
        let pair = StereoPair { left: Projection::read(&entries, left)?, right: Projection::read(&entries, right)? };
        if pair.left.matrix[0] > 0.0 && pair.baseline() > 0.0 {
            return Ok(pair);
        }
        let message = format!(
            "P_rect_{left}, P_rect_{right}: expected a focal length above 0, and a first row whose last number is smaller \
             in the right camera's"
        );
        Err(Error::file(path, message))
    }

    /// The intrinsics of the left camera.
    pub(in crate::data) fn intrinsics(&self) -> Intrinsics {
        self.left.intrinsics()
    }

    /// Metres between the cameras: `(P_left[0, 3] - P_right[0, 3]) / f`.
    pub(in crate::data) fn baseline(&self) -> f64 {
        (self.left.matrix[3] - self.right.matrix[3]) / self.left.matrix[0]
    }
}

/// `[R | t]` with the last row 0 0 0 1.
fn rigid(r: [f64; 9], t: [f64; 3]) -> [f64; 16] {
    let [a, b, c, d, e, f, g, h, i] = r;
    [a, b, c, t[0], d, e, f, t[1], g, h, i, t[2], 0.0, 0.0, 0.0, 1.0]
}

/// `a b` for a matrix `a` of rows of four (3x4 or 4x4) and a 4x4 matrix `b`.
fn product<const N: usize>(a: &[f64; N], b: &[f64; 16]) -> [f64; N] {
    std::array::from_fn(|i| (0..4).map(|k| a[i / 4 * 4 + k] * b[4 * k + i % 4]).sum())
}

/// The lines of a calibration file, `KEY: numbers`.
pub(in crate::data) struct CalibrationLines {
    path: PathBuf,
    values: HashMap<String, String>,
}

impl CalibrationLines {
    pub(in crate::data) fn read(path: PathBuf) -> Result<CalibrationLines> {
        let text = read_text(&path, MAX_SETTINGS, "a calibration")?;
        let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
        let mut values = HashMap::new();
        for (key, value) in text.lines().filter_map(|line| line.split_once(':')) {
            let key = key.trim();
            if values.insert(key.to_owned(), value.trim().to_owned()).is_some() {
                return Err(Error::file(path, format!("{key}: stands there twice; leave the right line of it")));
            }
        }
        Ok(CalibrationLines { path, values })
    }

    /// The `N` finite numbers of a key.
    pub(in crate::data) fn numbers<const N: usize>(&self, key: &str) -> Result<[f64; N]> {
        let wrong = |found: String| Error::file(&self.path, format!("{key}: expected {N} numbers, found {found}"));
        let text = self.values.get(key).ok_or_else(|| wrong("no such line".to_owned()))?;
        let number = |word: &str| match word.parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(number),
            _ => Err(wrong(format!("{word:?}"))),
        };
        let numbers = text.split_whitespace().map(number).collect::<Result<Vec<f64>>>()?;
        <[f64; N]>::try_from(numbers).map_err(|numbers| wrong(numbers.len().to_string()))
    }

    /// Width and height: whole numbers of pixels.
    fn size(&self, key: &str) -> Result<[f64; 2]> {
        let size: [f64; 2] = self.numbers(key)?;
        match is_size(size[0], size[1]) {
            true => Ok(size),
            false => {
                let message = format!(
                    "{key}: expected width and height in pixels, at most 100 megapixels, found {size:?}; it should be \
                     the size of this day's pictures"
                );
                Err(Error::file(&self.path, message))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs::{self, File};

    use super::*;

    const CAMERA_LINES: [&str; 5] = [
        "S_rect_02: 1.242e+03 3.75e+02",
        "S_rect_03: 1.242e+03 3.75e+02",
        "R_rect_00: 1 0 0 0 1 0 0 0 1",
        "P_rect_02: 700 0 600 45 0 710 170 0.2 0 0 1 0.003",
        "P_rect_03: 700 0 610 -339 0 710 180 2.2 0 0 1 0.003",
    ];

    fn day(camera_lines: &[&str], lidar: &str) -> tempfile::TempDir {
        let day = tempfile::tempdir().unwrap();
        let lines = format!("calib_time: 09-Jan-2012 13:57:47\n{}\n", camera_lines.join("\n"));
        fs::write(day.path().join(CAMERAS), lines).unwrap();
        fs::write(day.path().join(LIDAR), lidar).unwrap();
        day
    }

    #[test]
    fn reads_intrinsics_and_projection() {
        // The LiDAR's axes turned to the camera's: z forward is x, x right is -y, y down is -z.
        let day = day(&CAMERA_LINES, "R: 0 -1 0 0 0 -1 1 0 0\nT: 0.5 -0.25 -0.125\n");
        let calibration = Calibration::read(day.path(), true).unwrap();
        assert_eq!(calibration.size, (1242, 375));
        let left = calibration.intrinsics(Side::Left);
        assert_eq!((left.fx, left.cx), (700.0 / 1242.0, 600.0 / 1242.0));
        assert_eq!((left.fy, left.cy), (710.0 / 375.0, 170.0 / 375.0));
        assert_eq!(calibration.intrinsics(Side::Right).cx, 610.0 / 1242.0);
        let p = calibration.lidar_to_image(Side::Left).unwrap();
        // A point at (10, 2, 1): camera (-2 + 0.5, -1 - 0.25, 10 - 0.125).
        let q: Vec<f64> = p.as_chunks::<4>().0.iter().map(|r| r[0] * 10.0 + r[1] * 2.0 + r[2] + r[3]).collect();
        let expected = [700.0 * -1.5 + 600.0 * 9.875 + 45.0, 710.0 * -1.25 + 170.0 * 9.875 + 0.2, 9.878];
        for (a, b) in q.iter().zip(expected) {
            assert!((a - b).abs() < 1e-9, "{a} {b}");
        }
    }

    #[test]
    fn messages_name_file_key_and_number() {
        for (i, line, what) in [
            (0, "", "S_rect_02: expected 2 numbers, found no such line"),
            (3, "P_rect_02: 1 2 3", "P_rect_02: expected 12 numbers, found 3"),
            (4, "P_rect_03: 700 0 x -339 0 710 180 2.2 0 0 1 0.003", "found \"x\""),
            (1, "S_rect_03: 0 375", "S_rect_03: expected width and height"),
            (0, "S_rect_02: 16384 16384", "S_rect_02: expected width and height"),
            (0, "S_rect_02: 1e8 2", "at most 100 megapixels"),
        ] {
            let mut lines = CAMERA_LINES;
            lines[i] = line;
            let day = day(&lines, "");
            let error = Calibration::read(day.path(), false).unwrap_err().to_string();
            assert!(error.contains(CAMERAS) && error.contains(what), "{error}");
        }
        for (line, what) in [
            ("P_rect_02: 700 0 1300 45 0 710 170 0.2 0 0 1 0", "outside the picture"),
            ("P_rect_02: -7 0 600 45 0 710 170 0.2 0 0 1 0", "above 0"),
        ] {
            let mut lines = CAMERA_LINES;
            lines[3] = line;
            let error = Calibration::intrinsics_of(day(&lines, "").path(), Side::Left).unwrap_err().to_string();
            assert!(error.contains(CAMERAS) && error.contains("P_rect_02") && error.contains(what), "{error}");
        }
        let huge = day(&CAMERA_LINES, "");
        File::options().write(true).open(huge.path().join(CAMERAS)).unwrap().set_len(1 << 40).unwrap();
        let error = Calibration::read(huge.path(), false).unwrap_err().to_string();
        assert!(error.contains(CAMERAS) && error.contains("a calibration of more than 1048576"), "{error}");
        let error = Calibration::read(day(&CAMERA_LINES, "R: 1\n").path(), true).unwrap_err().to_string();
        assert!(error.contains(LIDAR) && error.contains("R: expected 9 numbers, found 1"), "{error}");
    }
}
