//! `parallax predict`.

use std::fs;
use std::path::{Path, PathBuf};

use parallax::data::DepthMap;
use parallax::data::picture::read_picture;
use parallax::data::resize::lanczos;
use parallax::files::write_bytes_atomically;
use parallax::monovit::evaluation::Predictor;
use parallax::monovit::metrics::resize_bilinear;
use parallax::monovit::weights::Weights;
use parallax::report::colormap::disparity_to_image;
use parallax::report::depth_png::write_depth_png;
use parallax::report::npy::write_npy;
use parallax::{Error, Result};

use super::progress::Progress;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    weights: super::weights::WeightsArgs,
    /// Pictures (PNG, JPEG), or folders of them.
    #[arg(required = true, value_name = "INPUT")]
    inputs: Vec<PathBuf>,
    /// Where the maps go: NAME_disp.png for every picture.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Also NAME_depth.png: 16 bit, metres * 256 (up to scale, as the weights see it).
    #[arg(long)]
    depth_png: bool,
    /// Also NAME.npy: inverse depth as f32, `[height, width]`.
    #[arg(long)]
    npy: bool,
    /// Depths are multiplied by this.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0)]
    scale: f64,
    /// Predict on the mirrored picture too, and join both.
    #[arg(long)]
    flip: bool,
}

pub fn run(args: Args) -> Result<()> {
    if !(args.scale > 0.0 && args.scale.is_finite()) {
        return Err(Error::setting("--scale", format!("{} is not a number above 0", args.scale)));
    }
    let Weights { model, params, config, .. } = args.weights.load()?;
    let pictures = pictures(&args.inputs)?;
    let predictor = Predictor::new(&model, &params, &config.loss);
    let mut progress = Progress::new("pictures", pictures.len() as u64);
    let mut failed = 0;
    for (i, path) in pictures.iter().enumerate() {
        // The rest of a folder still gets done; the exit status says that something was not.
        if let Err(error) = predict(&args, &predictor, path, (config.height, config.width)) {
            progress.say(&format!("parallax: {error}"));
            failed += 1;
        }
        progress.set(i as u64 + 1, "");
    }
    progress.finish();
    match failed {
        0 => Ok(()),
        n => Err(Error::Failed(format!("{n} of {} pictures could not be done (see above)", pictures.len()))),
    }
}

fn predict(args: &Args, predictor: &Predictor, path: &Path, (height, width): (usize, usize)) -> Result<()> {
    let picture = read_picture(path)?;
    let (w, h) = (picture.width() as usize, picture.height() as usize);
    let seen = lanczos(&picture, width as u32, height as u32);
    let inverse = resize_bilinear(&predictor.inverse_depth(&seen, args.flip), (height, width), (h, w));
    let inverse: Vec<f32> = inverse.into_iter().map(|x| x as f32).collect();
    let stem = path.file_stem().unwrap_or(path.as_os_str()).to_string_lossy();
    let to = |ending: &str| args.out.join(format!("{stem}{ending}"));
    let map = to("_disp.png");
    let mut bytes = std::io::Cursor::new(Vec::new());
    disparity_to_image(&inverse, w, h)
        .write_to(&mut bytes, image::ImageFormat::Png)
        .map_err(|e| Error::file(&map, format!("could not be encoded: {e}")))?;
    write_bytes_atomically(&map, bytes.get_ref())?;
    if args.npy {
        write_npy(to(".npy"), &inverse, h, w)?;
    }
    if args.depth_png {
        let metres = inverse.iter().map(|&d| (args.scale / f64::from(d)) as f32).collect();
        write_depth_png(to("_depth.png"), &DepthMap { width: w, height: h, metres })?;
    }
    Ok(())
}

/// The pictures among the inputs, and inside those that are folders, in order of name.
fn pictures(inputs: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let mut all = Vec::new();
    for input in inputs {
        if !input.is_dir() {
            // What is missing is found out when it is read, by name.
            all.push(input.clone());
            continue;
        }
        let entries = fs::read_dir(input).map_err(|e| Error::io(input, e))?;
        let mut inside: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).filter(|p| is_picture(p)).collect();
        if inside.is_empty() {
            return Err(Error::file(input, "holds no PNG or JPEG pictures"));
        }
        inside.sort();
        all.extend(inside);
    }
    Ok(all)
}

fn is_picture(path: &Path) -> bool {
    path.extension().is_some_and(|e| ["png", "jpg", "jpeg"].iter().any(|known| e.eq_ignore_ascii_case(known)))
}
