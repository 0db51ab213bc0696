//! Which size of the network some tensors belong to, from their shapes.

use crate::monovit::{Config, Preset};
use crate::nn::Named;

/// What tensors tell about the sizes of their network; what they do not tell is `None`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Sizes {
    channels: [Option<usize>; 4],
    layers: [Option<usize>; 4],
    paths: [Option<usize>; 4],
    mlp_ratio: Option<usize>,
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
        match parts[..] {
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
        match name {
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

    /// Whether nothing was found.
    pub fn is_empty(&self) -> bool {
        *self == Sizes::default()
    }

    /// How these sizes differ from a configuration's, in words; and how far, in all.
    pub fn differences(&self, config: &Config) -> (Vec<String>, f64) {
        let mut said = Vec::new();
        let mut distance = 0.0;
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
        compare("channels", &self.channels, &config.channels);
        compare("layers", &self.layers, &config.layers);
        compare("paths", &self.paths, &config.paths);
        compare("MLP ratio", &[self.mlp_ratio], &[config.mlp_ratio]);
        if let Some([channels, hidden]) = self.squeeze {
            compare("squeezed channels", &[Some(hidden)], &[channels / config.reduction]);
        }
        compare("pose width", &[self.pose_width], &[config.pose_width]);
        compare("pose channels", &[self.pose_squeeze], &[config.pose_squeeze]);
        (said, distance)
    }

    /// The presets that these sizes are those of.
    pub fn fitting(&self) -> Vec<Preset> {
        Preset::ALL.into_iter().filter(|p| self.differences(&p.config()).0.is_empty()).collect()
    }

    /// The preset that is nearest, and how it differs.
    pub fn nearest(&self) -> (Preset, Vec<String>) {
        let [first, others @ ..] = Preset::ALL.map(|p| (p, self.differences(&p.config())));
        let (preset, (said, _)) =
            others.into_iter().fold(first, |best, other| if other.1.1 < best.1.1 { other } else { best });
        (preset, said)
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
                assert_eq!(fitting.iter().map(|p| p.name()).collect::<Vec<_>>(), [size.as_str()], "{prefix}");
            }
            let by_decoder = Sizes::of(&part("depth.")).fitting();
            assert!(by_decoder.iter().any(|p| p.name() == size), "{size}: {by_decoder:?}");
            let by_pose: Vec<&str> = Sizes::of(&part("pose")).fitting().iter().map(|p| p.name()).collect();
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
        assert_eq!(nearest, Preset::Small);
        assert_eq!(said, ["channels 64 128 200 288 instead of 64 128 216 288", "layers 1 3 6 2 instead of 1 3 6 3"]);
    }
}
