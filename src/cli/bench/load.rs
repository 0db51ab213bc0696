//! `parallax bench load`: how fast a training is on a folder's files, over the same with its batches in memory.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use parallax::data::batch::{Augment, Batch, Loader, batch_of_step};
use parallax::data::camera::Camera;
use parallax::data::{DataSource, Opening, open_folder};
use parallax::train::{RunConfig, Trainer};
use parallax::{Error, Result};
use serde::Serialize;

use super::Sizes;
use crate::cli::camera::CameraArgs;
use crate::cli::progress::Progress;

#[derive(clap::Args)]
pub struct Args {
    /// The folder of frames, as train takes it. Nothing of it is kept in memory, so that every step decodes; prepared frames
    /// of this size that lie in it are used.
    dir: PathBuf,
    /// File of the folder's prepared frames [default: the one of this size that lies in the folder, if there is any].
    #[arg(long, value_name = "FILE")]
    prepared: Option<PathBuf>,
    #[command(flatten)]
    lens: CameraArgs,
    #[command(flatten)]
    sizes: Sizes,
    /// Number of timed steps of each kind in a round.
    #[arg(long, value_name = "N", default_value_t = 12)]
    iterations: usize,
    /// Number of rounds: each from memory, then from the files.
    #[arg(long, value_name = "N", default_value_t = 3)]
    rounds: usize,
}

/// Measurements, means over all rounds.
#[derive(Serialize)]
struct Speeds {
    /// Steps a second with batches that were made before.
    memory: f64,
    /// Steps a second with batches that are made meanwhile, as in training.
    files: f64,
    /// The second over the first.
    share: f64,
    /// Seconds of a step from the files in which training waited for its batch: the log's `data_seconds`.
    data_seconds: f64,
}

/// Steps before those that are timed.
const WARM: usize = 2;

pub fn run(args: &Args) -> Result<()> {
    args.sizes.check()?;
    if args.iterations == 0 || args.rounds == 0 {
        return Err(Error::setting("--iterations", "at least 1 step in at least 1 round"));
    }
    let size = [args.sizes.height, args.sizes.width];
    let camera = args.lens.or(Camera::Auto);
    let data = open_folder(
        &args.dir,
        Opening { camera, prepared: args.prepared.as_deref(), cache_bytes: 0, ..Opening::of(size) },
    )?;
    let speeds = measure(args, &data)?;
    if args.sizes.json {
        return crate::cli::print_json(&speeds);
    }
    let Speeds { memory, files, share, data_seconds } = speeds;
    say!("from memory {memory:.3} steps/s, from the files {files:.3} steps/s: {:.1} %", 100.0 * share);
    say!("of a step from the files training waits {data_seconds:.4} s for its batch");
    Ok(())
}

/// Takes rounds of steps by turns, on the same samples.
fn measure(args: &Args, data: &Arc<dyn DataSource>) -> Result<Speeds> {
    let batch = args.sizes.batch;
    let config = RunConfig { auto_mask_delay: 0.0, ..RunConfig::new(args.sizes.architecture()?, 1_000_000) };
    let mut trainer = Trainer::new(config.model(), config.plan());
    let (augment, seed) = (Augment::default(), 0);
    let n = args.iterations;
    let made: Vec<Batch> = (0..n.min(8) as u64)
        .map(|step| batch_of_step(data.as_ref(), augment, batch, seed, step))
        .collect::<Result<_>>()?;
    for step in 0..WARM {
        trainer.step(&made[step % made.len()])?;
    }
    let mut progress = Progress::new("rounds", args.rounds as u64);
    let (mut memory, mut files, mut waited) = (0.0, 0.0, 0.0);
    for round in 1..=args.rounds {
        let start = Instant::now();
        for step in 0..n {
            trainer.step(&made[step % made.len()])?;
        }
        memory += start.elapsed().as_secs_f64();
        let mut loader = Loader::start(data.clone(), augment, batch, seed, 0, None)?;
        // What the loader makes ahead while nobody trains is no part of the speed: it is used up first.
        for _ in 0..WARM + 3 {
            trainer.step(&loader.next_batch()?)?;
        }
        let start = Instant::now();
        for _ in 0..n {
            let asked = Instant::now();
            let next = loader.next_batch()?;
            waited += asked.elapsed().as_secs_f64();
            trainer.step(&next)?;
        }
        files += start.elapsed().as_secs_f64();
        progress.set(round as u64, "");
    }
    progress.finish();
    let all = (n * args.rounds) as f64;
    Ok(Speeds { memory: all / memory, files: all / files, share: memory / files, data_seconds: waited / all })
}
