//! Files appear whole or not at all: written aside, then renamed.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use crate::{Error, Result};

/// A name in the folder of `path`, which is made if it is missing, that no other writer uses.
fn aside(path: &Path) -> Result<PathBuf> {
    static COUNTER: AtomicU64 = AtomicU64::new(0);
    let Some(name) = path.file_name() else {
        return Err(Error::file(path, "expected the name of a file to write"));
    };
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
    let number = COUNTER.fetch_add(1, Ordering::Relaxed);
    Ok(folder.join(format!(".{}.{}-{number}.tmp", name.to_string_lossy(), std::process::id())))
}

/// Removes what killed writers left in a folder: nobody else may be writing into it. Files of other names than this
/// module gives (`.NAME.PROCESS-NUMBER.tmp`) are left alone.
pub fn clean(folder: impl AsRef<Path>) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in entries.flatten() {
        let name = entry.file_name();
        if is_aside(&name.to_string_lossy()) {
            // What cannot be removed costs nothing but its place on the disk.
            let _ = fs::remove_file(entry.path());
        }
    }
}

/// Whether this module gave a file its name, while it was being written.
pub fn is_aside(name: &str) -> bool {
    let numbers = name.strip_prefix('.').and_then(|n| n.strip_suffix(".tmp")).and_then(|n| n.rsplit_once('.'));
    let digits = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    numbers.and_then(|(_, numbers)| numbers.split_once('-')).is_some_and(|(pid, n)| digits(pid) && digits(n))
}

/// Writes a file through `write` so that nobody ever sees half of it: into a temporary file in the same folder,
/// flushed to the disk, then renamed over `path`. If anything fails the temporary file is removed and what stood at
/// `path` before still stands there. Missing parent folders are made.
pub fn write_atomically(
    path: impl AsRef<Path>,
    write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<()> {
    let path = path.as_ref();
    let aside = aside(path)?;
    let result = write_whole(&aside, write).and_then(|()| fs::rename(&aside, path));
    if result.is_err() {
        // The first error is the one to report; a temporary file that cannot be removed adds nothing to it.
        let _ = fs::remove_file(&aside);
    }
    result.map_err(|e| Error::io(path, e))
}

fn write_whole(path: &Path, write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>) -> io::Result<()> {
    let mut writer = BufWriter::new(File::create(path)?);
    write(&mut writer)?;
    writer.flush()?;
    writer.get_ref().sync_all()
}

/// Gives a file that was written piece by piece its name: flushed to the disk, then renamed from `partial` over `path`, in
/// the same folder.
///
/// # Errors
/// If it cannot be flushed or renamed: `partial` is left as it is, and so is what stood at `path`.
pub fn appear(file: File, partial: &Path, path: &Path) -> Result<()> {
    file.sync_all().map_err(|e| Error::io(partial, e))?;
    // Some systems do not rename an open file.
    drop(file);
    fs::rename(partial, path).map_err(|e| Error::io(path, e))
}

/// [`write_atomically`] for bytes that are at hand.
pub fn write_bytes_atomically(path: impl AsRef<Path>, bytes: &[u8]) -> Result<()> {
    write_atomically(path, |writer| writer.write_all(bytes))
}

/// Makes sure that files can be written into a folder, which is made if it is missing: to be called before anything
/// that takes time.
///
/// # Errors
/// If the folder cannot be made, or nothing can be written into it.
pub fn check_writable(folder: impl AsRef<Path>) -> Result<()> {
    let folder = folder.as_ref();
    fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
    let probe = folder.join(".writable");
    write_bytes_atomically(&probe, b"")?;
    fs::remove_file(&probe).map_err(|e| Error::io(probe, e))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn writes_replaces_and_makes_folders() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a/b/file.txt");
        write_bytes_atomically(&path, b"one").unwrap();
        write_bytes_atomically(&path, b"two").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");
        assert_eq!(fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
    }

    #[test]
    fn what_killed_writers_left_is_removed_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        for name in [".state.safetensors.123-0.tmp", "state.safetensors", ".hidden", "notes.tmp", ".mine.tmp"] {
            fs::write(folder.path().join(name), name).unwrap();
        }
        clean(folder.path());
        let mut left: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        left.sort();
        assert_eq!(left, [".hidden", ".mine.tmp", "notes.tmp", "state.safetensors"]);
    }

    #[test]
    fn a_folder_that_can_be_written_into_is_made_and_left_empty() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("a/b");
        check_writable(&folder).unwrap();
        check_writable(&folder).unwrap();
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 0);
        fs::write(place.path().join("file"), "mine").unwrap();
        let error = check_writable(place.path().join("file/inside")).unwrap_err().to_string();
        assert!(error.contains("inside"), "{error}");
    }

    #[test]
    fn a_failed_write_leaves_the_old_file_and_no_litter() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file.txt");
        write_bytes_atomically(&path, b"old").unwrap();
        let error = write_atomically(&path, |writer| {
            writer.write_all(b"half of the new")?;
            Err(io::Error::other("the disk is full"))
        })
        .unwrap_err();
        assert!(error.to_string().contains("file.txt") && error.to_string().contains("the disk is full"), "{error}");
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
