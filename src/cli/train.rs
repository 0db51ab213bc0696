//! `parallax train`.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use parallax::data::apart::neighbours;
use parallax::monovit::Preset;
use parallax::networks::{Architecture, Setup};
use parallax::train::cost::check_memory;
use parallax::train::data::{self, is_rendered};
use parallax::train::fit::{Fitted, fit_memory};
use parallax::train::freeze::frozen;
use parallax::train::layers::Layers;
use parallax::train::recipe::{RunConfig, STEPS};
use parallax::train::run::{Ended, Event, Run, RunData, RunMetrics};
use parallax::train::start::Start;
use parallax::weights::{self, SHIPPED, architecture_of};
use parallax::{Error, Result};

use super::ablation;
use super::architecture::{ArchitectureArgs, Said};
use super::camera::CameraArgs;
use super::control::Control;
use super::film::FilmArgs;
use super::progress::Progress;
use super::report;
use super::stereo::StereoArgs;
use super::watch::Watch;

#[derive(clap::Args)]
pub struct Args {
    /// Training frames: `street` (rendered by the program), `street-2` (the same worlds seen by many cameras, for weights that
    /// carry over to pictures that were not rendered), a folder or a film [default: street].
    ///
    /// A folder in the layout of KITTI raw, of KITTI odometry or of Cityscapes' video; or any folder of PNG, JPEG or WebP
    /// frames, in the order in which people number them, each folder inside it a sequence of its own. `camera.toml` among
    /// the frames says which camera took them. Depth maps and the right camera's pictures, if there are any, lie in folders
    /// `depth` and `right` beside the frames, under their names, or where `camera.toml` says.
    ///
    /// A film (mp4, mov, mkv, ...) is read by ffmpeg, which has to be installed: --fps frames a second are taken out into a
    /// folder beside it, which is what the run then trains on.
    #[arg(long, value_name = "street|street-2|DIR|FILM")]
    data: Option<String>,
    /// Render new sequences while training goes on, for `street` and `street-2`: every epoch shows half of the last one's and
    /// as many that were never seen.
    #[arg(long)]
    endless: bool,
    #[command(flatten)]
    film: FilmArgs,
    /// List of a folder's frames to train on, lines `FOLDER FRAME`, or of KITTI and Cityscapes `FOLDER FRAME SIDE`
    /// [default: all that have both neighbours].
    #[arg(long, value_name = "FILE")]
    split: Option<PathBuf>,
    /// List of a folder's frames to validate on [default: the last tenth of each drive, with a gap before it].
    #[arg(long, value_name = "FILE")]
    val_split: Option<PathBuf>,
    /// File of the folder's prepared frames, as `parallax data prepare` writes it [default: the one of this size that lies
    /// in the folder, if there is any].
    #[arg(long, value_name = "FILE")]
    prepared: Option<PathBuf>,
    #[command(flatten)]
    lens: CameraArgs,
    #[command(flatten)]
    architecture: ArchitectureArgs,
    /// Height of the pictures that the networks see, a multiple of 32 [default: 96, or that of the weights to start
    /// from].
    #[arg(long, value_name = "PIXELS")]
    height: Option<usize>,
    /// Width of the pictures that the networks see, a multiple of 32 [default: 320, or that of the weights to start
    /// from].
    #[arg(long, value_name = "PIXELS")]
    width: Option<usize>,
    /// Batch size [default: 4].
    #[arg(long, value_name = "N")]
    batch: Option<usize>,
    /// Number of training steps; with --resume, the number to go on to [default: 3800].
    #[arg(long, value_name = "N", conflicts_with = "epochs")]
    steps: Option<u64>,
    /// Compute transformer layers again in the backward pass: a step takes less memory and more time.
    #[arg(long)]
    recompute: bool,
    /// Memory that training may take, such as 8G or 900M (1G is 1024M, 1M is 1024 x 1024 bytes): what it takes to fit is done
    /// and said. First transformer layers are computed again (--recompute), then the batch is taken in parts, whose
    /// gradients are averaged (--accumulate). An estimate, good to a tenth [default: the configuration as it is, refused if
    /// the free memory is not enough].
    #[arg(long, value_name = "SIZE", value_parser = bytes_of)]
    memory: Option<f64>,
    /// Steps between two lines of the log [default: 10].
    #[arg(long, value_name = "N")]
    log_every: Option<u64>,
    /// Steps between two checkpoints, at which the state is saved and the weights are validated [default: 200].
    #[arg(long, value_name = "N")]
    checkpoint_every: Option<u64>,
    /// Number of epochs, instead of --steps: passes over the training samples, each rounded up to whole steps.
    #[arg(long, value_name = "N")]
    epochs: Option<u64>,
    /// Learning rate of the depth decoder; those of the encoder and of the pose networks keep their ratio to it
    /// [default: 0.001, or 0.0001 where networks of a published size start from weights].
    #[arg(long, value_name = "RATE")]
    learning_rate: Option<f64>,
    /// Seed of everything random [default: 0].
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Published training, by name: monovit or monodepth2. Flags and --config win over it; it wins over the defaults of the
    /// preset and of weights to start from [default: this program's own].
    #[arg(long, value_name = "NAME")]
    recipe: Option<String>,
    /// Print the configuration that all this amounts to, as TOML, and do nothing else.
    #[arg(long, conflicts_with_all = ["resume", "json"])]
    print_config: bool,
    /// Configuration, such as a run's config.toml, whole or in part. Flags win over it; it wins over a recipe and the
    /// defaults for weights to start from.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Weights of all four networks to start from: a run, a file, or a folder with encoder.pth, depth.pth, ...; several
    /// times for several files; `shipped`: those inside the program [default: random weights].
    #[arg(long, value_name = "FILE|DIR")]
    init: Vec<PathBuf>,
    /// Weights of an MPViT or a ResNet (torchvision's) that was trained on ImageNet, for the depth encoder to start from.
    #[arg(long, value_name = "FILE")]
    init_encoder: Option<PathBuf>,
    /// Weights of a ResNet-18 that was trained on ImageNet (torchvision's), for the pose encoder to start from.
    #[arg(long, value_name = "FILE")]
    init_pose: Option<PathBuf>,
    /// Start from those weights that fit, and list the others.
    #[arg(long)]
    allow_partial: bool,
    /// Pass over samples with a frame that cannot be read, and say at the end how many they were [default: the first
    /// one ends the run].
    #[arg(long)]
    skip_bad_frames: bool,
    /// Continue this run: an interrupted one, or with --steps a finished one.
    #[arg(long, value_name = "RUN", conflicts_with_all = ["out", "config", "recipe", "init", "init_encoder", "init_pose", "split", "preset", "network", "encoder"])]
    resume: Option<PathBuf>,
    /// Folder of the run, new or empty [default: the first of runs/1, runs/2, ... that does not exist].
    #[arg(long, value_name = "RUN")]
    out: Option<PathBuf>,
    /// Print `metrics.json` on standard output at the end, and nothing else there.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    stereo: StereoArgs,
    #[command(flatten)]
    control: Control,
    #[command(flatten)]
    watch: Watch,
    #[command(flatten)]
    networks: ablation::Networks,
    #[command(flatten)]
    loss: ablation::Loss,
}

pub fn run(args: Args) -> Result<()> {
    if args.print_config {
        let config = configuration(&args)?;
        config.check()?;
        let text = toml::to_string(&config).map_err(|e| Error::Failed(format!("the configuration: {e}")))?;
        say!("{}", text.trim_end());
        return Ok(());
    }
    let stop = catch_stop()?;
    let (mut run, data) = match &args.resume {
        Some(folder) => resume(&args, folder)?,
        None => create(&args)?,
    };
    note!(
        "training {} on {} samples, {} steps of {}; everything goes to {}",
        run.config.architecture().name(),
        data.train.len(),
        run.config.steps,
        run.config.batch,
        run.folder.display()
    );
    for camera in data.train.cameras() {
        note!("camera: {camera}");
    }
    for aside in [Some(&data.validation), data.test.as_ref()].into_iter().flatten() {
        if let Some(warning) = neighbours(data.train.as_ref(), aside.as_ref()) {
            note!("warning: {warning}");
        }
    }
    let began = Instant::now();
    let mut progress = Progress::new("training", run.config.steps);
    let place = run.folder.clone();
    if let Err(error) = report::record_machine(&place) {
        note!("warning: the machine could not be noted: {error}");
    }
    args.watch.begin(&place);
    let ended = run.train(
        &data,
        || stop.asked.load(Ordering::SeqCst),
        |event| {
            show(&event, &mut progress, &stop);
            if matches!(event, Event::Validated(_)) {
                report::leave(&place, true);
            }
        },
    );
    report::leave(&place, false);
    let ended = ended?;
    stop.waits.store(false, Ordering::SeqCst);
    progress.finish();
    let folder = run.folder.display();
    match ended {
        Ended::Interrupted(step) => {
            note!("stopped after step {step}; go on with: parallax train --resume {folder}{}", skipped(&run));
            // As the shell says it of a program that Ctrl-C ended: scripts can tell this from done.
            std::process::exit(130);
        }
        Ended::Finished(metrics) => {
            if args.json {
                super::print_json(&metrics)?;
            }
            let RunConfig { init, init_encoder, init_pose, .. } = &run.config;
            let from_files = !init.is_empty() || init_encoder.is_some() || init_pose.is_some();
            let start = if from_files { "start" } else { "untrained" };
            print_metrics(&metrics, start);
            let seconds = began.elapsed().as_secs_f64();
            let skipped = skipped(&run);
            note!(
                "done in {seconds:.0} s, {:.0} s of them training; look at {folder}/report.html{skipped}",
                metrics.seconds
            );
        }
    }
    Ok(())
}

/// How many samples were passed over, and the first of them; nothing if there was none.
fn skipped(run: &Run) -> String {
    match (run.skipped().count(), run.skipped().first()) {
        (n, Some(first)) => format!("; {n} samples were skipped because a frame cannot be read, the first: {first}"),
        _ => String::new(),
    }
}

/// Ctrl-C: whether it was pressed, and whether there is a step to be waited for.
struct Stop {
    asked: AtomicBool,
    waits: AtomicBool,
}

/// Catches Ctrl-C and SIGTERM. Where nothing would be lost the program ends at once; while steps are taken, after the
/// present one; the second time, at once.
fn catch_stop() -> Result<Arc<Stop>> {
    let stop = Arc::new(Stop { asked: AtomicBool::new(false), waits: AtomicBool::new(false) });
    let handler = stop.clone();
    ctrlc::set_handler(move || {
        if !handler.waits.load(Ordering::SeqCst) || handler.asked.swap(true, Ordering::SeqCst) {
            std::process::exit(130);
        }
        note!("\nstopping after this step; once more to stop at once");
    })
    .map_err(|e| Error::Failed(format!("Ctrl-C cannot be caught: {e}")))?;
    Ok(stop)
}

fn show(event: &Event, progress: &mut Progress, stop: &Stop) {
    match event {
        Event::Phase(what) => {
            // In all other phases what is done so far is on the disk.
            stop.waits.store(*what == "training", Ordering::SeqCst);
            progress.say(what);
        }
        Event::Rotations(step, error) => {
            if step % 50 == 0 {
                progress.say(&format!("  step {step}: mean error {error:.2} pixels"));
            }
        }
        // The state was saved: a run that ends here validates when it is resumed.
        Event::Validating => stop.waits.store(false, Ordering::SeqCst),
        Event::Step(r) => {
            stop.waits.store(true, Ordering::SeqCst);
            progress.set(r.step, &format!("loss {:.4} warped {:.4} (unwarped {:.4})", r.loss, r.warped, r.unwarped));
        }
        Event::Validated(v) => {
            let abs_rel = v.abs_rel.map_or_else(String::new, |a| format!(", Abs Rel {a:.4}"));
            let best = if v.best { ", the best so far" } else { "" };
            progress.say(&format!(
                "step {}: on validation data photometric error {:.4}{best}; warped {:.4}, unwarped {:.4}{abs_rel}",
                v.validated, v.photometric, v.warped, v.unwarped
            ));
        }
        Event::Health(warning) => progress.say(&format!("warning: {}", warning.message)),
        Event::Warning(what) => progress.say(&format!("warning: {what}")),
    }
}

/// A new run.
fn create(args: &Args) -> Result<(Run, RunData)> {
    let mut config = configuration(args)?;
    config.check()?;
    match args.memory {
        Some(most) => {
            let Fitted { bytes, changes } = fit_memory(&mut config, most)?;
            let fits = if changes.is_empty() { "fits as it is" } else { "fits with changes" };
            note!("{:.2} GiB of memory: the training {fits}, and needs about {:.2} GiB", gib(most), gib(bytes));
            changes.iter().for_each(|change| note!("  {change}"));
        }
        None => check_memory(&config)?,
    }
    // Weights that do not fit are found out before anything is rendered or made.
    let start = Start::of(&config)?;
    for (files, report) in &start.reports {
        let files: Vec<String> = files.iter().map(|f| f.display().to_string()).collect();
        note!("starting from {}", files.join(", "));
        if report.problem().is_some() {
            note!("{report}");
        }
    }
    frozen(&start.params, &config.freeze)?;
    if !is_rendered(&config.data) {
        config.data = args.film.folder(Path::new(&config.data))?.to_string_lossy().into_owned();
    }
    let folder = args.out.clone().unwrap_or_else(|| next_free("runs"));
    let made = !folder.exists();
    Run::claim(&folder)?;
    let prepared = open(&config).and_then(|data| {
        config.set_epoch(data.train.len());
        Ok((Run::create_from(&folder, config, start)?, data))
    });
    prepared.inspect_err(|_| {
        // A folder made for nothing; if it cannot go, the error above says what matters.
        if made {
            let _ = std::fs::remove_dir(&folder);
        }
    })
}

/// A run that goes on, where its data are now and to as many steps as are asked for.
fn resume(args: &Args, folder: &Path) -> Result<(Run, RunData)> {
    args.refuse_what_cannot_change()?;
    let change = |config: &mut RunConfig| {
        if let Some(data) = &args.data {
            config.data = absolute(data);
        }
        if let Some(steps) = args.steps {
            (config.steps, config.epochs) = (steps, None);
        }
        config.skip_bad_frames |= args.skip_bad_frames;
        config.recompute |= args.recompute;
        args.control.apply_kept(config);
        args.watch.apply(config);
        Ok(())
    };
    let run = Run::resume_with(folder, change, |warning| note!("warning: {warning}"))?;
    if run.steps() > run.config.steps {
        let message = format!("{} steps, but the run has taken {} already", run.config.steps, run.steps());
        return Err(Error::setting("--steps", message));
    }
    note!("going on from step {} to {}", run.steps(), run.config.steps);
    let data = open(&run.config)?;
    Ok((run, data))
}

fn print_metrics(m: &RunMetrics, start: &str) {
    if m.images == 0 {
        return note!("no frame that was set aside has ground-truth depth to measure against");
    }
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
    for (name, metrics) in [(start, &m.before), ("mean depth map", &m.mean_map), ("trained", &m.after)] {
        if let Some(m) = metrics {
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
        }
    }
}

impl Args {
    /// Of a run that goes on, only where its data are, how many steps it takes and whether bad frames are passed over
    /// can be said anew.
    fn refuse_what_cannot_change(&self) -> Result<()> {
        let given = [
            ("--height", self.height.is_some()),
            ("--width", self.width.is_some()),
            ("--batch", self.batch.is_some()),
            ("--epochs", self.epochs.is_some()),
            ("--learning-rate", self.learning_rate.is_some()),
            ("--seed", self.seed.is_some()),
            ("--val-split", self.val_split.is_some()),
            ("--endless", self.endless),
            ("--memory", self.memory.is_some()),
            ("--prepared", self.prepared.is_some()),
            ("--fov", self.lens.fov.is_some()),
            ("--intrinsics", self.lens.intrinsics.is_some()),
            ("--camera", self.lens.camera.is_some()),
            ("--allow-partial", self.allow_partial),
            ("--fps", self.film.fps.is_some()),
            ("--log-every", self.log_every.is_some()),
            ("--checkpoint-every", self.checkpoint_every.is_some()),
            ("--sources or --baseline", self.stereo.any()),
            ("an ablation", self.networks.any() || self.loss.any()),
        ];
        match given.into_iter().chain(self.control.fixed()).find(|(_, given)| *given) {
            Some((flag, _)) => {
                let message = "cannot be changed with --resume: it is part of the run. A new run can start from its \
                               weights with --init RUN";
                Err(Error::setting(flag, message))
            }
            None => Ok(()),
        }
    }
}

fn gib(bytes: f64) -> f64 {
    bytes / f64::from(1 << 30)
}

/// Bytes from a number with a unit: `8G`, `1.5GiB`, `900M`.
fn bytes_of(text: &str) -> Result<f64, String> {
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let unit = match text[digits.len()..].to_ascii_lowercase().as_str() {
        "g" | "gb" | "gib" => f64::from(1 << 30),
        "m" | "mb" | "mib" => f64::from(1 << 20),
        _ => return Err("expected a number with a unit: 8G, 900M".into()),
    };
    let number = digits.trim().parse::<f64>().ok().filter(|x| *x > 0.0 && x.is_finite());
    number.map(|x| x * unit).ok_or_else(|| "expected a number above 0 with a unit: 8G, 900M".into())
}

/// A path that means the same from any folder.
fn absolute(data: &str) -> String {
    if is_rendered(data) {
        return data.to_owned();
    }
    std::path::absolute(data).map_or_else(|_| data.to_owned(), |p| p.to_string_lossy().into_owned())
}

fn configuration(args: &Args) -> Result<RunConfig> {
    let layers = Layers::read(args.recipe.as_deref(), args.config.as_deref())?;
    let said = Said { preset: layers.preset()?, network: layers.network()?, encoder: layers.encoder()? };
    let said = args.architecture.over(said)?;
    let defaults = if !args.init.is_empty() {
        // Where weights do not say it the preset does; whether they fit it is found out when they are read.
        let named = said.preset.map(|preset| Setup::of(said.or(preset)));
        let setup = weights::setup_of(&args.init).or_else(|e| named.ok_or(e))?;
        RunConfig::from_weights(setup, STEPS)
    } else if args.init_encoder.is_some() {
        RunConfig::from_encoder(architecture(args, said)?, STEPS)
    } else {
        RunConfig::new(architecture(args, said)?, STEPS)
    };
    let mut c = layers.over(&defaults)?;
    macro_rules! take {
        ($($field:ident),*) => {$(if let Some(value) = args.$field.clone() { c.$field = value; })*};
    }
    let asked = said.or(c.architecture());
    (c.preset, c.network) = (asked.preset, asked.network);
    c.encoder = (asked.encoder != asked.network.usual_encoder()).then_some(asked.encoder);
    take!(data, height, width, batch, seed, steps, log_every, checkpoint_every);
    if args.epochs.is_some() || args.steps.is_some() {
        c.epochs = args.epochs;
    }
    c.data = absolute(&c.data);
    for (to, from) in [
        (&mut c.split, &args.split),
        (&mut c.val_split, &args.val_split),
        (&mut c.prepared, &args.prepared),
        (&mut c.init_encoder, &args.init_encoder),
        (&mut c.init_pose, &args.init_pose),
    ] {
        if from.is_some() {
            *to = from.clone();
        }
        if let Some(path) = to {
            *path = std::path::absolute(&*path).unwrap_or_else(|_| path.clone());
        }
    }
    if !args.init.is_empty() {
        let anywhere = |p: &PathBuf| match p.as_os_str() == SHIPPED {
            true => p.clone(),
            false => std::path::absolute(p).unwrap_or_else(|_| p.clone()),
        };
        c.init = args.init.iter().map(anywhere).collect();
    }
    c.allow_partial |= args.allow_partial;
    c.skip_bad_frames |= args.skip_bad_frames;
    c.recompute |= args.recompute;
    c.endless |= args.endless;
    c.camera = args.lens.or(c.camera);
    args.stereo.apply(&mut c);
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
    args.control.apply(&mut c)?;
    args.watch.apply(&mut c);
    Ok(c)
}

/// The networks that were asked for; where no size was, those of the encoder to start from; without one, the reduced ones.
fn architecture(args: &Args, said: Said) -> Result<Architecture> {
    match (said.preset, &args.init_encoder) {
        (None, Some(file)) => Ok(said.or(architecture_of(std::slice::from_ref(file))?)),
        _ => Ok(said.or(Preset::Nano)),
    }
}

/// `runs/1`, `runs/2`, ...: the first that is not there.
fn next_free(parent: &str) -> PathBuf {
    (1..).map(|i| Path::new(parent).join(i.to_string())).find(|p| !p.exists()).expect("numbers do not end")
}

/// Opens what a run trains, validates and reports on, with a bar for what has to be rendered.
fn open(config: &RunConfig) -> Result<RunData> {
    let bar: Mutex<Option<(&'static str, Progress)>> = Mutex::new(None);
    data::open(config, &|what, done, all| {
        let Ok(mut bar) = bar.lock() else { return };
        if bar.as_ref().is_none_or(|(of, _)| *of != what) {
            *bar = Some((what, Progress::new(what, all as u64)));
        }
        if let Some((_, progress)) = bar.as_mut() {
            progress.set(done as u64, "");
            if done == all {
                progress.finish();
            }
        }
    })
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;
    use parallax::train::recipe::RunConfig;

    #[derive(clap::Parser)]
    struct Command {
        #[command(flatten)]
        args: super::Args,
    }

    /// Flags that may stay unsaid are options without a value of their own: the defaults are the configuration's.
    #[test]
    fn help_states_the_defaults_that_hold() {
        let c = RunConfig::usual();
        let command = Command::command();
        let expected = [
            ("data", c.data),
            ("height", c.height.to_string()),
            ("width", c.width.to_string()),
            ("batch", c.batch.to_string()),
            ("steps", c.steps.to_string()),
            ("log_every", c.log_every.to_string()),
            ("checkpoint_every", c.checkpoint_every.to_string()),
            ("learning_rate", c.optim.rate.to_string()),
            ("seed", c.seed.to_string()),
            ("ssim", c.loss.ssim.to_string()),
            ("accumulate", c.accumulate.to_string()),
            ("encoder_rate", c.optim.encoder_rate.to_string()),
            ("pose_rate", c.optim.pose_rate.to_string()),
            ("keep", c.keep.to_string()),
        ];
        for (flag, value) in expected {
            let argument = command.get_arguments().find(|a| a.get_id() == flag).unwrap_or_else(|| panic!("--{flag}"));
            let help = argument.get_help().map(ToString::to_string).unwrap_or_default().replace('\n', " ");
            assert!(help.contains(&format!("[default: {value}")), "--{flag}: {help:?} does not say {value}");
        }
    }
}
