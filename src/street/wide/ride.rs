//! The camera of a wide sequence: its lens, how it hangs in its car, and where that drives.

use super::super::camera::Pose;
use super::super::draw::Draw;
use crate::camera::Intrinsics;

/// How far the car may travel in one frame, in metres.
pub(super) const FASTEST: f64 = 1.4;

/// A lens around the given one: its focal length times 0.75 to 1.35, most often near 1, and another principal point.
pub(crate) fn camera(draw: &mut Draw, around: Intrinsics) -> Intrinsics {
    let zoom = if draw.chance(0.5) { draw.range(0.95, 1.06) } else { draw.range(0.75, 1.35) };
    Intrinsics {
        fx: around.fx * zoom,
        fy: around.fy * zoom,
        cx: around.cx + draw.range(-0.02, 0.02),
        cy: around.cy + draw.range(-0.07, 0.05),
    }
}

/// The path for `frames` frames along a road that starts in the middle lane at x = `lane` and bends by `bend` (1/m, to
/// the right): 0.2 to 1.4 m a frame, a height near 1.65 m, and the pitch and roll of a camera that is not mounted quite
/// level in a car that nods.
pub(crate) fn ride(draw: &mut Draw, frames: usize, lane: f64, bend: f64) -> Vec<Pose> {
    let y = draw.range(-0.1, 0.1);
    let (tilt, roll) = (draw.normal(0.012), draw.normal(0.01));
    let cruise = if draw.chance(0.2) { draw.range(0.2, 0.6) } else { draw.range(0.6, 1.3) };
    let mut z = 0.0;
    let (mut off, mut drift, mut surge) = (draw.range(-0.2, 0.2), draw.range(-0.01, 0.01), 0.0);
    let (mut poses, heading) = (Vec::with_capacity(frames), draw.range(-0.03, 0.03));
    for _ in 0..frames {
        let x = lane + off + 0.5 * bend * z * z;
        let yaw = bend * z + drift + heading;
        let level = Pose::new([x, y, z], yaw, tilt + draw.normal(0.003));
        poses.push(rolled(level, roll + draw.normal(0.002)));
        surge = 0.9 * surge + draw.normal(0.02);
        drift = 0.8 * drift + draw.normal(0.004) - 0.01 * off;
        let speed = (cruise + surge).clamp(0.2, FASTEST);
        z += speed * libm::cos(bend * z);
        off += speed * drift;
    }
    poses
}

/// A camera turned about its own axis of sight.
fn rolled(pose: Pose, angle: f64) -> Pose {
    let (s, c) = (libm::sin(angle), libm::cos(angle));
    let rotation = pose.rotation.map(|[x, y, z]| [c * x + s * y, c * y - s * x, z]);
    Pose { rotation, ..pose }
}
