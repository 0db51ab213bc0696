//! Metric scale from a known camera: how high it hangs over the road says how long a metre is.
//!
//! Depth from a single moving camera is known up to a factor. The road gives it away, after DNet's dense geometrical
//! constraints (Xue et al., IROS 2020, 2004.05560): every pixel has a tangent plane; where that plane is level, it is
//! ground, and its distance from the camera is the camera's height in the prediction's unit; the median over all such
//! pixels against the true height is the factor.
//!
//! The tangent plane needs no point cloud. A plane `n . P = d` (unit normal n, distance d) seen along rays
//! `P = z (x, y, 1)` is linear in *inverse* depth:
//!
//! ```text
//! 1/z = a x + b y + c    with (a, b, c) = n / d
//! ```
//!
//! so differences of the inverse depth between neighbours are a and b, the value itself gives c, and
//! `d = 1 / |(a, b, c)|`.

use super::metrics::median;
use crate::camera::Intrinsics;

/// A plane is level if its normal is so near to the camera's y axis: the cosine of 5 degrees, as in the paper.
const LEVEL: f64 = 0.996_194_698;

/// There is a road if so many of the pixels are level.
const LEAST_SHARE: f64 = 0.01;

/// Ground plane found in a map of inverse depth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ground {
    /// The camera's height over it, in the unit of the map's depth.
    pub camera_height: f64,
    /// The share of the pixels that show it, in (0, 1].
    pub share: f64,
}

/// Finds the ground in a row-major `(height, width)` map of inverse depth, seen by a camera that is held level to some
/// degrees (its y axis points down). `None` if less than a hundredth of the map is ground.
///
/// # Panics
/// If the map does not hold `height * width` values.
pub fn find_ground(inverse_depth: &[f32], (height, width): (usize, usize), camera: Intrinsics) -> Option<Ground> {
    assert_eq!(inverse_depth.len(), height * width, "find_ground: a map of {height}x{width} expected");
    let at = |u: usize, v: usize| f64::from(inverse_depth[v * width + u]);
    let (fx, fy) = (camera.fx * width as f64, camera.fy * height as f64);
    let (cx, cy) = (camera.cx * width as f64, camera.cy * height as f64);
    let mut heights = Vec::new();
    for v in 1..height.saturating_sub(1) {
        let y = (v as f64 - cy) / fy;
        for u in 1..width.saturating_sub(1) {
            let x = (u as f64 - cx) / fx;
            let a = (at(u + 1, v) - at(u - 1, v)) / 2.0 * fx;
            let b = (at(u, v + 1) - at(u, v - 1)) / 2.0 * fy;
            let c = at(u, v) - a * x - b * y;
            let length = (a * a + b * b + c * c).sqrt();
            // False for what is not a number, too.
            if b > LEVEL * length && length.is_finite() {
                heights.push(1.0 / length);
            }
        }
    }
    let share = heights.len() as f64 / inverse_depth.len() as f64;
    if share < LEAST_SHARE {
        return None;
    }
    median(heights).map(|camera_height| Ground { camera_height, share })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::DataSource;
    use crate::street::{Street, StreetConfig};

    /// The street's camera hangs so high, in metres.
    const STREET: f64 = 1.65;

    fn inverse(metres: &[f32], unit: f32) -> Vec<f32> {
        metres.iter().map(|&z| if z > 0.0 { 1.0 / (z * unit) } else { 0.0 }).collect()
    }

    #[test]
    fn the_streets_exact_depth_in_an_unknown_unit_gives_its_factor() {
        let config = StreetConfig { sequences: 6, frames: 4, seed: 5, ..StreetConfig::default() };
        let street = Street::render(&config, None);
        for sample in 0..street.len() {
            let depth = street.depth(sample).unwrap().unwrap();
            for unit in [0.037, 1.0, 12.5] {
                let map = inverse(&depth.metres, unit);
                let ground = find_ground(&map, (depth.height, depth.width), config.intrinsics).unwrap();
                let factor = STREET / ground.camera_height;
                let off = factor * f64::from(unit) - 1.0;
                assert!(off.abs() < 0.02, "{}: {off:+.3}, {ground:?}", street.name(sample));
            }
        }
    }

    /// The inverse depth of planes `n . P = d`, the nearest one at every pixel.
    fn planes(planes: &[([f64; 3], f64)], camera: Intrinsics, noise: f64) -> Vec<f32> {
        let mut random = crate::random::Random::new(3, 0);
        let mut map = Vec::new();
        for v in 0..96 {
            for u in 0..320 {
                let (x, y) =
                    ((f64::from(u) / 320.0 - camera.cx) / camera.fx, (f64::from(v) / 96.0 - camera.cy) / camera.fy);
                let inverse = planes.iter().map(|(n, d)| (n[0] * x + n[1] * y + n[2]) / d).fold(0.01, f64::max);
                map.push((inverse * (1.0 + noise * (2.0 * random.unit() - 1.0))) as f32);
            }
        }
        map
    }

    fn tilted(degrees: f64) -> [f64; 3] {
        [0.0, degrees.to_radians().cos(), degrees.to_radians().sin()]
    }

    #[test]
    fn a_plane_is_found_exactly_though_the_camera_nods() {
        for degrees in [-3.0, 0.0, 3.0] {
            let map = planes(&[(tilted(degrees), 1.3)], Intrinsics::KITTI, 0.0);
            let ground = find_ground(&map, (96, 320), Intrinsics::KITTI).unwrap();
            assert!((ground.camera_height / 1.3 - 1.0).abs() < 1e-3, "{degrees}: {ground:?}");
        }
    }

    #[test]
    fn noise_and_walls_hardly_matter() {
        let road = (tilted(0.0), 1.65);
        // A wall ahead, another at the side, and noise of half a per cent.
        let map = planes(&[road, ([0.0, 0.0, 1.0], 30.0), ([1.0, 0.0, 0.0], 6.0)], Intrinsics::KITTI, 0.005);
        let ground = find_ground(&map, (96, 320), Intrinsics::KITTI).unwrap();
        assert!((ground.camera_height / 1.65 - 1.0).abs() < 0.05, "{ground:?}");
    }

    #[test]
    fn without_ground_there_is_no_height() {
        for map in [
            planes(&[([0.0, 0.0, 1.0], 8.0)], Intrinsics::KITTI, 0.0),
            planes(&[(tilted(30.0), 1.65)], Intrinsics::KITTI, 0.0),
            vec![0.2; 96 * 320],
            vec![0.0; 96 * 320],
            vec![f32::NAN; 96 * 320],
        ] {
            assert_eq!(find_ground(&map, (96, 320), Intrinsics::KITTI), None);
        }
        assert_eq!(find_ground(&[1.0], (1, 1), Intrinsics::KITTI), None);
        // A ceiling is level too, but above.
        let ceiling = planes(&[([0.0, -1.0, 0.0], 2.0)], Intrinsics::KITTI, 0.0);
        assert_eq!(find_ground(&ceiling, (96, 320), Intrinsics::KITTI), None);
    }
}
