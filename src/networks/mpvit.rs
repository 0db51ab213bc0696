//! MPViT as a depth encoder: a size for each preset.

use super::{Encoder, FeatureMap};
use crate::error::Result;
use crate::monovit::encoder::Encoder as MpVit;
use crate::monovit::{Ablation, Config, Preset};
use crate::nn::{Builder, Context};
use crate::tensor::{Float, Var};

impl Encoder for MpVit {
    type Config = Config;

    const PRESETS: &'static [Preset] = &Preset::ALL;

    fn ablated(config: Config, ablation: &Ablation) -> Result<Config> {
        ablation.check(&config)?;
        Ok(ablation.apply(config))
    }

    fn check(config: &Config) -> Result<()> {
        config.check()
    }

    fn maps(config: &Config) -> Vec<FeatureMap> {
        FeatureMap::halving(&config.feature_channels())
    }

    fn new<T: Float>(b: &mut Builder<T>, config: &Config) -> Self {
        MpVit::new(b, config)
    }

    #[track_caller]
    fn forward<T: Float>(&self, c: &Context<T>, image: &Var<T>) -> Vec<Var<T>> {
        self.forward(c, image)
    }
}
