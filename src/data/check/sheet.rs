//! The contact sheet: what a data set looks like.

use image::RgbImage;

use crate::Result;
use crate::data::DataSource;

/// Columns of a contact sheet.
const COLUMNS: usize = 8;

/// A contact sheet: samples from all over the data, each with the frames before and after it, one above the other.
///
/// # Errors
/// If a frame cannot be read.
pub fn contact_sheet(data: &dyn DataSource) -> Result<RgbImage> {
    let columns = data.len().min(COLUMNS);
    let mut sheet = RgbImage::new(1, 1);
    for column in 0..columns {
        let sample = column * (data.len() - 1) / (columns - 1).max(1);
        for (row, offset) in [-1, 0, 1].into_iter().enumerate() {
            let picture = data.image(sample, offset)?;
            let (width, height) = picture.dimensions();
            if column == 0 && row == 0 {
                sheet = RgbImage::new(width * columns as u32, height * 3);
            }
            let place = [column as i64 * i64::from(width), row as i64 * i64::from(height)];
            image::imageops::replace(&mut sheet, picture.as_ref(), place[0], place[1]);
        }
    }
    Ok(sheet)
}
