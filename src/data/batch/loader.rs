//! The thread that makes batches ahead of training.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::JoinHandle;

use super::skip::SkipList;
use super::{Batch, Making, assemble, order};
use crate::data::DataSource;
use crate::error::{Error, Result};

/// A thread that makes the batches of consecutive steps, a few ahead.
pub struct Loader {
    batches: Option<Receiver<Result<Batch>>>,
    thread: Option<JoinHandle<()>>,
    /// Why there are no more batches.
    stopped: Option<Error>,
}

/// An error that says the same.
fn again(error: &Error) -> Error {
    match error {
        Error::Io { path, source } => Error::io(path, std::io::Error::new(source.kind(), source.to_string())),
        Error::File { path, message } => Error::file(path, message),
        Error::Setting { name, message } => Error::setting(name, message),
        Error::Failed(message) => Error::Failed(message.clone()),
    }
}

impl Loader {
    /// Starts at `first_step` (from 0). A sample that cannot be read is an error; with a list to `skip` it is put there,
    /// and another one stands for it.
    ///
    /// # Errors
    /// If there are fewer samples than a batch holds.
    pub fn start(
        data: Arc<dyn DataSource>,
        making: impl Into<Making>,
        batch: usize,
        seed: u64,
        first_step: u64,
        skip: Option<SkipList>,
    ) -> Result<Self> {
        if batch == 0 || data.len() < batch {
            let message = format!("{batch} samples a batch, but the data holds {}: make it smaller", data.len());
            return Err(Error::setting("batch", message));
        }
        let making = making.into();
        let (send, batches) = sync_channel(3);
        let thread = std::thread::spawn(move || {
            for step in first_step.. {
                let make = || assemble(data.as_ref(), making, batch, seed, step, skip.as_ref());
                // A panic becomes an error of this step, not a thread that is gone.
                let made = catch_unwind(AssertUnwindSafe(make)).unwrap_or_else(|_| {
                    let samples = order::of_step(data.as_ref(), batch, seed, step);
                    let names: Vec<String> = samples.into_iter().map(|sample| data.name(sample)).collect();
                    Err(Error::Failed(format!(
                        "the batch of step {} could not be made ({})",
                        step + 1,
                        names.join(", ")
                    )))
                });
                let last = made.is_err();
                // The other end hangs up when training is over.
                if send.send(made).is_err() || last {
                    break;
                }
            }
        });
        Ok(Loader { batches: Some(batches), thread: Some(thread), stopped: None })
    }

    /// The next batch.
    ///
    /// # Errors
    /// If it could not be made; from then on always the same.
    pub fn next_batch(&mut self) -> Result<Batch> {
        if let Some(error) = &self.stopped {
            return Err(again(error));
        }
        let batches = self.batches.as_ref().expect("there until dropped");
        let stopped = |_| Err(Error::Failed("the thread that makes batches has stopped".into()));
        let next = batches.recv().unwrap_or_else(stopped);
        self.stopped = next.as_ref().err().map(again);
        next
    }
}

impl Drop for Loader {
    fn drop(&mut self) {
        self.batches = None;
        if let Some(thread) = self.thread.take() {
            // A panic there was reported by the missing batch already.
            let _ = thread.join();
        }
    }
}
