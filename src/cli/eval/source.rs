//! The data that `parallax eval` measures on.

use std::path::Path;

use parallax::Result;
use parallax::data::DataSource;
use parallax::data::camera::Camera;
use parallax::data::frames::{self, Frames};
use parallax::data::kitti::{DepthAxis, GroundTruth, Kitti, LeftOut, Options, is_kitti};
use parallax::data::stills::{Layout, Stills};
use parallax::eval::projected::Projected;
use parallax::eval::protocol::Protocol;
use parallax::eval::scale::Scale;
use parallax::street::{Street, StreetConfig, WorldKind};
use parallax::train::data::{STREET_2, is_rendered};

use super::Args;

/// The data to measure on, at the networks' size, and the frames that cannot be measured.
pub fn open(args: &Args, height: usize, width: usize) -> Result<(Box<dyn DataSource>, LeftOut)> {
    if is_rendered(&args.data) {
        let street = StreetConfig { height, width, sequences: 8, seed: args.seed, ..StreetConfig::default() };
        let street = match args.data == STREET_2 {
            // Many short drives: each has a road and a camera of its own.
            true => StreetConfig {
                sequences: 88,
                frames: 4,
                world: WorldKind::Street2,
                own_lenses: true,
                moving_cars: true,
                ..street
            },
            false => street,
        };
        return Ok((Box::new(Street::render(&street, None)), LeftOut::default()));
    }
    let root = Path::new(&args.data);
    let kittis = match args.protocol {
        Protocol::Eigen => Some(GroundTruth::Lidar(DepthAxis::LidarX)),
        Protocol::EigenCameraZ => Some(GroundTruth::Lidar(DepthAxis::CameraZ)),
        Protocol::Projected => Some(GroundTruth::Off),
        Protocol::Improved => Some(GroundTruth::Improved),
        _ => None,
    };
    // Depth is compared pixel by pixel, whichever camera took the pictures; only the camera's height needs to know.
    let camera = |otherwise| if matches!(args.scale, Scale::CameraHeight(_)) { Camera::Auto } else { otherwise };
    if kittis.is_none() && root.is_dir() && !is_kitti(root)? {
        let camera = camera(Camera::Fov { degrees: 90.0 });
        if let Some(layout) = Layout::of(root)? {
            let stills = Stills::open(layout, root, args.split.as_deref(), [height, width], camera)?;
            let left_out = stills.left_out().clone();
            return Ok((Box::new(stills), left_out));
        }
        let options = frames::Options { neighbours: false, with_depth: true, camera, ..frames::Options::default() };
        let frames = Frames::open(root, args.split.as_deref(), [height, width], options)?;
        // Every frame of a list has depth, or opening failed.
        let left_out = if args.split.is_some() { LeftOut::default() } else { frames.left_out().clone() };
        return Ok((Box::new(frames), left_out));
    }
    let ground_truth = kittis.unwrap_or(GroundTruth::Improved);
    let camera = camera(Camera::KittiPublished);
    let options = Options { neighbours: false, ground_truth, camera, ..Options::default() };
    let kitti = Kitti::open(root, args.split.as_deref(), height, width, options)?;
    if args.protocol == Protocol::Projected {
        let projected = Projected::new(kitti, args.split.is_some())?;
        let left_out = projected.left_out().clone();
        return Ok((Box::new(projected), left_out));
    }
    let left_out = kitti.left_out().clone();
    Ok((Box::new(kitti), left_out))
}
