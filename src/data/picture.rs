//! Pictures from files: headers checked before anything is decoded, sizes bounded, messages with the path.

use std::fs::{self, File};
use std::io::{Cursor, Read};
use std::path::Path;

use image::{DynamicImage, ImageError, ImageReader, RgbImage};

use crate::{Error, Result};

/// Pictures with more pixels are refused.
pub const MAX_PIXELS: u64 = 100_000_000;

/// A header lies within so many bytes, nearly always.
const HEAD: u64 = 64 << 10;

/// Reads the header alone: the width and height of a PNG or JPEG.
///
/// # Errors
/// If the file is missing, is no picture, is empty, or has more than 100 megapixels.
pub fn check_picture(path: &Path) -> Result<(u32, u32)> {
    let file = File::open(path).map_err(|e| Error::io(path, e))?;
    let mut head = Vec::new();
    (&file).take(HEAD).read_to_end(&mut head).map_err(|e| Error::io(path, e))?;
    let dimensions = match dimensions(&head) {
        // A header behind a long preface (a colour profile, a preview): read on.
        Err(_) if head.len() as u64 == HEAD => {
            (&file).read_to_end(&mut head).map_err(|e| Error::io(path, e))?;
            dimensions(&head)
        }
        result => result,
    };
    check_size(path, dimensions.map_err(|e| undecodable(path, &e))?)
}

fn dimensions(bytes: &[u8]) -> Result<(u32, u32), ImageError> {
    ImageReader::new(Cursor::new(bytes)).with_guessed_format()?.into_dimensions()
}

fn check_size(path: &Path, (width, height): (u32, u32)) -> Result<(u32, u32)> {
    if width == 0 || height == 0 {
        return Err(Error::file(path, "the picture is empty"));
    }
    if u64::from(width) * u64::from(height) > MAX_PIXELS {
        let message = format!("{width}x{height} pixels: pictures above 100 megapixels are refused; make it smaller");
        return Err(Error::file(path, message));
    }
    Ok((width, height))
}

fn undecodable(path: &Path, error: &ImageError) -> Error {
    Error::file(path, format!("expected a PNG or JPEG picture, could not decode it ({error}); restore the file"))
}

/// Decodes a PNG or JPEG, whatever its name ends in, with its own channels and bits.
pub fn decode(path: &Path) -> Result<DynamicImage> {
    let bytes = fs::read(path).map_err(|e| Error::io(path, e))?;
    let size = dimensions(&bytes).map_err(|e| undecodable(path, &e))?;
    check_size(path, size)?;
    let reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(|e| Error::io(path, e))?;
    reader.decode().map_err(|e| undecodable(path, &e))
}

/// Decodes a PNG or JPEG as 8-bit RGB.
pub fn read_picture(path: &Path) -> Result<RgbImage> {
    decode(path).map(DynamicImage::into_rgb8)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A PNG's signature and header chunk with any size, followed by nothing.
    fn png_header(width: u32, height: u32) -> Vec<u8> {
        let mut chunk = b"IHDR".to_vec();
        chunk.extend(width.to_be_bytes());
        chunk.extend(height.to_be_bytes());
        chunk.extend([8, 2, 0, 0, 0]);
        let mut crc = u32::MAX;
        for &byte in &chunk {
            crc ^= u32::from(byte);
            for _ in 0..8 {
                crc = if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 };
            }
        }
        let mut bytes = b"\x89PNG\r\n\x1a\n\0\0\0\x0d".to_vec();
        bytes.extend(chunk);
        bytes.extend((!crc).to_be_bytes());
        // The start of the pixels: all that a header's reader looks for.
        bytes.extend(b"\0\0\x10\0IDAT");
        bytes
    }

    #[test]
    fn headers_are_read_without_the_pixels() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        fs::write(&path, png_header(1242, 375)).unwrap();
        assert_eq!(check_picture(&path).unwrap(), (1242, 375));
        let error = read_picture(&path).unwrap_err().to_string();
        assert!(error.contains("a.png") && error.contains("could not decode"), "{error}");
    }

    #[test]
    fn more_than_a_hundred_megapixels_are_refused_before_decoding() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("huge.png");
        fs::write(&path, png_header(20_000, 5_001)).unwrap();
        for error in [check_picture(&path).unwrap_err(), read_picture(&path).unwrap_err()] {
            let error = error.to_string();
            assert!(error.contains("huge.png") && error.contains("20000x5001"), "{error}");
        }
    }

    #[test]
    fn what_is_no_picture_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("b.png");
        for bytes in [b"".as_slice(), b"not a picture", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0"] {
            fs::write(&path, bytes).unwrap();
            for error in [check_picture(&path).unwrap_err(), read_picture(&path).unwrap_err()] {
                assert!(error.to_string().contains("b.png"), "{error}");
            }
        }
        assert!(check_picture(&folder.path().join("c.png")).unwrap_err().to_string().contains("c.png"));
    }

    #[test]
    fn jpeg_and_grey_become_rgb() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.jpg");
        RgbImage::from_pixel(16, 8, image::Rgb([90, 120, 30])).save(&path).unwrap();
        assert_eq!(check_picture(&path).unwrap(), (16, 8));
        let pixel = read_picture(&path).unwrap().get_pixel(8, 4).0;
        assert!(pixel.iter().zip([90, 120, 30]).all(|(a, b)| a.abs_diff(b) < 6), "{pixel:?}");
        let path = folder.path().join("g.png");
        image::GrayImage::from_pixel(4, 4, image::Luma([77])).save(&path).unwrap();
        assert_eq!(read_picture(&path).unwrap().get_pixel(1, 1).0, [77, 77, 77]);
    }
}
