//! The layers of a configuration: a file wins over a recipe, which wins over the defaults of a preset or of weights.

use std::path::{Path, PathBuf};

use super::recipe::{RunConfig, STEPS};
use super::recipes;
use crate::error::{Error, Result};
use crate::formats::bounded::{MAX_SETTINGS, read_text};
use crate::monovit::Preset;
use crate::networks::{Architecture, EncoderKind, Network};

/// Settings of a recipe and a file, still without the defaults.
#[derive(Debug, Default)]
pub struct Layers {
    said: toml::Table,
    /// Fields of the defaults that a recipe takes away.
    unset: Vec<String>,
    /// The file, and its text.
    file: Option<(PathBuf, String)>,
}

impl Layers {
    /// Reads a recipe by its name, and over it a file: a run's `config.toml`, or part of one.
    ///
    /// # Errors
    /// If there is no such recipe, or the file is no TOML: its name, and the line.
    pub fn read(recipe: Option<&str>, file: Option<&Path>) -> Result<Self> {
        let mut layers = Layers::default();
        if let Some(name) = recipe {
            layers.said = recipes::named(name)?;
            let unset = layers.said.remove("unset").map_or(Ok(Vec::new()), toml::Value::try_into);
            layers.unset = unset.map_err(|e| Error::Failed(format!("the recipe {name}: {e}")))?;
        }
        if let Some(path) = file {
            let text = read_text(path, MAX_SETTINGS, "a configuration")?;
            let said: toml::Table = toml::from_str(&text).map_err(|e| Error::file(path, e.to_string()))?;
            // A number of steps and one of epochs are two ways of saying the same.
            if said.contains_key("steps") {
                layers.said.remove("epochs");
            }
            fill(&mut layers.said, said);
            layers.file = Some((path.to_owned(), text));
        }
        Ok(layers)
    }

    /// The preset that is named, if any is.
    ///
    /// # Errors
    /// If there is no preset of that name.
    pub fn preset(&self) -> Result<Option<Preset>> {
        self.named("preset")
    }

    /// The network that is named, if any is.
    ///
    /// # Errors
    /// If there is no network of that name.
    pub fn network(&self) -> Result<Option<Network>> {
        self.named("network")
    }

    /// The encoder that is named, if any is.
    ///
    /// # Errors
    /// If there is no encoder of that name.
    pub fn encoder(&self) -> Result<Option<EncoderKind>> {
        self.named("encoder")
    }

    fn named<T: serde::de::DeserializeOwned>(&self, field: &str) -> Result<Option<T>> {
        self.said.get(field).cloned().map(|name| name.try_into().map_err(|e| self.wrong(&e))).transpose()
    }

    /// These layers over defaults.
    ///
    /// # Errors
    /// Names the file, and the line where a value cannot be used.
    pub fn over(self, defaults: &RunConfig) -> Result<RunConfig> {
        let table = toml::Table::try_from(defaults);
        let mut whole = table.map_err(|e| Error::Failed(format!("the configuration: {e}")))?;
        for field in &self.unset {
            whole.remove(field);
        }
        fill(&mut whole, self.said.clone());
        let config: RunConfig = whole.try_into().map_err(|e| self.wrong(&e))?;
        let Some((path, text)) = &self.file else { return config.check().map(|()| config) };
        config.check().map_err(|error| match error {
            Error::Setting { name, message } => {
                let place = line_of(text, &name).map_or(String::new(), |line| format!("line {line}: "));
                Error::file(path, format!("{place}{name}: {message}"))
            }
            other => other,
        })?;
        Ok(config)
    }

    fn wrong(&self, error: &toml::de::Error) -> Error {
        match &self.file {
            Some((path, _)) => Error::file(path, error.to_string()),
            None => Error::Failed(format!("the recipe: {error}")),
        }
    }
}

/// Reads a configuration: a run's `config.toml`, or part of one; what it does not say is as in [`RunConfig::new`] of
/// its preset.
///
/// # Errors
/// Names the file, and the line where a value cannot be used.
pub fn read_config(path: &Path) -> Result<RunConfig> {
    let layers = Layers::read(None, Some(path))?;
    let preset = layers.preset()?.unwrap_or(Preset::Nano);
    let architecture = Architecture::of(layers.network()?.unwrap_or_default(), preset);
    layers.over(&RunConfig::new(architecture, STEPS))
}

/// Puts what was said over the defaults, table by table. A choice (`kind`) with what belongs to it is one thing.
fn fill(defaults: &mut toml::Table, said: toml::Table) {
    for (key, value) in said {
        match (defaults.get_mut(&key), value) {
            (Some(toml::Value::Table(below)), toml::Value::Table(said)) if !said.contains_key("kind") => {
                fill(below, said);
            }
            (_, value) => {
                defaults.insert(key, value);
            }
        }
    }
}

/// The line of a TOML text, from 1, that sets a field such as `optim.clip`.
fn line_of(text: &str, field: &str) -> Option<usize> {
    let (table, key) = field.rsplit_once('.').unwrap_or(("", field));
    let mut within = "";
    for (i, line) in text.lines().enumerate() {
        let line = line.trim();
        if let Some(name) = line.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
            within = name.trim();
        } else if within == table && line.split('=').next().is_some_and(|name| name.trim() == key) {
            return Some(i + 1);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::camera::Camera;
    use crate::train::schedule::RateDecay;

    fn composed(recipe: &str, text: &str) -> Result<RunConfig> {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("config.toml");
        std::fs::write(&path, text).unwrap();
        let layers = Layers::read(Some(recipe), Some(&path))?;
        let preset = layers.preset()?.unwrap();
        layers.over(&RunConfig::new(preset, STEPS))
    }

    /// The figures of the papers.
    #[test]
    fn recipes_say_what_the_papers_say() {
        let monovit = composed("monovit", "").unwrap();
        assert_eq!((monovit.preset, monovit.batch, monovit.epochs), (Preset::Small, 12, Some(20)));
        assert_eq!((monovit.height, monovit.width, monovit.initial_disparity), (192, 640, None));
        let optim = monovit.optim;
        assert_eq!((optim.encoder_rate, optim.rate, optim.pose_rate, optim.decay), (5e-5, 1e-4, 1e-4, 0.01));
        assert_eq!(optim.schedule.decay, RateDecay::Epochs { factor: 0.9 });
        assert_eq!(monovit.camera, Camera::KittiPublished);
        assert!(monovit.augment.jitter && !monovit.loss.consistent_grid && monovit.loss.auto_mask);
        // 39,810 frames, the training split of Zhou et al.
        let mut config = monovit;
        config.set_epoch(39_810);
        assert_eq!((config.epoch, config.steps), (Some(3318), 66_360));
        let plan = config.plan();
        assert_eq!((plan.auto_mask_after, plan.rotations.steps, plan.schedule.factor(3318)), (0, 0, 1.0));
        assert!((plan.schedule.factor(66_360) - 0.9f64.powi(19)).abs() < 1e-12);

        let mut monodepth2 = composed("monodepth2", "").unwrap();
        assert_eq!((monodepth2.optim.encoder_rate, monodepth2.optim.decay), (1e-4, 0.0));
        monodepth2.set_epoch(39_810);
        let schedule = monodepth2.plan().schedule;
        assert_eq!((schedule.factor(15 * 3318), schedule.factor(15 * 3318 + 1)), (1.0, 0.1));
    }

    #[test]
    fn a_file_wins_over_a_recipe_and_that_over_the_preset() {
        let config = composed("monovit", "preset = \"tiny\"\nsteps = 70\n[optim]\nrate = 2e-4").unwrap();
        assert_eq!((config.preset, config.steps, config.epochs), (Preset::Tiny, 70, None));
        assert_eq!((config.optim.rate, config.optim.encoder_rate, config.batch), (2e-4, 5e-5, 12));
        assert_eq!(config.checkpoint_every, RunConfig::usual().checkpoint_every);
        let error = composed("monovit", "batch = 0").unwrap_err().to_string();
        assert!(error.contains("config.toml") && error.contains("line 1: batch"), "{error}");
        let error = composed("monodepth", "").unwrap_err().to_string();
        assert!(error.contains("monodepth is none of monovit, monodepth2"), "{error}");
    }
}
