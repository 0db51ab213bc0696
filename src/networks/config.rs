//! Everything that decides the shapes of the networks.

use super::{Architecture, DecoderConfig, EncoderConfig, Nested};
use crate::error::{Error, Result};
use crate::monovit::pose::PoseConfig;
use crate::nn::Start;

/// Sizes of the encoder, the decoder and the pose network, and how their weights start.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// The depth encoder.
    pub encoder: EncoderConfig,
    /// The depth decoder.
    pub decoder: DecoderConfig,
    /// The pose network.
    pub pose: PoseConfig,
    /// Initialisation of the layers in front of normalisations.
    pub start: Start,
}

/// MonoViT of the paper, in any size.
impl From<crate::monovit::Config> for Config {
    fn from(config: crate::monovit::Config) -> Self {
        let nested = Nested { attention: config.decoder_attention, reduction: config.reduction };
        Config {
            decoder: DecoderConfig::Monovit(nested),
            pose: config.pose(),
            start: config.start,
            encoder: EncoderConfig::Mpvit(config),
        }
    }
}

impl From<&Config> for Config {
    fn from(config: &Config) -> Self {
        config.clone()
    }
}

impl Config {
    /// Checks that networks of these sizes can be made, and that decoder and encoder fit.
    ///
    /// # Errors
    /// Names the field that cannot be used; where the decoder cannot read the encoder's maps, the encoders that fit.
    pub fn check(&self) -> Result<()> {
        self.encoder.check()?;
        self.decoder.check(&self.encoder.maps()).map_err(|error| match error {
            Error::Setting { name, message } if name == "encoder" => {
                let (network, encoder) = (self.decoder.network(), self.encoder.kind().name());
                let fitting: Vec<&str> = Architecture::fitting(network).map(|kind| kind.name()).collect();
                let message = format!(
                    "{encoder} does not fit the network {}: {message}. Encoders that fit: {}",
                    network.name(),
                    fitting.join(", ")
                );
                Error::Setting { name, message }
            }
            other => other,
        })?;
        match self.pose {
            PoseConfig { width: 0, .. } => Err(Error::setting("pose_width", "0, but at least 1 is needed")),
            PoseConfig { squeeze: 0, .. } => Err(Error::setting("pose_squeeze", "0, but at least 1 is needed")),
            _ => Ok(()),
        }
    }

    /// The sizes of MPViT, where that is the encoder.
    pub fn mpvit(&self) -> Option<&crate::monovit::Config> {
        match &self.encoder {
            EncoderConfig::Mpvit(config) => Some(config),
            _ => None,
        }
    }
}
