//! The names of a run's files, the lock on its folder, and its weights.

use std::fs::{File, TryLockError};
use std::path::Path;

use crate::error::{Error, Result};
use crate::formats::atomic::write_bytes_atomically;
use crate::formats::safetensors;
use crate::networks::{DepthNetwork, Setup};
use crate::nn::Params;
use crate::train::recipe::RunConfig;
use crate::weights::{self, Need, Weights};

/// The file of the weights that validation chose.
pub(in crate::train) const BEST: &str = "best.safetensors";
/// The file of the weights that training ended with.
pub(in crate::train) const LAST: &str = "last.safetensors";
/// The folder of states.
pub(in crate::train) const CHECKPOINTS: &str = "checkpoints";
/// The folder of pictures as training goes on, `STEP-SAMPLE.jpg`.
pub(in crate::train) const PAGES: &str = "pages";
/// The folder of [`views`](crate::train::views).
pub(in crate::train) const VIEWS: &str = "views";
/// The folder of TensorBoard's events.
pub(in crate::train) const TENSORBOARD: &str = "tensorboard";
pub(super) const LOCK: &str = ".lock";

/// Whether a process is training the run of a folder now, as far as that can be told.
pub fn is_running(folder: &Path) -> bool {
    // Held for this moment alone, by a handle that is closed at once.
    File::open(folder.join(LOCK)).is_ok_and(|file| matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock)))
}

/// Takes the run for this process, until the file is closed, be it by a crash.
pub(in crate::train) fn lock(folder: &Path) -> Result<File> {
    let path = folder.join(LOCK);
    let file = File::create(&path).map_err(|e| Error::io(&path, e))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => {
            Err(Error::file(folder, "another process is training this run: wait for it, or give another folder"))
        }
        // Some network file systems have no locks: better a run without one than none.
        Err(TryLockError::Error(e)) if e.kind() == std::io::ErrorKind::Unsupported => Ok(file),
        Err(TryLockError::Error(e)) => Err(Error::io(&path, e)),
    }
}

pub(super) fn write_config(folder: &Path, config: &RunConfig) -> Result<()> {
    let text = toml::to_string(config).map_err(|e| Error::Failed(format!("the configuration: {e}")))?;
    write_bytes_atomically(folder.join("config.toml"), text.as_bytes())
}

/// Writes weights for use: PyTorch's names and layouts, their setup in the metadata.
pub fn write_weights(path: &Path, params: &Params<f32>, setup: &Setup) -> Result<()> {
    safetensors::write(path, &params.export(), setup.metadata()?)
}

/// Reads weights to predict depth with: a run's folder, or a file or folder of any kind that [`weights::load`] reads.
pub fn load_weights(path: &Path) -> Result<(DepthNetwork, Params<f32>, Setup)> {
    let Weights { model, params, setup, .. } = weights::load(&[path.to_owned()], Need::Depth, false)?;
    Ok((model, params, setup))
}
