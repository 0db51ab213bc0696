//! `parallax data prepare`.

use std::path::PathBuf;
use std::sync::Mutex;

use parallax::data::prepared::prepare;
use parallax::networks::setup::check_size;
use parallax::{Error, Result};

use crate::cli::film::FilmArgs;
use crate::cli::progress::Progress;

#[derive(clap::Args)]
pub struct Args {
    /// The folder of frames, or the film, as train takes it.
    dir: PathBuf,
    #[command(flatten)]
    film: FilmArgs,
    /// The file to write [default: frames-WIDTHxHEIGHT.prepared in the folder, where train looks for it].
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Height of the pictures that the networks see, a multiple of 32.
    #[arg(long, value_name = "PIXELS", default_value_t = 96)]
    height: usize,
    /// Width of the pictures that the networks see, a multiple of 32.
    #[arg(long, value_name = "PIXELS", default_value_t = 320)]
    width: usize,
}

pub fn run(mut args: Args) -> Result<()> {
    args.dir = args.film.folder(&args.dir)?;
    let args = &args;
    check_size("--height", args.height)?;
    check_size("--width", args.width)?;
    let progress: Mutex<Option<Progress>> = Mutex::new(None);
    let report = |done: usize, all: usize| {
        if let Ok(mut progress) = progress.lock() {
            progress.get_or_insert_with(|| Progress::new("frames", all as u64)).set(done as u64, "");
        }
    };
    let outcome = prepare(&args.dir, [args.height, args.width], args.out.as_deref(), &report)?;
    if let Ok(Some(progress)) = progress.into_inner() {
        progress.finish();
    }
    for (name, why) in &outcome.unreadable {
        note!("cannot be read: {name}: {why}");
    }
    note!(
        "{} frames of {}x{} in {} ({:.0} MB), {} of them prepared before",
        outcome.frames,
        args.width,
        args.height,
        outcome.path.display(),
        1e-6 * outcome.bytes as f64,
        outcome.kept
    );
    match outcome.unreadable.len() {
        0 => Ok(()),
        n => Err(Error::file(&args.dir, format!("{n} frames cannot be read and were left out: restore them"))),
    }
}
