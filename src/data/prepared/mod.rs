//! Frames at the size that the networks see, in one file, so that training decodes and resizes nothing.
//!
//! `parallax data prepare` writes it ([`prepare`]); data sets of files look for it in their folder, under
//! [`file_name`], and read frames from it by position. They are the same to the bit as those that are read from the files
//! of the folder. A file that no longer belongs to them (a frame was added, removed or changed, by name, bytes and time) is
//! refused, not passed over.

mod layout;
#[cfg(test)]
mod tests;
mod write;

use std::collections::HashMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use image::RgbImage;

use self::layout::{Layout, Source, checksum, name_below};
use crate::{Error, Result};

pub use self::write::{Outcome, prepare};

/// The name under which the prepared frames of a folder are looked for in it.
pub fn file_name([height, width]: [usize; 2]) -> String {
    format!("frames-{width}x{height}.prepared")
}

/// A file of prepared frames that belongs to the files of its folder.
pub struct Prepared {
    path: PathBuf,
    root: PathBuf,
    layout: Layout,
    file: Mutex<File>,
    /// Of each frame its checksum, and whether it is there.
    table: Vec<(u32, bool)>,
    places: HashMap<String, usize>,
}

impl Prepared {
    /// The prepared frames in a folder of data, of that size, if there are any.
    ///
    /// # Errors
    /// As [`Prepared::open`].
    pub fn find(root: &Path, size: [usize; 2]) -> Result<Option<Prepared>> {
        let path = root.join(file_name(size));
        if path.is_file() { Prepared::open(&path, root, size).map(Some) } else { Ok(None) }
    }

    /// Opens the prepared frames of the folder `root`, at `[height, width]` pixels.
    ///
    /// # Errors
    /// If the file cannot be read, is damaged, of another version or size, or older than the frames: each with the reason.
    pub fn open(path: &Path, root: &Path, [height, width]: [usize; 2]) -> Result<Prepared> {
        let mut file = File::open(path).map_err(|e| Error::io(path, e))?;
        let layout = Layout::read(&mut file, path)?;
        if [layout.height as usize, layout.width as usize] != [height, width] {
            let message = format!(
                "holds frames of {}x{}, where {width}x{height} are needed: prepare those, or train at that size",
                layout.width, layout.height
            );
            return Err(Error::file(path, message));
        }
        if let Some(change) = change(&layout.sources, &Source::all(root)?) {
            let message = format!(
                "no longer belongs to the frames of {}: {change}; prepare them again (parallax data prepare), or remove \
                 this file",
                root.display()
            );
            return Err(Error::file(path, message));
        }
        let table = read_table(&mut file, &layout, path)?;
        let places = layout.sources.iter().enumerate().map(|(i, source)| (source.name.clone(), i)).collect();
        Ok(Prepared { path: path.to_owned(), root: root.to_owned(), layout, file: Mutex::new(file), table, places })
    }

    /// How many frames are there. Those whose files could not be read are not.
    pub fn frames(&self) -> usize {
        self.table.iter().filter(|(_, there)| *there).count()
    }

    /// The frame that was made of a file of the folder, if it is there.
    ///
    /// # Errors
    /// If it cannot be read, or its checksum is wrong.
    pub fn get(&self, source: &Path) -> Result<Option<RgbImage>> {
        let Some(&frame) = name_below(&self.root, source).and_then(|name| self.places.get(&name)) else {
            return Ok(None);
        };
        let (expected, there) = self.table[frame];
        if !there {
            return Ok(None);
        }
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        let bytes = read_frame(&mut file, &self.layout, frame).map_err(|e| Error::io(&self.path, e))?;
        drop(file);
        if checksum(&[&bytes]) != expected {
            let message = format!(
                "the frame of {} is damaged: remove this file, and prepare the frames again (parallax data prepare)",
                source.display()
            );
            return Err(Error::file(&self.path, message));
        }
        Ok(RgbImage::from_raw(self.layout.width, self.layout.height, bytes))
    }
}

/// The first difference between two lists of frames, if there is one.
fn change(then: &[Source], now: &[Source]) -> Option<String> {
    if then == now {
        return None;
    }
    let by_name = |sources: &[Source]| -> HashMap<String, Source> {
        sources.iter().map(|source| (source.name.clone(), source.clone())).collect()
    };
    let (old, new) = (by_name(then), by_name(now));
    let added = now.iter().find(|source| !old.contains_key(&source.name)).map(|s| format!("{} was added", s.name));
    let removed = then.iter().find(|source| !new.contains_key(&source.name)).map(|s| format!("{} is gone", s.name));
    let changed = now.iter().find(|source| old.get(&source.name).is_some_and(|old| old != *source));
    let changed = changed.map(|source| format!("{} was changed", source.name));
    added.or(removed).or(changed).or_else(|| Some("their order changed".to_owned()))
}

/// The checksums of all frames, and whether they are there.
fn read_table(file: &mut File, layout: &Layout, path: &Path) -> Result<Vec<(u32, bool)>> {
    let mut bytes = vec![0; (layout.frame_at(0) - layout.entry_at(0)) as usize];
    file.seek(SeekFrom::Start(layout.entry_at(0))).map_err(|e| Error::io(path, e))?;
    file.read_exact(&mut bytes).map_err(|e| Error::io(path, e))?;
    let entry = |entry: &[u8; 8]| {
        let [a, b, c, d, there, ..] = *entry;
        (u32::from_le_bytes([a, b, c, d]), there == 1)
    };
    Ok(bytes.as_chunks::<8>().0.iter().map(entry).collect())
}

fn read_frame(file: &mut File, layout: &Layout, frame: usize) -> std::io::Result<Vec<u8>> {
    let mut bytes = vec![0; layout.frame_bytes() as usize];
    file.seek(SeekFrom::Start(layout.frame_at(frame)))?;
    file.read_exact(&mut bytes)?;
    Ok(bytes)
}
