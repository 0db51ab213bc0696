//! `parallax view`: depth in the browser, served on this machine alone.
//!
//! `guard` says who may ask, `server` which question is which, `gallery` holds the pictures, `work` computes; `page.html`,
//! `page.js`, `cloud.js` and `page.css` are what the browser gets.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

use parallax::data::inputs::find_pictures;
use parallax::weights::SHIPPED;
use parallax::{Error, Result};

use super::film::FilmArgs;
use super::lens::Flags;
use super::weights::WeightsArgs;

mod gallery;
mod guard;
mod reply;
mod server;
mod work;

use gallery::Gallery;
use work::{Network, Worker};

#[derive(clap::Args)]
#[command(after_long_help = AFTER)]
pub struct Args {
    /// Pictures (PNG, JPEG, WebP), folders of them, or films (read by ffmpeg, if installed); more can be dropped into the
    /// page.
    #[arg(value_name = "INPUT")]
    inputs: Vec<PathBuf>,
    #[command(flatten)]
    film_args: FilmArgs,
    #[command(flatten)]
    weights: WeightsArgs,
    /// Other weights, to compare with: both maps are shown side by side.
    #[arg(long, value_name = "FILE|DIR")]
    against: Option<PathBuf>,
    /// Port to serve on [default: a free one].
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    port: u16,
    /// Open the page in the default browser.
    #[arg(long)]
    open: bool,
    /// Focal lengths and principal point, in pixels of the pictures [default: as for `predict`].
    #[arg(long, value_name = "FX,FY,CX,CY", group = "camera", value_parser = super::pinhole)]
    intrinsics: Option<[f64; 4]>,
    /// Horizontal field of view in degrees [default: as for `predict`].
    #[arg(long, value_name = "DEGREES", group = "camera", value_parser = super::predict::field_of_view)]
    fov: Option<f64>,
}

const AFTER: &str = "\
On the page:
  Drop a picture in, or choose one. Point at the map to read depth: in metres where the weights know
  them (the shipped ones, for a camera 1.65 m above the road), without a unit elsewhere. Click, or press
  Enter, for what a pixel looks at. Turn the points with the mouse, a finger or the arrow keys. The
  pictures of a folder play as a film.

Nothing leaves this machine: the page is served on 127.0.0.1 alone, loads nothing from elsewhere, and
requests that come from other pages are refused. Ctrl-C ends it.

Examples:
  parallax view photo.jpg --open
  parallax view drive/ --weights runs/1
  parallax view drive/ --weights runs/1 --against runs/2";

pub fn run(args: Args) -> Result<()> {
    let inputs = args.film_args.folders(&args.inputs)?;
    let found = match inputs.is_empty() {
        true => Default::default(),
        // Nothing is written: there is no folder for results to pass over.
        false => find_pictures(&inputs, Path::new(""))?,
    };
    let mut networks = vec![Network::load(&args.weights)?];
    if let Some(path) = &args.against {
        networks.push(Network::load(&args.weights.instead(path))?);
    }
    let flags = Flags { intrinsics: args.intrinsics, fov: args.fov };
    let gallery = Arc::new(Gallery::new(found.pictures, inputs, flags));
    let worker = Worker::new(networks, gallery.clone());
    let (ask, asked) = channel();
    let serving = server::start(args.port, gallery, worker.state(), ask)?;
    say!("depth in the browser: {}   (Ctrl-C ends it)", serving.address());
    if args.weights.name() == SHIPPED {
        note!("weights inside the program; --weights RUN shows others, --against compares");
    }
    if args.open
        && let Err(error) = opener::open_browser(serving.address())
    {
        note!("no browser could be opened ({error}): open the address above");
    }
    answer(worker, &asked)
}

/// Answers until somebody ends it. On the program's first thread, which is one of those that compute.
fn answer(mut worker: Worker, asked: &std::sync::mpsc::Receiver<work::Question>) -> Result<()> {
    let stop = Arc::new(AtomicBool::new(false));
    let of_handler = stop.clone();
    ctrlc::set_handler(move || of_handler.store(true, Ordering::Relaxed))
        .map_err(|e| Error::Failed(format!("Ctrl-C cannot be heard: {e}")))?;
    while !stop.load(Ordering::Relaxed) {
        match asked.recv_timeout(Duration::from_millis(100)) {
            // Whoever asked may be gone.
            Ok(question) => drop(question.reply.send(worker.answer(&question.ask))),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
    }
    note!("ended");
    Ok(())
}
