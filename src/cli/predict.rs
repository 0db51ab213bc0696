//! `parallax predict`.

use std::path::PathBuf;
use std::time::Instant;

use image::RgbImage;
use parallax::camera::Intrinsics;
use parallax::data::film::{is_film, make_film};
use parallax::data::inputs::{Input, find_pictures};
use parallax::data::resize::lanczos;
use parallax::depth::InverseDepth;
use parallax::eval::camera_height::find_ground;
use parallax::eval::metrics::{STEREO_SCALE, median};
use parallax::eval::odometry::Odometry;
use parallax::eval::predictor::Predictor;
use parallax::formats::atomic::check_writable;
use parallax::formats::depth_png::write_depth_png;
use parallax::formats::npy::write_npy;
use parallax::formats::picture::read_picture;
use parallax::formats::ply::write_point_cloud;
use parallax::formats::png::write_png;
use parallax::report::colormap::disparity_to_image;
use parallax::weights::{Need, Weights};
use parallax::{Error, Result};
use serde::Serialize;

use super::film::FilmArgs;
use super::progress::Progress;
use super::sizes::Numbers;

mod outputs;
mod paths;

use outputs::{Job, Outputs, jobs};

#[derive(clap::Args)]
#[command(after_long_help = AFTER)]
pub struct Args {
    #[command(flatten)]
    weights: super::weights::WeightsArgs,
    /// Pictures (PNG, JPEG, WebP), folders of them, or films (mp4, mov, mkv, ...; read by ffmpeg, if installed).
    ///
    /// Of a folder everything below it, frame2 before frame10; hidden files and links to folders are
    /// passed over. Pictures of any size up to 100 megapixels, turned as their EXIF orientation says;
    /// alpha is ignored.
    #[arg(required = true, value_name = "INPUT", verbatim_doc_comment)]
    inputs: Vec<PathBuf>,
    #[command(flatten)]
    film_args: FilmArgs,
    /// Also make a film of every film's maps: FILM_disp.mp4 in the folder for the results.
    #[arg(long, help_heading = "Results")]
    film: bool,
    /// Folder for the results; created if it is missing.
    ///
    /// A picture's results bear its name; those of a folder lie as its pictures do. With several inputs
    /// each folder's results go into a folder of its own name. Two pictures whose results would be the
    /// same file, or that would overwrite a picture, are an error before any work.
    #[arg(long, value_name = "DIR", verbatim_doc_comment)]
    out: PathBuf,
    /// Print one JSON object: what was made of every picture, and what failed.
    ///
    /// weights, height, width (of the network), pictures: [{input, outputs: {disparity, depth,
    /// inverse_depth, points}, width, height, factor, median_depth, seconds}], failed: [{input, error}],
    /// seconds.
    #[arg(long, verbatim_doc_comment)]
    json: bool,
    /// Also NAME_depth.png: 16-bit grey, depth * 256, as KITTI stores it.
    ///
    /// 0 would mean unknown and does not occur; depths beyond 255.996 become 255.996, the largest that fits.
    #[arg(long, help_heading = "Results")]
    depth_png: bool,
    /// Also NAME.npy: inverse depth as 32-bit floats, `[height, width]`.
    #[arg(long, help_heading = "Results")]
    npy: bool,
    /// Also NAME.ply: every pixel as a coloured point; x right, y down, z forward.
    #[arg(long, help_heading = "Results")]
    ply: bool,
    /// Also poses.txt for every folder or film: the camera's path, by the pose network, as `eval --poses` compares it.
    ///
    /// A line for each frame, in order: the rows of [R | C], from its camera to the first one's (x right, y down, z forward),
    /// in the unit of depth. Frames of a folder have to follow one another.
    #[arg(long, help_heading = "Results", conflicts_with = "camera_height")]
    poses: bool,
    /// Leave pictures alone whose results are all there.
    #[arg(long)]
    skip_existing: bool,
    /// Flip post-processing: predict on the mirrored picture too, and join both. Twice the time, better borders.
    #[arg(long, help_heading = "Network")]
    flip: bool,
    /// Numbers in which products are taken; bf16 where the processor has AVX-512 BF16.
    #[arg(long, value_enum, default_value = "f32", help_heading = "Network")]
    precision: Numbers,
    /// Factor that depths are multiplied by [default: 1].
    #[arg(long, value_name = "FACTOR", group = "unit", help_heading = "Scale (one of)", value_parser = above_zero)]
    scale: Option<f64>,
    /// Metres for weights from stereo pairs whose baseline of 0.54 m was called 0.1: --scale 5.4.
    #[arg(long, group = "unit", help_heading = "Scale (one of)")]
    stereo: bool,
    /// Metres by the camera's known height over the road (KITTI: 1.65), for every picture on its own.
    #[arg(long, value_name = "METRES", group = "unit", help_heading = "Scale (one of)", value_parser = above_zero)]
    camera_height: Option<f64>,
    /// Focal lengths and principal point, in pixels of the pictures [default: from --fov].
    #[arg(long, value_name = "FX,FY,CX,CY", group = "camera", help_heading = "Camera (for --ply, --camera-height)")]
    #[arg(value_parser = super::pinhole)]
    intrinsics: Option<[f64; 4]>,
    /// Horizontal field of view in degrees, for square pixels around the middle [default: 81.5, KITTI's].
    #[arg(long, value_name = "DEGREES", group = "camera", help_heading = "Camera (for --ply, --camera-height)")]
    #[arg(value_parser = field_of_view)]
    fov: Option<f64>,
}

const AFTER: &str = "\
What is written:
  NAME_disp.png is there to be looked at: inverse depth in magma, near is bright, from its smallest
  value to its 95th percentile. All other results are numbers, at the picture's own size.

Scale:
  Weights that learnt from one moving camera know depth up to a factor. --camera-height finds it on
  the road: every pixel of the prediction has a tangent plane; where that is level to 5 degrees it is
  ground, and the median distance of these planes from the camera is the camera's height h in the
  prediction's unit. Depths are multiplied by METRES / h. The camera has to be held level and to see
  the road: a picture of which less than a hundredth is level fails. --json says the factor of each
  picture; for the frames of one video their median, given as --scale, is steadier.

Camera:
  Without --intrinsics or --fov it is KITTI's: a focal length of 0.58 of the width. With another lens
  points lie too far to the sides or too little, and --camera-height is off by the same ratio.

Exit status:
  0 all pictures are done; 1 something failed: what, is said on standard error, and the other
  pictures are done; 2 wrong usage.

Examples:
  parallax predict --weights runs/1 pictures/ --out depth/
  parallax predict --weights runs/1 drive/ --out depth/ --camera-height 1.65 --ply --depth-png
  parallax predict --weights runs/1 phone.jpg --out depth/ --ply --fov 67 --flip";

fn above_zero(text: &str) -> Result<f64, String> {
    let number = text.parse::<f64>().ok().filter(|x| *x > 0.0 && x.is_finite());
    number.ok_or_else(|| "expected a number above 0".to_owned())
}

fn field_of_view(text: &str) -> Result<f64, String> {
    let number = text.parse::<f64>().ok().filter(|x| (1.0..=175.0).contains(x));
    number.ok_or_else(|| "expected degrees from 1 to 175".to_owned())
}

/// What was done, as JSON.
#[derive(Serialize)]
struct Summary {
    weights: String,
    /// The size at which the network saw the pictures.
    height: usize,
    width: usize,
    pictures: Vec<Done>,
    failed: Vec<Failure>,
    seconds: f64,
}

#[derive(Serialize)]
struct Done {
    input: String,
    outputs: Outputs,
    width: usize,
    height: usize,
    /// What depths were multiplied by.
    factor: f64,
    /// The median of the depths, after that.
    median_depth: f64,
    seconds: f64,
}

#[derive(Serialize)]
struct Failure {
    input: String,
    error: String,
}

pub fn run(args: Args) -> Result<()> {
    let started = Instant::now();
    let inputs = args.film_args.folders(&args.inputs)?;
    let films = films(&args, &inputs)?;
    let found = find_pictures(&inputs, &args.out)?;
    tell_skipped(&found.skipped);
    let jobs = jobs(found.pictures, &args)?;
    let maps: Vec<(PathBuf, PathBuf)> = match args.film {
        true => jobs.iter().map(|job| (job.input.path.clone(), job.outputs.disparity.clone())).collect(),
        false => Vec::new(),
    };
    let paths = if args.poses { paths::of(&jobs, &args.out)? } else { Vec::new() };
    let (jobs, there) = left_to_do(jobs, args.skip_existing);
    let need = if args.poses { Need::All } else { Need::Depth };
    let Weights { model, params, setup, .. } = args.weights.load_with(need)?;
    let made = !args.out.exists();
    check_writable(&args.out)?;
    let predictor = Predictor::new(&model, &params, &setup).with_precision(args.precision.checked()?)?;
    let size = (setup.height, setup.width);
    let mut progress = Progress::new("pictures", jobs.len() as u64);
    let (mut done, mut failed) = (Vec::new(), Vec::new());
    for (i, job) in jobs.into_iter().enumerate() {
        let input = job.input.path.to_string_lossy().into_owned();
        // The rest of a folder still gets done; the exit status says that something was not.
        match predict(&args, &predictor, job, size) {
            Ok(picture) => done.push(picture),
            Err(error) => {
                progress.say(&format!("parallax: {error}"));
                failed.push(Failure { input, error: error.to_string() });
            }
        }
        progress.set(i as u64 + 1, "");
    }
    progress.finish();
    if args.camera_height.is_some()
        && done.len() > 1
        && let Some(factor) = median(done.iter().map(|picture| picture.factor).collect())
    {
        note!("the median factor is {factor:.3}: --scale {factor:.3} gives all pictures the same");
    }
    let odometry = Odometry::new(&model, &params, &setup);
    for path in &paths {
        if let Err(error) = path.write(&odometry, args.factor_of_all()) {
            note!("parallax: {error}");
            failed.push(Failure { input: path.file.to_string_lossy().into_owned(), error: error.to_string() });
        }
    }
    for (folder, film) in &films {
        let of_film = maps.iter().filter(|(picture, map)| picture.starts_with(folder) && map.is_file());
        make_film(&of_film.map(|(_, map)| map.clone()).collect::<Vec<_>>(), args.film_args.rate(), film)?;
        note!("the maps as a film: {}", film.display());
    }
    let (all, failures) = (done.len() + failed.len(), failed.len());
    if args.json {
        let (weights, seconds) = (args.weights.name(), started.elapsed().as_secs_f64());
        super::print_json(&Summary { weights, height: size.0, width: size.1, pictures: done, failed, seconds })?;
    }
    // A folder that was made for nothing; if it cannot go, what matters is said already.
    if made && failures == all {
        let _ = std::fs::remove_dir(&args.out);
    }
    let kept = if there > 0 { format!(", {there} were there already") } else { String::new() };
    note!("{} of {} pictures done{kept}; the results are in {}", all - failures, all + there, args.out.display());
    match failures {
        0 => Ok(()),
        n => Err(Error::Failed(format!("{n} of {all} pictures could not be done (see above)"))),
    }
}

/// The films to be made of maps: of which folder of frames, and where.
fn films(args: &Args, folders: &[PathBuf]) -> Result<Vec<(PathBuf, PathBuf)>> {
    if !args.film {
        return Ok(Vec::new());
    }
    let films = args.inputs.iter().zip(folders).filter(|(film, _)| is_film(film));
    let made = films.map(|(film, folder)| {
        let mut name = film.file_stem().unwrap_or_default().to_owned();
        name.push("_disp.mp4");
        (folder.clone(), args.out.join(name))
    });
    match made.collect::<Vec<_>>() {
        none if none.is_empty() => Err(Error::setting("--film", "makes films of films, and none is given")),
        films => Ok(films),
    }
}

/// The pictures whose results are not all there, and how many are, if those are to be left alone.
fn left_to_do(jobs: Vec<Job>, skip_existing: bool) -> (Vec<Job>, usize) {
    let all = jobs.len();
    let left: Vec<Job> = jobs.into_iter().filter(|job| !(skip_existing && job.outputs.exist())).collect();
    let there = all - left.len();
    (left, there)
}

/// Names the files of folders that are no pictures.
fn tell_skipped(skipped: &[PathBuf]) {
    if skipped.is_empty() {
        return;
    }
    let first: Vec<String> = skipped.iter().take(5).map(|path| path.display().to_string()).collect();
    let more = if skipped.len() > first.len() { ", ..." } else { "" };
    note!("{} files are no PNG, JPEG or WebP and are passed over: {}{more}", skipped.len(), first.join(", "));
}

fn predict(args: &Args, predictor: &Predictor, job: Job, (height, width): (usize, usize)) -> Result<Done> {
    let started = Instant::now();
    let picture = read_picture(&job.input.path)?;
    let (w, h) = (picture.width() as usize, picture.height() as usize);
    let camera = args.camera(w as f64, h as f64);
    let seen = lanczos(&picture, width as u32, height as u32);
    let map = predictor.inverse_depth(&seen, args.flip);
    if !map.is_whole() {
        return Err(Error::file(&job.input.path, predictor.why_not_finite(&seen)));
    }
    let factor = args.factor(&job.input, &map.values, (height, width), camera)?;
    let median_depth = median(map.values.iter().map(|&d| factor / f64::from(d)).collect()).unwrap_or(f64::NAN);
    write(&job.outputs, &picture, &map.resized(h, w, factor), camera)?;
    let input = job.input.path.to_string_lossy().into_owned();
    let seconds = started.elapsed().as_secs_f64();
    Ok(Done { input, outputs: job.outputs, width: w, height: h, factor, median_depth, seconds })
}

/// Writes what is wanted of a picture's inverse depth.
fn write(outputs: &Outputs, picture: &RgbImage, inverse: &InverseDepth, camera: Intrinsics) -> Result<()> {
    let (height, width) = inverse.size();
    write_png(&outputs.disparity, &disparity_to_image(&inverse.values, width, height))?;
    if let Some(path) = &outputs.inverse_depth {
        write_npy(path, &inverse.values, height, width)?;
    }
    if outputs.depth.is_none() && outputs.points.is_none() {
        return Ok(());
    }
    let depth = inverse.depth().as_if_metres();
    if let Some(path) = &outputs.depth {
        write_depth_png(path, &depth)?;
    }
    if let Some(path) = &outputs.points {
        write_point_cloud(path, &depth, picture, camera)?;
    }
    Ok(())
}

impl Args {
    /// The camera of a picture of `width x height` pixels.
    fn camera(&self, width: f64, height: f64) -> Intrinsics {
        let [fx, fy, cx, cy] = self.intrinsics.unwrap_or_else(|| {
            // Half the width over the tangent of half the view.
            let focal = self.fov.map_or(Intrinsics::KITTI.fx, |fov| 0.5 / (fov / 2.0).to_radians().tan()) * width;
            [focal, focal, (width - 1.0) / 2.0, (height - 1.0) / 2.0]
        });
        Intrinsics { fx: fx / width, fy: fy / height, cx: cx / width, cy: cy / height }
    }

    /// Factor on all depths, where pictures have no factor of their own.
    fn factor_of_all(&self) -> f64 {
        if self.stereo { STEREO_SCALE } else { self.scale.unwrap_or(1.0) }
    }

    /// What a picture's depths are multiplied by; `map` is its inverse depth as predicted.
    fn factor(&self, input: &Input, map: &[f32], size: (usize, usize), camera: Intrinsics) -> Result<f64> {
        let Some(metres) = self.camera_height else { return Ok(self.factor_of_all()) };
        let ground = find_ground(map, size, camera).ok_or_else(|| {
            let message = "no road was found to measure the camera's height over: give --scale instead, or the \
                           camera's --intrinsics or --fov if it is not KITTI's";
            Error::file(&input.path, message)
        })?;
        Ok(metres / ground.camera_height)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_from_the_command_line_are_checked() {
        assert_eq!(super::super::pinhole("721.5, 722,609,172.8"), Ok([721.5, 722.0, 609.0, 172.8]));
        for wrong in ["", "1,2,3", "1,2,3,4,5", "0,1,2,3", "1,-1,2,3", "1,2,nan,3", "a,b,c,d"] {
            assert!(super::super::pinhole(wrong).is_err(), "{wrong}");
        }
        assert_eq!(above_zero("1.65"), Ok(1.65));
        for wrong in ["0", "-1", "nan", "inf", "x"] {
            assert!(above_zero(wrong).is_err(), "{wrong}");
        }
        assert!(field_of_view("67").is_ok() && field_of_view("0").is_err() && field_of_view("180").is_err());
    }

    #[derive(clap::Parser)]
    struct Command {
        #[command(flatten)]
        args: Args,
    }

    fn args(more: &[&str]) -> Args {
        let all = ["predict", "--weights", "w", "a.png", "--out", "o"].iter().chain(more);
        <Command as clap::Parser>::try_parse_from(all).map(|command| command.args).unwrap()
    }

    #[test]
    fn every_flag_of_the_scale_gives_its_factor() {
        let input = Input { path: "a.png".into(), name: "a".into() };
        let size = (24, 80);
        // A road: inverse depth grows with the row below the horizon. Its camera hangs half a unit above it.
        let road: Vec<f32> =
            (0..24 * 80).map(|i| (((i / 80) as f64 - 11.5) / (80.0 * 0.58) / 0.5).max(0.01) as f32).collect();
        let factor = |more: &[&str]| {
            let args = args(more);
            args.factor(&input, &road, size, args.camera(80.0, 24.0))
        };
        assert_eq!(factor(&[]).unwrap(), 1.0);
        assert_eq!(factor(&["--scale", "2.5"]).unwrap(), 2.5);
        assert_eq!(factor(&["--stereo"]).unwrap(), 5.4);
        let found = factor(&["--camera-height", "1.65"]).unwrap();
        assert!((found / 3.3 - 1.0).abs() < 0.01, "{found}");
        // With a longer lens the same rows lie nearer to the horizon: the camera hangs lower.
        let longer = factor(&["--camera-height", "1.65", "--intrinsics", "92.8,92.8,39.5,11.5"]).unwrap();
        assert!((longer / 6.6 - 1.0).abs() < 0.02, "{longer}");
        let nowhere = args(&["--camera-height", "1.65"]);
        let error = nowhere.factor(&input, &vec![0.1; 24 * 80], size, nowhere.camera(80.0, 24.0)).unwrap_err();
        assert!(error.to_string().contains("a.png: no road"), "{error}");
    }

    #[test]
    fn the_camera_is_kittis_unless_given() {
        let close = |a: Intrinsics, b: Intrinsics, by: f64| {
            let pairs = [(a.fx, b.fx), (a.fy, b.fy), (a.cx, b.cx), (a.cy, b.cy)];
            assert!(pairs.iter().all(|(a, b)| (a / b - 1.0).abs() < by), "{a:?} {b:?}");
        };
        // The published constants are those of KITTI's pictures, up to half a pixel.
        close(args(&[]).camera(1242.0, 375.0), Intrinsics::KITTI, 4e-3);
        close(args(&["--fov", "81.5"]).camera(640.0, 480.0), args(&[]).camera(640.0, 480.0), 1e-3);
        let given = args(&["--intrinsics", "700,710,600,170"]).camera(1000.0, 500.0);
        close(given, Intrinsics { fx: 0.7, fy: 1.42, cx: 0.6, cy: 0.34 }, 1e-12);
    }
}
