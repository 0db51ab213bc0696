//! The contract of depth decoders.

use super::FeatureMap;
use crate::error::{Error, Result};
use crate::monovit::Ablation;
use crate::nn::{Builder, Context, Conv};
use crate::tensor::{Float, Var};

/// A depth decoder: from an encoder's maps to disparities (sigmoid, in [0, 1]) at 1, 1/2, 1/4, 1/8 of the picture.
///
/// Its parameters stand directly under the builder's path, with the names of the public checkpoints.
pub trait Decoder: Sized {
    /// The sizes, as far as they do not follow from the encoder's maps.
    type Config: Clone + std::fmt::Debug + PartialEq;

    /// What is left of a configuration when the decoder's parts of an ablation are taken away.
    ///
    /// # Errors
    /// Names the switch that this decoder has nothing for.
    fn ablated(config: Self::Config, ablation: &Ablation) -> Result<Self::Config> {
        if ablation.decoder_attention {
            return Ok(config);
        }
        let message = "this decoder has no such part: the switch belongs to the network monovit";
        Err(Error::setting("decoder_attention", message))
    }

    /// Checks that the decoder can be made for these maps.
    ///
    /// # Errors
    /// Says which maps it needs, or names the field that cannot be used.
    fn check(config: &Self::Config, maps: &[FeatureMap]) -> Result<()>;

    /// The decoder for an encoder's maps, with its parameters.
    ///
    /// # Panics
    /// If [`check`](Decoder::check) refuses them.
    fn new<T: Float>(b: &mut Builder<T>, config: &Self::Config, maps: &[FeatureMap]) -> Self;

    /// Disparities at 1, 1/2, 1/4, 1/8 of the picture, `[B, h, w, 1]` each.
    #[track_caller]
    fn forward<T: Float>(&self, c: &Context<T>, features: &[Var<T>]) -> Vec<Var<T>>;

    /// The convolutions whose sigmoid the disparities are, largest first, each with a bias.
    fn heads(&self) -> &[Conv];
}

/// Channels of the five maps that a decoder of five levels needs, at 1/2, 1/4, 1/8, 1/16, 1/32 of the picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pyramid(pub [usize; 5]);

impl Pyramid {
    /// The channels, if the maps are of that kind. The first map's channels w decide a decoder's widths (w/4 at full size,
    /// w/2, w, 2w, 4w: published with w = 64), so they are a multiple of 4.
    ///
    /// # Errors
    /// Says which maps there are instead.
    pub fn of(maps: &[FeatureMap]) -> Result<Self> {
        let refuse = |message: String| Err(Error::setting("encoder", message));
        let strides: Vec<usize> = maps.iter().map(|map| map.stride).collect();
        if strides != [2, 4, 8, 16, 32] {
            return refuse(format!("its maps are at 1/{strides:?} of the picture, but 1/[2, 4, 8, 16, 32] are needed"));
        }
        let channels = std::array::from_fn(|i| maps[i].channels);
        if channels[0] == 0 || !channels[0].is_multiple_of(4) {
            return refuse(format!(
                "{} channels of its first map are not a multiple of 4, as the decoder needs",
                channels[0]
            ));
        }
        Ok(Pyramid(channels))
    }

    /// Channels of a decoder's levels, full size first.
    pub fn levels(self) -> [usize; 5] {
        let w = self.0[0];
        [w / 4, w / 2, w, 2 * w, 4 * w]
    }
}
