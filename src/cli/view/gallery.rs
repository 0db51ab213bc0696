//! The pictures that can be looked at: those that were given, and those that were dropped into the page.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use image::RgbImage;
use parallax::data::inputs::Input;
use parallax::formats::picture::{picture_of_bytes, read_picture_with_lens};
use parallax::{Error, Result};

use crate::cli::lens::{Flags, Lens};

/// Pictures that were dropped in and are kept; the oldest go first.
const KEPT: usize = 32;

/// Pictures by number: from 0 those that were given, then those that were dropped in.
pub struct Gallery {
    given: Vec<Input>,
    inputs: Vec<PathBuf>,
    flags: Flags,
    dropped: Mutex<Dropped>,
}

#[derive(Default)]
struct Dropped {
    /// How many were forgotten.
    gone: usize,
    files: VecDeque<Arc<Vec<u8>>>,
}

/// A picture and its camera.
pub struct Picture {
    pub image: RgbImage,
    pub lens: Lens,
}

impl Gallery {
    pub fn new(given: Vec<Input>, inputs: Vec<PathBuf>, flags: Flags) -> Gallery {
        Gallery { given, inputs, flags, dropped: Mutex::default() }
    }

    /// The names of the pictures that were given.
    pub fn names(&self) -> Vec<String> {
        self.given.iter().map(|input| input.name.to_string_lossy().into_owned()).collect()
    }

    fn dropped(&self) -> MutexGuard<'_, Dropped> {
        self.dropped.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a picture's file in, if it is one, and gives its number.
    ///
    /// # Errors
    /// If it is no picture.
    pub fn add(&self, bytes: Vec<u8>) -> Result<usize> {
        picture_of_bytes(Path::new("the picture"), &bytes)?;
        let mut dropped = self.dropped();
        dropped.files.push_back(Arc::new(bytes));
        if dropped.files.len() > KEPT {
            dropped.files.pop_front();
            dropped.gone += 1;
        }
        Ok(self.given.len() + dropped.gone + dropped.files.len() - 1)
    }

    /// Reads the picture of a number.
    ///
    /// # Errors
    /// If there is none, or it cannot be read.
    pub fn read(&self, number: usize) -> Result<Picture> {
        let dropped;
        let (path, (image, focal)) = match self.given.get(number) {
            Some(input) => (input.path.as_path(), read_picture_with_lens(&input.path)?),
            None => {
                let held = self.dropped();
                let file = (number - self.given.len()).checked_sub(held.gone).and_then(|at| held.files.get(at));
                dropped = file.cloned().ok_or_else(|| gone(number))?;
                drop(held);
                let path = Path::new("the picture");
                (path, picture_of_bytes(path, &dropped)?)
            }
        };
        let size = [f64::from(image.width()), f64::from(image.height())];
        let lens = match self.given.get(number) {
            Some(_) => self.flags.lens(&self.inputs, path, size, focal)?,
            // No folder is looked into for a picture that came from the page.
            None => self.flags.lens_alone(size, focal),
        };
        Ok(Picture { image, lens })
    }
}

fn gone(number: usize) -> Error {
    Error::Failed(format!(
        "there is no picture {number}: the last {KEPT} that were dropped in are kept, drop it in again"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn png(shade: u8) -> Vec<u8> {
        let mut bytes = std::io::Cursor::new(Vec::new());
        RgbImage::from_pixel(4, 3, image::Rgb([shade; 3])).write_to(&mut bytes, image::ImageFormat::Png).unwrap();
        bytes.into_inner()
    }

    #[test]
    fn the_last_pictures_are_kept_under_their_numbers() {
        let gallery = Gallery::new(Vec::new(), Vec::new(), Flags::default());
        for number in 0..KEPT + 3 {
            assert_eq!(gallery.add(png(number as u8)).unwrap(), number);
        }
        assert_eq!(gallery.read(KEPT).unwrap().image.get_pixel(0, 0).0, [KEPT as u8; 3]);
        for number in [0, 2, KEPT + 3, usize::MAX] {
            assert!(gallery.read(number).err().unwrap().to_string().contains("drop it in again"), "{number}");
        }
        assert!(gallery.read(3).is_ok());
        let error = gallery.add(b"no picture".to_vec()).unwrap_err().to_string();
        assert!(error.contains("the picture") && error.contains("PNG, JPEG or WebP"), "{error}");
        assert!(gallery.read(KEPT + 3).is_err());
    }
}
