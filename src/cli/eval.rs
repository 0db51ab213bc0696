//! `parallax eval`.

use std::path::PathBuf;

use parallax::data::DataSource;
use parallax::data::kitti::LeftOut;
use parallax::eval::breakdown::BINS;
use parallax::eval::csv;
use parallax::eval::evaluate::{ByNetwork, Evaluation, Predicts};
use parallax::eval::folder::{Holds, PredictionFolder};
use parallax::eval::predictions::Predictions;
use parallax::eval::predictor::Predictor;
use parallax::eval::protocol::Protocol;
use parallax::eval::scale::Scale;
use parallax::eval::study::{Settings, study};
use parallax::formats::atomic::write_bytes_atomically;
use parallax::train::data::is_rendered;
use parallax::weights::Weights;
use parallax::{Error, Result};

use super::progress::Progress;
use super::sizes::Numbers;
use measured::{Measured, One};

mod measured;
mod poses;
mod sheets;
mod source;

#[derive(clap::Args)]
#[command(mut_arg("weights", |weights| {
    weights.num_args(1..).help(
        "Weights: a run's folder (its best weights), a file (.safetensors, .pth, .npz), or a folder with encoder.pth, \
         depth.pth, ...; `shipped`: those inside the program; several networks (A B C) are set beside each other, the \
         others less the first",
    )
}))]
pub struct Args {
    #[command(flatten)]
    weights: super::weights::WeightsArgs,
    /// Measure what another program predicted: a .npy file of inverse depths `[frames, height, width]`, up to a factor
    /// (not the sigmoid), one map for each frame in the order of the split.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["weights", "allow_partial", "height", "width", "flip"])]
    disparities: Option<PathBuf>,
    /// Measure what another program predicted: a folder of depth maps, matched with the frames by their names:
    /// 16-bit PNGs of metres times 256, .npy `[height, width]` or .pfm; `_depth` may stand before the ending.
    ///
    /// KITTI raw: FOLDER/image_02/data/0000000005.png, or without data/; other folders: as the frames. What `predict`
    /// writes for the same folder fits.
    #[arg(long, value_name = "DIR")]
    #[arg(conflicts_with_all = ["weights", "disparities", "allow_partial", "height", "width", "flip"])]
    predictions: Option<PathBuf>,
    /// The .npy and .pfm files of --predictions hold inverse depth, as `predict --npy` writes it [default: depth].
    #[arg(long, requires = "predictions")]
    inverse: bool,
    /// Pass over files of --predictions that are of no frame that is measured [default: they are an error].
    #[arg(long, requires = "predictions")]
    ignore_extra: bool,
    /// Compare trajectories instead: the true poses, twelve numbers a line (the rows of [R | C]) as KITTI odometry's
    /// poses/09.txt.
    ///
    /// Five-frame error (mean of sqrt(sum of squares) / 5), ATE after a similarity (Umeyama), KITTI's segment errors;
    /// --plot draws both from above.
    #[arg(long, value_name = "FILE", requires = "trajectory")]
    #[arg(conflicts_with_all = ["weights", "disparities", "predictions", "split", "flip", "csv", "sheets", "details"])]
    poses: Option<PathBuf>,
    /// The predicted poses to compare with --poses, in the same form, one for each frame.
    #[arg(long, value_name = "FILE", requires = "poses")]
    trajectory: Option<PathBuf>,
    /// Frames to measure on: `street` or `street-2` (with a seed that no run trains on) or a folder: in
    /// the layout of KITTI raw, or (where the protocol is not KITTI's) of frames with depth maps, as train takes them, or
    /// in the layout of Cityscapes' video, KITTI 2015, Make3D, DrivingStereo's weather sets or Middlebury 2014.
    #[arg(long, value_name = "street|street-2|DIR", default_value = "street")]
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
    /// Seed of the street, and of the draws for intervals.
    #[arg(long, value_name = "N", default_value_t = 3_000_000)]
    seed: u64,
    /// How often images are drawn again for the 95 % intervals of the means (percentile bootstrap; whole sequences
    /// where there are several); 0: no intervals.
    #[arg(long, value_name = "N", default_value_t = 1000, help_heading = "More than a mean")]
    bootstrap: usize,
    /// Where bins of true distance begin, in metres, with commas [default: 0,5,10,20,30,40,60,80].
    #[arg(long, value_name = "METRES", value_delimiter = ',', help_heading = "More than a mean")]
    bins: Option<Vec<f64>>,
    /// Also print errors by distance, by ninths of the picture, and by sequence.
    #[arg(long, help_heading = "More than a mean")]
    details: bool,
    /// Write the metrics of every image into a table of comma-separated values.
    #[arg(long, value_name = "FILE", help_heading = "More than a mean")]
    csv: Option<PathBuf>,
    /// Draw the ten images with the largest Abs Rel (of the first weights) into a folder: 01.png the worst.
    ///
    /// Each with its picture, predicted and true depth in one scale of colours, and relative error.
    #[arg(long, value_name = "DIR", help_heading = "More than a mean")]
    sheets: Option<PathBuf>,
    /// Draw Abs Rel by distance (of trajectories, both from above), as SVG.
    #[arg(long, value_name = "FILE", help_heading = "More than a mean")]
    plot: Option<PathBuf>,
    /// Print one JSON object: what was measured, how, and the metrics of all and of each image.
    ///
    /// weights, disparities or predictions, data, split, protocol, scale, flip, precision, height, width (of the predictions), frames, images
    /// (those that were measured), skipped: [{why, frames, first}], abs_rel, sq_rel, rmse, rmse_log, a1, a2, a3,
    /// ratio_median, ratio_std, per_image, without_pixels, without_depth, without_scale,
    /// sequences (of each image), interval: {unit, units, replicates, low, high}, distances, regions, sets, others (further
    /// weights: the same, and their difference from the first).
    #[arg(long, verbatim_doc_comment)]
    json: bool,
}

/// What predicts.
enum By {
    Network(Box<Predictor>),
    File(Predictions),
    Folder(PathBuf),
}

/// The size at which pictures are shown of which a folder holds the predictions.
const SHOWN: (usize, usize) = (192, 640);

/// Something that predicts, and what it is called.
struct Candidate {
    name: String,
    by: By,
    height: usize,
    width: usize,
}

pub fn run(args: Args) -> Result<()> {
    if let (Some(truth), Some(predicted)) = (&args.poses, &args.trajectory) {
        return poses::run(&args, truth, predicted);
    }
    let settings =
        Settings { bins: args.bins.clone().unwrap_or(BINS.to_vec()), replicates: args.bootstrap, seed: args.seed };
    let mut found: Vec<One> = Vec::new();
    let mut left_out = LeftOut::default();
    for weights in args.weights.each() {
        let candidate = args.candidate(&weights)?;
        let (height, width) = (candidate.height, candidate.width);
        if let Some(first) = found.first().filter(|first| (first.height, first.width) != (height, width))
            && is_rendered(&args.data)
        {
            let message = format!(
                "{} sees pictures of {height}x{width}, {} of {}x{}: give --height and --width, so that both see one street",
                candidate.name, first.name, first.height, first.width
            );
            return Err(Error::setting("weights", message));
        }
        let (data, lacking) = source::open(&args, height, width)?;
        left_out = lacking;
        let (by, (height, width)) = candidate.predicts(&args, data.as_ref())?;
        let mut progress = Progress::new("images", data.len() as u64);
        let how = args.evaluation();
        let study = study(by.as_ref(), data.as_ref(), how, &settings, |done| progress.set(done as u64, ""))?;
        progress.finish();
        if let (Some(folder), true) = (&args.sheets, found.is_empty()) {
            let written = sheets::write_worst(folder, &study, by.as_ref(), data.as_ref(), how)?;
            note!("{} sheets of the worst images are in {}", written.len(), folder.display());
        }
        let (frames, name) = (data.len() + left_out.without_depth, candidate.name.clone());
        let difference = found.first().and_then(|first: &One| study.less(&first.study, &settings));
        found.push(One { name, height, width, frames, study, difference });
    }
    let measured = Measured::new(&args, found, &left_out);
    if let Some(path) = &args.csv {
        csv::write(path, &measured.studies())?;
    }
    if let Some(path) = &args.plot {
        write_bytes_atomically(path, measured.plot().svg().as_bytes())?;
    }
    if args.json {
        return super::print_json(&measured);
    }
    measured.print(args.details);
    Ok(())
}

impl Args {
    fn evaluation(&self) -> Evaluation {
        Evaluation { protocol: self.protocol, scale: self.scale, flip: self.flip }
    }

    /// The source of predictions: another program's file, or these weights.
    fn candidate(&self, weights: &super::weights::WeightsArgs) -> Result<Candidate> {
        if let Some(path) = &self.disparities {
            let found = Predictions::read(path)?;
            let (height, width) = found.size;
            return Ok(Candidate { name: path.display().to_string(), by: By::File(found), height, width });
        }
        if let Some(folder) = &self.predictions {
            if is_rendered(&self.data) {
                let message = "the street's frames have no files to match: write it with `data street --out DIR`, and give \
                               --data DIR";
                return Err(Error::setting("predictions", message));
            }
            let (height, width) = SHOWN;
            return Ok(Candidate { name: folder.display().to_string(), by: By::Folder(folder.clone()), height, width });
        }
        let Weights { model, params, setup, .. } = weights.load()?;
        let predictor = Predictor::new(&model, &params, &setup).with_precision(self.precision.checked()?)?;
        let by = By::Network(Box::new(predictor));
        Ok(Candidate { name: weights.name(), by, height: setup.height, width: setup.width })
    }
}

impl Candidate {
    /// The predictor for the frames of some data, and the rows and columns of its maps (of a folder, its first one's).
    fn predicts<'a>(&'a self, args: &Args, data: &dyn DataSource) -> Result<(Box<dyn Predicts + 'a>, (usize, usize))> {
        let size = (self.height, self.width);
        match &self.by {
            By::Network(predictor) => Ok((Box::new(ByNetwork { predictor, flip: args.flip }), size)),
            By::File(predictions) => {
                predictions.check(data.len())?;
                Ok((Box::new(predictions), size))
            }
            By::Folder(folder) => {
                let holds = if args.inverse { Holds::InverseDepth } else { Holds::Depth };
                let found = PredictionFolder::open(folder, data, holds, args.ignore_extra)?;
                if !found.extra().is_empty() {
                    note!("{} predictions are of other frames and are passed over", found.extra().len());
                }
                let (_, size) = found.inverse_depth(data, 0)?;
                Ok((Box::new(found), size))
            }
        }
    }
}
