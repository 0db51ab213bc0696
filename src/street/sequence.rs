//! One street, the drive along it, and what was filmed on it.

use std::sync::{Arc, OnceLock};

use image::RgbImage;
use rayon::prelude::*;

use super::build::street;
use super::camera::{Pose, View, drive};
use super::draw::Draw;
use super::render::Scene;
use super::rendered::{StreetConfig, WorldKind};
use super::wide::{camera, ride, wide_street};
use super::world::World;
use crate::camera::Intrinsics;
use crate::depth::DepthMap;

/// The purposes of streams of random numbers.
const WORLD: u64 = 1;
pub(super) const PATH: u64 = 2;
const CAMERA: u64 = 3;

/// One street and the drive along it.
pub(super) struct Sequence {
    pub(super) world: World,
    pub(super) poses: Vec<Pose>,
    pub(super) intrinsics: Intrinsics,
    pub(super) images: Vec<Arc<RgbImage>>,
    /// Depth of the frames, once it was asked for.
    depths: Vec<OnceLock<DepthMap>>,
    /// Frames of the second camera; empty without one.
    pub(super) right: Vec<Arc<RgbImage>>,
}

/// The path that a sequence's world is driven along by itself.
pub(super) fn usual_path(config: &StreetConfig, number: usize, world: &World) -> Vec<Pose> {
    let draw = &mut Draw::new(config.seed, number as u64, PATH);
    match config.world {
        WorldKind::Street1 => drive(draw, config.frames, world.lane, world.room, config.moving_cars),
        WorldKind::Street2 => ride(draw, config.frames, world.lane, world.bend),
    }
}

impl Sequence {
    /// Renders the sequence of a number, which may be any, along the path that `path` gives for its world; `done` hears of
    /// each frame.
    pub(super) fn film(
        config: &StreetConfig,
        number: usize,
        path: &(dyn Fn(usize, &World) -> Vec<Pose> + Sync),
        done: &(dyn Fn() + Sync),
    ) -> Sequence {
        let draw = &mut Draw::new(config.seed, number as u64, WORLD);
        let (world, intrinsics) = match config.world {
            WorldKind::Street1 => (street(draw, config.frames, config.moving_cars), config.intrinsics),
            WorldKind::Street2 => (
                wide_street(draw, config.frames, config.moving_cars),
                match config.own_lenses {
                    true => camera(&mut Draw::new(config.seed, number as u64, CAMERA), config.intrinsics),
                    false => config.intrinsics,
                },
            ),
        };
        let poses = path(number, &world);
        let image = |frame: usize, pose: Pose| {
            let image = Scene::new(&world, View::new(config, intrinsics, pose), frame).image();
            done();
            Arc::new(image)
        };
        let images = poses.par_iter().enumerate().map(|(frame, pose)| image(frame, *pose)).collect();
        let right = poses.par_iter().enumerate().map(|(frame, pose)| image(frame, pose.beside(config.baseline)));
        let right = if config.baseline == 0.0 { Vec::new() } else { right.collect() };
        let depths = poses.iter().map(|_| OnceLock::new()).collect();
        Sequence { world, poses, intrinsics, images, depths, right }
    }

    /// The depth of a frame at the pixels' centres: camera z in metres, 0 for the sky. It is rendered once.
    pub(super) fn depth(&self, config: &StreetConfig, frame: usize) -> DepthMap {
        let view = View::new(config, self.intrinsics, self.poses[frame]);
        self.depths[frame].get_or_init(|| Scene::new(&self.world, view, frame).depth()).clone()
    }
}
