//! What has to be known of weights to use them: the networks, the size of their pictures, the range of their depths.

use std::collections::HashMap;

use serde::{Deserialize, Serialize};

use super::{Architecture, Config, EncoderKind, Network};
use crate::error::{Error, Result};
use crate::monovit::loss::check_depths;
use crate::monovit::{Ablation, Preset};

/// The networks that weights belong to, the pictures they were trained on, and the depths that a disparity stands for.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Setup {
    /// The named size of the networks.
    pub preset: Preset,
    /// The network; MonoViT in files that do not say it.
    #[serde(default)]
    pub network: Network,
    /// The depth encoder; MPViT in files that do not say it.
    #[serde(default)]
    pub encoder: EncoderKind,
    /// The parts that are taken away from it.
    #[serde(default)]
    pub ablation: Ablation,
    /// Height of the pictures in pixels, a multiple of 32.
    pub height: usize,
    /// Width of the pictures in pixels, a multiple of 32.
    pub width: usize,
    /// The depth of sigmoid disparity 1.
    pub min_depth: f64,
    /// The depth of sigmoid disparity 0.
    pub max_depth: f64,
}

/// The key of a [`Setup`] in the metadata of a file of weights.
const KEY: &str = "parallax";

impl Setup {
    /// The usual setup of an architecture (or, given a preset, of MonoViT in that size): the published picture size, depths
    /// from 0.1 to 100.
    pub fn of(architecture: impl Into<Architecture>) -> Self {
        let Architecture { network, encoder, preset } = architecture.into();
        let (height, width) = match preset {
            Preset::Pico | Preset::Nano => (96, 320),
            Preset::Tiny | Preset::Xsmall | Preset::Small | Preset::Base => (192, 640),
        };
        let ablation = Ablation::default();
        Setup { preset, network, encoder, ablation, height, width, min_depth: 0.1, max_depth: 100.0 }
    }

    /// The names of the networks.
    pub fn architecture(&self) -> Architecture {
        Architecture { network: self.network, encoder: self.encoder, preset: self.preset }
    }

    /// The sizes of the networks.
    ///
    /// # Panics
    /// If [`check`](Setup::check) refuses them.
    #[track_caller]
    pub fn model(&self) -> Config {
        self.architecture().config(&self.ablation).unwrap_or_else(|error| panic!("networks of no use: {error}"))
    }

    /// Checks every field.
    ///
    /// # Errors
    /// Names the field that cannot be used.
    pub fn check(&self) -> Result<()> {
        check_size("height", self.height)?;
        check_size("width", self.width)?;
        check_depths("min_depth", self.min_depth, self.max_depth)?;
        self.architecture().config(&self.ablation).map(drop)
    }

    /// The metadata of a file of weights that belong to this setup.
    ///
    /// # Errors
    /// If a number cannot be written as JSON.
    pub fn metadata(&self) -> Result<HashMap<String, String>> {
        let text = serde_json::to_string(self).map_err(|e| Error::Failed(format!("the setup as JSON: {e}")))?;
        Ok(HashMap::from([(KEY.into(), text)]))
    }

    /// The setup that the metadata of a file of weights holds, if any.
    ///
    /// # Errors
    /// If there is one that cannot be read or used.
    pub fn from_metadata(metadata: &HashMap<String, String>) -> Result<Option<Self>> {
        let Some(text) = metadata.get(KEY) else { return Ok(None) };
        let wrong = |e: serde_json::Error| Error::setting(KEY, e.to_string());
        let mut value: serde_json::Value = serde_json::from_str(text).map_err(wrong)?;
        // Earlier files hold the whole recipe of their training, with the depths among the settings of the loss.
        if let (Some(loss), Some(fields)) = (value.get("loss").cloned(), value.as_object_mut()) {
            for depth in ["min_depth", "max_depth"] {
                fields.extend(loss.get(depth).map(|metres| (depth.to_owned(), metres.clone())));
            }
        }
        let setup: Setup = serde_json::from_value(value).map_err(wrong)?;
        setup.check()?;
        Ok(Some(setup))
    }
}

/// Checks a side of the pictures: a multiple of 32, because the deepest map has a 32nd of it, and at least 64, because a
/// map of one pixel has nothing to be mirrored at its border.
///
/// # Errors
/// Names the field and the next size that would do.
pub fn check_size(field: &str, size: usize) -> Result<()> {
    if !size.is_multiple_of(32) || !(64..=8192).contains(&size) {
        let below = (size / 32 * 32).clamp(64, 8192);
        let message = format!("{size} is not a multiple of 32 from 64 to 8192; {below} would do");
        return Err(Error::setting(field, message));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn metadata_is_read_back_and_that_of_earlier_files_too() {
        let setup = Setup { height: 64, width: 96, max_depth: 80.0, ..Setup::of(Preset::Pico) };
        assert_eq!(Setup::from_metadata(&setup.metadata().unwrap()).unwrap(), Some(setup));
        let earlier = r#"{"preset":"pico","height":64,"width":96,"batch":4,"ablation":{"cnn_path":true},
            "loss":{"min_depth":0.1,"max_depth":80.0,"ssim":0.85}}"#;
        let metadata = HashMap::from([(KEY.to_owned(), earlier.to_owned())]);
        assert_eq!(Setup::from_metadata(&metadata).unwrap(), Some(setup));
        assert_eq!(Setup::from_metadata(&HashMap::new()).unwrap(), None);
        let other = Setup::of(Architecture::of(Network::Monodepth2, Preset::Nano));
        assert_eq!(Setup::from_metadata(&other.metadata().unwrap()).unwrap(), Some(other));
        assert_eq!((other.network, other.encoder), (Network::Monodepth2, EncoderKind::Resnet18));
    }

    #[test]
    fn a_setup_that_cannot_be_used_is_refused_by_field() {
        for (field, text) in [
            ("height", r#"{"preset":"nano","height":100,"width":320,"min_depth":0.1,"max_depth":100.0}"#),
            ("width", r#"{"preset":"nano","height":96,"width":9000000,"min_depth":0.1,"max_depth":100.0}"#),
            ("min_depth", r#"{"preset":"nano","height":96,"width":320,"min_depth":0.0,"max_depth":100.0}"#),
            ("parallax", r#"{"preset":"nano","height":96}"#),
            (
                "preset",
                r#"{"preset":"base","network":"monovit","encoder":"resnet34","height":96,"width":320,"min_depth":0.1,"max_depth":100.0}"#,
            ),
        ] {
            let metadata = HashMap::from([(KEY.to_owned(), text.to_owned())]);
            let error = Setup::from_metadata(&metadata).unwrap_err().to_string();
            assert!(error.starts_with(field), "{error}");
        }
    }
}
