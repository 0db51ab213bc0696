//! The sheet of `parallax attention`: pictures in lines, each with its title, and a scale of colours.

use image::imageops::{FilterType, replace, resize};
use image::{Rgb, RgbImage};
use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster, get_raster_width};
use parallax::data::resize::lanczos;
use parallax::report::colormap::disparity_to_image;
use parallax::report::overlay::{Overlay, glow, mark};
use parallax::tensor::Tensor;

const PAPER: Rgb<u8> = Rgb([255, 255, 255]);
const INK: [f32; 3] = [40.0, 40.0, 48.0];
/// Between pictures, and around them.
const GAP: u32 = 10;
/// The height of a title.
const TITLE: u32 = 20;
/// The width of a picture in the lines.
const CELL: u32 = 316;

/// A map, and its height and width.
type Map = (Tensor<f32>, (usize, usize));

/// What stands at one place of the sheet.
pub struct Panel {
    title: String,
    content: Content,
}

enum Content {
    Picture,
    Disparity(Map),
    Signed(Map),
}

impl Panel {
    /// The picture itself.
    pub fn picture(title: String) -> Self {
        Panel { title, content: Content::Picture }
    }

    /// A disparity, in magma.
    pub fn disparity(title: String, map: Map) -> Self {
        Panel { title, content: Content::Disparity(map) }
    }

    /// A signed map over the picture.
    pub fn signed(title: String, map: Map) -> Self {
        Panel { title, content: Content::Signed(map) }
    }

    /// Drawn at the size of `picture`, the point marked.
    fn draw(&self, picture: &RgbImage, overlay: &Overlay, [x, y]: [f32; 2]) -> RgbImage {
        let (w, h) = picture.dimensions();
        let mut drawn = match &self.content {
            Content::Picture => picture.clone(),
            Content::Signed((map, size)) => overlay.signed(map.data(), *size),
            // As it is: how coarse a scale is may be seen.
            Content::Disparity((map, (rows, columns))) => {
                resize(&disparity_to_image(map.data(), *columns, *rows), w, h, FilterType::Triangle)
            }
        };
        mark(&mut drawn, x * w as f32 - 0.5, y * h as f32 - 0.5);
        drawn
    }
}

/// Draws the sheet. The point is given in parts of the picture's width and height.
pub fn sheet(picture: &RgbImage, point: [f32; 2], top: [Panel; 2], lines: &[Vec<Panel>]) -> RgbImage {
    let columns = lines.iter().map(Vec::len).max().unwrap_or(0).max(2) as u32;
    let width = columns * (CELL + GAP) - GAP;
    // A very long or very high picture is bent, rather than a sheet that nobody can look at.
    let height_of = |width: u32| {
        let ratio = f64::from(picture.height()) / f64::from(picture.width());
        (f64::from(width) * ratio.clamp(0.1, 2.0)).round() as u32
    };
    let half = (width - GAP) / 2;
    let (large, small) = (lanczos(picture, half, height_of(half)), lanczos(picture, CELL, height_of(CELL)));
    let (above, line) = (TITLE + large.height() + GAP, TITLE + small.height() + GAP);
    let mut sheet = RgbImage::from_pixel(width + 2 * GAP, GAP + above + lines.len() as u32 * line + TITLE + GAP, PAPER);

    let overlay = Overlay::new(&large);
    for (i, panel) in (0..).zip(&top) {
        place(&mut sheet, panel, panel.draw(&large, &overlay, point), GAP + i * (half + GAP), GAP);
    }
    let overlay = Overlay::new(&small);
    for (row, panels) in (0..).zip(lines) {
        for (column, panel) in (0..).zip(panels) {
            let (x, y) = (GAP + column * (CELL + GAP), GAP + above + row * line);
            place(&mut sheet, panel, panel.draw(&small, &overlay, point), x, y);
        }
    }
    legend(&mut sheet);
    sheet
}

fn place(sheet: &mut RgbImage, panel: &Panel, drawn: RgbImage, x: u32, y: u32) {
    write(sheet, &panel.title, x, y);
    replace(sheet, &drawn, i64::from(x), i64::from(y + TITLE));
}

/// The scale of colours, at the foot.
fn legend(sheet: &mut RgbImage) {
    const LENGTH: u32 = 160;
    let y = sheet.height() - GAP - TITLE;
    let x = write(sheet, "takes away ", GAP, y);
    for column in 0..LENGTH {
        let colour = glow(90.0, 2.0 * column as f32 / (LENGTH - 1) as f32 - 1.0);
        (3..15).for_each(|row| sheet.put_pixel(x + column, y + row, colour));
    }
    write(sheet, " adds   every map scaled by its own largest weight", x + LENGTH, y);
}

/// Writes a line of text, as far as the sheet goes; returns where it ends.
pub(super) fn write(sheet: &mut RgbImage, text: &str, x: u32, y: u32) -> u32 {
    const WEIGHT: FontWeight = FontWeight::Regular;
    const HEIGHT: RasterHeight = RasterHeight::Size16;
    let advance = get_raster_width(WEIGHT, HEIGHT) as u32;
    let mut left = x;
    for letter in text.chars() {
        let Some(raster) = get_raster(letter, WEIGHT, HEIGHT) else { continue };
        for (row, line) in (y..).zip(raster.raster()) {
            for (column, &cover) in (left..).zip(*line) {
                if let Some(pixel) = sheet.get_pixel_mut_checked(column, row) {
                    let cover = f32::from(cover) / 255.0;
                    for (byte, ink) in pixel.0.iter_mut().zip(INK) {
                        *byte = (f32::from(*byte) * (1.0 - cover) + ink * cover).round() as u8;
                    }
                }
            }
        }
        left += advance;
    }
    left
}
