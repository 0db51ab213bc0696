//! Streets seen by many cameras: each group of sequences has focal lengths, a principal point, a mounting and a way of
//! driving of its own. A network that has seen one camera alone takes its horizon and its height for granted.

use super::camera::{Pose, drive, winding};
use super::draw::Draw;
use super::rendered::{PATH, Street, StreetConfig};
use crate::camera::Intrinsics;

/// What a stream of random numbers is for.
const CAMERA: u64 = 5;
/// Sequences of one camera.
pub const GROUP: usize = 12;

/// How a camera hangs in the car.
#[derive(Clone, Copy, Debug)]
struct Mount {
    /// Metres above the usual 1.65.
    higher: f64,
    /// Radians up, and to the right.
    pitch: f64,
    roll: f64,
}

impl Mount {
    /// The pose of a camera that hangs so, where the usual one is at `pose`.
    fn of(self, pose: Pose) -> Pose {
        let tilted = Pose::new([0.0; 3], 0.0, self.pitch).rotation;
        let (s, c) = (libm::sin(self.roll), libm::cos(self.roll));
        let rolled = [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]];
        let [x, y, z] = pose.position;
        let rotation = product(product(pose.rotation, tilted), rolled);
        Pose { rotation, position: [x, y - self.higher, z] }
    }
}

fn product(a: [[f64; 3]; 3], b: [[f64; 3]; 3]) -> [[f64; 3]; 3] {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

/// Renders `config.sequences` sequences (rounded up to whole groups of [`GROUP`]), each group by a camera of its own: focal
/// lengths of 0.5 to 0.75 widths (square pixels), a principal point up to 4 % of the width and 8 % of the height off the
/// middle, 1.4 to 1.9 m above the road, pitched by up to 2.5 and rolled by up to 1.5 degrees. A third of them wind. The
/// configuration's own camera is not used. `progress` hears of all frames.
pub fn varied(config: &StreetConfig, progress: Option<&(dyn Fn(usize, usize) + Sync)>) -> Vec<Street> {
    let groups = config.sequences.div_ceil(GROUP);
    let cameras = if config.baseline == 0.0 { 1 } else { 2 };
    let each = GROUP * config.frames * cameras;
    let group = |group: usize| {
        let mut draw = Draw::new(config.seed, group as u64, CAMERA);
        let focal = draw.range(0.5, 0.75);
        let aspect = config.width as f64 / config.height as f64;
        let intrinsics = Intrinsics {
            fx: focal,
            fy: focal * aspect,
            cx: 0.5 + draw.range(-0.04, 0.04),
            cy: 0.5 + draw.range(-0.08, 0.08),
        };
        let degrees = |most: f64, draw: &mut Draw| draw.range(-most, most).to_radians();
        let mount =
            Mount { higher: draw.range(-0.25, 0.25), pitch: degrees(2.5, &mut draw), roll: degrees(1.5, &mut draw) };
        let rate = draw.range(0.5, 3.0);
        let own = StreetConfig {
            intrinsics,
            sequences: GROUP,
            // Worlds that no group shares.
            seed: config.seed.wrapping_mul(1_000).wrapping_add(group as u64),
            ..config.clone()
        };
        let path = |k: usize, lane: f64, room: f64| -> Vec<Pose> {
            let mut draw = Draw::new(own.seed, k as u64, PATH);
            let poses = match group % 3 {
                2 => {
                    let speed = draw.range(0.4, 0.95);
                    winding(&mut draw, config.frames, lane, rate, speed)
                }
                _ => drive(&mut draw, config.frames, lane, room, config.moving_cars),
            };
            poses.into_iter().map(|pose| mount.of(pose)).collect()
        };
        let report = |done: usize, _: usize| {
            if let Some(progress) = progress {
                progress(group * each + done, groups * each);
            }
        };
        Street::film(&own, &|k, world| path(k, world.lane, world.room), Some(&report))
    };
    (0..groups).map(group).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_group_has_a_camera_of_its_own_and_exact_geometry() {
        let config =
            StreetConfig { height: 24, width: 80, sequences: 25, frames: 3, seed: 4, ..StreetConfig::default() };
        let streets = varied(&config, None);
        assert_eq!(streets.iter().map(|s| s.config().sequences).collect::<Vec<_>>(), [GROUP; 3]);
        let cameras: Vec<Intrinsics> = streets.iter().map(|s| s.config().intrinsics).collect();
        assert!(cameras[0] != cameras[1] && cameras[1] != cameras[2], "{cameras:?}");
        for street in &streets {
            let k = street.config().intrinsics;
            assert!((k.fx * 80.0 - k.fy * 24.0).abs() < 1e-9, "square pixels");
            for pose in street.poses(3) {
                let up = 1.65 - pose.position[1] - 1.65;
                assert!(up.abs() <= 0.25, "{up}");
                let r = pose.rotation;
                for (i, j) in [(0, 0), (0, 1), (1, 2), (2, 2)] {
                    let dot: f64 = (0..3).map(|k| r[k][i] * r[k][j]).sum();
                    assert!((dot - f64::from(u8::from(i == j))).abs() < 1e-12);
                }
            }
        }
        let again = varied(&config, None);
        assert_eq!(again[2].frame(5, 1), streets[2].frame(5, 1));
        assert_ne!(streets[0].frame(5, 1), streets[1].frame(5, 1));
    }
}
