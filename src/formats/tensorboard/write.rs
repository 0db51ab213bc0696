//! Event files as they are written: a new one for every session, frame after frame.

use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use prost::Message;

use super::checksum;
use super::message::{Event, Point, SessionLog, Status, Summary, What};
use crate::{Error, Result};

/// The version that readers take the files for.
pub const FILE_VERSION: &str = "brain.Event:2";
/// The beginning of the names by which TensorBoard knows its files. TensorFlow ends them in the name of the host, which is
/// nobody's business.
const NAME: &str = "events.out.tfevents.";

/// An event file, open at its end.
pub struct EventWriter {
    path: PathBuf,
    file: File,
}

impl EventWriter {
    /// A new file in a folder, which is made if it is missing; its name sorts after those of all that lie there. Readers
    /// forget what earlier files say of steps from `from` on.
    ///
    /// # Errors
    /// If the folder or the file cannot be made or written.
    pub fn create(folder: &Path, from: u64) -> Result<Self> {
        fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
        let (path, file) = new_file(folder)?;
        let mut writer = EventWriter { path, file };
        writer.write(0, What::FileVersion(FILE_VERSION.into()))?;
        writer.write(from, What::SessionLog(SessionLog { status: Status::Start.into() }))?;
        Ok(writer)
    }

    /// Adds what is known of a step.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn add(&mut self, step: u64, points: Vec<Point>) -> Result<()> {
        self.write(step, What::Summary(Summary { points }))
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    fn write(&mut self, step: u64, what: What) -> Result<()> {
        let event = Event { wall_time: now(), step: i64::try_from(step).unwrap_or(i64::MAX), what: Some(what) };
        let message = event.encode_to_vec();
        let length = (message.len() as u64).to_le_bytes();
        let mut frame = Vec::with_capacity(message.len() + 16);
        frame.extend_from_slice(&length);
        frame.extend_from_slice(&checksum(&length).to_le_bytes());
        frame.extend_from_slice(&message);
        frame.extend_from_slice(&checksum(&message).to_le_bytes());
        // In one call: a program that is killed leaves whole frames.
        self.file.write_all(&frame).map_err(|e| Error::io(&self.path, e))
    }
}

/// Seconds since 1970.
fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |t| t.as_secs_f64())
}

/// `events.out.tfevents.SECONDS.NUMBER`, neither of them less than any that is there: a clock may have been set back, and
/// two sessions may begin within a second.
fn new_file(folder: &Path) -> Result<(PathBuf, File)> {
    let entries = fs::read_dir(folder).map_err(|e| Error::io(folder, e))?;
    let numbers = |name: String| {
        let (seconds, number) = name.strip_prefix(NAME)?.split_once('.')?;
        Some((seconds.parse::<u64>().ok()?, number.parse::<u64>().ok()?))
    };
    let there = entries.flatten().filter_map(|entry| numbers(entry.file_name().to_string_lossy().into_owned()));
    let (latest, most) = there.fold((0, None), |(s, n), (t, m)| (s.max(t), n.max(Some(m))));
    let seconds = latest.max(now() as u64);
    for number in most.map_or(0, |most| most.saturating_add(1)).. {
        let path = folder.join(format!("{NAME}{seconds:010}.{number:04}"));
        match File::create_new(&path) {
            Ok(file) => return Ok((path, file)),
            Err(e) if e.kind() == ErrorKind::AlreadyExists => {}
            Err(e) => return Err(Error::io(&path, e)),
        }
    }
    Err(Error::file(folder, "is full of event files"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn later_files_sort_after_earlier_ones_whatever_the_clock_says() {
        let place = tempfile::tempdir().unwrap();
        let first = EventWriter::create(place.path(), 1).unwrap().path;
        fs::write(place.path().join("events.out.tfevents.9999999999.0007"), "").unwrap();
        fs::write(place.path().join("events.out.tfevents.1.somebodys-host"), "").unwrap();
        let second = EventWriter::create(place.path(), 1).unwrap().path;
        let third = EventWriter::create(place.path(), 1).unwrap().path;
        assert!(first < second && second < third, "{first:?} {second:?} {third:?}");
        assert_eq!(third.file_name().unwrap(), "events.out.tfevents.9999999999.0009");
    }
}
