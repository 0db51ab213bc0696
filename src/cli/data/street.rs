//! `parallax data street`.

use std::path::PathBuf;

use parallax::camera::Intrinsics;
use parallax::street::{Street, StreetConfig, WorldKind, export};
use parallax::{Error, Result};

use crate::cli::progress::Progress;

#[derive(clap::Args)]
pub struct Args {
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
    /// The files' layout: that of KITTI raw (PNG), or a folder of JPEG frames for each sequence, with camera.toml.
    #[arg(long, value_enum, default_value_t = Layout::Kitti)]
    layout: Layout,
    /// Focal lengths and principal point of the camera, in pixels [default: KITTI's, for any size].
    #[arg(long, value_name = "FX,FY,CX,CY", value_parser = crate::cli::pinhole)]
    intrinsics: Option<[f64; 4]>,
    /// A second camera so far to the right: 0.54 is KITTI's distance [default: one camera].
    #[arg(long, value_name = "METRES")]
    baseline: Option<f64>,
    /// Drive along winding paths, which turn so many degrees a frame, to one side and then to the other [default: a drive that
    /// holds its lane and hardly turns].
    #[arg(long, value_name = "DEGREES", conflicts_with = "moving_cars")]
    turn: Option<f64>,
    /// Roads of many kinds, as `train --data street-2` sees them, but of one camera.
    #[arg(long, conflicts_with = "turn")]
    wide: bool,
    /// Add moving cars.
    #[arg(long)]
    moving_cars: bool,
}

/// How a street is written.
#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Layout {
    Kitti,
    Frames,
}

/// Pictures that a street may consist of.
const MOST_GIGABYTES: f64 = 32.0;

pub fn run(a: Args) -> Result<()> {
    for (name, value) in
        [("--sequences", a.sequences), ("--frames", a.frames), ("--height", a.height), ("--width", a.width)]
    {
        // A sample is a frame with both neighbours.
        let least = if name == "--frames" { 3 } else { 1 };
        if !(least..=20_000).contains(&value) {
            return Err(Error::setting(name, format!("{value} is not from {least} to 20000")));
        }
    }
    let baseline = a.baseline.unwrap_or(0.0);
    if a.baseline.is_some_and(|b| !(b > 0.0 && b <= 10.0)) {
        return Err(Error::setting("--baseline", format!("{baseline} is not a distance above 0, up to 10 metres")));
    }
    if a.turn.is_some_and(|rate| !(rate > 0.0 && rate <= 5.0)) {
        return Err(Error::setting("--turn", "expected degrees a frame above 0, up to 5"));
    }
    let cameras = if baseline > 0.0 { 2 } else { 1 };
    // All pictures are held until they are written.
    let gigabytes =
        3e-9 * cameras as f64 * [a.sequences, a.frames, a.height, a.width].iter().map(|&n| n as f64).product::<f64>();
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
        world: if a.wide { WorldKind::Street2 } else { WorldKind::Street1 },
        own_lenses: false,
        moving_cars: a.moving_cars,
        baseline,
        intrinsics: a.intrinsics.map_or(Intrinsics::KITTI, |k| Intrinsics {
            fx: k[0] / a.width as f64,
            fy: k[1] / a.height as f64,
            cx: k[2] / a.width as f64,
            cy: k[3] / a.height as f64,
        }),
    };
    let progress = std::sync::Mutex::new(Progress::new("frames", (cameras * a.sequences * a.frames) as u64));
    let report = |done: usize, _: usize| {
        if let Ok(mut progress) = progress.lock() {
            progress.set(done as u64, "");
        }
    };
    let street = match a.turn {
        Some(rate) => Street::render_winding(&config, rate, Some(&report)),
        None => Street::render(&config, Some(&report)),
    };
    match a.layout {
        Layout::Kitti => export::write(&street, &a.out)?,
        Layout::Frames => export::write_frames(&street, &a.out)?,
    }
    if let Ok(progress) = progress.lock() {
        progress.finish();
    }
    note!("wrote {} sequences of {} frames to {}", a.sequences, a.frames, a.out.display());
    Ok(())
}
