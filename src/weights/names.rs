//! From the names in a file to the names of the model.
//!
//! Published weights come as one file a network, each with names of its own (`stem.0.conv.weight`, `convs.f4...`,
//! `encoder.conv1.weight`, `net.0.weight`), or as one file with the networks' names in front, and either may be wrapped
//! once more by what trained it (`module.`, `model.`, `state_dict.`).

use std::path::Path;
use std::sync::LazyLock;

use crate::monovit::Preset;
use crate::networks::DepthNetwork;
use crate::nn::Params;

/// The four networks, as the model's names begin.
pub const NETWORKS: [&str; 4] = ["encoder", "depth", "pose_encoder", "pose"];

/// What stands in front of names without meaning anything here.
const WRAPPERS: [&str; 8] =
    ["module.", "model.", "models.", "weights.", "state_dict.", "model_state_dict.", "network.", "_orig_mod."];

/// What training programs keep beside the weights: the names begin so.
const TRAINING: [&str; 8] = [
    "optimizer.",
    "optimizers.",
    "optimizer_states.",
    "lr_scheduler.",
    "lr_schedulers.",
    "scheduler.",
    "callbacks.",
    "loops.",
];

/// What a tensor in a file is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Place {
    /// A parameter, if there is one of this name.
    Model(String),
    /// A ResNet's, of the name that torchvision gives it: the depth encoder's or the pose encoder's.
    ResNet(String),
    /// Something that no model here has a use for: what, in the plural.
    Useless(&'static str),
    /// Something unknown.
    Unknown,
}

/// What stands in front of weights that were averaged over steps.
const AVERAGES: [&str; 12] = [
    "ema.",
    "model_ema.",
    "ema_model.",
    "ema_state_dict.",
    "state_dict_ema.",
    "swa.",
    "swa_model.",
    "averaged_model.",
    "average_model.",
    "avg_model.",
    "shadow.",
    "shadow_params.",
];

/// A name without the wrappers in front of it, and whether they say that its tensor is an average over steps.
pub(super) fn unwrapped(mut name: &str) -> (&str, bool) {
    let mut averaged = false;
    loop {
        if let Some(rest) = WRAPPERS.iter().find_map(|w| name.strip_prefix(w)) {
            name = rest;
        } else if let Some(rest) = AVERAGES.iter().find_map(|w| name.strip_prefix(w)) {
            (name, averaged) = (rest, true);
        } else {
            return (name, averaged);
        }
    }
}

/// The prefixes that wrap a whole model, whatever they are called: everything that begins with one, and nothing else of
/// the file, has a place once it is taken off. `unknown` are the names that have none as they are.
pub(super) fn wrappers<'a>(unknown: &[&'a str]) -> Vec<&'a str> {
    const DEEPEST: usize = 4;
    /// More than all networks of a file have; each is compared with all.
    const MOST: usize = 4096;
    if unknown.len() > MOST {
        return Vec::new();
    }
    let mut found: Vec<&str> = Vec::new();
    for name in unknown {
        if found.iter().any(|prefix| name.starts_with(prefix)) {
            continue;
        }
        let ends = name.match_indices('.').map(|(dot, _)| dot + 1).take(DEEPEST);
        let mut prefixes = ends.map(|end| &name[..end]);
        let wraps = |prefix: &&str| {
            let mut under = unknown.iter().filter_map(|other| other.strip_prefix(*prefix)).map(place).peekable();
            under.peek().is_some() && under.all(|place| place != Place::Unknown)
        };
        found.extend(prefixes.find(wraps));
    }
    found
}

/// What the tensor of this name is.
pub(super) fn place(name: &str) -> Place {
    let (name, _) = unwrapped(name);
    if name == "num_batches_tracked" || name.ends_with(".num_batches_tracked") {
        return Place::Useless("counters of batches");
    }
    if TRAINING.iter().any(|part| name.starts_with(part)) {
        return Place::Useless("tensors of a training's state");
    }
    if let Some(rest) = resnet(name) {
        return Place::ResNet(rest.to_owned());
    }
    if let Some((network, rest)) = own(name) {
        return Place::Model(format!("{network}.{rest}"));
    }
    let (root, inner) = name.split_once('.').unwrap_or((name, ""));
    let networks: &[&str] = match root {
        // Both encoders are called that: the depth encoder among others, the ResNet in its own file.
        "encoder" => &["encoder", "pose_encoder"],
        "depth" | "decoder" => &["depth"],
        "pose_encoder" => &["pose_encoder"],
        "pose" => &["pose"],
        _ => &[],
    };
    let is_encoder = networks.iter().any(|n| n.ends_with("encoder"));
    let head = |name: &str| name.starts_with("cls_head.") || name.starts_with("fc.");
    if head(name) || is_encoder && head(inner.strip_prefix("encoder.").unwrap_or(inner)) {
        return Place::Useless("tensors of a classification head");
    }
    if let (true, Some(rest)) = (is_encoder, resnet(inner)) {
        return Place::Model(format!("{root}.encoder.{rest}"));
    }
    match own(inner) {
        Some((network, rest)) if networks.contains(&network) => Place::Model(format!("{network}.{rest}")),
        _ => Place::Unknown,
    }
}

/// The network that uses this name without its own in front, and the name there.
fn own(name: &str) -> Option<(&'static str, String)> {
    let (first, rest) = name.split_once('.')?;
    match first {
        "stem" | "patch_embed_stages" | "mhca_stages" => Some(("encoder", name.to_owned())),
        "convs" => Some(("depth", name.to_owned())),
        // Monodepth2's, which has no other names; of MonoViT's the same modules once more.
        "decoder" => {
            let (number, rest) = rest.split_once('.')?;
            let number = number.parse::<usize>().ok()?;
            match number < UNET_MODULES && rest.starts_with("conv.") {
                true => Some(("depth", format!("decoder.{number}.{rest}"))),
                false => Some(("depth", format!("convs.{}.{rest}", DECODER_KEYS.get(number)?))),
            }
        }
        "net" if rest.starts_with(|c: char| c.is_ascii_digit()) => Some(("pose", name.to_owned())),
        _ => None,
    }
}

/// A ResNet's name of a tensor, from torchvision's, or with `encoder.` in front.
fn resnet(name: &str) -> Option<&str> {
    let name = name.strip_prefix("encoder.").unwrap_or(name);
    let (first, _) = name.split_once('.')?;
    matches!(first, "conv1" | "bn1" | "layer1" | "layer2" | "layer3" | "layer4").then_some(name)
}

/// Number of modules of Monodepth2's decoder.
const UNET_MODULES: usize = 14;

/// The nested decoder's name of a tensor that is called by its number, `depth.decoder.N.`, as Monodepth2's is.
pub(super) fn nested(name: &str) -> Option<String> {
    let (number, rest) = name.strip_prefix("depth.decoder.")?.split_once('.')?;
    Some(format!("depth.convs.{}.{rest}", DECODER_KEYS.get(number.parse::<usize>().ok()?)?))
}

/// The network that a ResNet of a file is: the depth encoder if it sees one picture, the pose encoder if two. Where the first
/// convolution is missing, the file's name has the say.
pub(super) fn resnet_network(path: &Path, first: Option<&[usize]>) -> &'static str {
    match first {
        Some([_, 3, ..]) => "encoder",
        Some(_) => "pose_encoder",
        None if path.file_stem().is_some_and(|stem| stem == "encoder") => "encoder",
        None => "pose_encoder",
    }
}

/// The nested decoder's modules in the order of the public checkpoints.
pub(super) static DECODER_KEYS: LazyLock<Vec<String>> = LazyLock::new(|| {
    // They are the same for every size.
    let (_, params): (_, Params<f32>) = DepthNetwork::new(Preset::Pico.config(), 0);
    let names = params.iter().filter_map(|(_, p)| p.name().strip_prefix("depth.convs.")?.split('.').next());
    let mut keys: Vec<String> = Vec::new();
    for key in names {
        if keys.iter().all(|k| k != key) {
            keys.push(key.to_owned());
        }
    }
    keys
});

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whatever_wraps_a_whole_model_is_a_wrapper() {
        let generator = ["generator.stem.0.conv.weight", "generator.convs.f4.conv_se.bias"];
        assert_eq!(wrappers(&generator), ["generator."]);
        let deep = ["trainer.nets.pose_net.net.0.bias", "trainer.nets.pose_net.net.1.bias"];
        assert_eq!(wrappers(&deep), ["trainer.nets.pose_net."]);
        // Another network that happens to have a layer of a name that is known.
        let other = ["discriminator.conv1.weight", "discriminator.conv9.weight"];
        assert_eq!(wrappers(&other), [""; 0]);
        assert_eq!(unwrapped("module.ema_state_dict.stem.0.x"), ("stem.0.x", true));
        assert_eq!(unwrapped("models.stem.0.x"), ("stem.0.x", false));
        // Neither depth nor length costs much.
        assert_eq!(wrappers(&["a.".repeat(1 << 16).as_str()]), [""; 0]);
    }

    #[test]
    fn every_arrangement_has_its_place() {
        let cases = [
            ("stem.0.conv.weight", "encoder.stem.0.conv.weight"),
            ("encoder.stem.0.conv.weight", "encoder.stem.0.conv.weight"),
            ("module.encoder.stem.0.conv.weight", "encoder.stem.0.conv.weight"),
            ("state_dict.module.mhca_stages.0.x", "encoder.mhca_stages.0.x"),
            ("model.patch_embed_stages.0.x", "encoder.patch_embed_stages.0.x"),
            ("convs.f4.conv_se.bias", "depth.convs.f4.conv_se.bias"),
            ("decoder.0.conv_se.bias", "depth.convs.f4.conv_se.bias"),
            ("decoder.convs.f4.conv_se.bias", "depth.convs.f4.conv_se.bias"),
            ("module.decoder.decoder.36.conv.bias", "depth.convs.dispconv3.conv.bias"),
            ("depth.decoder.1.conv_se.bias", "depth.convs.f3.conv_se.bias"),
            ("depth.convs.f4.conv_se.bias", "depth.convs.f4.conv_se.bias"),
            ("encoder.encoder.conv1.weight", "encoder.encoder.conv1.weight"),
            ("module.encoder.encoder.layer3.5.bn3.bias", "encoder.encoder.layer3.5.bn3.bias"),
            ("decoder.0.conv.conv.weight", "depth.decoder.0.conv.conv.weight"),
            ("depth.decoder.13.conv.bias", "depth.decoder.13.conv.bias"),
            ("pose_encoder.encoder.bn1.bias", "pose_encoder.encoder.bn1.bias"),
            ("net.3.bias", "pose.net.3.bias"),
            ("pose.net.3.bias", "pose.net.3.bias"),
        ];
        for (theirs, ours) in cases {
            assert_eq!(place(theirs), Place::Model(ours.into()), "{theirs}");
        }
        for (theirs, ours) in [
            ("conv1.weight", "conv1.weight"),
            ("encoder.conv1.weight", "conv1.weight"),
            ("module.encoder.layer4.1.bn2.bias", "layer4.1.bn2.bias"),
        ] {
            assert_eq!(place(theirs), Place::ResNet(ours.into()), "{theirs}");
        }
        assert_eq!(nested("depth.decoder.4.conv.conv.bias").as_deref(), Some("depth.convs.X_00_Conv_0.conv.conv.bias"));
        assert_eq!(nested("depth.decoder.40.conv.bias"), None);
        let useless = [
            "fc.weight",
            "encoder.fc.bias",
            "pose_encoder.encoder.fc.bias",
            "encoder.encoder.fc.bias",
            "cls_head.cls.weight",
            "model.stem.0.bn.num_batches_tracked",
            "optimizer.state.0.exp_avg",
        ];
        for name in useless {
            assert!(matches!(place(name), Place::Useless(_)), "{name}");
        }
        let unknown = [
            "",
            ".",
            "stem",
            "pose.stem.0.conv.weight",
            "encoder.convs.f4.x",
            "decoder.37.conv.bias",
            "decoder.x.bias",
            "encoder.encoder.stem.0.conv.weight",
            "transformer.fc.weight",
            "depth.fc.weight",
        ];
        for name in unknown {
            assert_eq!(place(name), Place::Unknown, "{name}");
        }
        // Neither depth nor length costs anything.
        for part in ["encoder.", "module.", "decoder."] {
            assert_eq!(place(&part.repeat(1 << 20)), Place::Unknown);
        }
    }
}
