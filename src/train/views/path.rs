//! The camera's path as the pose network joins it, beside the way that it really went.

use super::{Shown, Views};
use crate::error::Result;
use crate::eval::odometry::{Odometry, joined};
use crate::eval::trajectory::{Pose, compare_trajectories};

/// The most frames of the camera's path.
const PATH: usize = 100;

/// Puts the path over frames that follow one another at the beginning of a data set into some views; nothing if there are no
/// such frames. Lengths times `scale`, which makes them metres.
pub(super) fn path(shown: &Shown, scale: Option<f64>, views: Views) -> Result<Views> {
    let data = shown.data;
    let follows = |&sample: &usize| {
        let (a, b) = (data.place(sample), data.place(sample + 1));
        data.recording(sample) == data.recording(sample + 1) && b.sequence == a.sequence && b.frame == a.frame + 1
    };
    let count = (0..data.len().saturating_sub(1)).take_while(follows).take(PATH).count();
    if count == 0 {
        return Ok(views);
    }
    let odometry = Odometry::new(shown.model, shown.params, &shown.setup);
    let motion = |i: usize| odometry.motion(&*data.image(i, 0)?, &*data.image(i + 1, 0)?);
    let motions: Vec<Pose> = (0..count).map(motion).collect::<Result<_>>()?;
    let found = joined(&motions, scale.unwrap_or(1.0));
    let known: Option<Vec<Pose>> = (0..=count).map(|i| data.pose(i).map(Pose)).collect();
    let truth = from_the_first(known.unwrap_or_default());
    let path_error = compare_trajectories(&truth, &found).ok().map(|errors| errors.ate);
    Ok(Views { path: from_above(&found), true_path: from_above(&truth), path_error, metres: scale.is_some(), ..views })
}

/// Poses relative to the first of them.
fn from_the_first(poses: Vec<Pose>) -> Vec<Pose> {
    let back = poses.first().map(Pose::inverse);
    back.map_or_else(Vec::new, |back| poses.iter().map(|pose| back.after(pose)).collect())
}

/// The x (right) and z (forward) of poses.
fn from_above(poses: &[Pose]) -> Vec<[f64; 2]> {
    poses.iter().map(|pose| [pose.position()[0], pose.position()[2]]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_true_path_begins_at_the_origin_and_looks_along_z() {
        // A camera that looks along the x of its world, and drives that way, then to its left, which is the world's z.
        let turned = |x: f64, z: f64| Pose([[0.0, 0.0, 1.0, x], [0.0, 1.0, 0.0, 5.0], [-1.0, 0.0, 0.0, z]]);
        let truth = from_the_first(vec![turned(3.0, 4.0), turned(5.0, 4.0), turned(5.0, 5.0)]);
        assert_eq!(from_above(&truth), [[0.0, 0.0], [0.0, 2.0], [-1.0, 2.0]]);
        assert!(from_the_first(Vec::new()).is_empty());
    }
}
