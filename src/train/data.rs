//! The data of a run: what its configuration calls `street` or a folder, split in three.

use std::path::Path;
use std::sync::Arc;

use super::recipe::RunConfig;
use super::run::RunData;
use crate::data::apart::refuse_shared;
use crate::data::aside::set_aside;
use crate::data::joined::Joined;
use crate::data::{DataSource, Opening, Subset, open_folder};
use crate::error::{Error, Result};
use crate::street::{Street, StreetConfig, varied};

/// The name of the embedded street as a data set. A folder of that name is `./street`.
pub const STREET: &str = "street";

/// The name of the street that many cameras see.
pub const STREET_2: &str = "street-2";

/// Whether a data set is rendered by the program, and not a folder.
pub fn is_rendered(data: &str) -> bool {
    [STREET, STREET_2].contains(&data)
}

/// Sequences of the embedded street: training, validation, test. Many short drives: a street more teaches more than a
/// few metres more of the same.
const SEQUENCES: [usize; 3] = [144, 12, 24];
/// Those of the street that many cameras see.
const SEQUENCES_2: [usize; 3] = [480, 24, 24];
/// Frames of each.
const FRAMES: usize = 10;
/// Where a second camera stands, if one is asked for: metres to the right, like KITTI's.
const BASELINE: f64 = 0.54;
/// The seeds of validation and test lie far from that of training: three worlds that have no street in common.
const APART: u64 = 1_000_000;

/// Opens (or renders) the samples that a run trains on, validates on and reports on. `progress` hears what is rendered,
/// how many frames are done and how many there are, from any thread.
///
/// # Errors
/// If the data cannot be read, one frame is in two splits, or there are fewer samples than a batch holds.
pub fn open(config: &RunConfig, progress: &(dyn Fn(&'static str, usize, usize) + Sync)) -> Result<RunData> {
    let data = match &config.data[..] {
        STREET => street(config, progress),
        STREET_2 => street_2(config, progress),
        _ => folder(config)?,
    };
    if data.train.len() < config.batch {
        let message =
            format!("{} samples a batch, but the data holds {}: make it smaller", config.batch, data.train.len());
        return Err(Error::setting("batch", message));
    }
    if config.loss.depth_supervision > 0.0 && !knows_depth(data.train.as_ref())? {
        let message = "no frame that is trained on has ground-truth depth: set it to 0, or add depth maps";
        return Err(Error::setting("loss.depth_supervision", message));
    }
    Ok(data)
}

/// Whether a sample has ground-truth depth. The others learn without.
fn knows_depth(data: &dyn DataSource) -> Result<bool> {
    for sample in 0..data.len() {
        if data.depth(sample)?.is_some() {
            return Ok(true);
        }
    }
    Ok(false)
}

/// The bytes of pictures that are held in memory while a run goes on: all of the street's, none of a folder's.
pub(super) fn bytes_held(config: &RunConfig) -> f64 {
    let cameras = if config.sources.other_camera() { 2 } else { 1 };
    let sequences = match &config.data[..] {
        STREET => SEQUENCES.iter().sum(),
        STREET_2 => SEQUENCES_2.iter().sum(),
        _ => 0usize,
    };
    let frames = cameras * sequences * FRAMES;
    3.0 * (frames * config.height * config.width) as f64
}

fn street(config: &RunConfig, progress: &(dyn Fn(&'static str, usize, usize) + Sync)) -> RunData {
    let RunConfig { height, width, seed, .. } = *config;
    let street = |what: &'static str, sequences: usize, seed: u64| {
        let baseline = if config.sources.other_camera() { BASELINE } else { 0.0 };
        let settings =
            StreetConfig { height, width, sequences, frames: FRAMES, seed, baseline, ..StreetConfig::default() };
        Arc::new(Street::render(&settings, Some(&|done, all| progress(what, done, all))))
    };
    let [train, validation, test] = SEQUENCES;
    RunData {
        train: street("street", train, seed),
        validation: street("validation", validation, seed.wrapping_add(APART)),
        test: Some(street("test", test, seed.wrapping_add(2 * APART))),
    }
}

/// The street that many cameras see.
fn street_2(config: &RunConfig, progress: &(dyn Fn(&'static str, usize, usize) + Sync)) -> RunData {
    let RunConfig { height, width, seed, .. } = *config;
    let baseline = if config.sources.other_camera() { BASELINE } else { 0.0 };
    let streets = |what: &'static str, sequences: usize, seed: u64| -> Arc<dyn DataSource> {
        let settings =
            StreetConfig { height, width, sequences, frames: FRAMES, seed, baseline, ..StreetConfig::default() };
        let streets = varied(&settings, Some(&|done, all| progress(what, done, all)));
        Arc::new(Joined::new(streets.into_iter().map(|street| Arc::new(street) as Arc<dyn DataSource>).collect()))
    };
    let [train, validation, test] = SEQUENCES_2;
    RunData {
        train: streets("street-2", train, seed),
        validation: streets("validation", validation, seed.wrapping_add(APART)),
        test: Some(streets("test", test, seed.wrapping_add(2 * APART))),
    }
}

/// The samples of the run's folder that a list names, or all.
fn samples(config: &RunConfig, list: Option<&Path>) -> Result<Arc<dyn DataSource>> {
    let size = [config.height, config.width];
    let RunConfig { camera, skip_bad_frames, sources, ref prepared, .. } = *config;
    let usual = Opening::of(size);
    let opening = Opening { list, camera, skip_bad_frames, sources, prepared: prepared.as_deref(), ..usual };
    open_folder(Path::new(&config.data), opening)
}

fn folder(config: &RunConfig) -> Result<RunData> {
    let all = samples(config, config.split.as_deref())?;
    let (train, aside): (Arc<dyn DataSource>, Arc<dyn DataSource>) = match &config.val_split {
        Some(split) => {
            let aside = samples(config, Some(split))?;
            refuse_shared(all.as_ref(), aside.as_ref(), split)?;
            (all, aside)
        }
        None => {
            let (rest, aside) = set_aside(all.as_ref());
            (Arc::new(Subset::new(all.clone(), rest)), Arc::new(Subset::new(all, aside)))
        }
    };
    // What selects the weights is not what is reported on.
    let (validation, mut test): (Vec<usize>, Vec<usize>) = (0..aside.len()).partition(|i| i % 2 == 0);
    let with_truth: Result<Vec<bool>> = test.iter().map(|&i| Ok(aside.depth(i)?.is_some())).collect();
    let mut with_truth = with_truth?.into_iter();
    test.retain(|_| with_truth.next().unwrap_or(false));
    Ok(RunData {
        train,
        validation: Arc::new(Subset::new(aside.clone(), validation)),
        test: (!test.is_empty()).then(|| Arc::new(Subset::new(aside, test)) as Arc<dyn DataSource>),
    })
}
