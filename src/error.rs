//! The one error type of everything that comes from outside: files, flags, data, checkpoints.
//!
//! A wrong shape in *code* panics instead, with the op's name and both shapes.

use std::path::{Path, PathBuf};

/// What went wrong, where, and what to do about it.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file could not be read or written.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// A file was read, but what it says cannot be used.
    #[error("{path}: {message}", path = path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What was expected, what was found, and what to do.
        message: String,
    },
    /// A setting (a flag, a field of a configuration) cannot be used.
    #[error("{name}: {message}")]
    Setting {
        /// The flag or field.
        name: String,
        /// What was expected, what was found, and what to do.
        message: String,
    },
    /// A computation failed (a loss that is not finite, for example).
    #[error("{0}")]
    Failed(String),
}

/// `Result` with this crate's [`Error`].
pub type Result<T, E = Error> = std::result::Result<T, E>;

impl Error {
    /// An operating-system error at `path`.
    pub fn io(path: impl AsRef<Path>, source: std::io::Error) -> Self {
        Error::Io { path: path.as_ref().to_owned(), source }
    }

    /// A file whose content cannot be used.
    pub fn file(path: impl AsRef<Path>, message: impl Into<String>) -> Self {
        Error::File { path: path.as_ref().to_owned(), message: message.into() }
    }

    /// A flag or configuration field that cannot be used.
    pub fn setting(name: impl Into<String>, message: impl Into<String>) -> Self {
        Error::Setting { name: name.into(), message: message.into() }
    }
}
