//! Whole files from outside, never more of them than such a file may have.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use crate::{Error, Result};

/// The most bytes that text written by people has: a configuration, a camera, a calibration.
pub const MAX_SETTINGS: u64 = 1 << 20;

/// Pictures with more pixels are refused.
pub const MAX_PIXELS: u64 = 100_000_000;

/// The bytes of a file, which is refused if it has more than `limit`; `what` it is meant to be stands in the message. What
/// is no real file and never ends (a device, a pipe) is refused as well, after as much.
///
/// # Errors
/// If it cannot be read, or is larger: names the file, the limit, and what to do.
pub fn read_bounded(path: &Path, limit: u64, what: &str) -> Result<Vec<u8>> {
    let file = File::open(path).map_err(|e| Error::io(path, e))?;
    let length = file.metadata().map_err(|e| Error::io(path, e))?.len();
    let too_large = |found: String| {
        let message = format!(
            "has {found} bytes, but {what} of more than {limit} is not read: check that this is the file meant"
        );
        Error::file(path, message)
    };
    if length > limit {
        return Err(too_large(length.to_string()));
    }
    let mut bytes = Vec::new();
    file.take(limit.saturating_add(1)).read_to_end(&mut bytes).map_err(|e| Error::io(path, e))?;
    if bytes.len() as u64 > limit {
        return Err(too_large(format!("more than {limit}")));
    }
    Ok(bytes)
}

/// [`read_bounded`] as text.
///
/// # Errors
/// As [`read_bounded`], and if it is not UTF-8.
pub fn read_text(path: &Path, limit: u64, what: &str) -> Result<String> {
    let bytes = read_bounded(path, limit, what)?;
    String::from_utf8(bytes).map_err(|e| {
        let at = e.utf8_error().valid_up_to();
        Error::file(path, format!("expected {what}, which is text in UTF-8; the byte at {at} is none"))
    })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn what_is_larger_than_it_may_be_is_refused_before_it_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("list.txt");
        fs::write(&path, "12345").unwrap();
        assert_eq!(read_bounded(&path, 5, "a list").unwrap(), b"12345");
        assert_eq!(read_text(&path, 9, "a list").unwrap(), "12345");
        let error = read_bounded(&path, 4, "a list").unwrap_err().to_string();
        for part in ["list.txt", "has 5 bytes", "a list of more than 4", "check"] {
            assert!(error.contains(part), "{error}");
        }
        // A file of a terabyte that holds nothing.
        File::create(&path).unwrap().set_len(1 << 40).unwrap();
        assert!(read_text(&path, MAX_SETTINGS, "a list").unwrap_err().to_string().contains("1099511627776 bytes"));
    }

    #[cfg(unix)]
    #[test]
    fn what_never_ends_is_refused() {
        let error = read_bounded(Path::new("/dev/zero"), 1000, "a list").unwrap_err().to_string();
        assert!(error.contains("/dev/zero") && error.contains("more than 1000 bytes"), "{error}");
    }

    #[test]
    fn what_is_no_text_or_not_there_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("list.txt");
        assert!(read_text(&path, 9, "a list").unwrap_err().to_string().contains("list.txt"));
        fs::write(&path, b"ab\xff").unwrap();
        let error = read_text(&path, 9, "a list").unwrap_err().to_string();
        assert!(error.contains("list.txt") && error.contains("UTF-8") && error.contains("at 2"), "{error}");
        assert!(read_bounded(folder.path(), 9, "a list").is_err());
    }
}
