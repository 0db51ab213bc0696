//! The one error type of everything that comes from outside: files, flags, data, checkpoints.
//!
//! A wrong shape in *code* panics instead, with the op's name and both shapes.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

/// What went wrong, where, and what to do about it.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file could not be read or written.
    #[error("{path}: {source}", path = printable(&path.to_string_lossy()))]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// A file was read, but what it says cannot be used.
    #[error("{path}: {message}", path = printable(&path.to_string_lossy()), message = printable(message))]
    File {
        /// The file.
        path: PathBuf,
        /// What was expected, what was found, and what to do.
        message: String,
    },
    /// A setting (a flag, a field of a configuration) cannot be used.
    #[error("{name}: {message}", name = printable(name), message = printable(message))]
    Setting {
        /// The flag or field.
        name: String,
        /// What was expected, what was found, and what to do.
        message: String,
    },
    /// A computation failed (a loss that is not finite, for example).
    #[error("{}", printable(.0))]
    Failed(String),
}

/// `Result` with this crate's [`Error`].
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Text from outside (names of files, what is in them) for a terminal: control characters, which could start an escape
/// sequence, are shown escaped; line ends and tabs stay.
pub fn printable(text: &str) -> Cow<'_, str> {
    // Marks that turn the direction of text hide what it says as well.
    let hostile = |c: char| {
        (c.is_control() && !matches!(c, '\n' | '\t'))
            || matches!(c, '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' | '\u{200e}' | '\u{200f}')
    };
    if !text.contains(hostile) {
        return Cow::Borrowed(text);
    }
    let escape = |c: char| if hostile(c) { c.escape_default().to_string() } else { c.to_string() };
    Cow::Owned(text.chars().map(escape).collect())
}

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_error_lets_an_escape_sequence_through() {
        let bad = "a\u{1b}[2Jb\r\u{9b}1m\u{202e}c";
        let errors = [
            Error::io(bad, std::io::Error::other("no")),
            Error::file(bad, bad),
            Error::setting(bad, bad),
            Error::Failed(bad.into()),
        ];
        for error in errors {
            let said = error.to_string();
            assert!(said.contains("a\\u{1b}[2Jb\\r") && said.contains("\\u{202e}c"), "{said:?}");
            assert!(!said.contains(|c: char| c.is_control()), "{said:?}");
        }
        assert_eq!(printable("two\nlines\tand \u{e9}"), "two\nlines\tand \u{e9}");
    }
}
