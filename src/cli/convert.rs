//! `parallax convert`.

use std::path::PathBuf;

use parallax::networks::setup::check_size;
use parallax::weights;
use parallax::weights::{Form, Need, Sources};
use parallax::{Error, Result};

mod ship;

#[derive(clap::Args)]
pub struct Args {
    /// Weights: files (.pth, .safetensors, .npz), a folder with encoder.pth, depth.pth, ..., or a run's folder.
    #[arg(value_name = "IN", required = true, num_args = 1..)]
    inputs: Vec<PathBuf>,
    /// What to write: a .safetensors, .npz or .pth file, or, without an ending, a folder with the published set:
    /// encoder.pth, depth.pth, pose_encoder.pth, pose.pth.
    #[arg(value_name = "OUT")]
    out: PathBuf,
    /// Load the parameters that fit, and list the others.
    #[arg(long)]
    allow_partial: bool,
    /// Height of the pictures that the network saw [default: that of the weights].
    #[arg(long, value_name = "PIXELS")]
    height: Option<usize>,
    /// Width of the pictures that the network saw [default: that of the weights].
    #[arg(long, value_name = "PIXELS")]
    width: Option<usize>,
    /// Of files that hold weights twice, as they are and averaged over steps, take the averaged ones [default: the plain
    /// ones].
    #[arg(long)]
    averaged: bool,
    /// Replace what stands at OUT.
    #[arg(long)]
    force: bool,
    /// Make the file of weights that lies inside the program: IN is a run's folder, OUT assets/shipped.safetensors.
    ///
    /// Numbers are rounded to bfloat16; the metadata say what the run was trained on, its recipe and steps, the version
    /// and the SIMD level of this program (to be run by the one that trained), the licence, and how depth becomes
    /// metres, which is measured on rendered streets. Says how much rounding changes depth.
    #[arg(long, conflicts_with_all = ["allow_partial", "height", "width", "averaged"])]
    ship: bool,
    /// Name of the world that the shipped weights were trained on [default: as the run's configuration says].
    #[arg(long, value_name = "WORDS", requires = "ship")]
    world: Option<String>,
    /// With --ship: on how many rendered streets metres are measured, with each of ten cameras.
    #[arg(long, value_name = "N", requires = "ship", default_value_t = 10, value_parser = clap::value_parser!(u16).range(1..))]
    streets: u16,
    /// Print one JSON object: what was matched, missing, unexpected; with --ship what was measured and written.
    #[arg(long)]
    json: bool,
}

pub fn run(args: Args) -> Result<()> {
    if args.ship {
        return ship::run(&args);
    }
    for (name, size) in [("--height", args.height), ("--width", args.width)] {
        size.map_or(Ok(()), |size| check_size(name, size))?;
    }
    let form = Form::of(&args.out)?;
    let open = if args.averaged { Sources::open_averaged } else { Sources::open };
    let mut weights = weights::load_from(&open(&args.inputs)?, Need::Any, args.allow_partial)?;
    if args.height.is_some() || args.width.is_some() {
        // How depth becomes metres was measured at the size that they had.
        weights.origin = None;
    }
    weights.setup.height = args.height.unwrap_or(weights.setup.height);
    weights.setup.width = args.width.unwrap_or(weights.setup.width);
    let outputs = weights::outputs(&weights, &args.out, form);
    if let (false, Some(there)) = (args.force, outputs.iter().find(|p| p.exists())) {
        return Err(Error::file(there, "is there already: --force replaces it (OUT is the last argument)"));
    }
    weights::save(&weights, &args.out, form)?;
    if args.json {
        return super::print_json(&weights.report);
    }
    say!("{}", weights.report);
    for output in outputs {
        say!("wrote       {}", output.display());
    }
    Ok(())
}
