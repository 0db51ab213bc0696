//! A network, its encoder and its size, by name.

use super::{Config, EncoderKind, Network};
use crate::error::{Error, Result};
use crate::monovit::{Ablation, Preset};

/// Names that decide the networks: what `--network`, `--encoder` and `--preset` say.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Architecture {
    /// The network, which means its decoder.
    pub network: Network,
    /// The encoder.
    pub encoder: EncoderKind,
    /// The size: of MPViT one of six, of other encoders `small` as published, or reduced.
    pub preset: Preset,
}

/// MonoViT of a size.
impl From<Preset> for Architecture {
    fn from(preset: Preset) -> Self {
        Architecture { network: Network::Monovit, encoder: EncoderKind::Mpvit, preset }
    }
}

impl Architecture {
    /// A network with the encoder that it comes with.
    pub fn of(network: Network, preset: Preset) -> Self {
        Architecture { network, encoder: network.usual_encoder(), preset }
    }

    /// All that there are: every network over every encoder that fits, in every size.
    pub fn all() -> impl Iterator<Item = Architecture> {
        let of = |&network: &Network| {
            let of = move |&encoder: &EncoderKind| {
                encoder.presets().iter().map(move |&preset| Architecture { network, encoder, preset })
            };
            EncoderKind::ALL.iter().flat_map(of)
        };
        Network::ALL.iter().flat_map(of).filter(|a| a.fits())
    }

    /// The encoders whose maps a network can read.
    pub(super) fn fitting(network: Network) -> impl Iterator<Item = EncoderKind> {
        let fits = move |encoder: &EncoderKind| {
            encoder.presets().last().is_some_and(|&preset| Architecture { network, encoder: *encoder, preset }.fits())
        };
        EncoderKind::ALL.iter().copied().filter(fits)
    }

    fn fits(self) -> bool {
        let usual = Ablation::default();
        let parts = self.encoder.config(self.preset, &usual).and_then(|encoder| {
            let decoder = self.network.config(self.preset, &usual)?;
            decoder.check(&encoder.maps())
        });
        parts.is_ok()
    }

    /// The name: the preset's alone of MonoViT over MPViT, as `nano`; of others as `monodepth2/resnet18/nano`.
    pub fn name(self) -> String {
        match (self.network, self.encoder) {
            (Network::Monovit, EncoderKind::Mpvit) => self.preset.name().to_owned(),
            (network, encoder) => format!("{}/{}/{}", network.name(), encoder.name(), self.preset.name()),
        }
    }

    /// The name in a sentence: `the preset nano`, `monodepth2/resnet18/nano`.
    pub fn in_words(self) -> String {
        match (self.network, self.encoder) {
            (Network::Monovit, EncoderKind::Mpvit) => format!("the preset {}", self.preset.name()),
            _ => self.name(),
        }
    }

    /// The configuration, less what an ablation takes away.
    ///
    /// # Errors
    /// If there is no such size of the encoder, encoder and decoder do not fit, or they lack what the ablation takes away:
    /// names the field, and what would do.
    pub fn config(self, ablation: &Ablation) -> Result<Config> {
        let presets = self.encoder.presets();
        if !presets.contains(&self.preset) {
            let names: Vec<&str> = presets.iter().map(|preset| preset.name()).collect();
            let message = format!(
                "there is no {} of {}, only {}: small is as published, the others are reduced",
                self.preset.name(),
                self.encoder.name(),
                names.join(", ")
            );
            return Err(Error::setting("preset", message));
        }
        let sizes = self.preset.config();
        let config = Config {
            encoder: self.encoder.config(self.preset, ablation)?,
            decoder: self.network.config(self.preset, ablation)?,
            pose: sizes.pose(),
            start: sizes.start,
        };
        config.check()?;
        Ok(config)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_architecture_has_a_name_of_its_own_and_can_be_made() {
        let mut names: Vec<String> = Architecture::all().map(Architecture::name).collect();
        // Two networks over MPViT in six sizes and three ResNets in three.
        assert_eq!(names.len(), 2 * (6 + 3 * 3));
        assert_eq!(names[0], "pico");
        assert!(names.iter().any(|name| name == "monodepth2/resnet18/nano"));
        for architecture in Architecture::all() {
            let config = architecture.config(&Ablation::default()).unwrap();
            assert_eq!(config.encoder.maps().last().map(|map| map.stride), Some(32), "{}", architecture.name());
        }
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), 30);
    }

    #[test]
    fn monovit_of_a_size_is_the_papers_configuration() {
        for preset in Preset::ALL {
            let found = Architecture::from(preset).config(&Ablation::default()).unwrap();
            assert_eq!(found, preset.config().into());
        }
    }

    #[test]
    fn what_does_not_fit_is_named_with_what_would() {
        let refused = |encoder, preset, ablation: Ablation| {
            let network = Network::Monodepth2;
            Architecture { network, encoder, preset }.config(&ablation).unwrap_err().to_string()
        };
        let size = refused(EncoderKind::Resnet50, Preset::Base, Ablation::default());
        assert!(size.starts_with("preset") && size.contains("no base of resnet50, only pico, nano, small"), "{size}");
        for (field, ablation) in [
            ("transformer_paths", Ablation { transformer_paths: Some(1), ..Ablation::default() }),
            ("cnn_path", Ablation { cnn_path: false, ..Ablation::default() }),
            ("drop_path", Ablation { drop_path: Some(0.1), ..Ablation::default() }),
            ("decoder_attention", Ablation { decoder_attention: false, ..Ablation::default() }),
        ] {
            let error = refused(EncoderKind::Resnet18, Preset::Nano, ablation);
            assert!(error.starts_with(field) && error.contains("no such part"), "{error}");
        }
        // A width that the decoder cannot halve twice.
        let mut config = Architecture::of(Network::Monodepth2, Preset::Nano).config(&Ablation::default()).unwrap();
        let layers = crate::nn::ResNetLayers::Eighteen;
        config.encoder = super::super::EncoderConfig::Resnet18(super::super::resnet::ResNetConfig { layers, width: 6 });
        let error = config.check().unwrap_err().to_string();
        assert!(error.contains("resnet18 does not fit the network monodepth2: 6 channels"), "{error}");
        assert!(error.contains("Encoders that fit: mpvit, resnet18, resnet34, resnet50"), "{error}");
    }
}
