//! `parallax data check`.

use std::path::PathBuf;

use parallax::data::camera::Camera;
use parallax::data::camera_fit::{self, CameraFit, Verdict};
use parallax::data::check::{Findings, Folder};
use parallax::data::{self, Opening, open_folder};
use parallax::formats::png::write_png;
use parallax::train::cost::{Cost, check_memory};
use parallax::train::recipe::{RunConfig, STEPS};
use parallax::{Error, Result};
use serde::Serialize;

use crate::cli::camera::CameraArgs;
use crate::cli::film::FilmArgs;
use crate::cli::progress::Progress;
use crate::cli::sizes::Sizes;

#[derive(clap::Args)]
pub struct Args {
    /// The folder: in the layout of KITTI raw, or of frames, as train takes it; or a film.
    dir: PathBuf,
    #[command(flatten)]
    film: FilmArgs,
    /// List of its frames [default: all that have both neighbours].
    #[arg(long, value_name = "FILE")]
    split: Option<PathBuf>,
    #[command(flatten)]
    lens: CameraArgs,
    /// Write a contact sheet: frames from all over the data between the ones before and after them; where there is depth,
    /// below them the frame after, warped by it, which should look like the frame [default: none is written].
    #[arg(long, value_name = "PNG")]
    sheet: Option<PathBuf>,
    /// Leave out the test whether the camera fits the frames [default: it is made].
    #[arg(long)]
    no_camera_fit: bool,
    #[command(flatten)]
    sizes: Sizes,
}

/// All that is found.
#[derive(Serialize)]
struct Report {
    #[serde(flatten)]
    found: Option<Findings>,
    /// The folders that hold pictures.
    folders: Vec<Folder>,
    /// The verdict of the frames on each camera.
    camera_fit: Vec<CameraFit>,
    /// Time and memory of a training step; nothing where none can be taken.
    step: Option<Step>,
    /// Why one cannot train on this as it is; empty if one can.
    faults: Vec<String>,
    /// Advice: things to look at.
    advice: Vec<String>,
}

/// Time and memory of a training step on this machine.
#[derive(Serialize)]
struct Step {
    /// The networks that take it.
    networks: String,
    seconds: f64,
    bytes: f64,
}

/// Says what a folder holds, what keeps one from training on it, and what should be looked at.
pub fn run(mut args: Args) -> Result<()> {
    args.dir = args.film.folder(&args.dir)?;
    let args = &args;
    args.sizes.check()?;
    let report = look(args)?;
    if args.sizes.json {
        crate::cli::print_json(&report)?
    } else {
        print(args, &report)
    }
    match report.faults.len() {
        0 => Ok(()),
        1 => Err(Error::file(&args.dir, "one cannot train on this as it is, for the reason above")),
        n => Err(Error::file(&args.dir, format!("one cannot train on this as it is, for the {n} reasons above"))),
    }
}

fn look(args: &Args) -> Result<Report> {
    let folders = if args.dir.is_dir() { data::check::survey(&args.dir)? } else { Vec::new() };
    let mut report = Report {
        found: None,
        faults: folders.iter().flat_map(Folder::faults).collect(),
        advice: folders.iter().flat_map(Folder::advice).collect(),
        folders,
        camera_fit: Vec::new(),
        step: None,
    };
    if args.split.is_some() {
        // A list may leave out what is wrong.
        report.advice.append(&mut report.faults);
    }
    let sizes = &args.sizes;
    let (list, camera) = (args.split.as_deref(), args.lens.or(Camera::Auto));
    let open = |size| open_folder(&args.dir, Opening { list, camera, skip_bad_frames: true, ..Opening::of(size) });
    let opened = match open([sizes.height, sizes.width]) {
        // What lies in the folder was looked at, and is worth telling.
        Err(error) if !report.folders.is_empty() => {
            report.faults.push(error.to_string());
            return Ok(report);
        }
        opened => opened?,
    };
    let mut progress = Progress::new("samples", opened.len() as u64);
    let found = data::check::check(opened.as_ref(), |done| progress.set(done as u64, ""));
    progress.finish();
    // Frames whose headers cannot be read were named by folder already.
    let named = |folder: &Folder| if args.split.is_some() { 0 } else { folder.unreadable.len() };
    let known: usize = report.folders.iter().map(named).sum();
    if found.unreadable.len() > known || found.train == 0 {
        report.faults.extend(found.faults());
    }
    report.advice.extend(found.advice());
    if let Some(path) = &args.sheet {
        write_png(path, &data::check::contact_sheet(opened.as_ref())?)?;
    }
    if !args.no_camera_fit {
        let widest = report.folders.iter().flat_map(|folder| &folder.sizes).map(|size| size.width).max();
        let size = camera_fit::size(widest, [sizes.height, sizes.width]);
        report.camera_fit = camera_fit::fit(open(size)?.as_ref());
    }
    for fit in &report.camera_fit {
        match fit.verdict {
            Verdict::DoesNotFit => report.faults.push(format!("from {} on {}", fit.first, fit.in_words())),
            Verdict::CannotTell if fit.is_askew() => {
                report.advice.push(format!("from {} on {}", fit.first, fit.in_words()))
            }
            _ => {}
        }
    }
    let config = RunConfig {
        height: sizes.height,
        width: sizes.width,
        batch: sizes.batch,
        data: args.dir.display().to_string(),
        ..RunConfig::new(sizes.architecture()?, STEPS)
    };
    match check_memory(&config) {
        Ok(()) => {
            let cost = Cost::of(config.model(), [sizes.height, sizes.width], sizes.batch, false)?;
            report.step = Some(Step {
                networks: config.architecture().name(),
                seconds: cost.seconds_step,
                bytes: cost.bytes_step,
            });
        }
        Err(error) => report.faults.push(error.to_string()),
    }
    report.found = Some(found);
    Ok(report)
}

fn print(args: &Args, report: &Report) {
    say!("{:48} {:>8} {:>12} {:>10} {:>5}", "folder", "pictures", "size", "frames/s", "gaps");
    for folder in &report.folders {
        let size = folder.sizes.first().map_or_else(String::new, |size| format!("{}x{}", size.width, size.height));
        let rate = folder.seconds.map_or_else(|| "-".to_owned(), |seconds| format!("{:.1}", 1.0 / seconds));
        let gaps = folder.missing.len().max(folder.time_gaps.len());
        say!("{:48} {:8} {size:>12} {rate:>10} {gaps:5}", folder.name, folder.pictures);
    }
    for (name, why) in report.folders.iter().flat_map(|folder| &folder.unreadable) {
        say!("cannot be read: {name}: {why}");
    }
    if let Some(found) = &report.found {
        print_found(found);
    }
    for fit in &report.camera_fit {
        say!("from {} on {}", fit.first, fit.in_words());
    }
    if let Some(Step { networks, seconds, bytes }) = &report.step {
        let sizes = &args.sizes;
        say!(
            "a step of {}, batch {}, takes about {seconds:.2} s on this machine and {:.0} MiB: 1000 steps in {:.0} minutes",
            networks,
            sizes.batch,
            bytes / f64::from(1 << 20),
            1000.0 * seconds / 60.0
        );
    }
    for advice in &report.advice {
        say!("look at this: {advice}");
    }
    for fault in &report.faults {
        say!("to be mended: {fault}");
    }
}

fn print_found(found: &Findings) {
    say!("\n{:48} {:>8} {:>8} {:>8} {:>8} {:>8}", "from", "samples", "depth", "still", "jumps", "cuts");
    for r in &found.recordings {
        let counts = [r.samples, r.with_depth, r.still, r.jumps.len(), r.cuts.len()].map(|n| format!("{n:8}"));
        say!("{:48} {}", r.first, counts.join(" "));
    }
    for (name, why) in &found.unreadable {
        say!("cannot be used: {name}: {why}");
    }
    say!("\n{} samples to train on, {} to be set aside", found.train, found.aside);
    for camera in &found.cameras {
        say!("camera: {camera}");
    }
}
