//! The contact sheet: what a data set looks like.

use image::RgbImage;

use crate::Result;
use crate::data::DataSource;
use crate::data::camera_fit::warped;

/// Columns of a contact sheet.
const COLUMNS: usize = 8;

/// A contact sheet: samples from all over the data, each with the frames before and after it, one above the other. Where
/// samples have depth a fourth row shows the frame after, warped by it onto the sample: it should look like the second row,
/// but for what has no depth or cannot be seen, which is black.
///
/// # Errors
/// If a frame or its depth cannot be read.
pub fn contact_sheet(data: &dyn DataSource) -> Result<RgbImage> {
    let columns = data.len().min(COLUMNS);
    let samples: Vec<usize> = (0..columns).map(|i| i * (data.len() - 1) / (columns - 1).max(1)).collect();
    let depths = samples.iter().map(|&sample| data.depth(sample)).collect::<Result<Vec<_>>>()?;
    let rows = if depths.iter().any(Option::is_some) { 4 } else { 3 };
    let mut sheet = RgbImage::new(1, 1);
    for (column, (&sample, depth)) in samples.iter().zip(&depths).enumerate() {
        let pictures = [data.image(sample, -1)?, data.image(sample, 0)?, data.image(sample, 1)?];
        let (width, height) = pictures[1].dimensions();
        if column == 0 {
            sheet = RgbImage::new(width * columns as u32, height * rows);
        }
        let mut put = |row: i64, picture: &RgbImage| {
            image::imageops::replace(&mut sheet, picture, column as i64 * i64::from(width), row * i64::from(height));
        };
        (0..).zip(&pictures).for_each(|(row, picture)| put(row, picture));
        let warp = |depth| warped(&pictures[1], &pictures[2], data.intrinsics(sample), depth);
        if let Some(warped) = depth.as_ref().and_then(warp) {
            put(3, &warped);
        }
    }
    Ok(sheet)
}
