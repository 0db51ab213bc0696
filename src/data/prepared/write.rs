//! Writes the file of prepared frames.
//!
//! It grows under a name of its own (`.NAME.partial`) and gets its name when it is whole. A preparation that was stopped
//! leaves the partial file behind, and the next one of the same frames takes over what is in it.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use super::layout::{Layout, Source, checksum};
use super::{Prepared, change, file_name, read_frame, read_table};
use crate::data::cache::{read_resized, side};
use crate::data::frames;
use crate::data::kitti::is_kitti;
use crate::formats::atomic::appear;
use crate::{Error, Result};

/// Result of a preparation.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// The file.
    pub path: PathBuf,
    /// Its bytes.
    pub bytes: u64,
    /// Frames in it.
    pub frames: usize,
    /// How many of those had been prepared before.
    pub kept: usize,
    /// Frames that cannot be read, and are not in it: name, and why. A training meets them in the folder.
    pub unreadable: Vec<(String, String)>,
}

/// Prepares all frames below a folder at `[height, width]` pixels, on rayon's threads, into `out`, or else into the folder
/// under the name at which data sets look for it. `progress` hears how many are done and how many there are, from any thread.
///
/// What was prepared before is kept where the frames are still the same; a preparation that is stopped can be started again.
///
/// # Errors
/// If the folder holds no frame, the file cannot be written (a full disk: what was done is kept for the next time), another
/// preparation is at work, or frames change meanwhile.
pub fn prepare(
    root: &Path,
    size: [usize; 2],
    out: Option<&Path>,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Result<Outcome> {
    let path = out.map_or_else(|| root.join(file_name(size)), Path::to_owned);
    let [height, width] = [side("height", size[0])?, side("width", size[1])?];
    let used_rows = if is_kitti(root)? { 1.0 } else { frames::Layout::of(root)?.used_rows() };
    let layout = Layout { height, width, sources: Source::all(root)? };
    // A file of another time, size or version is made anew.
    if let Ok(there) = Prepared::open(&path, root, size)
        && there.frames() == layout.sources.len()
    {
        let frames = there.frames();
        return Ok(Outcome { path, bytes: layout.file_bytes(), frames, kept: frames, unreadable: Vec::new() });
    }
    let partial = partial_name(&path)?;
    let (file, table) = begin(&partial, &layout)?;
    let file = Mutex::new(file);
    let kept = table.iter().filter(|there| **there).count();
    let done = AtomicUsize::new(kept);
    let unreadable = Mutex::new(Vec::new());
    let missing: Vec<usize> = (0..table.len()).filter(|&frame| !table[frame]).collect();
    missing.into_par_iter().try_for_each(|frame| {
        let source = &layout.sources[frame].name;
        match read_resized(&root.join(source), used_rows, width, height) {
            Ok(picture) => {
                let mut file = file.lock().unwrap_or_else(PoisonError::into_inner);
                put(&mut file, &layout, frame, picture.as_raw()).map_err(|e| Error::io(&partial, e))?;
            }
            Err(error) => {
                unreadable.lock().unwrap_or_else(PoisonError::into_inner).push((source.clone(), error.to_string()));
            }
        }
        progress(done.fetch_add(1, Ordering::Relaxed) + 1, layout.sources.len());
        Ok::<(), Error>(())
    })?;
    if let Some(change) = change(&layout.sources, &Source::all(root)?) {
        let message =
            format!("changed while its frames were prepared ({change}): prepare them again when it is at rest");
        return Err(Error::file(root, message));
    }
    appear(file.into_inner().unwrap_or_else(PoisonError::into_inner), &partial, &path)?;
    let mut unreadable = unreadable.into_inner().unwrap_or_else(PoisonError::into_inner);
    unreadable.sort();
    let frames = layout.sources.len() - unreadable.len();
    Ok(Outcome { path, bytes: layout.file_bytes(), frames, kept, unreadable })
}

fn partial_name(path: &Path) -> Result<PathBuf> {
    let Some(name) = path.file_name() else {
        return Err(Error::file(path, "expected the name of a file to write"));
    };
    if path.is_dir() {
        return Err(Error::file(path, "is a folder: expected the name of a file to write"));
    }
    Ok(path.with_file_name(format!(".{}.partial", name.to_string_lossy())))
}

/// Opens the partial file, and finds out which frames it holds whole. One of other frames, or of none, begins anew.
fn begin(partial: &Path, layout: &Layout) -> Result<(File, Vec<bool>)> {
    let io = |e| Error::io(partial, e);
    if let Some(folder) = partial.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
    }
    let mut file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(partial).map_err(io)?;
    match file.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            return Err(Error::file(partial, "another process is preparing these frames: wait for it, or stop it"));
        }
        // A file system without locks.
        Err(TryLockError::Error(_)) => {}
    }
    if Layout::read(&mut file, partial).is_ok_and(|found| found == *layout) {
        let table = read_table(&mut file, layout, partial)?;
        let mut there = Vec::with_capacity(table.len());
        for (frame, (expected, written)) in table.into_iter().enumerate() {
            // What was being written when the machine stopped may be half there.
            there.push(written && checksum(&[&read_frame(&mut file, layout, frame).map_err(io)?]) == expected);
        }
        return Ok((file, there));
    }
    if file.metadata().map_err(io)?.len() > 0 {
        file.set_len(0).map_err(io)?;
    }
    file.seek(SeekFrom::Start(0)).map_err(io)?;
    file.write_all(&layout.head()).map_err(io)?;
    file.set_len(layout.file_bytes()).map_err(io)?;
    Ok((file, vec![false; layout.sources.len()]))
}

/// Writes a frame, then that it is there.
fn put(file: &mut File, layout: &Layout, frame: usize, pixels: &[u8]) -> io::Result<()> {
    file.seek(SeekFrom::Start(layout.frame_at(frame)))?;
    file.write_all(pixels)?;
    let mut entry = [0u8; 8];
    entry[..4].copy_from_slice(&checksum(&[pixels]).to_le_bytes());
    entry[4] = 1;
    file.seek(SeekFrom::Start(layout.entry_at(frame)))?;
    file.write_all(&entry)
}
