//! The recipe of a run: everything that decides it, as `config.toml` holds it.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::rotations::Shake;
use super::trainer::OptimConfig;
use crate::data::batch::Augment;
use crate::error::{Error, Result};
use crate::monovit::loss::LossConfig;
use crate::monovit::{Ablation, Config, Preset};
use crate::optim::{Decay, Schedule};

/// Everything that decides a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// The named sizes.
    pub preset: Preset,
    /// Height of the pictures that the networks see, a multiple of 32.
    pub height: usize,
    /// Width of the pictures that the networks see, a multiple of 32.
    pub width: usize,
    /// Samples a step.
    pub batch: usize,
    /// Steps.
    pub steps: u64,
    /// Everything random follows from it.
    pub seed: u64,
    /// `street`, or a folder in the layout of KITTI raw.
    pub data: String,
    /// A split list for training; all frames without.
    pub split: Option<PathBuf>,
    /// A split list for a folder: every second frame validates, the others (with ground truth) are reported on. Every
    /// tenth training frame is set aside, without.
    pub val_split: Option<PathBuf>,
    /// Weights to start from: files or folders, all four networks together.
    #[serde(default, deserialize_with = "none_one_or_many", skip_serializing_if = "Vec::is_empty")]
    pub init: Vec<PathBuf>,
    /// Weights that the depth encoder starts from alone: an MPViT trained on ImageNet.
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
    /// A line in the log every so many steps.
    pub log_every: u64,
    /// The whole state is written, and the weights are validated, every so many steps.
    pub checkpoint_every: u64,
    /// What is taken away from the named sizes.
    #[serde(default)]
    pub ablation: Ablation,
    /// Augmentation.
    pub augment: Augment,
    /// The loss.
    pub loss: LossConfig,
    /// The optimiser.
    pub optim: OptimConfig,
}

impl RunConfig {
    /// The recipe for a small network from scratch, on the embedded street.
    pub fn new(preset: Preset, steps: u64) -> Self {
        let mut config = RunConfig {
            preset,
            height: 96,
            width: 320,
            batch: 4,
            steps,
            seed: 0,
            data: "street".into(),
            split: None,
            val_split: None,
            init: Vec::new(),
            init_encoder: None,
            init_pose: None,
            allow_partial: false,
            initial_disparity: Some(0.15),
            log_every: 10,
            checkpoint_every: 200,
            ablation: Ablation::default(),
            augment: Augment { flip: true, jitter: false },
            loss: LossConfig {
                auto_mask_after: 300,
                consistent_grid: true,
                shake: Shake { steps: 500, keep: 600, ..Shake::default() },
                ..LossConfig::default()
            },
            optim: OptimConfig {
                encoder_rate: 1e-3,
                rate: 1e-3,
                pose_rate: 2.8e-3,
                decay: 0.01,
                betas: [0.9, 0.999],
                clip: 0.0,
                average: 0.99,
                schedule: Schedule { warm_up: 100, decay: Decay::Cosine { steps, end: 0.01 } },
            },
        };
        config.set_steps(steps);
        config
    }

    /// Sets the number of steps: a cosine ends with them, a fall comes after three quarters, and what belongs to the
    /// beginning takes no more than its share.
    pub fn set_steps(&mut self, count: u64) {
        self.steps = count;
        match &mut self.optim.schedule.decay {
            Decay::Cosine { steps, .. } => *steps = count,
            Decay::Step { at, .. } => *at = count / 4 * 3,
            Decay::Constant | Decay::Exponential { .. } => {}
        }
        let shrink = |steps: &mut u64, part: u64| *steps = (*steps).min(count / part);
        shrink(&mut self.optim.schedule.warm_up, 10);
        shrink(&mut self.loss.shake.steps, 4);
        shrink(&mut self.loss.shake.keep, 4);
        shrink(&mut self.loss.auto_mask_after, 7);
    }

    /// The sizes of the networks.
    pub fn model(&self) -> Config {
        self.ablation.apply(self.preset.config())
    }

    /// Checks what can be checked without data.
    pub fn check(&self) -> Result<()> {
        check_size("--height", self.height)?;
        check_size("--width", self.width)?;
        if self.batch == 0 {
            return Err(Error::setting("--batch", "at least 1"));
        }
        if self.initial_disparity.is_some_and(|d| d.is_nan() || d <= 0.0 || d >= 1.0) {
            return Err(Error::setting("initial_disparity", "a number between 0 and 1"));
        }
        if self.steps == 0 {
            return Err(Error::setting("--steps", "at least 1"));
        }
        self.loss.check()?;
        self.ablation.check(&self.preset.config())
    }

    /// What a safetensors file says about itself: this configuration, as JSON under `parallax`.
    pub fn metadata(&self) -> Result<HashMap<String, String>> {
        let text = serde_json::to_string(self).map_err(|e| Error::Failed(format!("the configuration: {e}")))?;
        Ok(HashMap::from([("parallax".into(), text)]))
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

/// Sides of pictures are multiples of 32, because the deepest map has a 32nd of them, and at least 64, because a map of
/// one pixel has nothing to be mirrored at its border.
pub fn check_size(name: &str, size: usize) -> Result<()> {
    if !size.is_multiple_of(32) || !(64..=8192).contains(&size) {
        let below = (size / 32 * 32).clamp(64, 8192);
        let message = format!("{size} is not a multiple of 32 from 64 to 8192; {below} would do");
        return Err(Error::setting(name, message));
    }
    Ok(())
}

/// Reads a run's (or anybody's) configuration.
pub fn read_config(path: &Path) -> Result<RunConfig> {
    let text = fs::read_to_string(path).map_err(|e| Error::io(path, e))?;
    toml::from_str(&text).map_err(|e| Error::file(path, e.to_string()))
}
