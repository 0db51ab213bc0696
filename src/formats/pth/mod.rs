//! PyTorch checkpoints (`.pth`, `.pt`): a reader that never runs anything, and a small writer.
//!
//! `torch.save` writes a *pickle*: a program for a little stack machine that builds Python objects, and that may name
//! any Python function and call it. Here the machine builds nothing but numbers, strings, lists, dictionaries and
//! descriptions of tensors. The few names it knows (`collections.OrderedDict`, `torch._utils._rebuild_tensor_v2`, the
//! storage classes, ...) stand in one table in `globals.rs` and mean those descriptions; every other name is refused.
//!
//! Two containers hold that pickle and the numbers: a zip archive since PyTorch 1.6 (`archive.rs`), before that several
//! pickles in a row with the numbers behind them (`legacy.rs`). `state.rs` is what comes out: an ordered list of dotted
//! names with their tensors and plain values. `write.rs` goes the other way.
//!
//! Everything in a file is a claim until it has been checked against the bytes that are there: memory and time are
//! bounded by the file's size and by the constants below, and no input makes the reader panic.

pub(in crate::formats) mod archive;
mod flatten;
mod globals;
mod legacy;
mod pickle;
mod state;
mod write;

#[cfg(test)]
mod tests;

pub use state::{Format, Item, Plain, State};
pub use write::{Saved, write};

use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use crate::error::Error;

/// The largest checkpoint that is read at all, in bytes. 100 million weights with the two moments of AdamW take 1.2 GB.
pub const MAX_FILE: u64 = 2 << 30;
/// The longest pickle, in bytes. That of 800 tensors has 0.1 MB.
const MAX_PICKLE: u64 = 64 << 20;
/// The most bytes of a zip archive's table of contents. An entry takes some 60.
const MAX_DIRECTORY: u64 = 16 << 20;
/// The most instructions of a pickle, which bounds its objects, memo and stack. A tensor takes some 30.
const MAX_INSTRUCTIONS: usize = 1 << 20;
/// The deepest nesting of dictionaries and lists.
const MAX_DEPTH: usize = 32;
/// The most values that are looked at when the nested dictionaries are flattened.
const MAX_VALUES: usize = 1 << 20;
/// The most bytes in all the names and strings of the result together.
const MAX_TEXT: usize = 64 << 20;
/// The most dimensions of a tensor.
const MAX_RANK: usize = 16;
/// How often larger than the bytes stored all the tensors together (which may share them) can be.
const MAX_SHARING: u128 = 8;
/// How often larger than the file all its compressed parts together can be.
const MAX_INFLATION: u64 = 64;
/// What the two ratios above allow in any case, so that tiny files are not refused: a mebibyte.
const SMALL: u64 = 1 << 20;

/// Why a checkpoint could not be read or written. The messages do not name the file: the caller knows it.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PthError {
    /// The operating system refused.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// Something else than a PyTorch checkpoint.
    #[error("not a PyTorch checkpoint: {0}")]
    NotACheckpoint(String),
    /// The file ends too early.
    #[error("the file is cut short: {0}. Copy or download it again")]
    Truncated(String),
    /// The bytes contradict each other.
    #[error("the file is damaged: {0}")]
    Damaged(String),
    /// The pickle names a Python function or class that is not on the list. Nothing was run.
    #[error(
        "it refers to `{0}`, which no list of weights needs; nothing was run. If you trust the file, load it in Python \
         and save its state_dict() alone"
    )]
    Refused(String),
    /// More than a list of weights has, of something.
    #[error("{0}, more than a list of weights has")]
    TooLarge(String),
    /// A checkpoint, but of a kind that is not read.
    #[error("{0}")]
    Unsupported(String),
    /// A tensor that does not fit the numbers it is said to be made of, or holds another kind of number.
    #[error("tensor `{name}`: {message}")]
    Tensor {
        /// The tensor's name, as far as it is known.
        name: String,
        /// What was expected and what was found.
        message: String,
    },
    /// Two entries have the same dotted name.
    #[error("`{0}` is there twice: which one is meant cannot be told")]
    Duplicate(String),
}

impl PthError {
    /// The same as this crate's error, which names the file.
    pub fn in_file(self, path: impl AsRef<Path>) -> Error {
        match self {
            PthError::Io(source) => Error::io(path, source),
            other => Error::file(path, other.to_string()),
        }
    }

    fn truncated(what: impl Into<String>) -> Self {
        PthError::Truncated(what.into())
    }

    fn damaged(what: impl Into<String>) -> Self {
        PthError::Damaged(what.into())
    }
}

/// Reads a checkpoint. A file that cannot be one is refused before it has been read whole.
pub fn read(path: impl AsRef<Path>) -> Result<State, PthError> {
    let mut file = File::open(path)?;
    if file.metadata()?.is_dir() {
        return Err(PthError::NotACheckpoint("a folder".into()));
    }
    let size = file.seek(SeekFrom::End(0))?;
    if size > MAX_FILE {
        return Err(PthError::TooLarge(format!("the file has {size} bytes (at most {MAX_FILE} are read)")));
    }
    file.seek(SeekFrom::Start(0))?;
    let mut head = Vec::new();
    (&mut file).take(512).read_to_end(&mut head)?;
    match recognise(&head)? {
        Format::Zip => archive::check(BufReader::new(&mut file))?,
        Format::Legacy => legacy::check(&head)?,
    }
    file.seek(SeekFrom::Start(0))?;
    let mut bytes = Vec::with_capacity(usize::try_from(size).unwrap_or(0));
    file.take(MAX_FILE).read_to_end(&mut bytes)?;
    from_bytes(bytes)
}

/// Reads a checkpoint that is in memory. The tensors keep the bytes alive and take their numbers from them.
pub fn from_bytes(bytes: Vec<u8>) -> Result<State, PthError> {
    if bytes.len() as u64 > MAX_FILE {
        return Err(PthError::TooLarge(format!("the file has {} bytes (at most {MAX_FILE} are read)", bytes.len())));
    }
    match recognise(&bytes)? {
        Format::Zip => archive::read(bytes),
        Format::Legacy => legacy::read(bytes),
    }
}

/// Which of the two formats the first bytes of a file belong to.
fn recognise(head: &[u8]) -> Result<Format, PthError> {
    let not = |what: &str| Err(PthError::NotACheckpoint(what.into()));
    match head {
        [] => Err(PthError::truncated("it is empty")),
        [b'P', b'K', 3, 4, ..] => Ok(Format::Zip),
        [b'P', b'K', 5, 6, ..] => not("an empty zip archive"),
        // A pickle begins with its protocol, 2 to 5.
        [0x80, 2..=5, ..] => Ok(Format::Legacy),
        _ if head.get(257..262) == Some(b"ustar") => Err(PthError::Unsupported(
            "a tar archive, as PyTorch before 0.2 wrote them: load it in Python and save it again".into(),
        )),
        _ if head.get(8) == Some(&b'{') && head.get(5..8) == Some(&[0; 3]) => {
            not("it looks like safetensors; rename it to .safetensors")
        }
        _ if head.starts_with(b"version https://git-lfs") => {
            not("a Git LFS pointer; run `git lfs pull` to get the file itself")
        }
        _ if head.trim_ascii_start().starts_with(b"<") => not("a web page; download the file itself"),
        _ => not("it begins neither like a zip archive nor like a pickle"),
    }
}

/// A name from the file as it may be printed: no control characters, and not too long.
pub(crate) fn shown(text: &str) -> String {
    let mut out: String = text.chars().take(100).flat_map(char::escape_debug).collect();
    if text.chars().nth(100).is_some() {
        out += "...";
    }
    out
}
