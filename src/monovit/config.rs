//! The sizes of MonoViT as data: the published ones and our reduced ones.

use serde::{Deserialize, Serialize};

use crate::nn::Start;

/// Everything that decides the shapes of the four networks.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Channels d0..d3 of the encoder's stages.
    pub channels: [usize; 4],
    /// Transformer layers in each stage's paths.
    pub layers: [usize; 4],
    /// Transformer paths in each stage.
    pub paths: [usize; 4],
    /// Hidden channels of the transformer's MLP, over its channels.
    pub mlp_ratio: usize,
    /// Attention heads.
    pub heads: usize,
    /// The windows of the convolutional relative position, each with its heads.
    pub windows: Vec<(usize, usize)>,
    /// The largest DropPath probability; layers grow towards it.
    pub drop_path: f64,
    /// The decoder's channel attention squeezes by this.
    pub reduction: usize,
    /// Channels of the pose ResNet's first stage.
    pub pose_width: usize,
    /// Channels of the pose decoder.
    pub pose_squeeze: usize,
    /// How weights start.
    pub start: Start,
}

/// A named configuration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
pub enum Preset {
    /// Small enough to check whole gradients in f64 (225,092 parameters).
    Pico,
    /// The reduced one, to train on an ordinary machine.
    Nano,
    /// MPViT tiny.
    Tiny,
    /// MPViT xsmall.
    Xsmall,
    /// MPViT small: the paper's.
    Small,
    /// MPViT base.
    Base,
}

impl Preset {
    /// All of them.
    pub const ALL: [Preset; 6] =
        [Preset::Pico, Preset::Nano, Preset::Tiny, Preset::Xsmall, Preset::Small, Preset::Base];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Preset::Pico => "pico",
            Preset::Nano => "nano",
            Preset::Tiny => "tiny",
            Preset::Xsmall => "xsmall",
            Preset::Small => "small",
            Preset::Base => "base",
        }
    }

    /// The sizes.
    pub fn config(self) -> Config {
        let published = |channels, layers, mlp_ratio| Config {
            channels,
            layers,
            paths: [2, 3, 3, 3],
            mlp_ratio,
            heads: 8,
            windows: vec![(3, 2), (5, 3), (7, 3)],
            drop_path: 0.2,
            reduction: 16,
            pose_width: 64,
            pose_squeeze: 256,
            start: Start::Published,
        };
        match self {
            Preset::Pico => Config {
                drop_path: 0.0,
                reduction: 4,
                pose_width: 4,
                pose_squeeze: 8,
                ..published([8, 16, 24, 32], [1, 1, 2, 1], 2)
            },
            Preset::Nano => Config {
                drop_path: 0.0,
                reduction: 8,
                pose_width: 16,
                pose_squeeze: 64,
                start: Start::Uniform,
                ..published([32, 48, 64, 96], [1, 1, 2, 1], 2)
            },
            Preset::Tiny => published([64, 96, 176, 216], [1, 2, 4, 1], 2),
            Preset::Xsmall => published([64, 128, 192, 256], [1, 2, 4, 1], 4),
            Preset::Small => published([64, 128, 216, 288], [1, 3, 6, 3], 4),
            Preset::Base => published([128, 224, 368, 480], [1, 3, 8, 3], 4),
        }
    }
}

impl Config {
    /// Channels of the five maps that the encoder gives: the stem's, then each stage's.
    pub fn feature_channels(&self) -> [usize; 5] {
        let d = self.channels;
        [d[0], d[1], d[2], d[3], d[3]]
    }

    /// Channels e of the decoder's first column: what the encoder's maps are brought to.
    pub fn lateral_channels(&self) -> [usize; 5] {
        let w = self.channels[0];
        [w, w, 2 * w, 4 * w, 8 * w]
    }

    /// Channels d of the decoder's nodes, by level.
    pub fn decoder_channels(&self) -> [usize; 5] {
        let w = self.channels[0];
        [w / 4, w / 2, w, 2 * w, 4 * w]
    }
}
