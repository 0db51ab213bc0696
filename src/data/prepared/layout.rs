//! The file of prepared frames: what stands where in it.
//!
//! ```text
//! 0   "PLXFRAME", version, height, width, number of frames (u32 each), bytes of the list (u64), checksum of all before
//!     and of the list (CRC-32), zero: 40 bytes, little-endian
//! 40  the list, for each frame: bytes of its name (u32), its name, bytes (u64) and time (i64 seconds, u32 nanoseconds)
//!     of the file that it was made of
//! ..  for each frame its checksum (CRC-32) and whether it is there (1, else 0), u32 each
//! ..  the frames, 3 height width bytes each
//! ```

use std::fs::{self, File};
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use crate::data::check::frame_files;
use crate::{Error, Result};

const MAGIC: &[u8; 8] = b"PLXFRAME";
const VERSION: u32 = 2;
const HEADER: u64 = 40;
/// Bytes of a frame in the list, without its name; in the table of checksums.
const LISTED: u64 = 24;
const ENTRY: u64 = 8;
/// A list of a million frames is shorter.
const MAX_LIST: u64 = 1 << 30;

/// The file that a frame was made of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Source {
    /// Its path below the folder of all data, with `/` between the parts.
    pub(super) name: String,
    bytes: u64,
    /// When it was modified: seconds and nanoseconds since the beginning of 1970.
    modified: (i64, u32),
}

impl Source {
    /// The frames below a folder as they are now, in order.
    ///
    /// # Errors
    /// If the folder cannot be read or holds no frame, or a name is not UTF-8.
    pub(super) fn all(root: &Path) -> Result<Vec<Source>> {
        let source = |path: PathBuf| {
            let name = name_below(root, &path).ok_or_else(|| {
                Error::file(&path, "its name is not UTF-8, which names of prepared frames have to be: rename it")
            })?;
            let metadata = fs::metadata(&path).map_err(|e| Error::io(&path, e))?;
            let modified = metadata.modified().map_err(|e| Error::io(&path, e))?;
            let modified = match modified.duration_since(UNIX_EPOCH) {
                Ok(since) => (since.as_secs() as i64, since.subsec_nanos()),
                Err(before) => (-(before.duration().as_secs() as i64) - 1, before.duration().subsec_nanos()),
            };
            Ok(Source { name, bytes: metadata.len(), modified })
        };
        frame_files(root)?.into_iter().map(source).collect()
    }
}

/// The path of a file below a folder as lists write it.
pub(super) fn name_below(root: &Path, path: &Path) -> Option<String> {
    let parts: Option<Vec<&str>> = path.strip_prefix(root).ok()?.iter().map(|part| part.to_str()).collect();
    parts.map(|parts| parts.join("/"))
}

/// Which frames, of which size; all places in the file follow.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Layout {
    pub(super) height: u32,
    pub(super) width: u32,
    pub(super) sources: Vec<Source>,
}

impl Layout {
    /// The header and the list.
    pub(super) fn head(&self) -> Vec<u8> {
        let mut list = Vec::new();
        for Source { name, bytes, modified: (seconds, nanoseconds) } in &self.sources {
            list.extend((name.len() as u32).to_le_bytes());
            list.extend(name.as_bytes());
            list.extend(bytes.to_le_bytes());
            list.extend(seconds.to_le_bytes());
            list.extend(nanoseconds.to_le_bytes());
        }
        let mut head = MAGIC.to_vec();
        for number in [VERSION, self.height, self.width, self.sources.len() as u32] {
            head.extend(number.to_le_bytes());
        }
        head.extend((list.len() as u64).to_le_bytes());
        head.extend(checksum(&[&head, &list]).to_le_bytes());
        head.extend([0; 4]);
        head.extend(list);
        head
    }

    fn list_bytes(&self) -> u64 {
        self.sources.iter().map(|source| LISTED + source.name.len() as u64).sum()
    }

    /// Bytes of a frame.
    pub(super) fn frame_bytes(&self) -> u64 {
        3 * u64::from(self.height) * u64::from(self.width)
    }

    /// Where the checksum of a frame stands.
    pub(super) fn entry_at(&self, frame: usize) -> u64 {
        HEADER + self.list_bytes() + ENTRY * frame as u64
    }

    /// Where a frame stands.
    pub(super) fn frame_at(&self, frame: usize) -> u64 {
        self.entry_at(self.sources.len()) + self.frame_bytes() * frame as u64
    }

    /// Bytes of the whole file.
    pub(super) fn file_bytes(&self) -> u64 {
        self.frame_at(self.sources.len())
    }

    /// Reads header and list of a file, and leaves it at the table of checksums.
    ///
    /// # Errors
    /// If the file is none of prepared frames, of another version, shorter or longer than it says, or damaged.
    pub(super) fn read(file: &mut File, path: &Path) -> Result<Layout> {
        let again = "prepare the frames again: parallax data prepare";
        let wrong = |what: &str| Error::file(path, format!("{what}; {again}"));
        let length = file.metadata().map_err(|e| Error::io(path, e))?.len();
        let mut header = [0u8; HEADER as usize];
        file.seek(SeekFrom::Start(0)).map_err(|e| Error::io(path, e))?;
        file.read_exact(&mut header).map_err(|_| wrong("is no file of prepared frames"))?;
        let mut fields = Fields(&header);
        if fields.take::<8>() != Some(*MAGIC) {
            return Err(wrong("is no file of prepared frames"));
        }
        let version = fields.u32().unwrap_or(0);
        if version != VERSION {
            return Err(wrong(&format!("has version {version} of the format, this program reads {VERSION}")));
        }
        let truncated = || wrong("is shorter than it says: it was cut off");
        let mut number = || fields.u32().ok_or_else(truncated);
        let (height, width, count) = (number()?, number()?, number()?);
        let list_bytes = fields.u64().ok_or_else(truncated)?;
        let expected = fields.u32().ok_or_else(truncated)?;
        // What the file claims is compared with its length before memory is taken for it.
        if list_bytes > MAX_LIST || list_bytes > length - HEADER || u64::from(count) * LISTED > list_bytes {
            return Err(truncated());
        }
        let mut list = vec![0; list_bytes as usize];
        file.read_exact(&mut list).map_err(|e| Error::io(path, e))?;
        if checksum(&[&header[..32], &list]) != expected {
            return Err(wrong("its list of frames is damaged"));
        }
        let sources = sources(&list, count as usize).ok_or_else(|| wrong("its list of frames is damaged"))?;
        let layout = Layout { height, width, sources };
        let frames = layout.frame_bytes().checked_mul(u64::from(count));
        if frames.is_none_or(|frames| length.checked_sub(frames) != Some(layout.frame_at(0))) {
            return Err(wrong(&format!(
                "has {length} bytes, which are not those of {count} frames of {width}x{height}"
            )));
        }
        Ok(layout)
    }
}

/// The frames of a list.
fn sources(list: &[u8], count: usize) -> Option<Vec<Source>> {
    let mut fields = Fields(list);
    let source = |_| {
        let length = fields.u32()?;
        let name = String::from_utf8(fields.bytes(length as usize)?.to_vec()).ok()?;
        let bytes = fields.u64()?;
        Some(Source { name, bytes, modified: (fields.u64()? as i64, fields.u32()?) })
    };
    let sources = (0..count).map(source).collect::<Option<Vec<_>>>()?;
    fields.0.is_empty().then_some(sources)
}

/// Bytes that are taken off the front.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    fn bytes(&mut self, n: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(n)?;
        self.0 = rest;
        Some(taken)
    }

    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        self.bytes(N)?.try_into().ok()
    }

    fn u32(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.take().map(u64::from_le_bytes)
    }
}

/// CRC-32 of bytes one after the other.
pub(super) fn checksum(parts: &[&[u8]]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    parts.iter().for_each(|part| hasher.update(part));
    hasher.finalize()
}
