//! The log of a run: a line of JSON for each logged step, and one for each validation.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::error::{Error, Result};
use crate::formats::atomic::write_bytes_atomically;
use crate::formats::bounded::read_text;

/// Some million lines.
const MAX_LOG: u64 = 1 << 30;

/// `log.jsonl`, open at its end.
pub(super) struct Log {
    path: PathBuf,
    file: File,
}

impl Log {
    pub(super) fn open(folder: &Path) -> Result<Self> {
        let path = folder.join("log.jsonl");
        let file = OpenOptions::new().create(true).append(true).open(&path).map_err(|e| Error::io(&path, e))?;
        Ok(Log { path, file })
    }

    /// Adds a line.
    pub(super) fn write(&mut self, line: &impl Serialize) -> Result<()> {
        let text = serde_json::to_string(line).map_err(|e| Error::Failed(format!("the log: {e}")))?;
        writeln!(self.file, "{text}").map_err(|e| Error::io(&self.path, e))
    }
}

/// Removes the lines of steps and validations after those that are known to be done: they will be logged again.
pub(super) fn forget_after(folder: &Path, steps: u64, validated: u64) -> Result<()> {
    let path = folder.join("log.jsonl");
    if !path.exists() {
        return Ok(());
    }
    let text = read_text(&path, MAX_LOG, "the log of a run")?;
    let keep = |line: &&str| {
        // A torn last line is none.
        let Ok(line) = serde_json::from_str::<serde_json::Value>(line) else { return false };
        let number = |field: &str| line[field].as_u64();
        number("step").is_some_and(|s| s <= steps) || number("validated").is_some_and(|s| s <= validated)
    };
    let kept: String = text.lines().filter(keep).flat_map(|l| [l, "\n"]).collect();
    write_bytes_atomically(&path, kept.as_bytes())
}
