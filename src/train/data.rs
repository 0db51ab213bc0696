//! The data of a run: what its configuration calls `street` or a folder, split in three.

use std::path::Path;
use std::sync::Arc;

use super::recipe::RunConfig;
use super::run::RunData;
use crate::data::apart::refuse_shared;
use crate::data::aside::set_aside;
use crate::data::{DataSource, Opening, Subset, open_folder};
use crate::error::{Error, Result};
use crate::street::{Endless, SHOWN, Street, StreetConfig, WorldKind};

/// The name of the embedded street as a data set. A folder of that name is `./street`.
pub const STREET: &str = "street";

/// The name of the wide world of rendered roads as a data set.
pub const STREET_2: &str = "street-2";

/// Whether a run's data are rendered by the program: `street`, which is `street-1`, or `street-2`.
pub fn is_rendered(data: &str) -> bool {
    [STREET, STREET_1, STREET_2].contains(&data)
}

/// The embedded street by its full name.
const STREET_1: &str = "street-1";

/// Sequences of `street-2` (training, validation, test), and frames of each.
const WIDE_SEQUENCES: [usize; 3] = [2400, 16, 24];
const WIDE_FRAMES: usize = 4;

/// Sequences of the embedded street: training, validation, test. Many short drives: a street more teaches more than a
/// few metres more of the same.
const SEQUENCES: [usize; 3] = [144, 12, 24];
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
    let data = if is_rendered(&config.data) { street(config, sequences(config), progress) } else { folder(config)? };
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
    let ([train, validation, test], frames) = match config.data.as_str() {
        STREET | STREET_1 => (SEQUENCES, FRAMES),
        STREET_2 => (WIDE_SEQUENCES, WIDE_FRAMES),
        _ => return 0.0,
    };
    // The epoch before, this one, and what is rendered for the next.
    let train = if config.endless { train + 2 * train / SHOWN } else { train };
    let frames = cameras * (train + validation + test) * frames;
    // Three bytes of a pixel, and where depth is learnt from, four more.
    let each = if config.loss.depth_supervision > 0.0 { 7.0 } else { 3.0 };
    each * (frames * config.height * config.width) as f64
}

/// Opens (or renders) the samples alone that pictures of a run are made of: those that it reports on, or else validates on.
///
/// # Errors
/// If a folder's data cannot be read.
pub fn open_shown(
    config: &RunConfig,
    progress: &(dyn Fn(&'static str, usize, usize) + Sync),
) -> Result<Arc<dyn DataSource>> {
    let [.., test] = sequences(config);
    let data = match is_rendered(&config.data) {
        true => street(&RunConfig { endless: false, ..config.clone() }, [0, 0, test], progress),
        false => folder(config)?,
    };
    Ok(data.test.unwrap_or(data.validation))
}

/// Sequences of rendered data: training, validation, test.
fn sequences(config: &RunConfig) -> [usize; 3] {
    if config.data == STREET_2 { WIDE_SEQUENCES } else { SEQUENCES }
}

fn street(
    config: &RunConfig,
    [train, validation, test]: [usize; 3],
    progress: &(dyn Fn(&'static str, usize, usize) + Sync),
) -> RunData {
    let RunConfig { height, width, seed, .. } = *config;
    let wide = config.data == STREET_2;
    let settings = |sequences: usize, seed: u64| {
        let baseline = if config.sources.other_camera() { BASELINE } else { 0.0 };
        let usual =
            StreetConfig { height, width, sequences, frames: FRAMES, seed, baseline, ..StreetConfig::default() };
        match wide {
            true => StreetConfig {
                frames: WIDE_FRAMES,
                world: WorldKind::Street2,
                own_lenses: true,
                moving_cars: true,
                ..usual
            },
            false => usual,
        }
    };
    let street = |what: &'static str, sequences: usize, seed: u64| {
        Arc::new(Street::render(&settings(sequences, seed), Some(&|done, all| progress(what, done, all))))
    };
    let train: Arc<dyn DataSource> = match config.endless {
        true => {
            let told = |done, all| progress("street", done, all);
            Arc::new(Endless::render(&settings(train, seed), Some(&told)))
        }
        false => street("street", train, seed),
    };
    RunData {
        train,
        validation: street("validation", validation, seed.wrapping_add(APART)),
        test: Some(street("test", test, seed.wrapping_add(2 * APART))),
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
