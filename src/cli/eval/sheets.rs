//! The worst images as sheets: picture, predicted and true depth, and where the error is.

use std::path::{Path, PathBuf};

use image::imageops::replace;
use image::{Rgb, RgbImage};
use parallax::Result;
use parallax::data::DataSource;
use parallax::data::resize::lanczos;
use parallax::eval::compare::{Comparison, Pair};
use parallax::eval::evaluate::{Evaluation, Outcome, Predicts, compare_sample};
use parallax::eval::statistics::quantile;
use parallax::eval::study::Study;
use parallax::formats::png::write_png;
use parallax::report::map::{colour_bar, draw_map, draw_values};

use crate::cli::sheet::write;

/// How many sheets are made.
const COUNT: usize = 10;
const PAPER: Rgb<u8> = Rgb([255, 255, 255]);
/// Between panels, and around them.
const GAP: u32 = 10;
/// The height of a line of text.
const LINE: u32 = 20;
/// The width of a panel.
const PANEL: u32 = 560;
/// Relative errors from here on have the brightest colour.
const LARGEST_ERROR: f64 = 0.5;

/// Writes the sheets of the images with the largest Abs Rel into a folder, `01.png` the worst; returns their paths.
pub fn write_worst(
    folder: &Path,
    study: &Study,
    by: &dyn Predicts,
    data: &dyn DataSource,
    how: Evaluation,
) -> Result<Vec<PathBuf>> {
    let mut written = Vec::new();
    for (rank, image) in (1..).zip(study.worst(COUNT)) {
        let image = &study.report.per_image[image];
        let Some(sample) = (0..data.len()).find(|&sample| data.name(sample) == image.name) else { continue };
        let Outcome::Compared(compared) = compare_sample(by, data, sample, how)? else { continue };
        let (inverse, size) = by.inverse_depth(data, sample)?;
        let title = format!("{}  Abs Rel {:.4}  {} pixels", image.name, image.metrics.abs_rel, image.pixels);
        let picture = data.image(sample, 0)?;
        let path = folder.join(format!("{rank:02}.png"));
        write_png(&path, &sheet(&title, &picture, (&inverse, size), &compared))?;
        written.push(path);
    }
    Ok(written)
}

/// The sheet of an image. The prediction is inverse depth, and its size.
fn sheet(
    title: &str,
    picture: &RgbImage,
    (inverse, size): (&[f32], (usize, usize)),
    compared: &Comparison,
) -> RgbImage {
    let ratio = f64::from(picture.height()) / f64::from(picture.width());
    let panel = (PANEL, (f64::from(PANEL) * ratio.clamp(0.1, 1.5)).round() as u32);
    let (step_x, step_y) = (PANEL + GAP, panel.1 + LINE + GAP);
    let mut sheet = RgbImage::from_pixel(2 * step_x + GAP, LINE + 2 * step_y + 2 * LINE + 3 * GAP, PAPER);
    write(&mut sheet, title, GAP, GAP);

    let mut inverse_truth: Vec<f64> = compared.pairs.iter().map(|pair| 1.0 / pair.truth).collect();
    inverse_truth.sort_unstable_by(f64::total_cmp);
    let [far, near] = [0.0, 0.95].map(|part| quantile(&inverse_truth, part).unwrap_or(1.0));
    let prediction: Vec<f64> = inverse.iter().map(|&d| f64::from(d) / compared.factor).collect();
    // Holes of a dense truth stay holes; the points of a scan are spread.
    let dense = compared.pairs.len() * 3 > compared.size.0 * compared.size.1;
    let reach = if dense { 0 } else { 2 };
    let values = |value: &dyn Fn(&Pair) -> f64, range: [f64; 2]| {
        let values = compared.pairs.iter().map(|pair| (pair.row, pair.column, value(pair)));
        draw_values(values, compared.size, panel, range, reach)
    };
    let error = |pair: &Pair| (pair.truth - pair.prediction).abs() / pair.truth;
    let panels = [
        ("picture", lanczos(picture, panel.0, panel.1)),
        ("predicted depth", draw_map(&prediction, size, panel, [far, near])),
        ("true depth, where it counts", values(&|pair| 1.0 / pair.truth, [far, near])),
        ("relative error |g - p| / g", values(&error, [0.0, LARGEST_ERROR])),
    ];
    for (i, (name, drawn)) in (0..).zip(panels) {
        let (x, y) = (GAP + i % 2 * step_x, GAP + LINE + GAP + i / 2 * step_y);
        write(&mut sheet, name, x, y);
        replace(&mut sheet, &drawn, i64::from(x), i64::from(y + LINE));
    }
    let y = 2 * GAP + LINE + 2 * step_y;
    bar(&mut sheet, GAP, y, &format!("depth: {:.1} m", 1.0 / far), &format!("{:.1} m and nearer", 1.0 / near));
    bar(&mut sheet, GAP + step_x, y, "error: 0", &format!("{LARGEST_ERROR} and more"));
    sheet
}

/// A bar of colours between two words.
fn bar(sheet: &mut RgbImage, x: u32, y: u32, low: &str, high: &str) {
    let x = write(sheet, &format!("{low} "), x, y);
    let bar = colour_bar(180, 12);
    replace(sheet, &bar, i64::from(x), i64::from(y + 3));
    write(sheet, &format!(" {high}"), x + bar.width(), y);
}

#[cfg(test)]
mod tests {
    use super::*;
    use parallax::eval::mean_map::MeanMap;
    use parallax::eval::protocol::Protocol;
    use parallax::eval::scale::Scale;
    use parallax::eval::study::{Settings, study};
    use parallax::report::map::UNKNOWN;
    use parallax::street::{Street, StreetConfig};

    #[test]
    fn the_worst_images_are_drawn_worst_first() {
        let street = StreetConfig { height: 32, width: 64, sequences: 4, frames: 5, ..StreetConfig::default() };
        let street = Street::render(&street, None);
        let flat = MeanMap { size: (1, 1), inverse_depth: vec![0.1] };
        let how = Evaluation { protocol: Protocol::Dense, scale: Scale::Median, flip: false };
        let found = study(&flat, &street, how, &Settings::default(), |_| ()).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let written = write_worst(folder.path(), &found, &flat, &street, how).unwrap();
        assert_eq!((written.len(), written[9].ends_with("10.png")), (COUNT, true));
        let sheet = image::open(&written[0]).unwrap().into_rgb8();
        let colours: std::collections::HashSet<_> = sheet.pixels().map(|p| p.0).collect();
        // The truth's panel has a sky without depth.
        assert!(colours.len() > 200 && colours.contains(&UNKNOWN.0) && colours.contains(&PAPER.0));
    }
}
