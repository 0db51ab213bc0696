//! `parallax eval`.

use std::path::{Path, PathBuf};

use parallax::Result;
use parallax::data::Dataset;
use parallax::data::kitti::{Camera, DepthAxis, GroundTruth, Kitti, Options};
use parallax::eval::metrics::{Protocol, Scale};
use parallax::eval::predictor::{Evaluation, Predictor, evaluate};
use parallax::street::{Street, StreetConfig};
use parallax::weights::Weights;

use super::progress::Progress;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    weights: super::weights::WeightsArgs,
    /// What to measure on: `street` (of a seed that no run trains on) or a folder in the layout of KITTI raw.
    #[arg(long, value_name = "street|DIR", default_value = "street")]
    data: String,
    /// The frames of a folder: lines `FOLDER FRAME SIDE`. All of them, without.
    #[arg(long, value_name = "FILE")]
    split: Option<PathBuf>,
    /// Which pixels count: dense, eigen, eigen-camera-z, improved.
    #[arg(long, default_value = "dense", value_parser = |s: &str| s.parse::<Protocol>().map_err(|e| e.to_string()))]
    protocol: Protocol,
    /// How predictions get their scale: median, stereo, or a factor.
    #[arg(long, default_value = "median", value_parser = |s: &str| s.parse::<Scale>().map_err(|e| e.to_string()))]
    scale: Scale,
    /// Predict on the mirrored picture too, and join both.
    #[arg(long)]
    flip: bool,
    /// Seed of the street.
    #[arg(long, value_name = "N", default_value_t = 3_000_000)]
    seed: u64,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

pub fn run(args: Args) -> Result<()> {
    let Weights { model, params, setup, .. } = args.weights.load()?;
    let (height, width) = (setup.height, setup.width);
    let data: Box<dyn Dataset> = if args.data == "street" {
        let street = StreetConfig { height, width, sequences: 8, seed: args.seed, ..StreetConfig::default() };
        Box::new(Street::render(&street, None))
    } else {
        let ground_truth = match args.protocol {
            Protocol::Eigen => GroundTruth::Lidar(DepthAxis::LidarX),
            Protocol::EigenCameraZ => GroundTruth::Lidar(DepthAxis::CameraZ),
            Protocol::Improved | Protocol::Dense => GroundTruth::Improved,
        };
        // Depth is compared pixel by pixel: whichever camera took the pictures.
        let camera = Camera::KittiPublished;
        let options = Options { neighbours: false, ground_truth, camera, ..Options::default() };
        Box::new(Kitti::open(Path::new(&args.data), args.split.as_deref(), height, width, options)?)
    };
    let samples: Vec<usize> = (0..data.len()).collect();
    let predictor = Predictor::new(&model, &params, &setup);
    let mut progress = Progress::new("images", samples.len() as u64);
    let how = Evaluation { protocol: args.protocol, scale: args.scale, flip: args.flip };
    let report = evaluate(&predictor, data.as_ref(), &samples, how, |done| progress.set(done as u64, ""))?;
    progress.finish();
    if args.json {
        return super::print_json(&report);
    }
    let m = report.metrics;
    say!("images    {}", report.images);
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
    Ok(())
}
