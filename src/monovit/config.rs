//! The sizes of MonoViT as data: the published ones and our reduced ones.

use serde::{Deserialize, Serialize};

use super::decoder::DecoderConfig;
use super::pose::PoseConfig;
use crate::error::{Error, Result};
use crate::nn::Start;

/// Configuration of the four networks: everything that decides their shapes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Number of channels d0..d3 of the encoder's stages.
    pub channels: [usize; 4],
    /// Number of transformer layers in each path of a stage.
    pub layers: [usize; 4],
    /// Number of transformer paths in each stage; with 0 the CNN path stands alone.
    pub paths: [usize; 4],
    /// Whether a CNN path (the inverted residual block) stands beside the transformer paths of each stage.
    #[serde(default = "yes")]
    pub cnn_path: bool,
    /// Expansion ratio of the transformer's MLP: hidden channels over channels.
    pub mlp_ratio: usize,
    /// Number of attention heads.
    pub heads: usize,
    /// The windows of the convolutional relative position, each with its heads.
    pub windows: Vec<(usize, usize)>,
    /// Largest DropPath (stochastic depth) probability; it grows linearly over the layers.
    pub drop_path: f64,
    /// Whether the decoder weighs channels by attention; without, the convolutions behind it stand alone.
    #[serde(default = "yes")]
    pub decoder_attention: bool,
    /// Reduction ratio of the decoder's channel attention.
    pub reduction: usize,
    /// Number of channels of the pose ResNet's first stage.
    pub pose_width: usize,
    /// Number of channels of the pose decoder.
    pub pose_squeeze: usize,
    /// Initialisation of the weights.
    pub start: Start,
}

fn yes() -> bool {
    true
}

/// What is taken away from a named configuration: the switches of MonoViT's ablation study (section 4), and the rate of
/// DropPath. The default takes nothing away.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Ablation {
    /// At most so many transformer paths in every stage. The published sizes have 2, 3, 3, 3, so that 2 leaves the
    /// first stage as it is; 1 keeps the path with the smallest window; 0 leaves the CNN path alone.
    pub transformer_paths: Option<usize>,
    /// Whether the CNN path stays.
    pub cnn_path: bool,
    /// Whether the decoder's channel attention stays.
    pub decoder_attention: bool,
    /// The largest DropPath probability, instead of the size's own.
    pub drop_path: Option<f64>,
}

impl Default for Ablation {
    fn default() -> Self {
        Ablation { transformer_paths: None, cnn_path: true, decoder_attention: true, drop_path: None }
    }
}

impl Ablation {
    /// What is left of a configuration.
    pub fn apply(&self, config: Config) -> Config {
        let most = self.transformer_paths.unwrap_or(usize::MAX);
        Config {
            paths: config.paths.map(|paths| paths.min(most)),
            cnn_path: config.cnn_path && self.cnn_path,
            decoder_attention: config.decoder_attention && self.decoder_attention,
            drop_path: self.drop_path.unwrap_or(config.drop_path),
            ..config
        }
    }

    /// Checks that networks can be made of what is left of a configuration.
    ///
    /// # Errors
    /// If more paths are asked for than any stage has, or as [`Config::check`] says.
    pub fn check(&self, config: &Config) -> Result<()> {
        let most = config.paths.into_iter().max().unwrap_or(0);
        if let Some(paths) = self.transformer_paths.filter(|&paths| paths > most) {
            let message = format!("{paths}, but no stage has more than {most}, and this takes paths away");
            return Err(Error::setting("transformer_paths", message));
        }
        self.apply(config.clone()).check()
    }
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
    /// All presets, smallest first.
    pub const ALL: [Preset; 6] =
        [Preset::Pico, Preset::Nano, Preset::Tiny, Preset::Xsmall, Preset::Small, Preset::Base];

    /// Name on the command line.
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

    /// Its configuration.
    pub fn config(self) -> Config {
        let published = |channels, layers, mlp_ratio| Config {
            channels,
            layers,
            paths: [2, 3, 3, 3],
            cnn_path: true,
            mlp_ratio,
            heads: 8,
            windows: vec![(3, 2), (5, 3), (7, 3)],
            drop_path: 0.2,
            decoder_attention: true,
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
    /// Checks that networks of these sizes can be made.
    ///
    /// # Errors
    /// Names the field that cannot be used: a stage without any path, channels that heads or levels do not divide,
    /// windows that do not share out the heads, a probability outside [0, 1).
    pub fn check(&self) -> Result<()> {
        let refuse = |field: &str, message: String| Err(Error::setting(field, message));
        if let Some(stage) = self.paths.iter().position(|&paths| paths == 0 && !self.cnn_path) {
            let message = format!("stage {} has neither a CNN path nor transformer paths: keep one", stage + 1);
            return refuse("cnn_path", message);
        }
        let counts = [
            ("layers", self.layers.into_iter().min()),
            ("mlp_ratio", Some(self.mlp_ratio)),
            ("heads", Some(self.heads)),
            ("reduction", Some(self.reduction)),
            ("pose_width", Some(self.pose_width)),
            ("pose_squeeze", Some(self.pose_squeeze)),
        ];
        if let Some((field, _)) = counts.into_iter().find(|&(_, least)| least == Some(0)) {
            return refuse(field, "0, but at least 1 is needed".into());
        }
        if let Some(&channels) = self.channels.iter().find(|&&c| c == 0 || !c.is_multiple_of(self.heads)) {
            return refuse("channels", format!("{channels} channels are not a multiple of {} heads", self.heads));
        }
        let first = self.channels[0];
        if !first.is_multiple_of(4) {
            let message = format!("{first} channels of the first stage are not a multiple of 4, as the decoder needs");
            return refuse("channels", message);
        }
        if let Some(channels) = self.channels.iter().find(|&&c| self.decoder_attention && c < self.reduction) {
            return refuse("reduction", format!("{} leaves nothing of {channels} channels", self.reduction));
        }
        let shared: usize = self.windows.iter().map(|&(_, heads)| heads).sum();
        if shared != self.heads || self.windows.iter().any(|&(window, heads)| window.is_multiple_of(2) || heads == 0) {
            let message = format!("odd windows whose heads sum to {} expected, found {:?}", self.heads, self.windows);
            return refuse("windows", message);
        }
        if !(0.0..1.0).contains(&self.drop_path) {
            return refuse("drop_path", format!("{} is not a probability below 1", self.drop_path));
        }
        Ok(())
    }

    /// Channels of the five maps that the encoder gives: the stem's, then each stage's.
    pub fn feature_channels(&self) -> [usize; 5] {
        let d = self.channels;
        [d[0], d[1], d[2], d[3], d[3]]
    }

    /// Sizes of the decoder behind this encoder.
    pub fn decoder(&self) -> DecoderConfig {
        DecoderConfig {
            features: self.feature_channels(),
            attention: self.decoder_attention,
            reduction: self.reduction,
        }
    }

    /// Sizes of the pose network.
    pub fn pose(&self) -> PoseConfig {
        PoseConfig { width: self.pose_width, squeeze: self.pose_squeeze }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_named_sizes_can_be_made_and_an_ablation_that_takes_nothing_leaves_them() {
        for preset in Preset::ALL {
            preset.config().check().unwrap();
            assert_eq!(Ablation::default().apply(preset.config()), preset.config());
        }
    }

    #[test]
    fn fewer_paths_are_at_most_so_many_in_every_stage() {
        let left =
            |n| Ablation { transformer_paths: Some(n), ..Ablation::default() }.apply(Preset::Small.config()).paths;
        assert_eq!([3, 2, 1, 0].map(left), [[2, 3, 3, 3], [2; 4], [1; 4], [0; 4]]);
    }

    #[test]
    fn what_cannot_be_made_is_named() {
        let refused = |ablation: Ablation| ablation.check(&Preset::Nano.config()).unwrap_err().to_string();
        let nothing = refused(Ablation { cnn_path: false, transformer_paths: Some(0), ..Ablation::default() });
        assert!(nothing.contains("cnn_path") && nothing.contains("neither"), "{nothing}");
        let more = refused(Ablation { transformer_paths: Some(4), ..Ablation::default() });
        assert!(more.contains("transformer_paths: 4") && more.contains("more than 3"), "{more}");
        for p in [1.0, -0.1, f64::NAN] {
            let rate = refused(Ablation { drop_path: Some(p), ..Ablation::default() });
            assert!(rate.contains("drop_path") && rate.contains("probability"), "{rate}");
        }
        let changed = |change: fn(&mut Config), field: &str| {
            let mut config = Preset::Nano.config();
            change(&mut config);
            let error = config.check().unwrap_err().to_string();
            assert!(error.starts_with(field), "{error}");
        };
        changed(|c| c.channels[1] = 50, "channels");
        changed(|c| c.heads = 0, "heads");
        changed(|c| c.windows[0].0 = 4, "windows");
        changed(|c| c.windows[0].1 = 1, "windows");
        changed(|c| c.reduction = 64, "reduction");
        changed(|c| c.layers[2] = 0, "layers");
        changed(|c| (c.cnn_path, c.paths[3]) = (false, 0), "cnn_path: stage 4");
    }
}
