//! `parallax eval`.

use std::path::PathBuf;

use parallax::Result;
use parallax::eval::predictions::Predictions;
use parallax::eval::predictor::{Evaluation, Predictor, evaluate, evaluate_predictions};
use parallax::eval::protocol::Protocol;
use parallax::eval::scale::Scale;
use parallax::weights::Weights;

use super::progress::Progress;
use super::sizes::Numbers;
use measured::{Measured, skipped};

mod measured;
mod source;

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
    /// the layout of KITTI raw, or (where the protocol is not KITTI's) of frames with depth maps, as train takes them.
    #[arg(long, value_name = "street|DIR", default_value = "street")]
    data: String,
    /// List of a folder's frames, lines `FOLDER FRAME SIDE` [default: all].
    #[arg(long, value_name = "FILE")]
    split: Option<PathBuf>,
    /// Which pixels count, against which ground truth.
    ///
    /// dense              0.001 to 80 m, the whole picture: truth without holes
    /// eigen              within Garg's crop; LiDAR scans, whose x is the depth (the tables of the literature)
    /// eigen-camera-z     the same, the camera's z is the depth
    /// improved           every pixel of KITTI's improved ground truth
    /// projected          as eigen, scans projected beforehand: DRIVE/proj_depth/velodyne/image_02/FRAME.npz
    /// make3d             C1: up to 70 m, rows 17 to 38 of the grid's 55, log10; the picture is its central 2:1
    /// drivingstereo      every pixel, no crop; drivingstereo-garg: within Garg's crop
    /// kitti2015          every pixel, no crop
    /// middlebury         every pixel, no crop
    /// cityscapes         0.001 to 80 m, rows 256 to 768, columns 192 to 1856
    #[arg(long, verbatim_doc_comment, default_value = "dense")]
    #[arg(value_parser = |s: &str| s.parse::<Protocol>().map_err(|e| e.to_string()))]
    protocol: Protocol,
    /// How predictions get their scale: median (of each image's ground truth), stereo (times 5.4), camera-height (what
    /// makes the camera hang 1.65 m over the road that is seen; camera-height=METRES for another), or a factor.
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
    /// ratio_median, ratio_std, per_image, without_pixels, without_depth, without_scale.
    #[arg(long, verbatim_doc_comment)]
    json: bool,
}

/// What predicts.
enum By {
    Network(Box<Predictor>),
    File(Predictions),
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
    let (data, left_out) = source::open(&args, height, width)?;
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
        scale: args.scale,
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
    measured.print();
    Ok(())
}
