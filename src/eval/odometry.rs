//! The camera's path through a sequence of frames, by the pose network: its motion from every frame to the next, joined.

use image::RgbImage;

use super::trajectory::Pose;
use crate::data::batch::to_tensor;
use crate::data::resize::lanczos;
use crate::networks::{DepthNetwork, Setup};
use crate::nn::{Context, Folded, Params};
use crate::tensor::Var;
use crate::{Error, Result};

/// The pose network with weights in evaluation mode.
pub struct Odometry {
    model: DepthNetwork,
    params: Folded<f32>,
    setup: Setup,
}

impl Odometry {
    /// That of these weights, which have to hold the pose networks.
    pub fn new(model: &DepthNetwork, params: &Params<f32>, setup: &Setup) -> Self {
        Odometry { model: model.clone(), params: Folded::new(params), setup: *setup }
    }

    /// The transform of points from the camera of the first frame to that of the second, in the unit of predicted depth.
    /// Frames of any size are resized.
    ///
    /// # Errors
    /// If a frame is empty, or what the network says is not finite.
    pub fn motion(&self, first: &RgbImage, second: &RgbImage) -> Result<Pose> {
        if [first, second].into_iter().any(|frame| frame.width() == 0 || frame.height() == 0) {
            return Err(Error::Failed("an empty frame shows no motion".into()));
        }
        let seen = |frame: &RgbImage| {
            let resized = lanczos(frame, self.setup.width as u32, self.setup.height as u32);
            Var::constant(to_tensor(&[&resized]))
        };
        let c = Context::folded(&self.params);
        let motion = self.model.motion(&c, &seen(first), &seen(second));
        let rows = Var::pose_matrix(&motion.slice(1, 0..3), &motion.slice(1, 3..6), false);
        let rows = rows.value().data();
        if !rows.iter().all(|x| x.is_finite()) {
            return Err(Error::Failed("the pose network's motion is not finite: the weights are broken".into()));
        }
        Ok(Pose(std::array::from_fn(|i| std::array::from_fn(|j| f64::from(rows[4 * i + j])))))
    }

    /// The poses of the cameras of frames that follow one another, each relative to the first; lengths times `scale`.
    ///
    /// # Errors
    /// If a frame cannot be read, or as [`motion`](Odometry::motion).
    pub fn path(&self, frames: impl IntoIterator<Item = Result<RgbImage>>, scale: f64) -> Result<Vec<Pose>> {
        let mut motions = Vec::new();
        let mut before: Option<RgbImage> = None;
        for frame in frames {
            let frame = frame?;
            if let Some(before) = &before {
                motions.push(self.motion(before, &frame)?);
            }
            before = Some(frame);
        }
        Ok(if before.is_some() { joined(&motions, scale) } else { Vec::new() })
    }
}

/// Camera poses, the first the identity, of motions that each map points of a camera to the next one's; lengths times
/// `scale`.
pub fn joined(motions: &[Pose], scale: f64) -> Vec<Pose> {
    let mut poses = vec![Pose::IDENTITY];
    for motion in motions {
        let mut step = motion.inverse();
        step.0.iter_mut().for_each(|row| row[3] *= scale);
        poses.push(poses[poses.len() - 1].after(&step));
    }
    poses
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monovit::Preset;
    use crate::street::{Street, StreetConfig};

    #[test]
    fn true_motions_make_the_true_path() {
        let config = StreetConfig { height: 32, width: 64, sequences: 1, frames: 9, ..StreetConfig::default() };
        let street = Street::render(&config, None);
        let truth: Vec<Pose> = street.poses(0).iter().map(|pose| Pose(pose.matrix())).collect();
        let motions: Vec<Pose> = truth.windows(2).map(|pair| pair[1].inverse().after(&pair[0])).collect();
        assert_eq!(
            street.relative_pose(2, 1).map(|row| row.map(|x| (1e9 * x).round())),
            motions[3].0.map(|row| row.map(|x| (1e9 * x).round()))
        );
        let path = joined(&motions, 2.0);
        for (found, pose) in path.iter().zip(&truth) {
            let expected = truth[0].inverse().after(pose);
            for (a, b) in found.0.iter().zip(&expected.0) {
                assert!((0..3).all(|j| (a[j] - b[j]).abs() < 1e-9) && (a[3] - 2.0 * b[3]).abs() < 1e-9, "{a:?} {b:?}");
            }
        }
        assert_eq!(path.len(), 9);
    }

    #[test]
    fn a_path_has_a_pose_for_every_frame_and_is_what_the_pairs_say() {
        let street = StreetConfig { height: 64, width: 96, sequences: 1, frames: 4, ..StreetConfig::default() };
        let street = Street::render(&street, None);
        let (model, params) = DepthNetwork::new(Preset::Pico.config(), 1);
        let odometry = Odometry::new(&model, &params, &Setup { height: 64, width: 96, ..Setup::of(Preset::Pico) });
        let frames = || (0..4).map(|i| Ok(street.frame(0, i).as_ref().clone()));
        let path = odometry.path(frames(), 1.0).unwrap();
        let pair = |i: usize| odometry.motion(street.frame(0, i), street.frame(0, i + 1)).unwrap();
        assert_eq!(path, joined(&[pair(0), pair(1), pair(2)], 1.0));
        assert!(path[1] != Pose::IDENTITY);
        assert!(odometry.path(std::iter::empty(), 1.0).unwrap().is_empty());
        let lost = frames().take(2).chain([Err(Error::Failed("lost".into()))]);
        assert!(odometry.path(lost, 1.0).unwrap_err().to_string().contains("lost"));
        assert!(odometry.motion(&RgbImage::new(0, 0), street.frame(0, 0)).is_err());
    }
}
