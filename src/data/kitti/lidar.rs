//! Depth from a LiDAR scan: its points, projected into a camera.

use std::fs;
use std::path::Path;

use crate::depth::DepthMap;
use crate::formats::bounded::read_bounded;
use crate::{Error, Result};

/// What a point's depth is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DepthAxis {
    /// The z of the camera: what a network predicts.
    #[default]
    CameraZ,
    /// The x of the LiDAR, which sits about 0.27 m behind the camera: what the Eigen tables of the literature use.
    LidarX,
}

/// Bytes of a point: x, y, z (metres; forward, left, up) and reflectance, little-endian f32.
const POINT: usize = 16;

/// The most bytes of a scan: four million points, thirty times as many as one turn of KITTI's LiDAR sees.
const MAX_SCAN: u64 = 64 << 20;

/// A scan's file is whole points.
pub fn check_scan(path: &Path) -> Result<()> {
    let length = fs::metadata(path).map_err(|e| Error::io(path, e))?.len();
    check_length(path, length)
}

fn check_length(path: &Path, length: u64) -> Result<()> {
    if length > MAX_SCAN {
        let message = format!("{length} bytes: LiDAR scans above {MAX_SCAN} are refused; check that this is one turn");
        return Err(Error::file(path, message));
    }
    if length == 0 || !length.is_multiple_of(POINT as u64) {
        let message = format!("expected a LiDAR scan of {POINT} bytes a point, found {length} bytes: the file is cut");
        return Err(Error::file(path, message));
    }
    Ok(())
}

/// The points of a scan, x, y and z in metres.
pub fn read_scan(path: &Path) -> Result<Vec<[f32; 3]>> {
    let bytes = read_bounded(path, MAX_SCAN, "a LiDAR scan")?;
    check_length(path, bytes.len() as u64)?;
    let points = bytes.as_chunks::<POINT>().0.iter();
    Ok(points
        .map(|point| {
            let [x, y, z, _] = point.as_chunks::<4>().0 else { unreachable!("sixteen bytes are four floats") };
            [x, y, z].map(|b| f32::from_le_bytes(*b))
        })
        .collect())
}

/// Projects points in front of the LiDAR (x >= 0) by `lidar_to_image` (3x4, row-major) into a depth map. A point at
/// (u, v) falls on column `round(u) - 1` and row `round(v) - 1` (halves to even: the convention of the Eigen tables,
/// whose pixels count from 1). Of several points on a pixel the nearest wins; a negative depth becomes 0.
pub fn project_scan(
    points: &[[f32; 3]],
    lidar_to_image: &[f64; 12],
    width: usize,
    height: usize,
    axis: DepthAxis,
) -> DepthMap {
    let mut metres = vec![f32::INFINITY; width * height];
    for point in points.iter().filter(|point| point[0] >= 0.0) {
        let [x, y, z] = point.map(f64::from);
        let rows = lidar_to_image.as_chunks::<4>().0;
        let row = |i: usize| rows[i][0] * x + rows[i][1] * y + rows[i][2] * z + rows[i][3];
        let camera_z = row(2);
        let (column, line) = ((row(0) / camera_z).round_ties_even() - 1.0, (row(1) / camera_z).round_ties_even() - 1.0);
        // Also false for what is not a number.
        if (0.0..width as f64).contains(&column) && (0.0..height as f64).contains(&line) {
            let depth = match axis {
                DepthAxis::CameraZ => camera_z,
                DepthAxis::LidarX => x,
            };
            let pixel = &mut metres[line as usize * width + column as usize];
            *pixel = pixel.min(depth as f32);
        }
    }
    for depth in &mut metres {
        *depth = if *depth > 0.0 && depth.is_finite() { *depth } else { 0.0 };
    }
    DepthMap { width, height, metres }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Camera axes from the LiDAR's, focal length 10, centre (5, 4).
    const P: [f64; 12] = [5.0, -10.0, 0.0, 0.0, 4.0, 0.0, -10.0, 0.0, 1.0, 0.0, 0.0, 0.0];

    #[test]
    fn nearest_point_wins_and_pixels_count_from_one() {
        let points = [[4.0, 0.0, 0.0], [2.0, 0.0, 0.0], [8.0, 0.0, 0.0], [-3.0, 0.0, 0.0], [f32::NAN, 0.0, 0.0]];
        let depth = project_scan(&points, &P, 10, 8, DepthAxis::CameraZ);
        // (u, v) = (5, 4) is column 4, row 3.
        assert_eq!(depth.metres[3 * 10 + 4], 2.0);
        assert_eq!(depth.metres.iter().filter(|&&d| d > 0.0).count(), 1);
    }

    #[test]
    fn halves_round_to_even() {
        // u = 5 - 10 y / x: 4.5 goes to 4, 5.5 to 6.
        let depth = project_scan(&[[2.0, 0.1, 0.0]], &P, 10, 8, DepthAxis::CameraZ);
        assert_eq!(depth.metres[3 * 10 + 3], 2.0);
        let depth = project_scan(
            &[[1.0, 0.0625, 0.0]],
            &[8.0, -8.0, 0.0, 0.0, 4.0, 0.0, -8.0, 0.0, 1.0, 0.0, 0.0, 0.0],
            10,
            8,
            DepthAxis::CameraZ,
        );
        // u = 7.5 goes to 8: column 7.
        assert_eq!(depth.metres[3 * 10 + 7], 1.0);
    }

    #[test]
    fn the_axis_is_the_depth() {
        let mut p = P;
        p[11] = -0.25;
        let at = |axis| project_scan(&[[2.0, 0.0, 0.0]], &p, 12, 8, axis).metres.iter().copied().fold(0.0, f32::max);
        assert_eq!(at(DepthAxis::CameraZ), 1.75);
        assert_eq!(at(DepthAxis::LidarX), 2.0);
    }

    #[test]
    fn a_cut_scan_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scan.bin");
        fs::write(&path, [0; 40]).unwrap();
        for error in [check_scan(&path).unwrap_err(), read_scan(&path).unwrap_err()] {
            assert!(error.to_string().contains("scan.bin") && error.to_string().contains("40 bytes"), "{error}");
        }
        std::fs::File::create(&path).unwrap().set_len(1 << 40).unwrap();
        for error in [check_scan(&path).unwrap_err(), read_scan(&path).unwrap_err()] {
            let error = error.to_string();
            assert!(error.contains("scan.bin") && error.contains("67108864"), "{error}");
        }
        fs::write(&path, [1.5f32, -2.0, 0.25, 0.5].map(f32::to_le_bytes).as_flattened()).unwrap();
        assert_eq!(read_scan(&path).unwrap(), [[1.5, -2.0, 0.25]]);
    }
}
