//! Samples that cannot be read, and those that stand for them.

use std::collections::HashSet;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::frames::Frames;
use crate::data::DataSource;
use crate::data::stereo::Sources;
use crate::error::{Error, Result};

/// The samples that are passed over because a frame of theirs cannot be read; shared by all that read them.
#[derive(Clone, Debug, Default)]
pub struct SkipList(Arc<Mutex<Skipped>>);

#[derive(Debug, Default)]
struct Skipped {
    names: HashSet<String>,
    first: Option<String>,
}

impl SkipList {
    fn skipped(&self) -> MutexGuard<'_, Skipped> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a sample by its name, and why; whether it is new.
    pub fn add(&self, name: &str, why: &str) -> bool {
        let mut skipped = self.skipped();
        skipped.first.get_or_insert_with(|| format!("{name}: {why}"));
        skipped.names.insert(name.to_owned())
    }

    /// How many samples are passed over.
    pub fn count(&self) -> usize {
        self.skipped().names.len()
    }

    /// The first of them, and why.
    pub fn first(&self) -> Option<String> {
        self.skipped().first.clone()
    }

    fn has(&self, name: &str) -> bool {
        self.skipped().names.contains(name)
    }

    /// The frames of a sample, or of the next one after it that can be read.
    pub(super) fn read(&self, data: &dyn DataSource, sample: usize, sources: Sources) -> Result<(usize, Frames)> {
        let others = (sample + 1..data.len()).chain(0..sample.min(data.len()));
        for sample in std::iter::once(sample).chain(others) {
            let name = data.name(sample);
            if self.has(&name) {
                continue;
            }
            match Frames::read(data, sample, sources) {
                Ok(frames) => return Ok((sample, frames)),
                Err(error) => drop(self.add(&name, &error.to_string())),
            }
        }
        let first = self.first().unwrap_or_default();
        Err(Error::Failed(format!("none of the {} samples can be read; the first: {first}", data.len())))
    }
}
