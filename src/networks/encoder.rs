//! The contract of depth encoders.

use crate::error::{Error, Result};
use crate::monovit::{Ablation, Preset};
use crate::nn::{Builder, Context};
use crate::tensor::{Float, Var};

/// A map of features that an encoder gives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FeatureMap {
    /// Its channels.
    pub channels: usize,
    /// Pixels of the picture for one of the map, along each side.
    pub stride: usize,
}

impl FeatureMap {
    /// Maps of these channels at 1/2, 1/4, 1/8, ... of the picture.
    pub fn halving(channels: &[usize]) -> Vec<FeatureMap> {
        channels.iter().enumerate().map(|(i, &channels)| FeatureMap { channels, stride: 2 << i }).collect()
    }
}

/// What is done to a picture in [0, 1] before an encoder sees it: `(x - mean) / deviation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InputNorm {
    /// Subtracted from every number.
    pub mean: f64,
    /// What the difference is divided by.
    pub deviation: f64,
}

impl InputNorm {
    /// A picture as the encoder sees it.
    pub fn apply<T: Float>(self, image: &Var<T>) -> Var<T> {
        image.affine(1.0 / self.deviation, -self.mean / self.deviation)
    }
}

/// A depth encoder: from a picture to maps of features, largest first.
///
/// Its parameters stand directly under the builder's path, with the names of the public checkpoints. Its sizes are a
/// configuration of its own, made by its line of the registry for every preset in [`PRESETS`](Encoder::PRESETS).
pub trait Encoder: Sized {
    /// The sizes.
    type Config: Clone + std::fmt::Debug + PartialEq;

    /// The presets of which there are sizes, smallest first: reduced ones to train on few cores, and the published.
    const PRESETS: &'static [Preset];

    /// What the picture is put through first, if anything.
    const INPUT: Option<InputNorm> = None;

    /// What is left of a configuration when the encoder's parts of an ablation are taken away.
    ///
    /// # Errors
    /// Names the switch that this encoder has nothing for.
    fn ablated(config: Self::Config, ablation: &Ablation) -> Result<Self::Config> {
        let usual = Ablation::default();
        let switches = [
            ("transformer_paths", ablation.transformer_paths != usual.transformer_paths),
            ("cnn_path", ablation.cnn_path != usual.cnn_path),
            ("drop_path", ablation.drop_path != usual.drop_path),
        ];
        match switches.into_iter().find(|(_, set)| *set) {
            Some((switch, _)) => {
                Err(Error::setting(switch, "this encoder has no such part: the switch belongs to the encoder mpvit"))
            }
            None => Ok(config),
        }
    }

    /// Checks that an encoder of these sizes can be made.
    ///
    /// # Errors
    /// Names the field that cannot be used.
    fn check(config: &Self::Config) -> Result<()>;

    /// The maps that [`forward`](Encoder::forward) gives, in its order. The deepest one has a 32nd of the picture's sides:
    /// that is what pictures' sizes are checked for.
    fn maps(config: &Self::Config) -> Vec<FeatureMap>;

    /// The encoder of a configuration, with its parameters.
    fn new<T: Float>(b: &mut Builder<T>, config: &Self::Config) -> Self;

    /// The maps of a picture `[B, H, W, 3]` that went through [`INPUT`](Encoder::INPUT), `[B, H / stride, W / stride,
    /// channels]` each.
    #[track_caller]
    fn forward<T: Float>(&self, c: &Context<T>, image: &Var<T>) -> Vec<Var<T>>;
}
