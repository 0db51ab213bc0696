//! The flags that say which weights to use, the same wherever weights are used.

use std::path::{Path, PathBuf};

use parallax::Result;
use parallax::networks::setup::check_size;
use parallax::weights;
use parallax::weights::{Need, SHIPPED, Sources, Weights};

#[derive(Clone, clap::Args)]
pub struct WeightsArgs {
    /// Weights: a run's folder (its best weights), a file (.safetensors, .pth, .npz), or a folder with encoder.pth,
    /// depth.pth, ...; several times for several files. `shipped`: those inside the program.
    #[arg(long, value_name = "FILE|DIR", default_value = SHIPPED)]
    weights: Vec<PathBuf>,
    /// Load the parameters that fit, and list the others.
    #[arg(long)]
    allow_partial: bool,
    /// Height of the pictures that the network sees, a multiple of 32 [default: that of the weights].
    #[arg(long, value_name = "PIXELS")]
    height: Option<usize>,
    /// Width of the pictures that the network sees, a multiple of 32 [default: that of the weights].
    #[arg(long, value_name = "PIXELS")]
    width: Option<usize>,
}

impl WeightsArgs {
    /// What was asked for, in words.
    pub fn name(&self) -> String {
        let names: Vec<_> = self.weights.iter().map(|w| w.to_string_lossy()).collect();
        names.join(", ")
    }

    /// These flags, for other weights.
    pub fn instead(&self, path: &Path) -> WeightsArgs {
        WeightsArgs { weights: vec![path.to_owned()], ..self.clone() }
    }

    /// Whether the network is to see pictures of another size than its weights were trained for.
    pub fn resized(&self) -> bool {
        self.height.is_some() || self.width.is_some()
    }

    /// Every path by itself, where there are several and each holds encoder and decoder of its own; otherwise all together,
    /// as the files of one network.
    pub fn each(&self) -> Vec<WeightsArgs> {
        let alone = |path: &PathBuf| {
            let networks = Sources::open(std::slice::from_ref(path)).map(|sources| sources.networks());
            networks.is_ok_and(|found| ["encoder", "depth"].iter().all(|network| found.contains(network)))
        };
        if self.weights.len() < 2 || !self.weights.iter().all(alone) {
            return vec![self.clone()];
        }
        self.weights.iter().map(|path| WeightsArgs { weights: vec![path.clone()], ..self.clone() }).collect()
    }

    /// The weights that were asked for, to predict depth with.
    pub fn load(&self) -> Result<Weights> {
        self.load_with(Need::Depth)
    }

    /// The weights that were asked for, with the networks that are needed.
    pub fn load_with(&self, need: Need) -> Result<Weights> {
        self.check()?;
        if self.weights.iter().any(|path| path.as_os_str() == SHIPPED) && Path::new(SHIPPED).exists() {
            note!(
                "`{SHIPPED}` means the weights inside the program, not ./{SHIPPED}: write --weights ./{SHIPPED} for that"
            );
        }
        let mut weights = weights::load(&self.weights, need, self.allow_partial)?;
        let averaged = weights.report.skipped.iter().find(|s| s.what.contains("averaged"));
        if weights.report.problem().is_some() {
            note!("{}", weights.report);
        } else if let Some(skipped) = averaged {
            note!("passed over {} and others: {}", skipped.name, skipped.what);
        }
        weights.setup.height = self.height.unwrap_or(weights.setup.height);
        weights.setup.width = self.width.unwrap_or(weights.setup.width);
        Ok(weights)
    }

    fn check(&self) -> Result<()> {
        for (name, size) in [("--height", self.height), ("--width", self.width)] {
            size.map_or(Ok(()), |size| check_size(name, size))?;
        }
        Ok(())
    }
}
