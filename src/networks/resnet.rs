//! Residual networks as depth encoders (Monodepth2, section 4; the ablation of MonoViT).

use super::{Encoder, FeatureMap, InputNorm};
use crate::error::{Error, Result};
use crate::monovit::Preset;
use crate::nn::{Builder, Context, ResNet, ResNetLayers};
use crate::tensor::{Float, Var};

/// Sizes of the encoder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ResNetConfig {
    /// The number of layers.
    pub layers: ResNetLayers,
    /// Channels of the stem; 64 as published.
    pub width: usize,
}

impl ResNetConfig {
    /// That of a preset: as wide as published, or reduced.
    pub(super) fn of(layers: ResNetLayers, preset: Preset) -> Self {
        let width = match preset {
            Preset::Pico => 8,
            Preset::Nano => 16,
            Preset::Tiny | Preset::Xsmall | Preset::Small | Preset::Base => 64,
        };
        ResNetConfig { layers, width }
    }
}

/// ResNet encoder: five maps, of the stem at 1/2 and of the stages at 1/4, 1/8, 1/16, 1/32; under `encoder` in a file of
/// its own.
#[derive(Clone, Debug)]
pub struct ResNetEncoder(ResNet);

impl Encoder for ResNetEncoder {
    type Config = ResNetConfig;

    const PRESETS: &'static [Preset] = &[Preset::Pico, Preset::Nano, Preset::Small];

    const INPUT: Option<InputNorm> = Some(InputNorm { mean: 0.45, deviation: 0.225 });

    fn check(config: &ResNetConfig) -> Result<()> {
        if config.width == 0 {
            return Err(Error::setting("width", "0, but at least 1 is needed"));
        }
        Ok(())
    }

    fn maps(config: &ResNetConfig) -> Vec<FeatureMap> {
        FeatureMap::halving(&config.layers.channels(config.width))
    }

    fn new<T: Float>(b: &mut Builder<T>, config: &ResNetConfig) -> Self {
        ResNetEncoder(ResNet::new(&mut b.at("encoder"), 3, config.layers, config.width))
    }

    #[track_caller]
    fn forward<T: Float>(&self, c: &Context<T>, image: &Var<T>) -> Vec<Var<T>> {
        self.0.forward(c, image)
    }
}
