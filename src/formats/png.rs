//! Colour pictures as PNG files.

use std::io::{self, Write};
use std::path::Path;

use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder, RgbImage};

use super::atomic::write_atomically;
use crate::Result;

/// Writes a picture as an 8-bit PNG, whole or not at all.
///
/// # Errors
/// If the picture is empty or the file cannot be written: the path and why.
pub fn write_png(path: impl AsRef<Path>, picture: &RgbImage) -> Result<()> {
    let (width, height) = picture.dimensions();
    write_atomically(path.as_ref(), |writer| {
        PngEncoder::new(writer as &mut dyn Write)
            .write_image(picture.as_raw(), width, height, ExtendedColorType::Rgb8)
            .map_err(io::Error::other)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::picture::read_picture;

    #[test]
    fn what_was_written_reads_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let picture = RgbImage::from_fn(3, 2, |x, y| image::Rgb([x as u8, y as u8, 200]));
        write_png(&path, &picture).unwrap();
        assert_eq!(read_picture(&path).unwrap(), picture);
        let nothing = folder.path().join("b.png");
        let error = write_png(&nothing, &RgbImage::new(0, 0)).unwrap_err().to_string();
        assert!(error.contains("b.png") && !nothing.exists(), "{error}");
    }
}
