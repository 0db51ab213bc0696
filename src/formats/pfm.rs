//! Portable float maps (`.pfm`), as Middlebury stores disparity: grey, 32-bit floats, rows from the bottom.
//!
//! A header of three words (`Pf`, width and height, scale), one white-space character, and the values; a negative scale
//! means that they are little-endian (<https://www.pauldebevec.com/Research/HDR/PFM/>).

use std::path::Path;

use super::bounded::{MAX_PIXELS, read_bounded};
use super::picture::is_size;
use crate::{Error, Result};

/// A header has fewer bytes.
const MAX_HEADER: u64 = 1 << 10;

/// A map of floats, row-major, the top row first.
#[derive(Clone, Debug, PartialEq)]
pub struct FloatMap {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// `height * width` values as they are stored; infinite where nothing is known.
    pub values: Vec<f32>,
}

/// Reads a grey PFM file.
///
/// # Errors
/// If the file cannot be read, is none, holds colour, or has not as many values as its header says.
pub fn read_pfm(path: &Path) -> Result<FloatMap> {
    let bytes = read_bounded(path, 4 * MAX_PIXELS + MAX_HEADER, "a PFM map")?;
    parse(&bytes).map_err(|why| Error::file(path, format!("expected a grey PFM map of floats: {why}")))
}

fn parse(bytes: &[u8]) -> Result<FloatMap, String> {
    let mut rest = bytes;
    match word(&mut rest)? {
        "Pf" => {}
        "PF" => return Err("it holds colour (PF); disparity is grey (Pf)".to_owned()),
        other => return Err(format!("it begins with {other:?}, not with Pf")),
    }
    let mut number = |what: &str| -> Result<f64, String> {
        let word = word(&mut rest)?;
        word.parse().map_err(|_| format!("the {what} in its header is {word:?}, which is no number"))
    };
    let (width, height, scale) = (number("width")?, number("height")?, number("scale")?);
    if !is_size(width, height) {
        return Err(format!("its header says {width}x{height} pixels; expected whole numbers, at most 100 megapixels"));
    }
    if !scale.is_finite() || scale == 0.0 {
        return Err(format!("its scale is {scale}; expected a number below 0 (little-endian) or above (big-endian)"));
    }
    let (width, height) = (width as usize, height as usize);
    if rest.len() != 4 * width * height {
        let (expected, found) = (4 * width * height, rest.len());
        return Err(format!("{width}x{height} pixels take {expected} bytes, and {found} are there: fetch it again"));
    }
    let value = |b: &[u8; 4]| if scale < 0.0 { f32::from_le_bytes(*b) } else { f32::from_be_bytes(*b) };
    let (pixels, _) = rest.as_chunks::<4>();
    let values = pixels.chunks_exact(width).rev().flatten().map(value).collect();
    Ok(FloatMap { width, height, values })
}

/// The next word of a header, and the one white-space character after it.
fn word<'a>(rest: &mut &'a [u8]) -> Result<&'a str, String> {
    let head = rest.get(..rest.len().min(MAX_HEADER as usize)).unwrap_or_default();
    let start = head.iter().position(|b| !b.is_ascii_whitespace()).unwrap_or(head.len());
    let head = head.get(start..).unwrap_or_default();
    let end = head.iter().position(u8::is_ascii_whitespace).ok_or("it ends within its header")?;
    *rest = rest.get(start + end + 1..).unwrap_or_default();
    head.get(..end).and_then(|word| std::str::from_utf8(word).ok()).ok_or_else(|| "its header is no text".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(header: &str, values: &[f32], bytes: fn(f32) -> [u8; 4]) -> Vec<u8> {
        header.bytes().chain(values.iter().flat_map(|&v| bytes(v))).collect()
    }

    #[test]
    fn rows_come_from_the_bottom_and_the_sign_says_the_order_of_bytes() {
        let stored = [1.0, 2.0, f32::INFINITY, 4.0, 5.0, 6.5];
        let expected = FloatMap { width: 3, height: 2, values: vec![4.0, 5.0, 6.5, 1.0, 2.0, f32::INFINITY] };
        assert_eq!(parse(&file("Pf\n3 2\n-1.0\n", &stored, f32::to_le_bytes)).unwrap(), expected);
        assert_eq!(parse(&file("Pf\r\n 3 2 0.5\n", &stored, f32::to_be_bytes)).unwrap(), expected);
    }

    #[test]
    fn what_is_no_grey_map_is_refused_by_what_is_wrong() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("disp0.pfm");
        for (header, why) in [
            ("PF\n1 1\n-1\n", "colour"),
            ("P5\n1 1\n-1\n", "begins with"),
            ("Pf\n1 x\n-1\n", "height"),
            ("Pf\n0 1\n-1\n", "0x1"),
            ("Pf\n1e9 1e9\n-1\n", "megapixels"),
            ("Pf\n2 1\n-1\n", "8 bytes, and 4 are"),
            ("Pf\n1 1\n0\n", "scale"),
            ("Pf\n1 1\nnan\n", "scale"),
        ] {
            std::fs::write(&path, file(header, &[1.0], f32::to_le_bytes)).unwrap();
            let error = read_pfm(&path).unwrap_err().to_string();
            assert!(error.contains("disp0.pfm") && error.contains(why), "{header:?}: {error}");
        }
        for cut in ["", "Pf", "Pf\n1", "Pf\n1 1\n-1"] {
            assert!(parse(cut.as_bytes()).unwrap_err().contains("ends within"), "{cut:?}");
        }
    }
}
