//! The signs of a run's health as it goes on: its monitor, and where that writes to.

use std::path::Path;

use super::Event;
use crate::error::Result;
use crate::train::health::Monitor;
use crate::train::log::{self, Log};
use crate::train::trainer::StepReport;

/// The monitor of a run, and where it writes to.
pub(super) struct Health {
    monitor: Monitor,
    log: Log,
}

impl Health {
    /// A monitor that has seen what the run has logged already.
    pub(super) fn open(folder: &Path) -> Result<Self> {
        let mut monitor = Monitor::default();
        log::steps(folder)?.iter().for_each(|step| drop(monitor.see(step)));
        Ok(Health { monitor, log: Log::open(folder, log::WARNINGS)? })
    }

    pub(super) fn see(&mut self, step: &StepReport, tell: &mut impl FnMut(Event)) -> Result<()> {
        for warning in self.monitor.see(step) {
            self.log.write(&warning)?;
            if warning.first {
                tell(Event::Health(&warning));
            }
        }
        Ok(())
    }
}
