//! The recipe of a run: everything that decides it, as `config.toml` holds it.
//!
//! What belongs to the beginning of a training (warm-up, rotations, the delay of auto-masking) is a share of its steps,
//! so that a recipe can be given another number of steps. [`RunConfig::plan`] turns the shares into steps.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

pub use super::layers::read_config;
use super::rotations::{RotationPlan, Rotations};
pub use super::schedule::{RateDecay, RateSchedule};
use crate::data::batch::{Augment, Making};
use crate::data::camera::Camera;
use crate::data::stereo::{Baseline, Sources};
use crate::error::{Error, Result};
use crate::monovit::loss::LossConfig;
use crate::monovit::{Ablation, Preset};
use crate::networks::setup::check_size;
use crate::networks::{Architecture, Config, EncoderKind, Network, Setup};
use crate::optim::Schedule;

/// Number of steps of the default run.
pub const STEPS: u64 = 3800;

/// The whole number of steps that is nearest to a share of them.
pub(super) fn steps_of(share: f64, steps: u64) -> u64 {
    (share * steps as f64).round() as u64
}

/// Settings of the optimiser.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OptimConfig {
    /// The learning rate of the depth encoder.
    pub encoder_rate: f64,
    /// The learning rate of the depth decoder.
    pub rate: f64,
    /// The learning rate of the pose networks. Their output is scaled by 0.01, so at the depth's rate they follow a
    /// hundred times as slowly.
    pub pose_rate: f64,
    /// Decoupled weight decay of every parameter.
    pub decay: f64,
    /// The decay rates b1 and b2 of AdamW's moments.
    pub betas: [f64; 2],
    /// Gradient clipping: bound on the norm of all gradients; 0 for none.
    pub clip: f64,
    /// Decay of the exponential moving average of the weights; 0 for none.
    pub average: f64,
    /// The factor on all rates over the run.
    pub schedule: RateSchedule,
}

impl OptimConfig {
    /// Checks every number.
    ///
    /// # Errors
    /// Names the field that cannot be used.
    pub fn check(&self) -> Result<()> {
        for (field, rate) in [
            ("encoder_rate", self.encoder_rate),
            ("rate", self.rate),
            ("pose_rate", self.pose_rate),
            ("decay", self.decay),
        ] {
            check(format!("optim.{field}"), rate, rate >= 0.0 && rate.is_finite(), "a number from 0")?;
        }
        for beta in self.betas {
            check("optim.betas", beta, (0.0..1.0).contains(&beta), "a number from 0 to below 1")?;
        }
        let clip = self.clip;
        check("optim.clip", clip, clip >= 0.0 && clip.is_finite(), "a bound above 0, or 0 for none")?;
        let average = self.average;
        check("optim.average", average, (0.0..1.0).contains(&average), "a number from 0 (for none) to below 1")?;
        self.schedule.check()
    }
}

impl Rotations {
    /// Checks every number.
    ///
    /// # Errors
    /// Names the field that cannot be used.
    pub fn check(&self) -> Result<()> {
        check_share("rotations.share", self.share)?;
        check_share("rotations.keep", self.keep)?;
        for (field, number) in [("pixels", self.pixels), ("rate", self.rate), ("weight", self.weight)] {
            check(format!("rotations.{field}"), number, number >= 0.0 && number.is_finite(), "a number from 0")?;
        }
        Ok(())
    }
}

pub(super) fn check(field: impl Into<String>, found: f64, good: bool, expected: &str) -> Result<()> {
    if good { Ok(()) } else { Err(Error::setting(field, format!("{found} is not {expected}"))) }
}

pub(super) fn check_share(field: &str, share: f64) -> Result<()> {
    check(field, share, (0.0..=1.0).contains(&share), "a share of the steps, from 0 to 1")
}

/// What a trainer needs of a recipe, its shares turned into steps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plan {
    /// The optimiser.
    pub optim: OptimConfig,
    /// The factor on the learning rates, step by step.
    pub schedule: Schedule,
    /// The loss.
    pub loss: LossConfig,
    /// The number of steps before auto-masking sets in.
    pub auto_mask_after: u64,
    /// The number of batches whose gradients a step averages.
    pub accumulate: usize,
    /// The number of steps in which the pose networks learn alone.
    pub pose_first: u64,
    /// The number of steps in which depth learns from pairs alone, where there are neighbours in time as well.
    pub pairs_first: u64,
    /// Known rotations for the pose network.
    pub rotations: RotationPlan,
    /// Whether transformer layers are computed again in the backward pass.
    pub recompute: bool,
    /// Seed of everything random.
    pub seed: u64,
}

/// Configuration of a training run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Named size of the networks.
    pub preset: Preset,
    /// The network, which means its decoder.
    #[serde(default)]
    pub network: Network,
    /// The depth encoder; without, the one that the network comes with.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub encoder: Option<EncoderKind>,
    /// Height of the pictures that the networks see, a multiple of 32.
    pub height: usize,
    /// Width of the pictures that the networks see, a multiple of 32.
    pub width: usize,
    /// Batch size.
    pub batch: usize,
    /// Number of batches whose gradients a step averages.
    pub accumulate: usize,
    /// Number of training steps.
    pub steps: u64,
    /// Number of epochs, where that is how the steps are counted: passes over the training samples. The steps follow from it
    /// when a run is made.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub epochs: Option<u64>,
    /// Seed of everything random.
    pub seed: u64,
    /// `street`, or a folder: in the layout of KITTI raw, or of frames ([`data::frames`](crate::data::frames)).
    pub data: String,
    /// List of the frames to train on; without it, all frames.
    pub split: Option<PathBuf>,
    /// A split list for a folder: every second frame validates, the others (with ground truth) are reported on. Every
    /// tenth training frame is set aside, without.
    pub val_split: Option<PathBuf>,
    /// The camera that took a folder's pictures.
    #[serde(default)]
    pub camera: Camera,
    /// The frames that a target is compared with: its neighbours in time, the other camera's, or both.
    #[serde(default)]
    pub sources: Sources,
    /// The unit of the distance between two cameras: with the calibrated one depth is in metres.
    #[serde(default)]
    pub baseline: Baseline,
    /// Training on neighbours in time and a second camera: the share of the steps in which depth learns from the second
    /// camera alone, and the pose networks the motion that belongs to it; then a pixel's least error over all of them
    /// counts. While depth is of another scale than the baseline, neighbours explain every pixel better than the second
    /// camera does, which would never be listened to.
    #[serde(default = "pairs_first")]
    pub pairs_first: f64,
    /// Whether samples with a frame that cannot be read are passed over and counted; they end the run otherwise.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub skip_bad_frames: bool,
    /// The file of a folder's prepared frames ([`data::prepared`](crate::data::prepared)); without it, the one that lies in
    /// the folder, if there is any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prepared: Option<PathBuf>,
    /// Whether rendered training data go on forever: sequences that were never seen are rendered while training goes on, and
    /// take the place of the oldest ([`Endless`](crate::street::Endless)).
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub endless: bool,
    /// Weights to start from: files or folders, all four networks together; `shipped` means those inside the program.
    #[serde(default, deserialize_with = "none_one_or_many", skip_serializing_if = "Vec::is_empty")]
    pub init: Vec<PathBuf>,
    /// Weights that the depth encoder starts from alone: an MPViT or a ResNet, as the encoder is, trained on ImageNet.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub init_encoder: Option<PathBuf>,
    /// Weights that the pose encoder starts from alone: a ResNet-18 trained on ImageNet.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub init_pose: Option<PathBuf>,
    /// Whether to start from those of the weights that fit, when not all do.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub allow_partial: bool,
    /// The disparity (sigmoid, in (0, 1)) that an untrained network predicts: the biases of the four heads. Without, as
    /// they are drawn: about 1/2, which is so near that what is nearer still has no disparity left.
    pub initial_disparity: Option<f64>,
    /// Whether transformer layers are computed again in the backward pass instead of keeping what they computed: a step
    /// takes less memory and more time, and learns the same.
    #[serde(default)]
    pub recompute: bool,
    /// A line in the log every so many steps.
    pub log_every: u64,
    /// The whole state is written, and the weights are validated, every so many steps.
    pub checkpoint_every: u64,
    /// Number of states that are kept: the newest, and those before it. From 3 on under their steps, too.
    pub keep: usize,
    /// Whether figures, pictures and histograms are written for TensorBoard, too (`tensorboard/` in the run's folder).
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub tensorboard: bool,
    /// Number of validations in a row without a new best after which training stops; without, it goes to the end.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub patience: Option<u64>,
    /// Steps of an epoch, which is one pass over the training samples: found when a run is made.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub epoch: Option<u64>,
    /// Patterns of the names of parameters and running statistics that stay as they are: `encoder.*`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub freeze: Vec<String>,
    /// The share of the steps, the first ones, in which the pose networks learn alone. Where weights from elsewhere start, a
    /// pose network that does not know the new camera's motion yet would bend depths that are right: too long a
    /// translation pushes what it sees towards the far end.
    #[serde(default)]
    pub pose_first: f64,
    /// The share of the steps before auto-masking sets in. While the motion is not known yet, a warped neighbour
    /// explains hardly any pixel better than an unwarped one, and masking would leave little to learn from.
    pub auto_mask_delay: f64,
    /// The parts that are taken away from the named sizes.
    #[serde(default)]
    pub ablation: Ablation,
    /// Augmentation.
    pub augment: Augment,
    /// The loss.
    pub loss: LossConfig,
    /// Known rotations for the pose network, before training and at its beginning; not where training starts from given
    /// weights of the pose networks.
    pub rotations: Rotations,
    /// The optimiser.
    pub optim: OptimConfig,
}

/// The usual share, for configurations from before there was one.
fn pairs_first() -> f64 {
    0.5
}

impl RunConfig {
    /// The default run: the reduced network on the embedded street.
    pub fn usual() -> Self {
        Self::new(Preset::Nano, STEPS)
    }

    /// The recipe for a small network from scratch, on the embedded street: of an architecture or, given a preset, of MonoViT
    /// in that size.
    pub fn new(architecture: impl Into<Architecture>, steps: u64) -> Self {
        let Architecture { network, encoder, preset } = architecture.into();
        RunConfig {
            preset,
            network,
            encoder: (encoder != network.usual_encoder()).then_some(encoder),
            height: 96,
            width: 320,
            batch: 4,
            accumulate: 1,
            steps,
            epochs: None,
            seed: 0,
            data: "street".into(),
            split: None,
            val_split: None,
            camera: Camera::Auto,
            sources: Sources::Mono,
            baseline: Baseline::Calibrated,
            pairs_first: pairs_first(),
            skip_bad_frames: false,
            prepared: None,
            endless: false,
            init: Vec::new(),
            init_encoder: None,
            init_pose: None,
            allow_partial: false,
            initial_disparity: Some(0.15),
            recompute: false,
            log_every: 10,
            checkpoint_every: 200,
            keep: 2,
            tensorboard: false,
            patience: None,
            epoch: None,
            freeze: Vec::new(),
            pose_first: 0.0,
            ablation: Ablation::default(),
            augment: Augment { flip: true, jitter: false, sensor: false },
            // Of the 3,800 steps of the default run these shares are 300, 500 before training and 600, and 100.
            auto_mask_delay: 0.0789,
            loss: LossConfig { consistent_grid: true, ..LossConfig::default() },
            rotations: Rotations { share: 0.1316, keep: 0.1579, ..Rotations::default() },
            optim: OptimConfig {
                encoder_rate: 1e-3,
                rate: 1e-3,
                pose_rate: 2.8e-3,
                decay: 0.01,
                betas: [0.9, 0.999],
                clip: 0.0,
                average: 0.99,
                schedule: RateSchedule { warm_up: 0.0263, decay: RateDecay::Cosine { end: 0.01 } },
            },
        }
    }

    /// The recipe for a start from trained weights: pictures of the weights' own size, and nothing of what random weights
    /// need. Depth learns at the published rates (MonoViT, section 4.1) in networks of the published sizes, which get many
    /// thousand steps; the reduced ones go on at the rates they learn at from scratch, and with auto-masking as late as
    /// there, because until the new motion is known it would leave little to learn from.
    ///
    /// The pose networks learn faster, and alone at first. They know the motion of another camera: where that moved three
    /// times as far between two frames, depths of three times the distance explain the new pictures, and depth gets there
    /// long before a pose network does whose output is scaled by 0.01.
    pub fn from_weights(setup: Setup, steps: u64) -> Self {
        let Setup { preset, ablation, height, width, min_depth, max_depth, .. } = setup;
        let scratch = Self::new(setup.architecture(), steps);
        let reduced = matches!(preset, Preset::Pico | Preset::Nano);
        RunConfig {
            ablation,
            height,
            width,
            initial_disparity: None,
            auto_mask_delay: if reduced { scratch.auto_mask_delay } else { 0.0 },
            loss: LossConfig { min_depth, max_depth, ..scratch.loss },
            rotations: Rotations::default(),
            pose_first: 0.3,
            optim: match reduced {
                true => OptimConfig { pose_rate: scratch.optim.rate, ..scratch.optim },
                false => OptimConfig { encoder_rate: 5e-5, rate: 1e-4, pose_rate: 1e-3, ..scratch.optim },
            },
            ..scratch
        }
    }

    /// The recipe for a depth encoder that starts from an image classifier: the published learning rates.
    pub fn from_encoder(architecture: impl Into<Architecture>, steps: u64) -> Self {
        let scratch = Self::new(architecture, steps);
        let optim = OptimConfig { encoder_rate: 5e-5, rate: 1e-4, pose_rate: 1e-4, ..scratch.optim };
        RunConfig { optim, ..scratch }
    }

    /// The names of the networks.
    pub fn architecture(&self) -> Architecture {
        let encoder = self.encoder.unwrap_or(self.network.usual_encoder());
        Architecture { network: self.network, encoder, preset: self.preset }
    }

    /// The networks, their pictures and the range of their depths.
    pub fn setup(&self) -> Setup {
        let Architecture { network, encoder, preset } = self.architecture();
        let RunConfig { ablation, height, width, .. } = *self;
        let (min_depth, max_depth) = (self.loss.min_depth, self.loss.max_depth);
        Setup { preset, network, encoder, ablation, height, width, min_depth, max_depth }
    }

    /// The sizes of the networks.
    ///
    /// # Panics
    /// If [`check`](RunConfig::check) refuses them.
    #[track_caller]
    pub fn model(&self) -> Config {
        self.setup().model()
    }

    /// The recipe for its number of steps.
    pub fn plan(&self) -> Plan {
        Plan {
            optim: self.optim,
            schedule: self.optim.schedule.over(self.steps, self.epoch.unwrap_or(self.steps)),
            loss: self.loss,
            auto_mask_after: steps_of(self.auto_mask_delay, self.steps),
            accumulate: self.accumulate,
            // Pairs tell depth its scale, which no pose network has to learn first.
            pose_first: if self.sources == Sources::Mono { steps_of(self.pose_first, self.steps) } else { 0 },
            pairs_first: steps_of(self.pairs_first, self.steps),
            rotations: match self.sources.in_time() {
                true => self.rotations.over(self.steps),
                // No pose network is asked.
                false => Rotations::default().over(self.steps),
            },
            recompute: self.recompute,
            seed: self.seed,
        }
    }

    /// How its samples become batches.
    pub fn making(&self) -> Making {
        let depth = self.loss.depth_supervision > 0.0;
        Making { augment: self.augment, sources: self.sources, baseline: self.baseline, depth }
    }

    /// Notes how many steps a pass over so many training samples takes, and how many steps the epochs are, if those are what
    /// counts.
    pub fn set_epoch(&mut self, samples: usize) {
        let epoch = samples.div_ceil(self.batch.saturating_mul(self.accumulate).max(1)) as u64;
        self.epoch = Some(epoch);
        if let Some(epochs) = self.epochs {
            self.steps = epochs.saturating_mul(epoch);
        }
    }

    /// Checks what can be checked without data.
    ///
    /// # Errors
    /// Names the field that cannot be used.
    pub fn check(&self) -> Result<()> {
        check_size("height", self.height)?;
        check_size("width", self.width)?;
        for (field, number) in [
            ("batch", self.batch as u64),
            ("accumulate", self.accumulate as u64),
            ("steps", self.steps),
            ("log_every", self.log_every),
            ("checkpoint_every", self.checkpoint_every),
            ("keep", self.keep as u64),
            ("patience", self.patience.unwrap_or(1)),
            ("epoch", self.epoch.unwrap_or(1)),
            ("epochs", self.epochs.unwrap_or(1)),
        ] {
            if number == 0 {
                return Err(Error::setting(field, "0 is too few: at least 1"));
            }
        }
        if self.initial_disparity.is_some_and(|d| d.is_nan() || d <= 0.0 || d >= 1.0) {
            return Err(Error::setting("initial_disparity", "expected a number between 0 and 1"));
        }
        if self.endless && !super::data::is_rendered(&self.data) {
            let message = format!("{} has an end: only the data that this program renders go on forever", self.data);
            return Err(Error::setting("endless", message));
        }
        if self.endless && self.sources.other_camera() {
            return Err(Error::setting(
                "endless",
                "there is no second camera: leave it out, or use sources = \"mono\"",
            ));
        }
        check_share("pose_first", self.pose_first)?;
        check_share("auto_mask_delay", self.auto_mask_delay)?;
        check_share("pairs_first", self.pairs_first)?;
        self.loss.check()?;
        self.rotations.check()?;
        self.optim.check()?;
        self.architecture().config(&self.ablation).map(drop)
    }
}

/// `init` may be nothing, one path, or a list.
fn none_one_or_many<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<Vec<PathBuf>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Paths {
        One(PathBuf),
        Many(Vec<PathBuf>),
    }
    Ok(match Option::<Paths>::deserialize(deserializer)? {
        None => Vec::new(),
        Some(Paths::One(path)) => vec![path],
        Some(Paths::Many(paths)) => paths,
    })
}

#[cfg(test)]
mod tests {
    use std::fs::{self, File};
    use std::path::Path;

    use super::*;
    use crate::optim::Decay;

    fn written(text: &str) -> Result<RunConfig> {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("config.toml");
        fs::write(&path, text).unwrap();
        read_config(&path)
    }

    #[test]
    fn shares_become_the_steps_of_the_default_run_and_grow_with_it() {
        let plan = RunConfig::usual().plan();
        assert_eq!((plan.schedule.warm_up, plan.auto_mask_after), (100, 300));
        assert_eq!((plan.rotations.steps, plan.rotations.keep), (500, 600));
        assert_eq!(plan.schedule.decay, Decay::Cosine { steps: 3800, end: 0.01 });
        let twice = RunConfig { steps: 7600, ..RunConfig::usual() }.plan();
        assert_eq!((twice.schedule.warm_up, twice.auto_mask_after), (200, 600));
        assert_eq!((twice.rotations.steps, twice.rotations.keep), (1000, 1200));
    }

    #[test]
    fn the_recipe_for_the_reference_street_has_the_steps_it_was_measured_with() {
        let config =
            read_config(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/benches/reference_street.toml"))).unwrap();
        let plan = config.plan();
        assert_eq!((plan.schedule.warm_up, plan.auto_mask_after), (100, 300));
        assert_eq!((plan.rotations.steps, plan.rotations.keep), (500, 600));
        assert_eq!(plan.schedule.decay, Decay::Cosine { steps: 3500, end: 0.01 });
    }

    #[test]
    fn a_recipe_of_a_short_run_is_one_of_a_long_run_with_more_steps() {
        let short = RunConfig::new(Preset::Nano, 20);
        assert_eq!(RunConfig { steps: STEPS, ..short }.plan(), RunConfig::usual().plan());
    }

    #[test]
    fn part_of_a_configuration_is_filled_from_its_preset() {
        let config = written("preset = \"small\"\nsteps = 7\n[loss]\nssim = 0.5\n[optim]\nclip = 2.0").unwrap();
        let mut expected = RunConfig::new(Preset::Small, 7);
        (expected.loss.ssim, expected.optim.clip) = (0.5, 2.0);
        assert_eq!(config, expected);
        let step = written("[optim.schedule.decay]\nkind = \"step\"\nat = 0.75\nfactor = 0.1").unwrap();
        assert_eq!(step.optim.schedule.decay, RateDecay::Step { at: 0.75, factor: 0.1 });
        assert_eq!(written("").unwrap(), RunConfig::usual());
    }

    #[test]
    fn from_trained_weights_the_pose_networks_learn_first_and_depth_at_the_rates_of_its_size() {
        let optim = RunConfig::from_weights(Setup::of(Preset::Nano), 300).optim;
        assert_eq!((optim.encoder_rate, optim.rate, optim.pose_rate), (1e-3, 1e-3, 1e-3));
        let config = RunConfig::from_weights(Setup::of(Preset::Small), 300);
        assert_eq!((config.plan().pose_first, config.plan().rotations.steps), (90, 0));
        let optim = config.optim;
        assert!(optim.encoder_rate == 5e-5 && optim.rate == 1e-4 && optim.pose_rate > optim.rate);
        assert_eq!(RunConfig::usual().plan().pose_first, 0);
    }

    #[test]
    fn what_is_written_is_read_back() {
        let config = RunConfig { split: Some("a list.txt".into()), ..RunConfig::usual() };
        assert_eq!(written(&toml::to_string(&config).unwrap()).unwrap(), config);
    }

    #[test]
    fn a_configuration_that_is_too_long_is_not_read() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("config.toml");
        File::create(&path).unwrap().set_len(1 << 40).unwrap();
        let error = read_config(&path).unwrap_err().to_string();
        assert!(error.contains("config.toml") && error.contains("a configuration of more than 1048576"), "{error}");
    }

    #[test]
    fn every_field_that_cannot_be_used_is_refused_with_its_line() {
        for (line, text) in [
            ("line 1: steps", "steps = 0"),
            ("line 1: log_every", "log_every = 0"),
            ("line 1: accumulate", "accumulate = 0"),
            ("line 1: keep", "keep = 0"),
            ("line 1: patience", "patience = 0"),
            ("line 2: checkpoint_every", "seed = 1\ncheckpoint_every = 0"),
            ("line 1: auto_mask_delay", "auto_mask_delay = 1.5"),
            ("line 1: pose_first", "pose_first = -0.1"),
            ("line 2: optim.clip", "[optim]\nclip = inf"),
            ("line 2: optim.average", "[optim]\naverage = 2.0"),
            ("line 2: optim.rate", "[optim]\nrate = -1e-3"),
            ("line 2: optim.pose_rate", "[optim]\npose_rate = nan"),
            ("line 2: optim.decay", "[optim]\ndecay = inf"),
            ("line 2: optim.betas", "[optim]\nbetas = [2.0, -3.0]"),
            ("line 2: optim.schedule.warm_up", "[optim.schedule]\nwarm_up = 100"),
            ("line 4: optim.schedule.decay.end", "# a comment\n[optim.schedule.decay]\nkind = \"cosine\"\nend = -inf"),
            ("line 2: rotations.share", "[rotations]\nshare = 500.0"),
            ("line 2: rotations.pixels", "[rotations]\npixels = nan"),
            ("line 3: rotations.rate", "[rotations]\npixels = 3.0\nrate = -1.0"),
            ("line 2: loss.ssim", "[loss]\nssim = 2.0"),
            ("line 2: loss.min_depth", "[loss]\nmin_depth = 0.0"),
        ] {
            let error = written(text).unwrap_err().to_string();
            assert!(error.contains("config.toml") && error.contains(line), "{text}: {error}");
        }
        for (name, text) in [("stepps", "stepps = 3"), ("shake", "[loss.shake]\nsteps = 2")] {
            let error = written(text).unwrap_err().to_string();
            assert!(error.contains(name), "{error}");
        }
    }
}
