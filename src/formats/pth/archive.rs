//! The format since PyTorch 1.6: a zip archive, not compressed, with one folder:
//!
//! | entry | what |
//! |---|---|
//! | `NAME/data.pkl` | the pickle |
//! | `NAME/data/KEY` | the numbers of storage KEY, little-endian |
//! | `NAME/byteorder` | `little` or `big`; since PyTorch 2.0 |
//! | `NAME/version` | the format's version, 3 |

use std::cell::Cell;
use std::io::{self, Cursor, Read, Seek, SeekFrom};
use std::ops::Range;
use std::rc::Rc;
use std::sync::Arc;

use zip::CompressionMethod;
use zip::read::{ArchiveOffset, Config, ZipArchive};
use zip::result::ZipError;

use super::state::{Format, State};
use super::{MAX_DIRECTORY, MAX_INFLATION, MAX_PICKLE, PthError, SMALL, pickle, shown};
use crate::formats::source::Source;
use crate::formats::stored::Storage;

/// PyTorch itself refuses what is newer.
const NEWEST_VERSION: u32 = 10;

/// An error unless the archive has a table of contents, of which no more than that is read.
pub(in crate::formats) fn check(mut file: impl Source) -> Result<(), PthError> {
    open(Box::new(&mut file)).map(|_| ())
}

/// Reads the table of contents, and not more than `MAX_DIRECTORY` bytes while looking for it.
fn open<'b>(mut file: Box<dyn Source + 'b>) -> Result<ZipArchive<Limited<'b>>, PthError> {
    // The table ends with this record of 22 bytes, behind which there can be a comment of up to 65535.
    let size = file.seek(SeekFrom::End(0))?;
    file.seek(SeekFrom::Start(size.saturating_sub(22 + 65_535)))?;
    let mut tail = Vec::new();
    (&mut file).take(22 + 65_535).read_to_end(&mut tail)?;
    if !tail.windows(4).any(|w| w == b"PK\x05\x06") {
        return Err(PthError::truncated(
            "it begins like a zip archive, but the table of contents at its end is missing",
        ));
    }
    let left = Rc::new(Cell::new(MAX_DIRECTORY));
    // Anything in front of the archive is not searched for.
    let config = Config { archive_offset: ArchiveOffset::Known(0) };
    let opened = ZipArchive::with_config(config, Limited { inner: file, left: Rc::clone(&left) });
    if left.get() == 0 {
        return Err(PthError::TooLarge(format!(
            "the table of contents of its zip archive takes more than {MAX_DIRECTORY} bytes to read"
        )));
    }
    let archive = opened.map_err(|e| PthError::damaged(format!("its zip archive cannot be read ({e})")))?;
    if archive.has_duplicate_names() {
        return Err(PthError::damaged("its zip archive has two entries of one name"));
    }
    left.set(u64::MAX);
    Ok(archive)
}

/// Reads only so many bytes: an archive can name many places at which its table of contents might begin.
struct Limited<'b> {
    inner: Box<dyn Source + 'b>,
    left: Rc<Cell<u64>>,
}

impl Read for Limited<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let left = self.left.get();
        if left == 0 {
            return Err(io::Error::other("the limit is reached"));
        }
        let n = usize::try_from(left).unwrap_or(usize::MAX).min(buffer.len());
        let n = self.inner.read(&mut buffer[..n])?;
        self.left.set(left - n as u64);
        Ok(n)
    }
}

impl Seek for Limited<'_> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.inner.seek(to)
    }
}

/// Reads an archive.
pub(super) fn read(bytes: Vec<u8>) -> Result<State, PthError> {
    let bytes = Arc::new(bytes);
    let mut archive = Archive::open(&bytes)?;
    let prefix = archive.prefix()?;
    if archive.has(&format!("{prefix}constants.pkl")) {
        return Err(PthError::Unsupported(
            "a TorchScript archive, which holds a program: in Python, torch.save(torch.jit.load(FILE).state_dict(), ...)"
                .into(),
        ));
    }
    archive.expect_little_endian(&prefix)?;
    archive.expect_known_version(&prefix)?;

    let pickle = archive.take(&format!("{prefix}data.pkl"), Expected::AtMost(MAX_PICKLE))?;
    let pickle_bytes = pickle.bytes.get(pickle.range.clone()).unwrap_or(&[]);
    let built = pickle::read(pickle_bytes)?;
    let mut storages = Vec::with_capacity(built.storages.len());
    for claim in &built.storages {
        let name = format!("{prefix}data/{}", claim.key);
        storages.push(archive.take(&name, Expected::Exactly(claim.bytes()?))?);
    }
    built.flatten(Format::Zip, &storages)
}

/// How long an entry has to be.
#[derive(Clone, Copy)]
pub(in crate::formats) enum Expected {
    Exactly(u64),
    AtMost(u64),
}

pub(in crate::formats) struct Archive<'b> {
    zip: ZipArchive<Limited<'b>>,
    bytes: &'b Arc<Vec<u8>>,
    /// The bytes of entries that may still be read. Entries could overlap, and so be more than the file.
    stored_left: u64,
    /// The bytes that may still be unpacked.
    inflated_left: u64,
}

impl<'b> Archive<'b> {
    pub(in crate::formats) fn open(bytes: &'b Arc<Vec<u8>>) -> Result<Self, PthError> {
        let zip = open(Box::new(Cursor::new(bytes.as_slice())))?;
        let size = bytes.len() as u64;
        Ok(Archive { zip, bytes, stored_left: size, inflated_left: size.saturating_mul(MAX_INFLATION) + SMALL })
    }

    /// The entries' names, as far as they are UTF-8.
    pub(in crate::formats) fn names(&self) -> Vec<String> {
        self.zip.file_names().filter_map(|name| Some(name.ok()?.into_owned())).collect()
    }

    fn has(&self, name: &str) -> bool {
        self.zip.index_for_name(name).is_some()
    }

    /// `NAME/`, the folder that everything is in.
    fn prefix(&self) -> Result<String, PthError> {
        let mut found = self.zip.file_names().filter_map(|name| Some(name.ok()?.strip_suffix("data.pkl")?.to_owned()));
        match (found.next(), found.next()) {
            (Some(prefix), None) if prefix.is_empty() || prefix.ends_with('/') => Ok(prefix),
            (Some(first), Some(second)) => Err(PthError::damaged(format!(
                "it has both `{}data.pkl` and `{}data.pkl`, expected one",
                shown(&first),
                shown(&second)
            ))),
            _ => Err(PthError::NotACheckpoint("a zip archive without the entry data.pkl".into())),
        }
    }

    fn expect_little_endian(&mut self, prefix: &str) -> Result<(), PthError> {
        match self.small_text(&format!("{prefix}byteorder"))?.as_deref() {
            None | Some("little") => Ok(()),
            Some("big") => Err(big_endian()),
            Some(other) => Err(PthError::damaged(format!("byte order `{}`, expected `little`", shown(other)))),
        }
    }

    fn expect_known_version(&mut self, prefix: &str) -> Result<(), PthError> {
        match self.small_text(&format!("{prefix}version"))?.as_deref().map(str::parse::<u32>) {
            None => Ok(()),
            Some(Ok(version)) if version <= NEWEST_VERSION => Ok(()),
            Some(Ok(version)) => {
                Err(PthError::Unsupported(format!("format version {version}, expected at most {NEWEST_VERSION}")))
            }
            Some(Err(_)) => Err(PthError::damaged("its version is not a number")),
        }
    }

    /// A short entry that need not be there.
    fn small_text(&mut self, name: &str) -> Result<Option<String>, PthError> {
        if !self.has(name) {
            return Ok(None);
        }
        let entry = self.take(name, Expected::AtMost(64))?;
        let bytes = entry.bytes.get(entry.range).unwrap_or(&[]);
        Ok(Some(String::from_utf8_lossy(bytes).trim().to_owned()))
    }

    /// An entry's bytes: a part of the file if it is stored as it is, unpacked otherwise. Its checksum is compared.
    pub(in crate::formats) fn take(&mut self, name: &str, expected: Expected) -> Result<Storage, PthError> {
        let Some(index) = self.zip.index_for_name(name) else {
            return Err(PthError::damaged(format!("the entry `{}` is missing", shown(name))));
        };
        let failed = |e: ZipError| PthError::damaged(format!("the entry `{}` cannot be read ({e})", shown(name)));
        let mut entry = self.zip.by_index(index).map_err(failed)?;
        let size = entry.size();
        match expected {
            Expected::Exactly(n) if size != n => {
                return Err(PthError::damaged(format!("the entry `{}` has {size} bytes, expected {n}", shown(name))));
            }
            Expected::AtMost(n) if size > n => {
                return Err(PthError::TooLarge(format!("the entry `{}` has {size} bytes (at most {n})", shown(name))));
            }
            _ => {}
        }
        let too_much = || PthError::TooLarge(format!("up to `{}` the entries are larger than the file", shown(name)));
        self.stored_left = self.stored_left.checked_sub(entry.compressed_size()).ok_or_else(too_much)?;
        let unreadable = |e: io::Error| PthError::damaged(format!("the entry `{}` cannot be read ({e})", shown(name)));
        if entry.compression() == CompressionMethod::Stored {
            let range = stored_range(entry.data_start(), size, self.bytes.len())
                .ok_or_else(|| PthError::truncated(format!("the entry `{}` goes beyond its end", shown(name))))?;
            // Reading to the end compares the checksum.
            let read = io::copy(&mut entry, &mut io::sink()).map_err(unreadable)?;
            if read != size {
                return Err(PthError::truncated(format!("the entry `{}` has {read} bytes of {size}", shown(name))));
            }
            return Ok(Storage { bytes: Arc::clone(self.bytes), range });
        }
        self.inflated_left = self.inflated_left.checked_sub(size).ok_or_else(|| {
            PthError::TooLarge(format!(
                "unpacked up to `{}` it has over {MAX_INFLATION} times the file's size",
                shown(name)
            ))
        })?;
        let mut unpacked = Vec::new();
        entry.take(size.saturating_add(1)).read_to_end(&mut unpacked).map_err(unreadable)?;
        if unpacked.len() as u64 != size {
            let found = unpacked.len();
            return Err(PthError::damaged(format!("the entry `{}` has {found} bytes, expected {size}", shown(name))));
        }
        let range = 0..unpacked.len();
        Ok(Storage { bytes: Arc::new(unpacked), range })
    }
}

/// Where an entry that is stored as it is lies in the file.
fn stored_range(start: Option<u64>, size: u64, file: usize) -> Option<Range<usize>> {
    let start = usize::try_from(start?).ok()?;
    let end = start.checked_add(usize::try_from(size).ok()?)?;
    (end <= file).then_some(start..end)
}

/// The same words for both formats.
pub(super) fn big_endian() -> PthError {
    PthError::Unsupported(
        "it was written on a big-endian machine, and only little-endian numbers are read: load it in Python on a usual \
         machine and save it again"
            .into(),
    )
}
