//! The camera: where a car carries it along the street, and how it turns pixels into rays.

use super::StreetConfig;
use super::draw::Draw;
use crate::camera::Intrinsics;

/// Camera pose: camera-to-world, in metres; x right, y down, z forward in both frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Rotation from the camera's axes to the world's, row-major; its columns are the camera's axes in the world.
    pub rotation: [[f64; 3]; 3],
    /// The camera's centre in the world, in metres.
    pub position: [f64; 3],
}

impl Pose {
    /// Pose of a camera at `position`, turned right by `yaw` and then up by `pitch` (radians).
    pub fn new(position: [f64; 3], yaw: f64, pitch: f64) -> Self {
        let (sy, cy) = (libm::sin(yaw), libm::cos(yaw));
        let (sp, cp) = (libm::sin(pitch), libm::cos(pitch));
        Pose { rotation: [[cy, sy * sp, sy * cp], [0.0, cp, -sp], [-sy, cy * sp, cy * cp]], position }
    }

    /// The rows `[R | C]` of the 3x4 camera-to-world matrix.
    pub fn matrix(&self) -> [[f64; 4]; 3] {
        std::array::from_fn(|i| {
            let r = self.rotation[i];
            [r[0], r[1], r[2], self.position[i]]
        })
    }

    /// The rows `[R | t]` that map a point of this camera to one of `other`: `other^-1 * self`.
    pub fn relative_to(&self, other: &Pose) -> [[f64; 4]; 3] {
        let (a, b) = (&self.rotation, &other.rotation);
        std::array::from_fn(|i| {
            std::array::from_fn(|j| {
                let column = |k: usize| if j < 3 { a[k][j] } else { self.position[k] - other.position[k] };
                (0..3).map(|k| b[k][i] * column(k)).sum()
            })
        })
    }

    /// The pose of a camera that looks the same way, `metres` to the right.
    pub(crate) fn beside(self, metres: f64) -> Pose {
        Pose { position: std::array::from_fn(|i| self.position[i] + metres * self.rotation[i][0]), ..self }
    }

    /// A world point in this camera's frame.
    pub(crate) fn to_camera(self, point: [f64; 3]) -> [f64; 3] {
        let d: [f64; 3] = std::array::from_fn(|k| point[k] - self.position[k]);
        std::array::from_fn(|i| (0..3).map(|k| self.rotation[k][i] * d[k]).sum())
    }
}

/// How far a car may travel in one frame, in metres.
pub(crate) const FASTEST: f64 = 1.0;
/// The camera's car wanders less the less room there is, but never drives as on rails; at most this far, in metres.
const STRAYING: std::ops::Range<f64> = 0.25..1.0;

/// The path of a car for `frames` frames: 0.5 to 1 m a frame with slow changes of speed, gentle steering that holds the
/// lane (its middle at x = `lane`, with `room` metres to stray on either side), and a little pitch. With `keep_right` it
/// stays off the oncoming traffic.
pub(crate) fn drive(draw: &mut Draw, frames: usize, lane: f64, room: f64, keep_right: bool) -> Vec<Pose> {
    let room = room.clamp(STRAYING.start, STRAYING.end);
    let mut x = lane + room * if keep_right { draw.range(0.2, 0.8) } else { draw.range(-0.8, 0.8) };
    let goal = lane + room * if keep_right { 0.4 } else { draw.range(-0.3, 0.3) };
    let mut z = 0.0;
    let mut yaw = draw.range(-0.03, 0.03);
    let (mut turn, mut surge) = (0.0, 0.0);
    let cruise = draw.range(0.55, 0.95);
    let mut poses = Vec::with_capacity(frames);
    for _ in 0..frames {
        // The yaw rate forgets, and is drawn back to the street's direction and to the lane.
        let strayed = (x - goal) - (x - goal).clamp(-room, room);
        turn = 0.8 * turn + draw.normal(0.004) - 0.02 * yaw - 0.002 * (x - goal) - 0.03 * strayed;
        yaw = (yaw + turn).clamp(-0.12, 0.12);
        let pose = Pose::new([x, 0.0, z], yaw, draw.normal(0.002));
        poses.push(pose);
        surge = 0.9 * surge + draw.normal(0.015);
        let speed = (cruise + surge).clamp(0.5, FASTEST);
        x += pose.rotation[0][2] * speed;
        z += pose.rotation[2][2] * speed;
    }
    poses
}

/// A path that winds: `rate` degrees a frame to one side, then to the other, at `speed` metres a frame along x = `lane`. The
/// camera hangs 1.6 m ahead of the rear axle, which is what follows its own direction.
pub(crate) fn winding(draw: &mut Draw, frames: usize, lane: f64, rate: f64, speed: f64) -> Vec<Pose> {
    const AHEAD: f64 = 1.6;
    /// Yaw at which it turns back, in radians.
    const MOST: f64 = 0.12;
    let (mut x, mut z, mut yaw) = (lane, 0.0, 0.0f64);
    let mut turn = rate.to_radians();
    let mut poses = Vec::with_capacity(frames);
    for _ in 0..frames {
        let camera = [x + AHEAD * libm::sin(yaw), 0.0, z + AHEAD * libm::cos(yaw)];
        poses.push(Pose::new(camera, yaw, draw.normal(0.002)));
        let half = yaw + 0.5 * turn;
        x += speed * libm::sin(half);
        z += speed * libm::cos(half);
        yaw += turn;
        if yaw.abs() > MOST && yaw * turn > 0.0 {
            turn = -turn;
        }
    }
    poses
}

/// A posed pinhole camera of a given picture size. A pixel `(u, v)`, centres at whole numbers, sees along
/// `R ((u - cx)/fx, (v - cy)/fy, 1)`, so the parameter along the ray *is* the depth.
#[derive(Clone, Copy, Debug)]
pub(crate) struct View {
    pub(crate) pose: Pose,
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Focal lengths and principal point, in pixels.
    pub(crate) focal: [f64; 2],
    pub(crate) centre: [f64; 2],
}

impl View {
    /// A camera at `pose`, its pictures of the configuration's size.
    pub(crate) fn new(config: &StreetConfig, k: Intrinsics, pose: Pose) -> Self {
        let (w, h) = (config.width as f64, config.height as f64);
        let (focal, centre) = ([k.fx * w, k.fy * h], [k.cx * w, k.cy * h]);
        View { pose, width: config.width, height: config.height, focal, centre }
    }

    /// The camera's x, y and z axes in the world.
    pub(crate) fn axes(&self) -> [[f32; 3]; 3] {
        std::array::from_fn(|j| std::array::from_fn(|i| self.pose.rotation[i][j] as f32))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_are_rotations_and_the_car_stays_in_its_lane() {
        for seed in 0..20 {
            let path = drive(&mut Draw::new(seed, 0, 0), 500, 0.0, 1.0, seed % 2 == 0);
            for pair in path.windows(2) {
                let (a, b) = (pair[0], pair[1]);
                let step = ((b.position[0] - a.position[0]).powi(2) + (b.position[2] - a.position[2]).powi(2)).sqrt();
                assert!((0.499..1.001).contains(&step), "{step}");
                assert!(b.position[0].abs() < 2.0, "{:?}", b.position);
            }
            for pose in &path {
                let r = pose.rotation;
                for i in 0..3 {
                    for j in 0..3 {
                        let dot: f64 = (0..3).map(|k| r[k][i] * r[k][j]).sum();
                        assert!((dot - (i == j) as u8 as f64).abs() < 1e-12);
                    }
                }
            }
        }
    }

    #[test]
    fn a_relative_pose_carries_points_from_camera_to_camera() {
        let a = Pose::new([0.3, 0.0, 4.0], 0.05, 0.01);
        let b = Pose::new([-0.2, 0.1, 5.0], -0.03, -0.02);
        let world = [1.0, -2.0, 20.0];
        let (pa, pb) = (a.to_camera(world), b.to_camera(world));
        let m = a.relative_to(&b);
        for i in 0..3 {
            let moved = m[i][0] * pa[0] + m[i][1] * pa[1] + m[i][2] * pa[2] + m[i][3];
            assert!((moved - pb[i]).abs() < 1e-12);
        }
        assert!(Pose::new([0.0; 3], 0.0, 0.1).rotation[1][2] < 0.0, "a positive pitch looks up: y points down");
    }
}
