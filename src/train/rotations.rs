//! Rotation pretraining: frames turned by known angles, which teach the pose network what a rotation looks like.
//!
//! From random weights the pose network is slow to see that pictures turn: for thousands of steps it answers with the
//! mean motion of all its training pairs, and whatever the camera's yaw and pitch really did is noise in the warp,
//! about as large as the parallax that depth is learnt from. But a rotation needs no depth. Turning a picture about the
//! camera's centre is a homography, so pairs whose rotation is known can be made of any video, without labels: before
//! training, pairs of neighbours are turned by random angles, and the pose network is asked for the difference of those
//! angles. The camera's own small rotation is noise with mean zero there.

use serde::{Deserialize, Serialize};

use super::freeze::Frozen;
use super::recipe::steps_of;
use crate::data::batch::Batch;
use crate::networks::DepthNetwork;
use crate::nn::{Context, Params};
use crate::optim::{AdamW, Decay, Group, Schedule};
use crate::random::{Random, Stream};
use crate::tensor::{Tape, Tensor, Var};

/// How much pairs are turned, and for how long, in shares of the training's steps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Rotations {
    /// Steps of the pose network alone before training, as a share of the training's steps; 0 for none.
    pub share: f64,
    /// The standard deviation of yaw and pitch at first, as the pixels that the picture's centre moves by. It shrinks to
    /// a quarter.
    pub pixels: f64,
    /// Their learning rate.
    pub rate: f64,
    /// The share of the training's own steps, its first ones, that still have pairs with known rotations, of the last
    /// size: so long as depth knows nothing, it gives the pose network reasons to forget.
    pub keep: f64,
    /// The weight of the mean error (in pixels) in the loss of those steps.
    pub weight: f64,
}

impl Default for Rotations {
    /// None.
    fn default() -> Self {
        Rotations { share: 0.0, pixels: 10.0, rate: 1e-3, keep: 0.0, weight: 0.05 }
    }
}

impl Rotations {
    /// Those of a training of so many steps.
    pub fn over(&self, steps: u64) -> RotationPlan {
        let Rotations { pixels, rate, weight, .. } = *self;
        RotationPlan { steps: steps_of(self.share, steps), pixels, rate, keep: steps_of(self.keep, steps), weight }
    }
}

/// [`Rotations`] with their shares turned into steps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RotationPlan {
    /// Steps before training, of the pose network alone; 0 for none.
    pub steps: u64,
    /// The standard deviation of yaw and pitch at first, in pixels of the picture's centre.
    pub pixels: f64,
    /// Their learning rate.
    pub rate: f64,
    /// Steps of the training itself that still have pairs with known rotations.
    pub keep: u64,
    /// The weight of the mean error (in pixels) in the loss of those steps.
    pub weight: f64,
}

/// Steps over which the learning rate grows.
const WARM_UP: u64 = 30;

impl RotationPlan {
    /// The standard deviation of the angles at a step (from 0), in pixels.
    fn size(&self, step: u64) -> f64 {
        self.pixels * (1.0 - 0.75 * step as f64 / self.steps as f64)
    }

    /// Term that a step (from 0) of the training itself adds to its loss, if any; `pass` (from 0) counts the batches.
    pub(super) fn term(
        &self,
        [step, pass]: [u64; 2],
        model: &DepthNetwork,
        c: &Context<f32>,
        batch: &Batch,
        seed: u64,
    ) -> Option<Var<f32>> {
        let mut random = Random::of(seed, Stream::KeptRotations(pass));
        let error = || rotation_error(model, c, batch, self.size(self.steps), &mut random);
        (step < self.keep && self.steps > 0).then(error).map(|e| e.affine(self.weight, 0.0))
    }
}

/// The steps before training. They have an optimiser of their own, so that training starts with a fresh one.
pub struct Lesson {
    plan: RotationPlan,
    adamw: AdamW<f32>,
    seed: u64,
    frozen: Frozen,
}

impl Lesson {
    /// No steps taken.
    pub fn new(plan: RotationPlan, params: &Params<f32>, seed: u64) -> Self {
        Lesson { plan, adamw: AdamW::new(params), seed, frozen: Frozen::default() }
    }

    /// This lesson with some parameters and statistics left as they are.
    pub fn keeping(self, frozen: Frozen) -> Self {
        Lesson { frozen, ..self }
    }

    /// One step; the mean error in pixels before it.
    pub fn step(&mut self, model: &DepthNetwork, params: &mut Params<f32>, batch: &Batch) -> f64 {
        let step = self.adamw.steps;
        let tape = Tape::new();
        let mut random = Random::of(self.seed, Stream::Rotations(step));
        let random_drop = Random::of(self.seed, Stream::RotationDropout);
        let c = Context::training_part(params, &tape, random_drop, self.frozen.clone());
        let error = rotation_error(model, &c, batch, self.plan.size(step), &mut random);
        let gradients = c.gradients(&mut error.backward());
        let schedule = Schedule { warm_up: WARM_UP, decay: Decay::Constant };
        let learning_rate = self.plan.rate * schedule.factor(step + 1);
        self.adamw.step(params, &gradients, |_| Group { learning_rate, decay: 0.0 });
        for (id, value) in c.into_moved() {
            params.set(id, value);
        }
        error.value().item() as f64
    }
}

/// The share of roll in the turns: cars hardly roll.
const ROLL: f64 = 0.25;

/// The mean error, in pixels, of the rotations that the pose network sees in turned neighbours.
///
/// # Panics
/// If the batch holds none.
pub fn rotation_error(
    model: &DepthNetwork,
    c: &Context<f32>,
    batch: &Batch,
    pixels: f64,
    random: &mut Random,
) -> Var<f32> {
    let (target, neighbours) = (&batch.target, batch.neighbours.as_ref());
    let [prev, next] = neighbours.expect("frames that follow one another");
    let mut turned = |frames: &Tensor<f32>| turn(frames, &angles(&batch.intrinsics, pixels, random), &batch.intrinsics);
    // Both frames of a pair are turned, so that which of them is interpolated says nothing.
    let firsts = [turned(prev), turned(target)];
    let seconds = [turned(target), turned(next)];
    let join = |[a, b]: [&Var<f32>; 2]| Var::concat(&[a, b], 0);
    let images = |of: &[Turned; 2]| join([&of[0].image, &of[1].image]);
    let by = |of: &[Turned; 2]| join([&of[0].by, &of[1].by]);
    let seen = model.motion(c, &images(&firsts), &images(&seconds)).slice(1, 0..3);
    // To first order, which is a thousandth of a radian here, angles subtract.
    let known = by(&seconds) - by(&firsts);
    let focal = batch.intrinsics.iter().map(|k| k[0]).sum::<f64>() / batch.intrinsics.len() as f64;
    (seen - known).abs().mean_all().affine(focal, 0.0)
}

/// Frames, and what they were turned by.
struct Turned {
    /// `[B, H, W, 3]`.
    image: Var<f32>,
    /// Axis-angle, `[B, 3]`.
    by: Var<f32>,
}

/// Random pitch, yaw and roll for each sample, `[B, 3]`, that move the centre by about `pixels`.
fn angles(intrinsics: &[[f64; 4]], pixels: f64, random: &mut Random) -> Tensor<f32> {
    let mut all = Vec::with_capacity(3 * intrinsics.len());
    for [fx, fy, ..] in intrinsics {
        for radians in [pixels / fy, pixels / fx, ROLL * pixels / fx] {
            all.push((radians * random.normal()) as f32);
        }
    }
    Tensor::from_vec([intrinsics.len(), 3], all)
}

/// What a camera sees that is turned so that points `p` of the old one are at `R p`.
fn turn(frames: &Tensor<f32>, by: &Tensor<f32>, intrinsics: &[[f64; 4]]) -> Turned {
    let [batch, height, width, _] = frames.shape().nhwc().expect("images");
    let by = Var::constant(by.clone());
    // A pure rotation moves every depth alike: 1 will do.
    let depth = Var::constant(Tensor::full([batch, height, width, 1], 1.0));
    let still = Var::constant(Tensor::zeros([batch, 3]));
    let back = Var::pose_matrix(&by, &still, true);
    Turned { image: Var::constant(frames.clone()).warp(&depth, &back, intrinsics, true), by }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::batch::{Augment, batch_of_step};
    use crate::monovit::Preset;
    use crate::street::{Street, StreetConfig};

    /// A bright dot in the middle moves right when the camera turns left, and up when it looks down.
    #[test]
    fn a_turn_moves_the_centre_by_as_many_pixels() {
        let (height, width) = (33, 65);
        let mut picture = Tensor::zeros([1, height, width, 3]);
        let centre = (16 * width + 32) * 3;
        picture.data_mut()[centre..centre + 3].fill(1.0);
        let (fx, fy) = (40.0, 60.0);
        let intrinsics = [[fx, fy, 32.0, 16.0]];
        // Yaw of atan(5 / fx) moves a point ahead by 5 pixels to the right: R p has x = +sin.
        let yaw = (5.0f64 / fx).atan() as f32;
        let pitch = (3.0f64 / fy).atan() as f32;
        for (angles, (row, column)) in [([0.0, yaw, 0.0], (16, 37)), ([pitch, 0.0, 0.0], (13, 32))] {
            let turned = turn(&picture, &Tensor::from_vec([1, 3], angles.to_vec()), &intrinsics);
            let bright = turned.image.value().data()[(row * width + column) * 3];
            assert!(bright > 0.95, "{angles:?}: {bright} at ({row}, {column})");
        }
    }

    #[test]
    fn a_lesson_teaches_the_pose_networks_and_nothing_else() {
        let config = StreetConfig { height: 64, width: 96, sequences: 1, frames: 6, ..StreetConfig::default() };
        let street = Street::render(&config, None);
        let batch =
            batch_of_step(&street, Augment { flip: false, jitter: false, sensor: false }, 2, 0, 0).expect("a batch");
        let (model, mut params) = DepthNetwork::new(Preset::Pico.config(), 0);
        // A network that answers with no motion is wrong by the angles themselves.
        for name in ["pose.net.3.weight", "pose.net.3.bias"] {
            let id = params.find(name).expect("the last layer");
            params.value_mut(id).data_mut().fill(0.0);
        }
        let before = params.clone();
        let plan = RotationPlan { steps: 2, pixels: 6.0, ..Rotations::default().over(0) };
        let mut lesson = Lesson::new(plan, &params, 0);
        let error = lesson.step(&model, &mut params, &batch);
        assert!(error > 0.2 * plan.pixels && error < 3.0 * plan.pixels, "{error} pixels");
        lesson.step(&model, &mut params, &batch);
        for ((_, old), (_, new)) in before.iter().zip(params.iter()) {
            let (name, same) = (old.name(), old.value.same_bits(&new.value));
            assert!(same || name.starts_with("pose"), "{name} moved");
            assert!(!same || !name.starts_with("pose.net.3"), "{name} did not move");
        }
    }
}
