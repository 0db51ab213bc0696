//! Pictures at the size that the networks see, read once as far as memory is given for them.

use std::collections::HashMap;
use std::hash::Hash;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use image::{RgbImage, imageops};

use super::frames::used;
use super::prepared::Prepared;
use super::resize::lanczos;
use crate::formats::picture::read_picture;
use crate::{Error, Result};

/// Frames of a size, kept up to a number of bytes; what is in stays in.
pub(super) struct Pictures<K> {
    width: u32,
    height: u32,
    /// The share of a picture's rows that is used, from the top.
    used_rows: f64,
    most_bytes: usize,
    kept: Mutex<Kept<K>>,
    /// Frames that were prepared at this size.
    prepared: Option<Prepared>,
}

struct Kept<K> {
    pictures: HashMap<K, Arc<RgbImage>>,
    bytes: usize,
}

impl<K: Eq + Hash> Pictures<K> {
    /// Pictures of `height x width` pixels, of which at most `most_bytes` are kept.
    ///
    /// # Errors
    /// If a side is 0 or longer than 16384.
    pub(super) fn new(height: usize, width: usize, most_bytes: usize) -> Result<Self> {
        let kept = Mutex::new(Kept { pictures: HashMap::new(), bytes: 0 });
        let [height, width] = [side("height", height)?, side("width", width)?];
        Ok(Pictures { width, height, used_rows: 1.0, most_bytes, kept, prepared: None })
    }

    /// Uses a share of the pictures' rows, from the top.
    pub(super) fn with_rows(self, used_rows: f64) -> Self {
        Pictures { used_rows, ..self }
    }

    /// Takes frames from the file of prepared ones in the folder of the data, if there is one of this size.
    ///
    /// # Errors
    /// If it is damaged, or older than the frames.
    pub(super) fn with_prepared(mut self, root: &Path) -> Result<Self> {
        self.prepared = Prepared::find(root, [self.height as usize, self.width as usize])?;
        Ok(self)
    }

    /// Takes frames from a file of prepared ones of the folder `root`.
    ///
    /// # Errors
    /// As [`Prepared::open`].
    pub(super) fn take_from(&mut self, file: &Path, root: &Path) -> Result<()> {
        self.prepared = Some(Prepared::open(file, root, [self.height as usize, self.width as usize])?);
        Ok(())
    }

    /// A frame, from the file that `path` gives if it is not kept.
    pub(super) fn get(&self, key: K, path: impl FnOnce() -> Result<PathBuf>) -> Result<Arc<RgbImage>> {
        if let Some(picture) = self.kept().pictures.get(&key) {
            return Ok(picture.clone());
        }
        let path = path()?;
        let prepared = self.prepared.as_ref().map(|prepared| prepared.get(&path)).transpose()?.flatten();
        let picture = Arc::new(match prepared {
            Some(picture) => picture,
            None => read_resized(&path, self.used_rows, self.width, self.height)?,
        });
        let bytes = picture.as_raw().len();
        let mut kept = self.kept();
        // Another thread may have decoded it in the meantime.
        if kept.bytes + bytes <= self.most_bytes && !kept.pictures.contains_key(&key) {
            kept.pictures.insert(key, picture.clone());
            kept.bytes += bytes;
        }
        Ok(picture)
    }

    /// How many pictures are kept, and their bytes.
    #[cfg(test)]
    pub(super) fn held(&self) -> (usize, usize) {
        let kept = self.kept();
        (kept.pictures.len(), kept.bytes)
    }

    /// A thread that panicked with the lock held leaves whole entries behind: they can be used.
    fn kept(&self) -> MutexGuard<'_, Kept<K>> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A share of a picture's rows, from the top, at `width x height` pixels.
///
/// # Errors
/// If it cannot be read.
pub(super) fn read_resized(path: &Path, used_rows: f64, width: u32, height: u32) -> Result<RgbImage> {
    let mut picture = read_picture(path)?;
    let rows = used(picture.height() as usize, used_rows) as u32;
    if rows < picture.height() {
        picture = imageops::crop_imm(&picture, 0, 0, picture.width(), rows).to_image();
    }
    Ok(if picture.dimensions() == (width, height) { picture } else { lanczos(&picture, width, height) })
}

/// The side of a picture.
///
/// # Errors
/// If it is 0 or longer than 16384.
pub(super) fn side(name: &str, size: usize) -> Result<u32> {
    match u32::try_from(size) {
        Ok(size) if (1..=1 << 14).contains(&size) => Ok(size),
        _ => Err(Error::setting(name, format!("expected 1 to {} pixels, found {size}", 1 << 14))),
    }
}
