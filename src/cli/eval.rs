//! `parallax eval`.

use std::path::{Path, PathBuf};

use parallax::Result;
use parallax::data::DataSource;
use parallax::data::camera::Camera;
use parallax::data::frames::{self, Frames};
use parallax::data::kitti::{DepthAxis, GroundTruth, Kitti, LeftOut, Options, is_kitti};
use parallax::data::stills::{Layout, Stills};
use parallax::eval::metrics::{Protocol, Report, STEREO_SCALE, Scale};
use parallax::eval::predictions::Predictions;
use parallax::eval::predictor::{Evaluation, Predictor, evaluate, evaluate_predictions};
use parallax::street::{Street, StreetConfig};
use parallax::weights::Weights;
use serde::Serialize;

use super::progress::Progress;
use super::sizes::Numbers;

#[derive(clap::Args)]
#[command(mut_arg("weights", |weights| weights.required(false).required_unless_present("disparities")))]
pub struct Args {
    #[command(flatten)]
    weights: super::weights::WeightsArgs,
    /// Measure what another program predicted: a .npy file of inverse depths `[frames, height, width]`, up to a factor
    /// (not the sigmoid), one map for each frame in the order of the split.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["weights", "allow_partial", "height", "width", "flip"])]
    disparities: Option<PathBuf>,
    /// Frames to measure on: `street` (with a seed that no run trains on) or a folder: in
    /// the layout of KITTI raw, or (protocol dense) of frames with depth maps, as train takes them, or
    /// in the layout of KITTI 2015, Make3D, DrivingStereo's weather sets or Middlebury 2014.
    #[arg(long, value_name = "street|DIR", default_value = "street")]
    data: String,
    /// List of a folder's frames, lines `FOLDER FRAME SIDE` [default: all].
    #[arg(long, value_name = "FILE")]
    split: Option<PathBuf>,
    /// Which pixels count: dense, eigen, eigen-camera-z, improved.
    #[arg(long, default_value = "dense", value_parser = |s: &str| s.parse::<Protocol>().map_err(|e| e.to_string()))]
    protocol: Protocol,
    /// How predictions get their scale: median, stereo, or a factor.
    #[arg(long, default_value = "median", value_parser = |s: &str| s.parse::<Scale>().map_err(|e| e.to_string()))]
    scale: Scale,
    /// Flip post-processing: predict on the mirrored picture too, and join both.
    #[arg(long)]
    flip: bool,
    /// Numbers in which products are taken; bf16 where the processor has AVX-512 BF16.
    #[arg(long, value_enum, default_value = "f32")]
    precision: Numbers,
    /// Seed of the street.
    #[arg(long, value_name = "N", default_value_t = 3_000_000)]
    seed: u64,
    /// Print one JSON object: what was measured, how, and the metrics of all and of each image.
    ///
    /// weights or disparities, data, split, protocol, scale, flip, precision, height, width (of the predictions), frames, images
    /// (those that were measured), skipped: [{why, frames, first}], abs_rel, sq_rel, rmse, rmse_log, a1, a2, a3,
    /// ratio_median, ratio_std, per_image, without_pixels, without_depth.
    #[arg(long, verbatim_doc_comment)]
    json: bool,
}

/// What predicts.
enum By {
    Network(Box<Predictor>),
    File(Predictions),
}

/// What was measured, and what came out.
#[derive(Serialize)]
struct Measured {
    weights: Option<String>,
    disparities: Option<PathBuf>,
    data: String,
    split: Option<PathBuf>,
    protocol: Protocol,
    scale: String,
    flip: bool,
    precision: Option<Numbers>,
    height: usize,
    width: usize,
    /// All that were looked at: those that were measured, and those that were not.
    frames: usize,
    skipped: Vec<Skipped>,
    #[serde(flatten)]
    report: Report,
}

/// Frames that are in none of the numbers.
#[derive(Serialize)]
struct Skipped {
    why: &'static str,
    frames: usize,
    first: Option<String>,
}

/// The frames that are not in a report, by why.
fn skipped(report: &Report, left_out: &LeftOut) -> Vec<Skipped> {
    let listed = |why, names: &[String]| Skipped { why, frames: names.len(), first: names.first().cloned() };
    let missing = left_out.first_depth.as_ref().map(|path| path.display().to_string());
    let all = [
        Skipped { why: "no ground-truth depth", frames: left_out.without_depth, first: missing },
        listed("no ground-truth depth", &report.without_depth),
        listed("no pixel of the ground truth counts under this protocol", &report.without_pixels),
    ];
    all.into_iter().filter(|skipped| skipped.frames > 0).collect()
}

pub fn run(args: Args) -> Result<()> {
    let (by, (height, width)) = match &args.disparities {
        Some(path) => {
            let found = Predictions::read(path)?;
            let size = found.size;
            (By::File(found), size)
        }
        None => {
            let Weights { model, params, setup, .. } = args.weights.load()?;
            let predictor = Predictor::new(&model, &params, &setup).with_precision(args.precision.checked()?)?;
            (By::Network(Box::new(predictor)), (setup.height, setup.width))
        }
    };
    let (data, left_out) = args.open(height, width)?;
    let mut progress = Progress::new("images", data.len() as u64);
    let how = Evaluation { protocol: args.protocol, scale: args.scale, flip: args.flip };
    let seen = |done| progress.set(done as u64, "");
    let report = match &by {
        By::Network(predictor) => {
            let samples: Vec<usize> = (0..data.len()).collect();
            evaluate(predictor, data.as_ref(), &samples, how, seen)?
        }
        By::File(predictions) => evaluate_predictions(predictions, data.as_ref(), how, seen)?,
    };
    progress.finish();
    let precision = args.disparities.is_none().then_some(args.precision);
    let measured = Measured {
        weights: args.disparities.is_none().then(|| args.weights.name()),
        disparities: args.disparities,
        data: match args.data.as_str() {
            "street" => format!("street of seed {}", args.seed),
            folder => folder.to_owned(),
        },
        split: args.split,
        protocol: args.protocol,
        scale: args.scale.to_string(),
        flip: args.flip,
        precision,
        height,
        width,
        frames: data.len() + left_out.without_depth,
        skipped: skipped(&report, &left_out),
        report,
    };
    if args.json {
        return super::print_json(&measured);
    }
    print(&measured, args.scale);
    Ok(())
}

fn print(measured: &Measured, scale: Scale) {
    let Measured { report, height, width, .. } = measured;
    let flipped = if measured.flip { ", joined with the mirrored picture's" } else { "" };
    let numbers = if measured.precision == Some(Numbers::Bf16) { ", products in bf16" } else { "" };
    match (&measured.weights, &measured.disparities) {
        (_, Some(file)) => say!("file      {}, maps of {width}x{height}", file.display()),
        (weights, None) => {
            say!("weights   {}, maps of {width}x{height}{flipped}{numbers}", weights.as_deref().unwrap_or_default());
        }
    }
    let listed = measured.split.as_ref().map_or_else(String::new, |list| format!(", frames of {}", list.display()));
    say!("data      {}{listed}", measured.data);
    let pixels = match measured.protocol {
        Protocol::Dense => "0.001 to 80 m, the whole picture",
        Protocol::Eigen => "0.001 to 80 m within Garg's crop, the LiDAR's x",
        Protocol::EigenCameraZ => "0.001 to 80 m within Garg's crop, the camera's z",
        Protocol::Improved => "every pixel of the improved ground truth",
    };
    say!("protocol  {}: {pixels}", measured.protocol);
    match scale {
        Scale::Median => say!("scaling   each image by the ratio of the medians"),
        Scale::Stereo => say!("scaling   stereo: times {STEREO_SCALE}"),
        Scale::Factor(factor) => say!("scaling   times {factor}"),
    }
    say!("images    {} of {} frames", report.images, measured.frames);
    for Skipped { why, frames, first } in &measured.skipped {
        let first = first.as_ref().map_or_else(String::new, |first| format!(" (the first: {first})"));
        say!("skipped   {frames}: {why}{first}");
    }
    let m = report.metrics;
    for (name, value) in [
        ("Abs Rel", m.abs_rel),
        ("Sq Rel", m.sq_rel),
        ("RMSE", m.rmse),
        ("RMSE log", m.rmse_log),
        ("a1", m.a1),
        ("a2", m.a2),
        ("a3", m.a3),
    ] {
        say!("{name:9} {value:.4}");
    }
    if let (Some(ratio), Some(std)) = (report.ratio_median, report.ratio_std) {
        say!("scale     median ratio {ratio:.3}, deviation {std:.3}");
    }
}

impl Args {
    /// What is measured on, and which of its frames cannot be.
    fn open(&self, height: usize, width: usize) -> Result<(Box<dyn DataSource>, LeftOut)> {
        if self.data == "street" {
            let street = StreetConfig { height, width, sequences: 8, seed: self.seed, ..StreetConfig::default() };
            return Ok((Box::new(Street::render(&street, None)), LeftOut::default()));
        }
        let root = Path::new(&self.data);
        if self.protocol == Protocol::Dense && root.is_dir() && !is_kitti(root)? {
            let camera = Camera::Fov { degrees: 90.0 };
            if let Some(layout) = Layout::of(root)? {
                let stills = Stills::open(layout, root, self.split.as_deref(), [height, width], camera)?;
                let left_out = stills.left_out().clone();
                return Ok((Box::new(stills), left_out));
            }
            let options = frames::Options { neighbours: false, with_depth: true, camera, ..frames::Options::default() };
            let frames = Frames::open(root, self.split.as_deref(), [height, width], options)?;
            // Every frame of a list has depth, or opening failed.
            let left_out = if self.split.is_some() { LeftOut::default() } else { frames.left_out().clone() };
            return Ok((Box::new(frames), left_out));
        }
        let ground_truth = match self.protocol {
            Protocol::Eigen => GroundTruth::Lidar(DepthAxis::LidarX),
            Protocol::EigenCameraZ => GroundTruth::Lidar(DepthAxis::CameraZ),
            Protocol::Improved | Protocol::Dense => GroundTruth::Improved,
        };
        // Depth is compared pixel by pixel: whichever camera took the pictures.
        let camera = Camera::KittiPublished;
        let options = Options { neighbours: false, ground_truth, camera, ..Options::default() };
        let kitti = Kitti::open(root, self.split.as_deref(), height, width, options)?;
        let left_out = kitti.left_out().clone();
        Ok((Box::new(kitti), left_out))
    }
}
