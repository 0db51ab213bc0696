//! The flags that say which networks: shared by the commands that make them.

use clap::builder::{PossibleValuesParser, TypedValueParser};
use parallax::monovit::Preset;
use parallax::networks::{Architecture, EncoderKind, Network};
use parallax::{Error, Result};

#[derive(clap::Args, Clone, Copy, Debug, Default)]
pub struct ArchitectureArgs {
    /// Size of the networks. Of encoders other than mpvit there are small (as published), nano and pico (reduced) [default:
    /// nano, or that of the weights to start from].
    #[arg(long)]
    pub preset: Option<Preset>,
    /// Depth network, which is called by its decoder [default: monovit, or that of the weights to start from].
    #[arg(long)]
    pub network: Option<Network>,
    /// Depth encoder; mpvit-tiny is mpvit with --preset tiny [default: the network's own, or that of the weights to start
    /// from].
    #[arg(long, value_name = "ENCODER", value_parser = encoder_parser())]
    pub encoder: Option<EncoderArg>,
}

/// An encoder, and its size where its name says that too.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EncoderArg {
    kind: EncoderKind,
    preset: Option<Preset>,
}

impl EncoderArg {
    /// All that there are: the encoders, and the published sizes of MPViT.
    fn all() -> impl Iterator<Item = (&'static str, EncoderArg)> {
        const SIZES: [(&str, Preset); 4] = [
            ("mpvit-tiny", Preset::Tiny),
            ("mpvit-xsmall", Preset::Xsmall),
            ("mpvit-small", Preset::Small),
            ("mpvit-base", Preset::Base),
        ];
        let plain = EncoderKind::ALL.iter().map(|&kind| (kind.name(), EncoderArg { kind, preset: None }));
        let sized = |(name, preset)| (name, EncoderArg { kind: EncoderKind::Mpvit, preset: Some(preset) });
        plain.chain(SIZES.map(sized))
    }
}

fn encoder_parser() -> impl TypedValueParser<Value = EncoderArg> {
    PossibleValuesParser::new(EncoderArg::all().map(|(name, _)| name)).try_map(|said| {
        EncoderArg::all().find(|(name, _)| *name == said).map(|(_, encoder)| encoder).ok_or("no such encoder")
    })
}

/// What configurations say of the networks, over which flags win.
#[derive(Clone, Copy, Debug, Default)]
pub struct Said {
    pub preset: Option<Preset>,
    pub network: Option<Network>,
    pub encoder: Option<EncoderKind>,
}

impl ArchitectureArgs {
    /// These flags, over what else says it.
    ///
    /// # Errors
    /// If the encoder's name and the preset say two sizes.
    pub fn over(&self, said: Said) -> Result<Said> {
        let of_encoder = self.encoder.and_then(|encoder| encoder.preset);
        if let (Some(preset), Some(other)) = (of_encoder, self.preset.filter(|&p| Some(p) != of_encoder)) {
            let message = format!(
                "mpvit-{} is mpvit of the preset {0}, but --preset is {}: leave one of them out",
                preset.name(),
                other.name()
            );
            return Err(Error::setting("--encoder", message));
        }
        Ok(Said {
            preset: self.preset.or(of_encoder).or(said.preset),
            network: self.network.or(said.network),
            encoder: self.encoder.map(|encoder| encoder.kind).or(said.encoder),
        })
    }

    /// The networks that are asked for: the reduced MonoViT, unless flags say otherwise.
    ///
    /// # Errors
    /// As [`over`](ArchitectureArgs::over).
    pub fn get(&self) -> Result<Architecture> {
        Ok(self.over(Said::default())?.or(Preset::Nano))
    }
}

impl Said {
    /// The networks, of which what is not said is as in others.
    pub fn or(self, others: impl Into<Architecture>) -> Architecture {
        let others = others.into();
        let network = self.network.unwrap_or(others.network);
        // Another network comes with an encoder of its own.
        let usual = if network == others.network { others.encoder } else { network.usual_encoder() };
        Architecture { network, encoder: self.encoder.unwrap_or(usual), preset: self.preset.unwrap_or(others.preset) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flags_win_and_what_they_leave_open_is_the_networks_own() {
        let all: Vec<(&str, EncoderArg)> = EncoderArg::all().collect();
        let encoder = |name: &str| all.iter().find(|(known, _)| *known == name).map(|(_, encoder)| *encoder);
        let get = |network, name, preset| {
            let encoder = encoder(name);
            ArchitectureArgs { preset, network, encoder }.get().map(Architecture::name)
        };
        assert_eq!(get(None, "", None).unwrap(), "nano");
        assert_eq!(get(None, "mpvit-tiny", None).unwrap(), "tiny");
        assert_eq!(get(None, "resnet34", Some(Preset::Small)).unwrap(), "monovit/resnet34/small");
        assert_eq!(get(Some(Network::Monodepth2), "", None).unwrap(), "monodepth2/resnet18/nano");
        assert_eq!(get(Some(Network::Monodepth2), "mpvit", None).unwrap(), "monodepth2/mpvit/nano");
        let error = get(None, "mpvit-tiny", Some(Preset::Base)).unwrap_err().to_string();
        assert!(error.contains("--encoder") && error.contains("preset tiny") && error.contains("--preset is base"));
    }
}
