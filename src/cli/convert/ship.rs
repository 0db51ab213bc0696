//! `parallax convert RUN FILE --ship`: the weights of a run as the file that lies inside the program.

use std::path::{Path, PathBuf};

use parallax::eval::predictor::Predictor;
use parallax::eval::shipping::{calibrate, moved, on_streets, streets};
use parallax::formats::bounded::{MAX_SETTINGS, read_text};
use parallax::tensor::simd;
use parallax::train::RunConfig;
use parallax::train::data::{STREET, STREET_2, is_rendered};
use parallax::train::layers::read_config;
use parallax::weights::{Need, Origin, SHIPPED, Sources, load_from, ship};
use parallax::{Error, Result};
use serde::{Deserialize, Serialize};

use super::Args;

/// Figures of `--json`.
#[derive(Serialize)]
struct Shipped<'a> {
    file: &'a Path,
    bytes: u64,
    origin: &'a Origin,
    /// Relative change of depth by rounding.
    rounding_mean: f64,
    rounding_largest: f64,
    abs_rel_before_rounding: f64,
    abs_rel: f64,
    a1: f64,
    factor_wandering: f64,
    formula_off: f64,
    images: usize,
}

pub fn run(args: &Args) -> Result<()> {
    let [folder] = &args.inputs[..] else {
        return Err(Error::setting("--ship", "takes one run's folder, and the file to write"));
    };
    if !folder.join("config.toml").is_file() {
        let message = "holds no config.toml: --ship takes a run's folder, which says what the weights were trained on";
        return Err(Error::file(folder, message));
    }
    if args.out.extension().is_none_or(|ending| ending != "safetensors") {
        return Err(Error::file(&args.out, "expected a .safetensors file to ship"));
    }
    if !args.force && args.out.exists() {
        return Err(Error::file(&args.out, "is there already: --force replaces it (OUT is the last argument)"));
    }
    let config = read_config(&folder.join("config.toml"))?;
    let trained_by = TrainedBy::of(folder)?;
    let sources = Sources::open(std::slice::from_ref(folder))?;
    let weights = load_from(&sources, Need::All, false)?;
    let mut rounded = load_from(&sources, Need::All, false)?;
    rounded.round_to_bf16();

    let sequences = usize::from(args.streets);
    note!("measuring metres on {sequences} rendered streets, with each of ten cameras");
    let exact = Predictor::new(&weights.model, &weights.params, &weights.setup);
    let predictor = Predictor::new(&rounded.model, &rounded.params, &rounded.setup);
    let calibration = calibrate(&predictor, sequences)?;
    let street = streets(&predictor, calibration.metres.camera, sequences);
    let before = on_streets(&exact, &street)?;
    let rounding = moved(&exact, &predictor, &street)?;

    let origin = Origin {
        world: args.world.clone().unwrap_or_else(|| world(&config)),
        steps: steps(folder).unwrap_or(config.steps),
        recipe: recipe(&config)?,
        version: trained_by.version,
        simd: trained_by.simd,
        licence: env!("CARGO_PKG_LICENSE").into(),
        metres: calibration.metres,
    };
    ship(&rounded, &origin, &args.out)?;
    let shipped = Shipped {
        file: &args.out,
        bytes: std::fs::metadata(&args.out).map_err(|e| Error::io(&args.out, e))?.len(),
        origin: &origin,
        rounding_mean: rounding.mean,
        rounding_largest: rounding.largest_in_a_picture,
        abs_rel_before_rounding: before.metrics.abs_rel,
        abs_rel: calibration.metrics.abs_rel,
        a1: calibration.metrics.a1,
        factor_wandering: calibration.wandering,
        formula_off: calibration.formula_off,
        images: calibration.images,
    };
    if args.json {
        return super::super::print_json(&shipped);
    }
    shipped.print();
    Ok(())
}

/// The program that trained a run: another version, or another SIMD level, would have made other weights.
#[derive(Deserialize)]
struct TrainedBy {
    version: String,
    simd: String,
}

impl TrainedBy {
    /// What the run's `machine.json` says; of a run that has none, this program is taken for it, and that is said.
    ///
    /// # Errors
    /// If the file is damaged.
    fn of(folder: &Path) -> Result<Self> {
        let path = folder.join("machine.json");
        if !path.exists() {
            note!("{} is missing: this program is named as the one that trained the weights", path.display());
            return Ok(TrainedBy { version: env!("CARGO_PKG_VERSION").into(), simd: simd::level()?.into() });
        }
        let text = read_text(&path, MAX_SETTINGS, "what a run was trained on")?;
        serde_json::from_str(&text).map_err(|e| Error::file(&path, format!("expected version and simd: {e}")))
    }
}

impl Shipped<'_> {
    fn print(&self) {
        let Origin { world, steps, version, simd, licence, metres, .. } = self.origin;
        say!("trained on  {world}, {steps} steps; by version {version} on {simd}; {licence}");
        say!(
            "rounding    moves depth by {:.2} % on average, by {:.1} % in the worst pixel of a usual picture",
            100.0 * self.rounding_mean,
            100.0 * self.rounding_largest
        );
        say!(
            "            Abs Rel on {} pictures of streets: {:.4} before, {:.4} after (a1 {:.3})",
            self.images,
            self.abs_rel_before_rounding,
            self.abs_rel,
            self.a1
        );
        say!(
            "metres      depth times {:.3} for a camera {} m above the road; from picture to picture {:.1} %",
            metres.factor,
            metres.camera_height,
            100.0 * self.factor_wandering
        );
        say!(
            "            other lenses: times (fx / {})^{:.3} (fy / {})^{:.3}, off by at most {:.0} %",
            metres.camera.fx,
            metres.by_width,
            metres.camera.fy,
            metres.by_height,
            100.0 * self.formula_off
        );
        say!("wrote       {}, {} bytes", self.file.display(), self.bytes);
    }
}

/// Name of the world that a run was trained on.
fn world(config: &RunConfig) -> String {
    match &config.data[..] {
        STREET => return format!("the program's own street, seed {}", config.seed),
        STREET_2 => return format!("the program's own street-2, seed {}", config.seed),
        _ => {}
    }
    last_part(Path::new(&config.data)).display().to_string()
}

/// The steps that a finished run says it took: with patience fewer than were planned.
fn steps(folder: &Path) -> Option<u64> {
    let text = std::fs::read(folder.join("metrics.json")).ok()?;
    serde_json::from_slice::<serde_json::Value>(&text).ok()?["steps"].as_u64()
}

/// A run's configuration; of files only their names, because nobody else has this machine's folders.
fn recipe(config: &RunConfig) -> Result<String> {
    let mut config = config.clone();
    if !is_rendered(&config.data) {
        config.data = last_part(Path::new(&config.data)).display().to_string();
    }
    for path in [
        &mut config.split,
        &mut config.val_split,
        &mut config.prepared,
        &mut config.init_encoder,
        &mut config.init_pose,
    ]
    .into_iter()
    .flatten()
    .chain(config.init.iter_mut().filter(|path| path.as_os_str() != SHIPPED))
    {
        *path = last_part(path);
    }
    toml::to_string(&config).map_err(|e| Error::Failed(format!("the configuration: {e}")))
}

fn last_part(path: &Path) -> PathBuf {
    path.file_name().map_or_else(|| path.to_owned(), PathBuf::from)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_of_the_program_that_trained_them() {
        let folder = tempfile::tempdir().unwrap();
        let here = TrainedBy::of(folder.path()).unwrap();
        assert_eq!((&here.version[..], &here.simd[..]), (env!("CARGO_PKG_VERSION"), simd::level().unwrap()));
        let file = folder.path().join("machine.json");
        std::fs::write(&file, r#"{"version": "0.0.7", "simd": "neon", "threads": 3}"#).unwrap();
        let there = TrainedBy::of(folder.path()).unwrap();
        assert_eq!((&there.version[..], &there.simd[..]), ("0.0.7", "neon"));
        std::fs::write(&file, r#"{"version": "0.0.7"}"#).unwrap();
        let error = TrainedBy::of(folder.path()).err().unwrap().to_string();
        assert!(error.contains("machine.json") && error.contains("simd"), "{error}");
    }

    #[test]
    fn a_recipe_names_no_folder_of_this_machine() {
        let mut config = RunConfig::usual();
        assert_eq!(world(&config), "the program's own street, seed 0");
        config.data = "/somewhere/private/frames".into();
        config.init = vec!["/somewhere/private/runs/1".into(), SHIPPED.into()];
        config.split = Some("/somewhere/private/train.txt".into());
        let text = recipe(&config).unwrap();
        assert!(!text.contains("private") && text.contains("train.txt") && text.contains(SHIPPED), "{text}");
        assert_eq!(world(&config), "frames");
    }
}
