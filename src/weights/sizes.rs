//! Which size of the network some tensors belong to, from their shapes.

use crate::monovit::{Ablation, Preset};
use crate::networks::{Architecture, Config, DecoderConfig, EncoderConfig, EncoderKind, Network};
use crate::nn::Named;

/// Encoders that share the names of their tensors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Family {
    /// MPViT.
    Mpvit,
    /// Residual networks.
    ResNet,
}

impl Family {
    /// That of an encoder.
    pub fn of(encoder: &EncoderConfig) -> Self {
        match encoder {
            EncoderConfig::Mpvit(_) => Family::Mpvit,
            EncoderConfig::Resnet18(_) | EncoderConfig::Resnet34(_) | EncoderConfig::Resnet50(_) => Family::ResNet,
        }
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Family::Mpvit => "MPViT",
            Family::ResNet => "ResNet",
        }
    }

    /// What its file is, with names that are in it.
    pub fn described(self) -> &'static str {
        match self {
            Family::Mpvit => "an MPViT (stem., mhca_stages.)",
            Family::ResNet => "a ResNet for one picture (conv1., layer1.)",
        }
    }
}

/// How far another encoder or decoder is, beside differences of sizes: further than these ever are.
const OTHER: f64 = 1e3;

/// What tensors tell about the sizes of their network; what they do not tell is `None`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Sizes {
    /// The kind of encoder.
    family: Option<Family>,
    /// The network that the decoder is of.
    network: Option<Network>,
    /// Channels of the encoder's first four maps.
    channels: [Option<usize>; 4],
    layers: [Option<usize>; 4],
    paths: [Option<usize>; 4],
    mlp_ratio: Option<usize>,
    /// Number of a ResNet's blocks in each stage, and of the convolutions in one.
    blocks: [Option<usize>; 4],
    convolutions: Option<usize>,
    /// Channels of the decoder's first attention, before and after the squeeze.
    squeeze: Option<[usize; 2]>,
    pose_width: Option<usize>,
    pose_squeeze: Option<usize>,
}

impl Sizes {
    /// Looks at names and shapes.
    pub fn of(tensors: &[Named]) -> Self {
        let mut sizes = Sizes::default();
        // The encoder has the say about channels: it is looked at last.
        for of_encoder in [false, true] {
            for tensor in tensors {
                if let Some(name) = tensor.name.strip_prefix("encoder.") {
                    if of_encoder {
                        sizes.see_encoder(name, tensor.tensor.shape());
                    }
                } else if !of_encoder {
                    sizes.see_other(&tensor.name, tensor.tensor.shape());
                }
            }
        }
        sizes
    }

    fn see_encoder(&mut self, name: &str, shape: &[usize]) {
        let parts: Vec<&str> = name.split('.').collect();
        let at = |i: usize| parts.get(i).and_then(|p| p.parse::<usize>().ok());
        let larger = |known: &mut Option<usize>, n: usize| *known = Some(known.unwrap_or(0).max(n));
        match parts.first() {
            Some(&"encoder") => self.family = Some(Family::ResNet),
            Some(&("stem" | "patch_embed_stages" | "mhca_stages")) => self.family = Some(Family::Mpvit),
            _ => {}
        }
        match parts[..] {
            ["encoder", "conv1", "weight"] => self.channels[0] = shape.first().copied(),
            ["encoder", layer, block, conv, "weight"] if conv.starts_with("conv") => {
                let number = |part: &str, of: &str| part.strip_prefix(of).and_then(|n| n.parse::<usize>().ok());
                let (Some(stage @ 1..5), Some(index @ 0..1024)) = (number(layer, "layer"), at(2)) else { return };
                larger(&mut self.blocks[stage - 1], index + 1);
                if let Some(of_block @ 1..10) = number(conv, "conv") {
                    larger(&mut self.convolutions, of_block);
                }
                // What enters the second block is what leaves each.
                if let ("1", "conv1", Some(channels)) = (block, conv, self.channels.get_mut(stage)) {
                    *channels = shape.get(1).copied();
                }
            }
            ["stem", "1", "conv", "weight"] => self.channels[0] = shape.first().copied(),
            ["patch_embed_stages", _, "patch_embeds", _, "patch_conv", "dwconv", "weight"] => {
                if let (Some(stage @ 0..4), Some(path @ 0..64)) = (at(1), at(3)) {
                    self.channels[stage] = shape.first().copied();
                    larger(&mut self.paths[stage], path + 1);
                }
            }
            ["mhca_stages", _, "mhca_blks", _, "MHCA_layers", _, "mlp", "fc1", "weight"] => {
                if let (Some(stage @ 0..4), Some(layer @ 0..1024)) = (at(1), at(5)) {
                    larger(&mut self.layers[stage], layer + 1);
                    if let &[hidden, channels] = shape
                        && channels > 0
                    {
                        self.mlp_ratio = Some(hidden / channels);
                    }
                }
            }
            _ => {}
        }
    }

    fn see_other(&mut self, name: &str, shape: &[usize]) {
        let second = shape.get(1).copied();
        if name.starts_with("depth.convs.") {
            self.network = Some(Network::Monovit);
        } else if name.starts_with("depth.decoder.") {
            self.network = Some(Network::Monodepth2);
        }
        // What was beside the enlarged map.
        let beside = || shape.first().zip(second).and_then(|(out, inputs)| inputs.checked_sub(*out));
        match name {
            "depth.decoder.10.conv.weight" => self.channels[0] = second.and_then(|n| n.checked_mul(4)),
            "depth.decoder.5.conv.conv.weight" => self.channels[1] = beside(),
            "depth.decoder.3.conv.conv.weight" => self.channels[2] = beside(),
            "depth.decoder.1.conv.conv.weight" => self.channels[3] = beside(),
            "depth.convs.dispconv0.conv.weight" => self.channels[0] = second.and_then(|n| n.checked_mul(4)),
            "depth.convs.f1.conv_se.weight" => self.channels[1] = second,
            "depth.convs.f2.conv_se.weight" => self.channels[2] = second,
            "depth.convs.f3.conv_se.weight" => self.channels[3] = second,
            "depth.convs.f4.ca.fc.0.weight" => {
                if let &[hidden, channels] = shape {
                    self.squeeze = Some([channels, hidden]);
                }
            }
            "pose_encoder.encoder.conv1.weight" => self.pose_width = shape.first().copied(),
            "pose.net.0.weight" => self.pose_squeeze = shape.first().copied(),
            _ => {}
        }
    }

    /// The kind of encoder, if any of its tensors are there.
    pub fn family(&self) -> Option<Family> {
        self.family
    }

    /// Whether nothing was found.
    pub fn is_empty(&self) -> bool {
        *self == Sizes::default()
    }

    /// How these sizes differ from a configuration's, in words; and how far, in all.
    pub fn differences(&self, config: &Config) -> (Vec<String>, f64) {
        let mut said = Vec::new();
        let mut distance = 0.0;
        let mut other = |what: &str, found: &str, expected: &str| {
            if found != expected {
                said.push(format!("the {what} {found} instead of {expected}"));
                distance += OTHER;
            }
        };
        if let Some(family) = self.family {
            other("encoder", family.name(), Family::of(&config.encoder).name());
        }
        if let Some(network) = self.network {
            other("decoder of", network.name(), config.decoder.network().name());
        }
        let mut compare = |what: &str, found: &[Option<usize>], expected: &[usize]| {
            let mut differs = false;
            for (f, &e) in found.iter().zip(expected) {
                if let Some(f) = f.filter(|&f| f != e) {
                    differs = true;
                    distance += ((f.max(1) as f64) / (e.max(1) as f64)).ln().abs();
                }
            }
            if differs {
                let found: Vec<String> = found.iter().map(|f| f.map_or("?".into(), |f| f.to_string())).collect();
                let expected: Vec<String> = expected.iter().map(usize::to_string).collect();
                said.push(format!("{what} {} instead of {}", found.join(" "), expected.join(" ")));
            }
        };
        // Another encoder's channels say nothing more.
        let maps = config.encoder.maps();
        let channels: Vec<usize> = maps.iter().take(4).map(|map| map.channels).collect();
        if self.family.is_none_or(|family| family == Family::of(&config.encoder)) {
            compare("channels", &self.channels, &channels);
        }
        match &config.encoder {
            EncoderConfig::Mpvit(config) => {
                compare("layers", &self.layers, &config.layers);
                compare("paths", &self.paths, &config.paths);
                compare("MLP ratio", &[self.mlp_ratio], &[config.mlp_ratio]);
            }
            EncoderConfig::Resnet18(config) | EncoderConfig::Resnet34(config) | EncoderConfig::Resnet50(config) => {
                compare("blocks", &self.blocks, &config.layers.blocks());
                let convolutions = if config.layers.expansion() == 1 { 2 } else { 3 };
                compare("convolutions in a block", &[self.convolutions], &[convolutions]);
            }
        }
        if let (Some([channels, hidden]), DecoderConfig::Monovit(nested)) = (self.squeeze, &config.decoder) {
            compare("squeezed channels", &[Some(hidden)], &[channels / nested.reduction]);
        }
        compare("pose width", &[self.pose_width], &[config.pose.width]);
        compare("pose channels", &[self.pose_squeeze], &[config.pose.squeeze]);
        (said, distance)
    }

    /// Whether these sizes could be an architecture's, as far as they are silent: an encoder alone is taken for that of the
    /// network that it was published in, and what tells neither encoder nor decoder for a part of MonoViT.
    fn speak_of(&self, architecture: &Architecture) -> bool {
        let Architecture { network, encoder, .. } = *architecture;
        match (self.network, self.family) {
            (Some(_), _) => true,
            (None, Some(_)) => network == encoder.published_in(),
            (None, None) => (network, encoder) == (Network::Monovit, EncoderKind::Mpvit),
        }
    }

    /// The architectures that these sizes are those of. A decoder alone is taken for that of its usual encoder, if it fits.
    pub fn fitting(&self) -> Vec<Architecture> {
        let fits = |architecture: &Architecture| self.distance(architecture).is_some_and(|(said, _)| said.is_empty());
        let mut all: Vec<Architecture> = Architecture::all().filter(fits).collect();
        let usual = |a: &Architecture| a.encoder == a.network.usual_encoder();
        if self.family.is_none() && all.iter().any(usual) {
            all.retain(usual);
        }
        all
    }

    /// The architecture that is nearest, and how it differs.
    pub fn nearest(&self) -> (Architecture, Vec<String>) {
        let nothing = (Architecture::from(Preset::Nano), Vec::new(), f64::INFINITY);
        let nearest = Architecture::all().fold(nothing, |best, architecture| match self.distance(&architecture) {
            Some((said, distance)) if distance < best.2 => (architecture, said, distance),
            _ => best,
        });
        (nearest.0, nearest.1)
    }

    fn distance(&self, architecture: &Architecture) -> Option<(Vec<String>, f64)> {
        let config = architecture.config(&Ablation::default()).ok()?;
        self.speak_of(architecture).then(|| self.differences(&config))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;
    use std::path::{Path, PathBuf};
    use std::sync::Arc;

    use super::*;
    use crate::formats::StoredTensor;

    /// Tensors of these shapes, whose numbers nobody asks for.
    fn tensors<'a>(shapes: impl IntoIterator<Item = (&'a String, &'a Vec<usize>)>) -> Vec<Named> {
        let file = Arc::new(PathBuf::from("a file"));
        let tensor = |shape: &[usize]| StoredTensor::of_f64(&vec![1; shape.len()], &[0.0]).spread(shape.to_vec());
        shapes
            .into_iter()
            .map(|(name, shape)| Named {
                name: name.clone(),
                origin: name.clone(),
                file: file.clone(),
                tensor: tensor(shape),
            })
            .collect()
    }

    /// Names and shapes of every published size.
    fn published() -> HashMap<String, HashMap<String, Vec<usize>>> {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/shapes.json");
        let all: HashMap<String, serde_json::Value> = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
        all.into_iter().map(|(size, v)| (size, serde_json::from_value(v["tensors"].clone()).unwrap())).collect()
    }

    #[test]
    fn every_published_size_is_known_by_its_shapes() {
        for (size, shapes) in published() {
            let part = |prefix: &str| tensors(shapes.iter().filter(|(name, _)| name.starts_with(prefix)));
            for prefix in ["", "encoder."] {
                let fitting = Sizes::of(&part(prefix)).fitting();
                assert_eq!(fitting.iter().map(|a| a.name()).collect::<Vec<_>>(), [size.as_str()], "{prefix}");
            }
            let by_decoder = Sizes::of(&part("depth.")).fitting();
            assert!(by_decoder.iter().any(|a| a.name() == size), "{size}: {by_decoder:?}");
            let by_pose: Vec<String> = Sizes::of(&part("pose")).fitting().iter().map(|a| a.name()).collect();
            let expected: &[&str] = if size == "nano" { &["nano"] } else { &["tiny", "xsmall", "small", "base"] };
            assert_eq!(by_pose, expected, "{size}");
        }
    }

    #[test]
    fn the_nearest_size_is_named_with_what_differs() {
        let mut shapes = published().remove("small").unwrap();
        for (name, shape) in &mut shapes {
            if name.starts_with("encoder.patch_embed_stages.2.") && name.ends_with("dwconv.weight") {
                shape[0] = 200;
            }
        }
        shapes.retain(|name, _| !name.starts_with("encoder.mhca_stages.3.mhca_blks.0.MHCA_layers.2."));
        shapes.retain(|name, _| !name.starts_with("encoder.mhca_stages.3.mhca_blks.1.MHCA_layers.2."));
        shapes.retain(|name, _| !name.starts_with("encoder.mhca_stages.3.mhca_blks.2.MHCA_layers.2."));
        let (nearest, said) = Sizes::of(&tensors(&shapes)).nearest();
        assert_eq!(nearest, Preset::Small.into());
        assert_eq!(said, ["channels 64 128 200 288 instead of 64 128 216 288", "layers 1 3 6 2 instead of 1 3 6 3"]);
    }
}
