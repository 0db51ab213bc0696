//! Pictures inside the page, as many as fit.

use std::io::Cursor;
use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::codecs::jpeg::JpegEncoder;

use super::record;

/// The most bytes that all pictures of a page take together, as they stand in it: the page stays below 10 MB.
const BUDGET: usize = 8_500_000;

/// The room that is left for pictures, and what found none.
pub struct Album {
    left: usize,
    /// Pictures that did not fit.
    pub left_out: usize,
    /// Pictures that could not be read.
    pub unreadable: usize,
}

impl Default for Album {
    fn default() -> Self {
        Album { left: BUDGET, left_out: 0, unreadable: 0 }
    }
}

impl Album {
    /// A picture as it is, JPEG or PNG, if it can be read and there is room.
    pub fn exact(&mut self, path: &Path) -> Option<String> {
        let bytes = record::picture(path).ok().filter(|bytes| image::load_from_memory(bytes).is_ok());
        let kind = if path.extension().is_some_and(|e| e == "png") { "png" } else { "jpeg" };
        self.place(kind, bytes)
    }

    /// A picture as the address of an image, turned into a JPEG, if it can be read and there is room.
    pub fn address(&mut self, path: &Path) -> Option<String> {
        self.place("jpeg", jpeg(path))
    }

    fn place(&mut self, kind: &str, bytes: Option<Vec<u8>>) -> Option<String> {
        let Some(bytes) = bytes else {
            self.unreadable += 1;
            return None;
        };
        let address = format!("data:image/{kind};base64,{}", STANDARD.encode(bytes));
        if address.len() > self.left {
            self.left_out += 1;
            return None;
        }
        self.left -= address.len();
        Some(address)
    }
}

/// The picture as JPEG; a file that is one already, as it is.
fn jpeg(path: &Path) -> Option<Vec<u8>> {
    let bytes = record::picture(path).ok()?;
    let found = image::load_from_memory(&bytes).ok()?;
    if bytes.starts_with(&[0xff, 0xd8]) {
        return Some(bytes);
    }
    let mut out = Cursor::new(Vec::new());
    found.to_rgb8().write_with_encoder(JpegEncoder::new_with_quality(&mut out, 85)).ok()?;
    Some(out.into_inner())
}
