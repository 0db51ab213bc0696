//! MonoViT's nested decoder, over any encoder with five maps.

use super::{Decoder, FeatureMap, Pyramid};
use crate::error::{Error, Result};
use crate::monovit::decoder::{Decoder as NestedDecoder, DecoderConfig};
use crate::monovit::{Ablation, Preset};
use crate::nn::{Builder, Context, Conv};
use crate::tensor::{Float, Var};

/// Sizes of the nested decoder that do not follow from the encoder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Nested {
    /// Whether channels are weighed by attention.
    pub attention: bool,
    /// Reduction ratio of the channel attention.
    pub reduction: usize,
}

impl Nested {
    /// Those of a preset.
    pub(super) fn of(preset: Preset) -> Self {
        let config = preset.config();
        Nested { attention: config.decoder_attention, reduction: config.reduction }
    }
}

impl Decoder for NestedDecoder {
    type Config = Nested;

    fn ablated(config: Nested, ablation: &Ablation) -> Result<Nested> {
        Ok(Nested { attention: config.attention && ablation.decoder_attention, ..config })
    }

    fn check(config: &Nested, maps: &[FeatureMap]) -> Result<()> {
        let Pyramid(channels) = Pyramid::of(maps)?;
        match channels[1..].iter().min() {
            Some(&least) if config.attention && (config.reduction == 0 || least < config.reduction) => {
                Err(Error::setting("reduction", format!("{} leaves nothing of {least} channels", config.reduction)))
            }
            _ => Ok(()),
        }
    }

    #[track_caller]
    fn new<T: Float>(b: &mut Builder<T>, config: &Nested, maps: &[FeatureMap]) -> Self {
        let Pyramid(features) = Pyramid::of(maps).expect("maps that were checked");
        let &Nested { attention, reduction } = config;
        NestedDecoder::new(b, &DecoderConfig { features, attention, reduction })
    }

    #[track_caller]
    fn forward<T: Float>(&self, c: &Context<T>, features: &[Var<T>]) -> Vec<Var<T>> {
        self.forward(c, features)
    }

    fn heads(&self) -> &[Conv] {
        self.heads()
    }
}
