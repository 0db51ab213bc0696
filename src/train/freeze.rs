//! Parameters that a training leaves as they are, by patterns of their names.

use std::collections::BTreeSet;
use std::sync::Arc;

use crate::error::{Error, Result};
use crate::nn::Params;

/// For each parameter and running statistic, in the order of [`Params`], whether it is left alone.
pub type Frozen = Arc<[bool]>;

/// Parameters and statistics that patterns such as `encoder.*` name; `*` stands for any characters, dots too. A pattern has to match a whole name.
///
/// # Errors
/// If a pattern matches nothing: what there is. If nothing is left to learn.
pub fn frozen(params: &Params<f32>, patterns: &[String]) -> Result<Frozen> {
    let mut all = vec![false; params.len()];
    for pattern in patterns {
        let mut found = false;
        for (frozen, (_, p)) in all.iter_mut().zip(params.iter()) {
            if p.names.iter().any(|name| matches(pattern, name)) {
                (*frozen, found) = (true, true);
            }
        }
        if !found {
            let message = format!("{pattern} matches no parameter; there are {}", groups(params).join(", "));
            return Err(Error::setting("freeze", message));
        }
    }
    if params.iter().zip(&all).all(|((_, p), &frozen)| frozen || !p.learnt) {
        return Err(Error::setting("freeze", format!("{} leaves nothing to learn", patterns.join(" "))));
    }
    Ok(all.into())
}

/// The beginnings of names, two words each, as patterns.
fn groups(params: &Params<f32>) -> Vec<String> {
    let start = |name: &str| name.split('.').take(2).collect::<Vec<_>>().join(".");
    let groups: BTreeSet<String> = params.iter().map(|(_, p)| start(p.name())).collect();
    groups.into_iter().map(|group| format!("{group}.*")).collect()
}

/// Whether a pattern matches the whole of a name.
fn matches(pattern: &str, name: &str) -> bool {
    let mut pieces = pattern.split('*');
    let first = pieces.next().unwrap_or_default();
    let Some(mut rest) = name.strip_prefix(first) else { return false };
    let mut last = None;
    // Each piece but the last at its first place; the last at the end.
    for piece in pieces {
        if let Some(before) = last.replace(piece) {
            match rest.find(before) {
                Some(at) => rest = &rest[at + before.len()..],
                None => return false,
            }
        }
    }
    last.map_or(rest.is_empty(), |last| rest.ends_with(last))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monovit::Preset;
    use crate::networks::DepthNetwork;

    #[test]
    fn a_star_stands_for_any_characters() {
        for (pattern, name, expected) in [
            ("encoder.*", "encoder.stem.0.conv.weight", true),
            ("encoder.*", "pose_encoder.encoder.conv1.weight", false),
            ("*.running_*", "encoder.stem.0.bn.running_mean", true),
            ("*.running_*", "encoder.stem.0.bn.weight", false),
            ("a.b", "a.b", true),
            ("a.b", "a.bc", false),
            ("*b*b", "ab", false),
            ("*b*b", "abb", true),
            ("*", "anything", true),
            ("", "a", false),
        ] {
            assert_eq!(matches(pattern, name), expected, "{pattern} {name}");
        }
    }

    #[test]
    fn patterns_that_match_nothing_or_leave_nothing_are_refused() {
        let (_, params) = DepthNetwork::new(Preset::Pico.config(), 0);
        let refused = |pattern: &str| frozen(&params, &[pattern.to_owned()]).unwrap_err().to_string();
        let error = refused("encodre.*");
        assert!(
            error.contains("encodre.*") && error.contains("encoder.stem.*") && error.contains("pose.net.*"),
            "{error}"
        );
        assert!(refused("*").contains("nothing to learn"));
        let found = frozen(&params, &["encoder.*".to_owned()]).unwrap();
        for ((_, p), &frozen) in params.iter().zip(found.iter()) {
            assert_eq!(frozen, p.name().starts_with("encoder."), "{}", p.name());
        }
        assert!(frozen(&params, &[]).unwrap().iter().all(|frozen| !frozen));
    }
}
