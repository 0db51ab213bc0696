//! `parallax predict`.

use std::path::{Path, PathBuf};
use std::time::Instant;

use image::RgbImage;
use parallax::camera::Intrinsics;
use parallax::data::film::{is_film, make_film};
use parallax::data::inputs::find_pictures;
use parallax::data::resize::lanczos;
use parallax::depth::InverseDepth;
use parallax::eval::metrics::median;
use parallax::eval::odometry::Odometry;
use parallax::eval::predictor::Predictor;
use parallax::formats::atomic::check_writable;
use parallax::formats::depth_png::write_depth_png;
use parallax::formats::npy::write_npy;
use parallax::formats::picture::read_picture_with_lens;
use parallax::formats::ply::write_point_cloud;
use parallax::formats::png::write_png;
use parallax::report::colormap::disparity_to_image;
use parallax::weights::{Need, Origin, Weights};
use parallax::{Error, Result};
use serde::Serialize;

use super::film::FilmArgs;
use super::lens::{self, Flags, Lens, Told};
use super::progress::Progress;
use super::sizes::Numbers;

mod outputs;
mod paths;
mod scale;

use outputs::{Job, Outputs, jobs};
use scale::Scaling;

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
    #[arg(long, value_name = "DIR", default_value = "depth", verbatim_doc_comment)]
    out: PathBuf,
    /// Print one JSON object: what was made of every picture, and what failed.
    ///
    /// weights, trained_on (words, or null), height, width (of the network), unit ("metres" or
    /// "relative"), pictures: [{input, outputs: {disparity, depth, inverse_depth, points}, width, height,
    /// view (across, in degrees), view_by ("flag", "camera_toml", "exif" or "assumed"), factor,
    /// median_depth, doubt (words, or null), seconds}], failed: [{input, error}], seconds (since the
    /// program began).
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
    /// Factor that depths are multiplied by [default: what makes metres, where the weights say it; otherwise 1].
    #[arg(long, value_name = "FACTOR", group = "unit", help_heading = "Scale (one of)", value_parser = above_zero)]
    scale: Option<f64>,
    /// Metres for weights from stereo pairs whose baseline of 0.54 m was called 0.1: --scale 5.4.
    #[arg(long, group = "unit", help_heading = "Scale (one of)")]
    stereo: bool,
    /// Metres by the camera's known height over the road (KITTI: 1.65), for every picture on its own.
    #[arg(long, value_name = "METRES", group = "unit", help_heading = "Scale (one of)", value_parser = above_zero)]
    camera_height: Option<f64>,
    /// Focal lengths and principal point, in pixels of the pictures [default: see Camera below].
    #[arg(long, value_name = "FX,FY,CX,CY", group = "camera", help_heading = CAMERA)]
    #[arg(value_parser = super::pinhole)]
    intrinsics: Option<[f64; 4]>,
    /// Horizontal field of view in degrees, for square pixels around the middle [default: see Camera below].
    #[arg(long, value_name = "DEGREES", group = "camera", help_heading = CAMERA)]
    #[arg(value_parser = field_of_view)]
    fov: Option<f64>,
}

/// Where the camera counts.
const CAMERA: &str = "Camera (for metres, --ply, --camera-height)";

const AFTER: &str = "\
Weights:
  Without --weights, those inside the program. They learnt depth from nothing but streets that this
  program renders, by watching and from their known depth; the first line of the output says which
  network they are and what it was trained on. They know a road seen from a car, with houses, trees and parked cars at its
  sides. A picture of anything else (a room, a face, a lawn) gets a map all the same: what the
  network makes of it, which may be nonsense. Nothing checks whether a picture shows a street.

Pictures of any size:
  The network sees every picture stretched to its own size, whatever the aspect (the shipped one:
  320x96), and its map is stretched back. It is best at what looks as a road does there: the horizon
  near the middle. Pictures much wider or taller than that, or of a few pixels, are done and named.

What is written:
  NAME_disp.png is there to be looked at: inverse depth in magma, near is bright, from its smallest
  value to its 95th percentile. All other results are numbers, at the picture's own size.

Scale:
  Shipped weights speak in metres for a camera that hangs 1.65 m above the road, as their training's
  did; at twice the height true depths are twice as large. Metres are corrected for the view across,
  by exponents that were measured on rendered streets (what looks the same through a longer lens is
  further away). With another --height or --width than the network's own, depths have no unit.
  Other weights that learnt from one moving camera know depth up to a factor. --camera-height finds it
  on the road: every pixel of the prediction has a tangent plane; where that is level to 5 degrees it is
  ground, and the median distance of these planes from the camera is the camera's height h in the
  prediction's unit. Depths are multiplied by METRES / h. The camera has to be held level and to see
  the road: a picture of which less than a hundredth is level fails. --json says the factor of each
  picture; for the frames of one video their median, given as --scale, is steadier.

Camera:
  The first of these that is there: --intrinsics or --fov; a camera.toml in the picture's folder or one
  above it up to the input (fov, or width, height, fx, fy, cx, cy in pixels); the focal length in the
  picture's EXIF data, unless it was cut to another aspect since; KITTI's, a view of 81.5 degrees across.
  With the wrong lens points lie too far to the sides or too little, and metres are off.

Exit status:
  0 all pictures are done; 1 something failed: what, is said on standard error, and the other
  pictures are done; 2 wrong usage.

Examples:
  parallax predict photo.jpg
  parallax predict phone.jpg --fov 67 --depth-png --ply
  parallax predict --weights runs/1 pictures/ --out depth/
  parallax predict --weights runs/1 drive/ --out depth/ --camera-height 1.65 --ply --depth-png
  parallax predict --weights runs/1 phone.jpg --out depth/ --ply --fov 67 --flip";

fn above_zero(text: &str) -> Result<f64, String> {
    let number = text.parse::<f64>().ok().filter(|x| *x > 0.0 && x.is_finite());
    number.ok_or_else(|| "expected a number above 0".to_owned())
}

pub(super) fn field_of_view(text: &str) -> Result<f64, String> {
    let number = text.parse::<f64>().ok().filter(|x| (1.0..=175.0).contains(x));
    number.ok_or_else(|| "expected degrees from 1 to 175".to_owned())
}

impl Args {
    /// The camera of a picture of a size, `[width, height]`, whose EXIF data tell a focal length of `focal` pixels.
    fn lens(&self, picture: &Path, size: [f64; 2], focal: Option<f64>) -> Result<Lens> {
        Flags { intrinsics: self.intrinsics, fov: self.fov }.lens(&self.inputs, picture, size, focal)
    }
}

/// What was done, as JSON.
#[derive(Serialize)]
struct Summary {
    weights: String,
    trained_on: Option<String>,
    /// The size at which the network saw the pictures.
    height: usize,
    width: usize,
    unit: &'static str,
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
    /// The camera's view across in degrees, and who told it.
    view: f64,
    view_by: Told,
    /// What depths were multiplied by.
    factor: f64,
    /// The median of the depths, after that.
    median_depth: f64,
    /// Why little is to be expected of this picture.
    doubt: Option<String>,
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
    let Weights { model, params, setup, origin, .. } = args.weights.load_with(need)?;
    let scaling = Scaling::new(&args, origin.as_ref());
    scaling.tell(&args.weights, &setup, params.count(""));
    let made = !args.out.exists();
    check_writable(&args.out)?;
    let predictor = Predictor::new(&model, &params, &setup).with_precision(args.precision.checked()?)?;
    let mut progress = Progress::new("pictures", jobs.len() as u64);
    let (mut done, mut failed) = (Vec::new(), Vec::new());
    for (i, job) in jobs.into_iter().enumerate() {
        let input = job.input.path.to_string_lossy().into_owned();
        // The rest of a folder still gets done; the exit status says that something was not.
        match predict(&args, &predictor, job, &scaling) {
            Ok(picture) => {
                if let Some(doubt) = &picture.doubt {
                    progress.say(&format!("{input}: {doubt}"));
                }
                done.push(picture);
            }
            Err(error) => {
                progress.say(&format!("parallax: {error}"));
                failed.push(Failure { input, error: error.to_string() });
            }
        }
        progress.set(i as u64 + 1, "");
    }
    progress.finish();
    if let Some(views) = lens::in_words(&done.iter().map(|p: &Done| (p.view_by, p.view)).collect::<Vec<_>>())
        && (scaling.unit() == "metres" || args.ply)
    {
        note!("{views}");
    }
    if args.camera_height.is_some()
        && done.len() > 1
        && let Some(factor) = median(done.iter().map(|picture| picture.factor).collect())
    {
        note!("the median factor is {factor:.3}: --scale {factor:.3} gives all pictures the same");
    }
    let odometry = Odometry::new(&model, &params, &setup);
    for path in &paths {
        if let Err(error) = path.write(&args, &odometry, &scaling) {
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
        let summary = Summary {
            weights: args.weights.name(),
            trained_on: origin.as_ref().map(Origin::in_words),
            height: setup.height,
            width: setup.width,
            unit: scaling.unit(),
            pictures: done,
            failed,
            seconds: started.elapsed().as_secs_f64(),
        };
        super::print_json(&summary)?;
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

fn predict(args: &Args, predictor: &Predictor, job: Job, scaling: &Scaling) -> Result<Done> {
    let started = Instant::now();
    let (height, width) = (predictor.setup().height, predictor.setup().width);
    let (picture, focal) = read_picture_with_lens(&job.input.path)?;
    let (w, h) = (picture.width() as usize, picture.height() as usize);
    let lens = args.lens(&job.input.path, [w as f64, h as f64], focal)?;
    let camera = lens.intrinsics;
    let seen = lanczos(&picture, width as u32, height as u32);
    let map = predictor.inverse_depth(&seen, args.flip);
    if !map.is_whole() {
        return Err(Error::file(&job.input.path, predictor.why_not_finite(&seen)));
    }
    let factor = scaling.factor(&job.input, &map.values, (height, width), camera)?;
    let median_depth = median(map.values.iter().map(|&d| factor / f64::from(d)).collect()).unwrap_or(f64::NAN);
    write(&job.outputs, &picture, &map.resized(h, w, factor), camera)?;
    let input = job.input.path.to_string_lossy().into_owned();
    let doubt = doubt((w, h), (width, height));
    let seconds = started.elapsed().as_secs_f64();
    let (view, view_by) = (lens.view(), lens.told);
    Ok(Done { input, outputs: job.outputs, width: w, height: h, view, view_by, factor, median_depth, doubt, seconds })
}

/// A picture with fewer pixels on a side shows hardly anything.
const FEW: usize = 32;

/// How many times wider or taller than the network's pictures a picture is stretched without a word.
const STRETCHED: f64 = 5.0;

/// Why little is to be expected of a picture of this width and height, seen at the size `seen`.
pub(super) fn doubt((w, h): (usize, usize), seen: (usize, usize)) -> Option<String> {
    let stretched = (w as f64 / h as f64) / (seen.0 as f64 / seen.1 as f64);
    let to = format!("is stretched to the network's {}x{}", seen.0, seen.1);
    if w < FEW || h < FEW {
        Some(format!("a picture of {w}x{h} pixels {to}: too few to see a street in, expect little"))
    } else if !(1.0 / STRETCHED..=STRETCHED).contains(&stretched) {
        let side = if stretched > 1.0 { "wider" } else { "taller" };
        let times = stretched.max(1.0 / stretched);
        Some(format!("a picture of {w}x{h} {to}, and is {times:.1} times {side} than that: expect little"))
    } else {
        None
    }
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

    #[test]
    fn little_is_said_to_be_expected_of_slits_and_specks() {
        let seen = (320, 96);
        for fine in [(1242, 375), (1920, 1080), (640, 480), (3024, 4032), (320, 96), (32, 32)] {
            assert_eq!(doubt(fine, seen), None, "{fine:?}");
        }
        for (size, word) in
            [((1, 1), "too few"), ((4000, 20), "too few"), ((8000, 400), "wider"), ((300, 600), "taller")]
        {
            assert!(doubt(size, seen).is_some_and(|doubt| doubt.contains(word)), "{size:?}");
        }
    }
}
