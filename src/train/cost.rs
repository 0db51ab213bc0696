//! What training costs at any size, known before it begins: arithmetic, memory, time.
//!
//! All three are counted on small pictures and not at the size asked for, which may need more memory than there is. In
//! networks of convolutions and factorised attention every count has the form `a + batch (b + c h + d w + e h w)` in the
//! pictures' height and width, so that five small steps say it for all sizes.

use std::fs;
use std::path::Path;
use std::time::Instant;

use super::data::bytes_held;
use super::recipe::{Plan, RunConfig};
use super::trainer::Trainer;
use crate::data::batch::Batch;
use crate::error::{Error, Result};
use crate::networks::Config;
use crate::nn::Context;
use crate::random::{Random, Stream};
use crate::tensor::{Shape, Tensor, Var, pool, profile};

/// The cost of a network at one size and batch size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cost {
    /// Arithmetic of the prediction of a batch, in floating-point operations.
    pub flops_inference: f64,
    /// Arithmetic of a training step: four networks, the loss, all gradients.
    pub flops_step: f64,
    /// Memory of a training step, in bytes: parameters, gradients, moments, average, and what the backward pass needs.
    pub bytes_step: f64,
    /// Memory of the parameters alone, in bytes: gradients take as much again.
    pub bytes_parameters: f64,
    /// Time of the prediction of a batch on this machine, in seconds: the arithmetic, at the speed of a small prediction.
    pub seconds_inference: f64,
    /// Time of a training step on this machine, in seconds: the arithmetic, at the speed of a small step.
    pub seconds_step: f64,
}

/// What is counted at one size.
type Counts = [f64; 3];

/// The sides of the pictures that are counted on, in pixels.
const SMALL: [usize; 2] = [64, 96];
/// Bytes that the parameters of the largest network take, with gradients, moments and average.
const MOST_PARAMETERS: f64 = 3e9;
/// Bytes that no network needs for a pixel of a training step.
const MOST_A_PIXEL: f64 = 32e3;
/// Buffers in use, to memory of the process: buffers are rounded up to classes of the pool, and the program needs some.
const OVERHEAD: f64 = 1.12;

impl Cost {
    /// Counts what a network costs at a picture size and batch size. Memory is counted for the whole process: nothing else
    /// should run meanwhile. With `recompute`, transformer layers are computed again in the backward pass.
    ///
    /// # Errors
    /// If a step on small pictures cannot be taken.
    pub fn of(config: impl Into<Config>, [height, width]: [usize; 2], batch: usize, recompute: bool) -> Result<Cost> {
        let plan = Plan { recompute, ..RunConfig::usual().plan() };
        let mut trainer = Trainer::new(config, plan);
        let parameters = 4.0 * trainer.params.count("") as f64;
        let [small, large] = SMALL;
        let mut count = |h: usize, w: usize, batch: usize| Self::count(&mut trainer, [h, w], batch);
        // The first step makes the optimiser's moments, which stay.
        count(small, small, 1)?;
        let (first, _) = count(small, small, 1)?;
        let (twice, _) = count(small, small, 2)?;
        let (wide, _) = count(small, large, 1)?;
        let (high, _) = count(large, small, 1)?;
        let (square, seconds) = count(large, large, 1)?;
        let side = |n: usize| (n as f64 - small as f64) / (large - small) as f64;
        let (y, x) = (side(height), side(width));
        let at: Counts = std::array::from_fn(|i| {
            // What does not grow with the batch, and the rest at the four corners.
            let fixed = 2.0 * first[i] - twice[i];
            let [o, w, h, s] = [first[i], wide[i], high[i], square[i]].map(|n| n - fixed);
            fixed + batch as f64 * (o + (w - o) * x + (h - o) * y + (s - w - h + o) * x * y)
        });
        let speed = [square[0] / seconds[0], square[1] / seconds[1]];
        // Parameters, moments and the average stand outside of a step.
        let state = 4.0 * parameters;
        Ok(Cost {
            flops_inference: at[0],
            flops_step: at[1],
            bytes_step: OVERHEAD * (at[2] + state),
            bytes_parameters: parameters,
            seconds_inference: at[0] / speed[0],
            seconds_step: at[1] / speed[1],
        })
    }

    /// Arithmetic of inference and of a step, and the most memory that a step holds; and the seconds that both take.
    fn count(trainer: &mut Trainer, [h, w]: [usize; 2], batch: usize) -> Result<(Counts, [f64; 2])> {
        let triplets = noise(h, w, batch);
        let start = Instant::now();
        let (_, inference) = profile::record(false, || {
            let image = Var::constant(triplets.target.clone());
            std::hint::black_box(trainer.model.disparities(&Context::inference(&trainer.params), &image));
        });
        let inference_seconds = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let ((report, peak), step) = profile::record(false, || pool::peak_of(|| trainer.step(&triplets)));
        report?;
        let seconds = [inference_seconds, start.elapsed().as_secs_f64()];
        let flops_inference = inference.iter().map(|e| e.flops as f64).sum();
        let flops_step = step.iter().map(|e| (e.flops + e.back.flops) as f64).sum();
        Ok(([flops_inference, flops_step, peak as f64], seconds))
    }
}

/// Makes sure that a training step, and the pictures that are held meanwhile, fit into the memory that is free now, as far as the system says how much that is.
///
/// # Errors
/// If it does not: both figures, and what makes it smaller.
pub fn check_memory(config: &RunConfig) -> Result<()> {
    let Some(free) = free_memory() else { return Ok(()) };
    // No network of this crate comes near this for a pixel, and none has as many parameters: not worth counting.
    let held = bytes_held(config);
    if held + MOST_PARAMETERS + MOST_A_PIXEL * (config.batch * config.height * config.width) as f64 <= free {
        return Ok(());
    }
    let network = config.architecture().config(&config.ablation)?;
    let cost = Cost::of(network, [config.height, config.width], config.batch, config.recompute)?;
    let needed = held + cost.bytes_step;
    if needed <= free {
        return Ok(());
    }
    let gib = |bytes: f64| bytes / f64::from(1 << 30);
    Err(Error::setting(
        "batch",
        format!(
            "training {} at {}x{}, batch {}, needs about {:.1} GiB, and {:.1} GiB are free: take a smaller \
             batch, smaller pictures or a smaller preset{}",
            config.architecture().name(),
            config.width,
            config.height,
            config.batch,
            gib(needed),
            gib(free),
            if config.recompute { "" } else { ", or --recompute" }
        ),
    ))
}

/// The bytes that a program can still take, where the system tells it (Linux): of the machine, and of a container.
fn free_memory() -> Option<f64> {
    let machine = fs::read_to_string("/proc/meminfo").ok()?;
    let line = machine.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    let free = 1024.0 * line.trim().trim_end_matches("kB").trim().parse::<f64>().ok()?;
    let number =
        |file: &str| fs::read_to_string(Path::new("/sys/fs/cgroup").join(file)).ok()?.trim().parse::<f64>().ok();
    let left = number("memory.max").zip(number("memory.current")).map(|(most, used)| (most - used).max(0.0));
    Some(left.map_or(free, |left| free.min(left)))
}

/// Triplets of noise.
fn noise(height: usize, width: usize, batch: usize) -> Batch {
    let mut random = Random::of(0, Stream::Only);
    let mut picture = |scale: usize| {
        let shape = Shape::new(&[batch, height >> scale, width >> scale, 3]);
        Tensor::build(shape, |out| out.iter_mut().for_each(|x| *x = random.unit() as f32))
    };
    let pyramid: Vec<_> = (0..4).map(&mut picture).collect();
    let sources = [picture(0), picture(0)];
    let (w, h) = (width as f64, height as f64);
    Batch::in_time(pyramid, sources, vec![[0.58 * w, 1.92 * h, 0.5 * w, 0.5 * h]; batch])
}
