//! `parallax train`.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use parallax::data::kitti::{Kitti, Options};
use parallax::data::{Dataset, Subset};
use parallax::eval::metrics::Metrics;
use parallax::monovit::Preset;
use parallax::street::{Street, StreetConfig};
use parallax::train::recipe::{RunConfig, STEPS, read_config};
use parallax::train::run::{Ended, Event, Run, RunData, RunMetrics};
use parallax::train::start::Start;
use parallax::weights::preset_of;
use parallax::{Error, Result};

use super::ablation;
use super::progress::Progress;

#[derive(clap::Args)]
pub struct Args {
    /// Where frames come from: `street` (made by the program) or a folder in the layout of KITTI raw.
    #[arg(long, value_name = "street|DIR")]
    data: Option<String>,
    /// The frames of a folder to train on: lines `FOLDER FRAME SIDE`. All that have neighbours, without.
    #[arg(long, value_name = "FILE")]
    split: Option<PathBuf>,
    /// The frames of a folder to validate on. Every tenth training frame is set aside, without.
    #[arg(long, value_name = "FILE")]
    val_split: Option<PathBuf>,
    /// The size of the networks.
    #[arg(long)]
    preset: Option<Preset>,
    /// Height of the pictures that the networks see, a multiple of 32.
    #[arg(long, value_name = "PIXELS")]
    height: Option<usize>,
    /// Width of the pictures that the networks see, a multiple of 32.
    #[arg(long, value_name = "PIXELS")]
    width: Option<usize>,
    /// Samples a step.
    #[arg(long, value_name = "N")]
    batch: Option<usize>,
    /// How many steps.
    #[arg(long, value_name = "N", conflicts_with = "epochs")]
    steps: Option<u64>,
    /// How many times through the data, instead of steps.
    #[arg(long, value_name = "N")]
    epochs: Option<u64>,
    /// The learning rate of the depth decoder; those of the encoder and of the pose networks keep their ratio to it.
    #[arg(long, value_name = "RATE")]
    learning_rate: Option<f64>,
    /// Everything random follows from this number.
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// A configuration such as a run's config.toml; flags win over it.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Weights to start from, all four networks: a run, a file, a folder with encoder.pth, depth.pth, ...; several times
    /// for several files. The preset is that of the weights.
    #[arg(long, value_name = "FILE|DIR")]
    init: Vec<PathBuf>,
    /// Start the depth encoder from an MPViT that was trained on ImageNet.
    #[arg(long, value_name = "FILE")]
    init_encoder: Option<PathBuf>,
    /// Start the pose encoder from a ResNet-18 that was trained on ImageNet (torchvision's).
    #[arg(long, value_name = "FILE")]
    init_pose: Option<PathBuf>,
    /// Start from those weights that fit; the others are listed.
    #[arg(long)]
    allow_partial: bool,
    /// Go on with an interrupted run.
    #[arg(long, value_name = "RUN", conflicts_with_all = ["out", "config", "init", "init_encoder", "init_pose", "data", "split", "preset"])]
    resume: Option<PathBuf>,
    /// The run's folder, new or empty.
    #[arg(long, value_name = "RUN")]
    out: Option<PathBuf>,
    /// Print `metrics.json` on standard output at the end, and nothing else there.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    networks: ablation::Networks,
    #[command(flatten)]
    loss: ablation::Loss,
}

pub fn run(args: Args) -> Result<()> {
    let stop = Arc::new(AtomicBool::new(false));
    let asked = stop.clone();
    ctrlc::set_handler(move || {
        // The second time, at once.
        if asked.swap(true, Ordering::SeqCst) {
            std::process::exit(130);
        }
        note!("\nstopping after this step; once more to stop at once");
    })
    .map_err(|e| Error::Failed(format!("Ctrl-C cannot be caught: {e}")))?;

    let (mut run, data) = match &args.resume {
        Some(folder) => {
            let run = Run::resume(folder)?;
            let data = open(&run.config)?;
            (run, data)
        }
        None => {
            let mut config = configuration(&args)?;
            config.check()?;
            // Weights that do not fit are found out before anything is rendered or made.
            let start = Start::of(&config)?;
            for (files, report) in &start.reports {
                let files: Vec<String> = files.iter().map(|f| f.display().to_string()).collect();
                note!("starting from {}", files.join(", "));
                if report.problem().is_some() {
                    note!("{report}");
                }
            }
            let folder = args.out.clone().unwrap_or_else(|| next_free("runs"));
            let made = !folder.exists();
            Run::claim(&folder)?;
            let prepared = open(&config).and_then(|data| {
                enough(&data, &config)?;
                if let Some(epochs) = args.epochs {
                    let a_pass = data.train.len().div_ceil(config.batch.max(1)) as u64;
                    config.steps = epochs * a_pass;
                }
                Ok((Run::create_from(&folder, config, start)?, data))
            });
            prepared.inspect_err(|_| {
                // A folder made for nothing; if it cannot go, the error above says what matters.
                if made {
                    let _ = std::fs::remove_dir(&folder);
                }
            })?
        }
    };
    note!(
        "training {} on {} samples, {} steps of {}; everything goes to {}",
        run.config.preset.name(),
        data.train.len(),
        run.config.steps,
        run.config.batch,
        run.folder.display()
    );
    let mut progress = Progress::new("training", run.config.steps);
    let ended = run.train(
        &data,
        || stop.load(Ordering::SeqCst),
        |event| match event {
            Event::Phase(what) => progress.say(what),
            Event::Rotations(step, error) => {
                if step % 50 == 0 {
                    progress.say(&format!("  step {step}: mean error {error:.2} pixels"));
                }
            }
            Event::Step(r) => {
                let note = format!("loss {:.4} photometric {:.4} (unwarped {:.4})", r.loss, r.photometric, r.unwarped);
                progress.set(r.step, &note);
            }
            Event::Validated(v) => {
                let abs_rel = v.abs_rel.map_or_else(String::new, |a| format!(", Abs Rel {a:.4}"));
                let best = if v.best { ", the best so far" } else { "" };
                let (step, error) = (v.step, v.photometric);
                progress.say(&format!("step {step}: photometric error on validation data {error:.4}{best}{abs_rel}"));
            }
        },
    )?;
    progress.finish();
    let folder = run.folder.display();
    match ended {
        Ended::Interrupted(step) => {
            note!("stopped after step {step}; go on with: parallax train --resume {folder}");
        }
        Ended::Finished(None) => {
            note!(
                "done; no frame that was set aside has ground-truth depth to measure against. Look at {folder}/images"
            );
        }
        Ended::Finished(Some(metrics)) => {
            if args.json {
                super::print_json(&metrics)?;
            }
            print_metrics(&metrics);
            note!("done in {:.0} s; look at {folder}/images", metrics.seconds);
        }
    }
    Ok(())
}

fn print_metrics(m: &RunMetrics) {
    note!("\n{} images that nothing was chosen on ({})", m.images, m.test);
    note!(
        "{:14} {:>8} {:>8} {:>8} {:>9} {:>6} {:>6} {:>6}",
        "",
        "Abs Rel",
        "Sq Rel",
        "RMSE",
        "RMSE log",
        "a1",
        "a2",
        "a3"
    );
    let row = |name: &str, m: &Metrics| {
        note!(
            "{name:14} {:8.4} {:8.4} {:8.3} {:9.4} {:6.3} {:6.3} {:6.3}",
            m.abs_rel,
            m.sq_rel,
            m.rmse,
            m.rmse_log,
            m.a1,
            m.a2,
            m.a3
        );
    };
    row("untrained", &m.before);
    if let Some(mean_map) = &m.mean_map {
        row("mean depth map", mean_map);
    }
    row("trained", &m.after);
}

fn configuration(args: &Args) -> Result<RunConfig> {
    let mut c = match &args.config {
        Some(path) => read_config(path)?,
        None => RunConfig::new(preset(args)?, STEPS),
    };
    macro_rules! take {
        ($($field:ident),*) => {$(if let Some(value) = args.$field.clone() { c.$field = value; })*};
    }
    take!(data, preset, height, width, batch, seed);
    for (to, from) in [
        (&mut c.split, &args.split),
        (&mut c.val_split, &args.val_split),
        (&mut c.init_encoder, &args.init_encoder),
        (&mut c.init_pose, &args.init_pose),
    ] {
        if from.is_some() {
            *to = from.clone();
        }
    }
    if !args.init.is_empty() {
        c.init.clone_from(&args.init);
    }
    c.allow_partial |= args.allow_partial;
    args.networks.apply(&mut c.ablation);
    args.loss.apply(&mut c.loss);
    if let Some(rate) = args.learning_rate {
        if !(rate > 0.0 && rate.is_finite()) {
            return Err(Error::setting("--learning-rate", format!("{rate} is not a number above 0")));
        }
        let factor = rate / c.optim.rate;
        c.optim.rate = rate;
        c.optim.encoder_rate *= factor;
        c.optim.pose_rate *= factor;
    }
    if let Some(steps) = args.steps {
        c.steps = steps;
    }
    Ok(c)
}

/// The preset that was asked for; without, that of the weights to start from; without those, the reduced one.
fn preset(args: &Args) -> Result<Preset> {
    let files: Vec<PathBuf> = args.init.iter().chain(&args.init_encoder).cloned().collect();
    match args.preset {
        Some(preset) => Ok(preset),
        None if files.is_empty() => Ok(Preset::Nano),
        None => preset_of(&files),
    }
}

/// `runs/1`, `runs/2`, ...: the first that is not there.
fn next_free(parent: &str) -> PathBuf {
    (1..).map(|i| Path::new(parent).join(i.to_string())).find(|p| !p.exists()).expect("numbers do not end")
}

fn enough(data: &RunData, config: &RunConfig) -> Result<()> {
    if data.train.len() < config.batch {
        let message =
            format!("{} samples a batch, but the data holds {}: make it smaller", config.batch, data.train.len());
        return Err(Error::setting("--batch", message));
    }
    Ok(())
}

/// Opens what a run trains, validates and reports on.
fn open(config: &RunConfig) -> Result<RunData> {
    let (height, width) = (config.height, config.width);
    if config.data == "street" {
        // Many short drives: a street more teaches more than a few metres more of the same.
        let street = |what: &'static str, seed: u64, sequences: usize| {
            let settings = StreetConfig { height, width, sequences, frames: 10, seed, ..StreetConfig::default() };
            let progress = std::sync::Mutex::new(Progress::new(what, (sequences * settings.frames) as u64));
            let report = |done: usize, _: usize| {
                if let Ok(mut progress) = progress.lock() {
                    progress.set(done as u64, "");
                }
            };
            let street = Street::render(&settings, Some(&report));
            if let Ok(progress) = progress.lock() {
                progress.finish();
            }
            Arc::new(street)
        };
        // Seeds far apart: three worlds that have no street in common.
        let seed = config.seed;
        return Ok(RunData {
            train: street("street", seed, 144),
            validation: street("validation", seed + 1_000_000, 12),
            test: Some(street("test", seed + 2_000_000, 24)),
        });
    }
    let root = Path::new(&config.data);
    let all: Arc<dyn Dataset> =
        Arc::new(Kitti::open(root, config.split.as_deref(), height, width, Options::default())?);
    let (train, aside): (Arc<dyn Dataset>, Arc<dyn Dataset>) = match &config.val_split {
        Some(split) => (all, Arc::new(Kitti::open(root, Some(split), height, width, Options::default())?)),
        None => {
            let (aside, rest) = (0..all.len()).partition(|i| i % 10 == 9);
            (Arc::new(Subset::new(all.clone(), rest)), Arc::new(Subset::new(all, aside)))
        }
    };
    // What selects the weights is not what is reported on.
    let (validation, mut test): (Vec<usize>, Vec<usize>) = (0..aside.len()).partition(|i| i % 2 == 0);
    let with_truth: Result<Vec<bool>> = test.iter().map(|&i| Ok(aside.depth(i)?.is_some())).collect();
    let mut with_truth = with_truth?.into_iter();
    test.retain(|_| with_truth.next().unwrap_or(false));
    Ok(RunData {
        train,
        validation: Arc::new(Subset::new(aside.clone(), validation)),
        test: (!test.is_empty()).then(|| Arc::new(Subset::new(aside, test)) as Arc<dyn Dataset>),
    })
}
