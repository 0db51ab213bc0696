//! What encoders and decoders there are: a line each.

use serde::{Deserialize, Serialize};

use super::monodepth2::UNetDecoder;
use super::resnet::{ResNetConfig, ResNetEncoder};
use super::{Decoder, Encoder, FeatureMap, Nested};
use crate::error::Result;
use crate::monovit::decoder::Decoder as NestedDecoder;
use crate::monovit::encoder::Encoder as MpVit;
use crate::monovit::{Ablation, Preset};
use crate::nn::ResNetLayers::{Eighteen, Fifty, ThirtyFour};
use crate::nn::{Builder, Context, Conv};
use crate::tensor::{Float, Var};

/// The encoders: for each its documentation, name in code and name in files, its type, its sizes for a preset, and the
/// network that it was published in.
macro_rules! encoders {
    ($($(#[$doc:meta])+ $kind:ident $name:literal: $encoder:ty, $sizes:expr, $published:ident;)+) => {
        /// An encoder by its name.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
        #[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
        pub enum EncoderKind {
            #[default]
            $($(#[$doc])+ #[serde(rename = $name)] #[cfg_attr(feature = "cli", value(name = $name))] $kind,)+
        }

        impl EncoderKind {
            /// All of them.
            pub const ALL: &'static [EncoderKind] = &[$(EncoderKind::$kind),+];

            /// Name in configurations and on the command line.
            pub fn name(self) -> &'static str {
                match self { $(EncoderKind::$kind => $name),+ }
            }

            /// The network that it was published in: what its weights belong to where no decoder is beside them.
            pub fn published_in(self) -> Network {
                match self { $(EncoderKind::$kind => Network::$published),+ }
            }

            /// The presets of which there are sizes, smallest first.
            pub fn presets(self) -> &'static [Preset] {
                match self { $(EncoderKind::$kind => <$encoder as Encoder>::PRESETS),+ }
            }

            /// Its sizes for a preset, less what an ablation takes away.
            ///
            /// # Errors
            /// Names the switch that the encoder has nothing for.
            pub fn config(self, preset: Preset, ablation: &Ablation) -> Result<EncoderConfig> {
                let sizes = match self {
                    $(EncoderKind::$kind => {
                        EncoderConfig::$kind(<$encoder as Encoder>::ablated(($sizes)(preset), ablation)?)
                    })+
                };
                Ok(sizes)
            }
        }

        /// Sizes of an encoder.
        #[derive(Clone, Debug, PartialEq)]
        pub enum EncoderConfig {
            $($(#[$doc])+ $kind(<$encoder as Encoder>::Config),)+
        }

        impl EncoderConfig {
            /// Which encoder it is of.
            pub fn kind(&self) -> EncoderKind {
                match self { $(EncoderConfig::$kind(_) => EncoderKind::$kind),+ }
            }

            /// Checks that the encoder can be made.
            ///
            /// # Errors
            /// Names the field that cannot be used.
            pub fn check(&self) -> Result<()> {
                match self { $(EncoderConfig::$kind(config) => <$encoder as Encoder>::check(config)),+ }
            }

            /// The maps that the encoder gives, largest first.
            pub fn maps(&self) -> Vec<FeatureMap> {
                match self { $(EncoderConfig::$kind(config) => <$encoder as Encoder>::maps(config)),+ }
            }

            /// The encoder; its parameters stand directly under the builder's path.
            pub fn build<T: Float>(&self, b: &mut Builder<T>) -> AnyEncoder {
                match self {
                    $(EncoderConfig::$kind(config) => AnyEncoder::$kind(<$encoder as Encoder>::new(b, config)),)+
                }
            }
        }

        /// Any of the encoders.
        #[derive(Clone, Debug)]
        pub enum AnyEncoder {
            $($(#[$doc])+ $kind($encoder),)+
        }

        impl AnyEncoder {
            /// The maps of a picture `[B, H, W, 3]` in [0, 1], largest first.
            #[track_caller]
            pub fn forward<T: Float>(&self, c: &Context<T>, image: &Var<T>) -> Vec<Var<T>> {
                match self {
                    $(AnyEncoder::$kind(encoder) => match <$encoder as Encoder>::INPUT {
                        Some(norm) => Encoder::forward(encoder, c, &norm.apply(image)),
                        None => Encoder::forward(encoder, c, image),
                    },)+
                }
            }
        }
    };
}

/// The networks, which are called by their decoders: documentation, names, the decoder's type, its sizes for a preset, and
/// the encoder that it comes with.
macro_rules! networks {
    ($($(#[$doc:meta])+ $network:ident $name:literal: $decoder:ty, $sizes:expr, $usual:ident;)+) => {
        /// A network by its name, which is that of its decoder.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
        #[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
        pub enum Network {
            #[default]
            $($(#[$doc])+ #[serde(rename = $name)] #[cfg_attr(feature = "cli", value(name = $name))] $network,)+
        }

        impl Network {
            /// All of them.
            pub const ALL: &'static [Network] = &[$(Network::$network),+];

            /// Name in configurations and on the command line.
            pub fn name(self) -> &'static str {
                match self { $(Network::$network => $name),+ }
            }

            /// The encoder that it comes with, where nothing else is asked for.
            pub fn usual_encoder(self) -> EncoderKind {
                match self { $(Network::$network => EncoderKind::$usual),+ }
            }

            /// The decoder's sizes for a preset, less what an ablation takes away.
            ///
            /// # Errors
            /// Names the switch that the decoder has nothing for.
            pub fn config(self, preset: Preset, ablation: &Ablation) -> Result<DecoderConfig> {
                let sizes = match self {
                    $(Network::$network => {
                        DecoderConfig::$network(<$decoder as Decoder>::ablated(($sizes)(preset), ablation)?)
                    })+
                };
                Ok(sizes)
            }
        }

        /// Sizes of a decoder, as far as they do not follow from the encoder.
        #[derive(Clone, Debug, PartialEq)]
        pub enum DecoderConfig {
            $($(#[$doc])+ $network(<$decoder as Decoder>::Config),)+
        }

        impl DecoderConfig {
            /// Which network it is of.
            pub fn network(&self) -> Network {
                match self { $(DecoderConfig::$network(_) => Network::$network),+ }
            }

            /// Checks that the decoder can be made for an encoder's maps.
            ///
            /// # Errors
            /// Says which maps it needs, or names the field that cannot be used.
            pub fn check(&self, maps: &[FeatureMap]) -> Result<()> {
                match self { $(DecoderConfig::$network(config) => <$decoder as Decoder>::check(config, maps)),+ }
            }

            /// The decoder for an encoder's maps; its parameters stand directly under the builder's path.
            ///
            /// # Panics
            /// If [`check`](DecoderConfig::check) refuses the maps.
            #[track_caller]
            pub fn build<T: Float>(&self, b: &mut Builder<T>, maps: &[FeatureMap]) -> AnyDecoder {
                match self {
                    $(DecoderConfig::$network(config) => {
                        AnyDecoder::$network(<$decoder as Decoder>::new(b, config, maps))
                    })+
                }
            }
        }

        /// Any of the decoders.
        #[derive(Clone, Debug)]
        pub enum AnyDecoder {
            $($(#[$doc])+ $network($decoder),)+
        }

        impl AnyDecoder {
            /// Disparities at 1, 1/2, 1/4, 1/8 of the picture, `[B, h, w, 1]` each, from the encoder's maps.
            #[track_caller]
            pub fn forward<T: Float>(&self, c: &Context<T>, features: &[Var<T>]) -> Vec<Var<T>> {
                match self { $(AnyDecoder::$network(decoder) => Decoder::forward(decoder, c, features)),+ }
            }

            /// The convolutions whose sigmoid the disparities are, largest first.
            pub fn heads(&self) -> &[Conv] {
                match self { $(AnyDecoder::$network(decoder) => Decoder::heads(decoder)),+ }
            }
        }
    };
}

encoders! {
    /// MPViT: CNN and transformer paths side by side, of a size for each preset.
    Mpvit "mpvit": MpVit, Preset::config, Monovit;
    /// ResNet-18.
    Resnet18 "resnet18": ResNetEncoder, |preset| ResNetConfig::of(Eighteen, preset), Monodepth2;
    /// ResNet-34.
    Resnet34 "resnet34": ResNetEncoder, |preset| ResNetConfig::of(ThirtyFour, preset), Monodepth2;
    /// ResNet-50.
    Resnet50 "resnet50": ResNetEncoder, |preset| ResNetConfig::of(Fifty, preset), Monodepth2;
}

networks! {
    /// MonoViT's nested decoder with channel attention; with MPViT, the paper's network.
    Monovit "monovit": NestedDecoder, Nested::of, Mpvit;
    /// Monodepth2's U-Net; published with ResNet-18 and ResNet-50.
    Monodepth2 "monodepth2": UNetDecoder, |_| (), Resnet18;
}
