//! `parallax attention`.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use image::RgbImage;
use parallax::data::batch::to_tensor;
use parallax::data::resize::lanczos;
use parallax::eval::attention::{Attention, AttentionRows, attention, saliency};
use parallax::formats::atomic::check_writable;
use parallax::formats::picture::{check_picture, read_picture};
use parallax::formats::png::write_png;
use parallax::networks::EncoderKind;
use parallax::report::overlay::{Overlay, mark};
use parallax::tensor::{Tensor, profile};
use parallax::train::run::load_weights;
use parallax::weights::SHIPPED;
use parallax::{Error, Result};
use serde::Serialize;

use super::sheet::{Panel, sheet};

#[derive(clap::Args)]
pub struct Args {
    /// Weights, or a run's folder (its best weights). `shipped`: those inside the program.
    #[arg(long, value_name = "FILE|RUN", default_value = SHIPPED)]
    weights: PathBuf,
    /// A picture (PNG, JPEG).
    #[arg(value_name = "IMAGE")]
    image: PathBuf,
    /// Query pixel: column and row in the picture, from 0 at the upper left.
    #[arg(long, value_name = "X,Y")]
    at: Point,
    /// Folder for the pictures: NAME_attention.png (the sheet), NAME_saliency.png, and NAME_stageS_pathP_layerL.png,
    /// each the mean over the heads.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Also write every head: NAME_stageS_pathP_layerL_headH.png.
    #[arg(long)]
    heads: bool,
    /// Saliency is computed for the mean disparity over a square around the pixel: its half width, in pixels of the
    /// picture as the networks see it.
    #[arg(long, value_name = "PIXELS", default_value_t = 1, value_parser = clap::value_parser!(u16).range(0..=1024))]
    radius: u16,
    /// Print one JSON object: what was written.
    #[arg(long)]
    json: bool,
}

/// A pixel of the picture.
#[derive(Clone, Copy, Debug)]
struct Point {
    x: u32,
    y: u32,
}

impl FromStr for Point {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers = text.split_once(',').and_then(|(x, y)| Some((x.trim().parse().ok()?, y.trim().parse().ok()?)));
        let (x, y) = numbers.ok_or("expected two whole numbers, as in 320,96")?;
        Ok(Point { x, y })
    }
}

/// Figures of `--json`.
#[derive(Serialize)]
struct Written {
    image: PathBuf,
    /// Column and row in the picture.
    at: [u32; 2],
    /// The same pixel as the networks see the picture, and the size at which they do: width and height.
    seen_at: [usize; 2],
    seen_size: [usize; 2],
    /// Sigmoid disparity there.
    disparity: f32,
    sheet: PathBuf,
    saliency: PathBuf,
    maps: Vec<Map>,
}

/// An overlay of a row.
#[derive(Serialize)]
struct Map {
    file: PathBuf,
    /// As in the file's name: stages as the paper counts them, the stem being the first; the others from 1.
    stage: usize,
    path: usize,
    layer: usize,
    /// From 1; none for the mean.
    head: Option<usize>,
    /// What a checkpoint calls the layer.
    name: String,
    /// Width and height of the map, and the column and row of the token that looks.
    size: [usize; 2],
    token: [usize; 2],
    /// The extremes of the weights, and their sum.
    smallest: f32,
    largest: f32,
    sum: f32,
}

pub fn run(args: Args) -> Result<()> {
    let Point { x, y } = args.at;
    let (w, h) = check_picture(&args.image)?;
    if x >= w || y >= h {
        let message =
            format!("{x},{y} lies outside the picture of {w}x{h}: 0 to {} and 0 to {} expected", w - 1, h - 1);
        return Err(Error::setting("--at", message));
    }
    check_writable(&args.out)?;
    let (model, params, setup) = load_weights(&args.weights)?;
    let picture = read_picture(&args.image)?;
    let (height, width) = (setup.height, setup.width);
    let seen = to_tensor(&[&lanczos(&picture, width as u32, height as u32)]);
    // The pixel's centre, at the size that the networks see.
    let scaled = |at: u32, from: u32, to: usize| ((f64::from(at) + 0.5) * to as f64 / f64::from(from)) as usize;
    let pixel = [scaled(y, h, height), scaled(x, w, width)];
    let found = attention(&model, &params, &seen, pixel);
    if !found.disparities.iter().all(Tensor::is_finite) {
        let culprit = profile::first_not_finite(|| attention(&model, &params, &seen, pixel)).unwrap_or_default();
        return Err(Error::file(&args.weights, format!("its disparities are not finite: {culprit}")));
    }
    let saliency = saliency(&model, &params, &seen, pixel, args.radius.into());

    let stem = args.image.file_stem().unwrap_or(args.image.as_os_str()).to_string_lossy().into_owned();
    let to = |ending: String| args.out.join(format!("{stem}_{ending}.png"));
    let overlay = Overlay::new(&picture);
    let over = |map: &Tensor<f32>, path: &Path| {
        let &[h, w] = map.dims() else { unreachable!("maps have two dimensions") };
        let mut made = overlay.signed(map.data(), (h, w));
        mark(&mut made, x as f32, y as f32);
        write_png(path, &made)
    };
    let mut maps = Vec::new();
    for rows in &found.rows {
        let mut write = |map: &Tensor<f32>, head: Option<usize>| {
            let of_head = head.map_or_else(String::new, |head| format!("_head{head}"));
            let file = to(format!("stage{}_path{}_layer{}{of_head}", rows.stage + 2, rows.path + 1, rows.layer + 1));
            over(map, &file)?;
            maps.push(Map::new(file, rows, map, head));
            Ok::<_, Error>(())
        };
        write(&rows.mean(), None)?;
        if args.heads {
            let &[heads, h, w] = rows.heads.dims() else { unreachable!("made with three dimensions") };
            let all = rows.heads.data().chunks_exact(h * w);
            for (head, row) in (1..=heads).zip(all) {
                write(&Tensor::from_vec([h, w], row.to_vec()), Some(head))?;
            }
        }
    }
    let disparity = found.disparities[0].at(&[0, pixel[0], pixel[1], 0]);
    let written = Written {
        at: [x, y],
        seen_at: [pixel[1], pixel[0]],
        seen_size: [width, height],
        disparity,
        sheet: to("attention".into()),
        saliency: to("saliency".into()),
        maps,
        image: args.image,
    };
    over(&displayed(&saliency), &written.saliency)?;
    write_png(&written.sheet, &figure(&picture, args.at, &found, &displayed(&saliency)))?;
    if args.json {
        return super::print_json(&written);
    }
    if written.maps.is_empty() {
        let what = match setup.encoder {
            EncoderKind::Mpvit => "these networks have no transformer paths".to_owned(),
            other => format!("the encoder {} has no attention", other.name()),
        };
        say!("{what}: the disparities and the saliency are all there is to see");
    }
    say!("{} is the sheet; {} more pictures beside it", written.sheet.display(), written.maps.len() + 1);
    Ok(())
}

impl Map {
    fn new(file: PathBuf, rows: &AttentionRows<f32>, map: &Tensor<f32>, head: Option<usize>) -> Self {
        let &[h, w] = map.dims() else { unreachable!("maps have two dimensions") };
        Map {
            file,
            stage: rows.stage + 2,
            path: rows.path + 1,
            layer: rows.layer + 1,
            head,
            name: rows.name(),
            size: [w, h],
            token: [rows.token[1], rows.token[0]],
            smallest: map.data().iter().copied().fold(f32::INFINITY, f32::min),
            largest: map.data().iter().copied().fold(f32::NEG_INFINITY, f32::max),
            sum: map.data().iter().sum(),
        }
    }
}

/// Gradients fall off steeply: their square root is shown, so that what lies beside the pixel is seen too.
fn displayed(saliency: &Tensor<f32>) -> Tensor<f32> {
    saliency.map(f32::sqrt)
}

/// The picture and the saliency above; below, line by line, the disparity of a scale beside what the pixel looks at in
/// the last layer of every path of a stage.
fn figure(picture: &RgbImage, at: Point, found: &Attention<f32>, saliency: &Tensor<f32>) -> RgbImage {
    let position = [(at.x as f32 + 0.5) / picture.width() as f32, (at.y as f32 + 0.5) / picture.height() as f32];
    let map = |map: Tensor<f32>| {
        let &[h, w] = map.dims() else { unreachable!("maps have two dimensions") };
        (map, (h, w))
    };
    let top = [
        Panel::picture(format!("the picture, and the pixel at {},{}", at.x, at.y)),
        Panel::signed("saliency: what its disparity depends on".into(), map(saliency.clone())),
    ];
    let lines = found.disparities.iter().enumerate().map(|(scale, disparity)| {
        let &[_, h, w, _] = disparity.dims() else { unreachable!("an image") };
        let size = if scale == 0 { "full size".into() } else { format!("1/{}", 1 << scale) };
        let mut line = vec![Panel::disparity(format!("disparity, {size}"), (disparity.reshape([h, w]), (h, w)))];
        let of_stage: Vec<_> = found.rows.iter().filter(|r| r.stage == scale).collect();
        let last = of_stage.iter().map(|r| r.layer).max();
        line.extend(of_stage.into_iter().filter(|r| Some(r.layer) == last).map(|rows| {
            let (divisor, window) = (4 << rows.stage, 3 + 2 * rows.path);
            let layer = if rows.layer == 0 { String::new() } else { format!(", layer {}", rows.layer + 1) };
            Panel::signed(format!("attention, 1/{divisor}, path {window}x{window}{layer}"), map(rows.mean()))
        }));
        line
    });
    sheet(picture, position, top, &lines.collect::<Vec<_>>())
}
