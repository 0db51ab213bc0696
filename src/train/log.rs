//! The logs of a run, lines of JSON: `log.jsonl` has one for each logged step, for each validation and for what the run's
//! page took there, `warnings.jsonl` one for each warning that begins or ends.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::trainer::StepReport;
use crate::error::{Error, Result};
use crate::formats::atomic::write_bytes_atomically;
use crate::formats::bounded::read_text;

/// Some million lines.
const MAX_LOG: u64 = 1 << 30;

/// The file of steps and validations.
pub(super) const LOG: &str = "log.jsonl";
/// The file of warnings.
pub(super) const WARNINGS: &str = "warnings.jsonl";

/// A log, open at its end.
pub(super) struct Log {
    path: PathBuf,
    file: File,
}

impl Log {
    /// Opens a file of a run's folder, which is made if it is missing.
    pub(super) fn open(folder: &Path, name: &str) -> Result<Self> {
        let path = folder.join(name);
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
    for name in [LOG, WARNINGS] {
        let path = folder.join(name);
        if !path.exists() {
            continue;
        }
        let text = read_text(&path, MAX_LOG, "the log of a run")?;
        let keep = |line: &&str| {
            // A torn last line is none.
            let Ok(line) = serde_json::from_str::<serde_json::Value>(line) else { return false };
            let number = |field: &str| line[field].as_u64();
            let validation = number("validated").or_else(|| number("page"));
            number("step").is_some_and(|s| s <= steps) || validation.is_some_and(|s| s <= validated)
        };
        let kept: String = text.lines().filter(keep).flat_map(|l| [l, "\n"]).collect();
        write_bytes_atomically(&path, kept.as_bytes())?;
    }
    Ok(())
}

/// The last logged step of a run; nothing where none is.
pub(super) fn last_step(folder: &Path) -> Result<Option<u64>> {
    Ok(lines(folder)?.iter().rev().find_map(|line| line["step"].as_u64()))
}

/// The step of the last validation that found the best weights so far; nothing where none did.
pub(super) fn best_step(folder: &Path) -> Result<Option<u64>> {
    let best = |line: &serde_json::Value| line["validated"].as_u64().filter(|_| line["best"] == true);
    Ok(lines(folder)?.iter().rev().find_map(best))
}

/// The lines of a run's log, oldest first, without those that are no JSON; none where there is no log.
fn lines(folder: &Path) -> Result<Vec<serde_json::Value>> {
    let path = folder.join(LOG);
    if !path.exists() {
        return Ok(Vec::new());
    }
    let text = read_text(&path, MAX_LOG, "the log of a run")?;
    Ok(text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect())
}

/// Steps of a run's log, oldest first. Lines from before they had all of today's figures are left out.
pub(super) fn steps(folder: &Path) -> Result<Vec<StepReport>> {
    let step = |line: serde_json::Value| {
        line.get("flow")?;
        serde_json::from_value(line).ok()
    };
    Ok(lines(folder)?.into_iter().filter_map(step).collect())
}
