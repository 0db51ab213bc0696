//! `parallax data`.

use std::path::PathBuf;

use parallax::data::camera::Camera;
use parallax::data::{self, open_folder};
use parallax::formats::png::write_png;
use parallax::monovit::Preset;
use parallax::monovit::setup::check_size;
use parallax::street::{Street, StreetConfig, export};
use parallax::train::cost::Cost;
use parallax::{Error, Result};

use super::camera::CameraArgs;
use super::progress::Progress;

#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand)]
enum What {
    /// The embedded street, in the layout of KITTI raw, with exact depth and poses.
    Street(StreetArgs),
    /// Look at a folder before training on it: what it holds, what is wrong with it, what training would take.
    ///
    /// Exit status 1 if there is nothing to train on. Frames that cannot be read are counted and named; train refuses them
    /// without --skip-bad-frames.
    Check(CheckArgs),
}

#[derive(clap::Args)]
struct CheckArgs {
    /// The folder: in the layout of KITTI raw, or of frames, as train takes it.
    dir: PathBuf,
    /// List of its frames [default: all that have both neighbours].
    #[arg(long, value_name = "FILE")]
    split: Option<PathBuf>,
    #[command(flatten)]
    lens: CameraArgs,
    /// Height of the pictures that the networks see.
    #[arg(long, value_name = "PIXELS", default_value_t = 96)]
    height: usize,
    /// Width of the pictures that the networks see.
    #[arg(long, value_name = "PIXELS", default_value_t = 320)]
    width: usize,
    /// Write a contact sheet: frames from all over the data between the ones before and after them.
    #[arg(long, value_name = "PNG")]
    sheet: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

#[derive(clap::Args)]
struct StreetArgs {
    /// Folder to write to, new or empty.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Number of sequences.
    #[arg(long, default_value_t = 4)]
    sequences: usize,
    /// Frames in each sequence.
    #[arg(long, default_value_t = 24)]
    frames: usize,
    /// Height of the pictures.
    #[arg(long, default_value_t = 96)]
    height: usize,
    /// Width of the pictures.
    #[arg(long, default_value_t = 320)]
    width: usize,
    /// Seed of everything random.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Add moving cars.
    #[arg(long)]
    moving_cars: bool,
}

/// Pictures that a street may consist of.
const MOST_GIGABYTES: f64 = 32.0;

pub fn run(args: Args) -> Result<()> {
    match args.what {
        What::Street(args) => street(args),
        What::Check(args) => check(&args),
    }
}

/// Says what a folder holds, and what should be looked at.
fn check(args: &CheckArgs) -> Result<()> {
    check_size("--height", args.height)?;
    check_size("--width", args.width)?;
    let size = [args.height, args.width];
    let data = open_folder(&args.dir, args.split.as_deref(), size, args.lens.or(Camera::Auto), true)?;
    let mut progress = Progress::new("samples", data.len() as u64);
    let found = data::check::check(data.as_ref(), |done| progress.set(done as u64, ""))?;
    progress.finish();
    if let Some(path) = &args.sheet {
        write_png(path, &data::check::contact_sheet(data.as_ref())?)?;
    }
    if args.json {
        return super::print_json(&found);
    }
    say!("{:40} {:>8} {:>8} {:>8} {:>8} {:>8}", "from", "samples", "depth", "still", "jumps", "cuts");
    for r in &found.recordings {
        let counts = [r.samples, r.with_depth, r.still, r.jumps.len(), r.cuts.len()].map(|n| format!("{n:8}"));
        say!("{:40} {}", r.first, counts.join(" "));
    }
    say!("\n{} samples to train on, {} to be set aside", found.train, found.aside);
    for camera in &found.cameras {
        say!("camera: {camera}");
    }
    let cost = Cost::of(&Preset::Nano.config(), size, 4)?;
    say!(
        "a step of nano, batch 4, takes about {:.2} s on this machine and {:.0} MiB: 1000 steps in {:.0} minutes",
        cost.seconds_step,
        cost.bytes_step / f64::from(1 << 20),
        1000.0 * cost.seconds_step / 60.0
    );
    for advice in found.advice() {
        say!("look at this: {advice}");
    }
    Ok(())
}

fn street(a: StreetArgs) -> Result<()> {
    for (name, value) in
        [("--sequences", a.sequences), ("--frames", a.frames), ("--height", a.height), ("--width", a.width)]
    {
        // A sample is a frame with both neighbours.
        let least = if name == "--frames" { 3 } else { 1 };
        if !(least..=20_000).contains(&value) {
            return Err(Error::setting(name, format!("{value} is not from {least} to 20000")));
        }
    }
    // All pictures are held until they are written.
    let gigabytes = 3e-9 * [a.sequences, a.frames, a.height, a.width].iter().map(|&n| n as f64).product::<f64>();
    if gigabytes > MOST_GIGABYTES {
        let message = format!(
            "these pictures take {gigabytes:.0} GB of memory (at most {MOST_GIGABYTES}): fewer, or smaller ones"
        );
        return Err(Error::setting("--sequences", message));
    }
    let config = StreetConfig {
        height: a.height,
        width: a.width,
        sequences: a.sequences,
        frames: a.frames,
        seed: a.seed,
        moving_cars: a.moving_cars,
        ..StreetConfig::default()
    };
    let progress = std::sync::Mutex::new(Progress::new("frames", (a.sequences * a.frames) as u64));
    let report = |done: usize, _: usize| {
        if let Ok(mut progress) = progress.lock() {
            progress.set(done as u64, "");
        }
    };
    let street = Street::render(&config, Some(&report));
    export::write(&street, &a.out)?;
    if let Ok(progress) = progress.lock() {
        progress.finish();
    }
    note!("wrote {} sequences of {} frames to {}", a.sequences, a.frames, a.out.display());
    Ok(())
}
