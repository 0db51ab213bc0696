//! `parallax bench`.

mod agree;
mod breakdown;
mod job;
mod load;
mod roofline;
mod scaling;

use std::path::PathBuf;

use parallax::Result;
use parallax::tensor::Precision;
use serde::Serialize;

use super::sizes::{Numbers, Sizes};
use breakdown::Row;
use job::{Conv, Measured, Network};

#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand)]
enum What {
    /// Time a whole training step: four networks, four scales, the loss, backward, AdamW.
    Step(Timed),
    /// Time the prediction of disparities.
    Infer {
        #[command(flatten)]
        timed: Timed,
        /// Numbers in which products are taken.
        #[arg(long, value_enum, default_value = "f32")]
        precision: Numbers,
    },
    /// Compare each op of a training step with the machine's limits of arithmetic and memory.
    #[command(alias = "ops")]
    Roofline(Counted),
    /// Bound the speed-up of a training step on many threads by how its work is cut. Nothing is timed.
    Scaling(scaling::Args),
    /// Time training steps on a folder's files, and the same with their batches in memory, by turns.
    Load(load::Args),
    /// One convolution, forward: 3x3, batch 2, 3 channels of 320x320 to 16.
    #[command(hide = true)]
    Conv {
        /// Number of timed iterations.
        #[arg(long, value_name = "N", default_value_t = 100)]
        iterations: usize,
        /// Print one JSON object.
        #[arg(long)]
        json: bool,
    },
    /// Compares this program's loss and disparities with those of another one, on its weights and its batch.
    #[command(hide = true)]
    Agree {
        /// Written by benches/pytorch/measure.py.
        file: PathBuf,
    },
}

#[derive(clap::Args)]
struct Counted {
    #[command(flatten)]
    sizes: Sizes,
    /// Number of timed iterations, after three that are not counted.
    #[arg(long, value_name = "N", default_value_t = 10)]
    iterations: usize,
    /// Seed of the weights and of the pictures.
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

#[derive(clap::Args)]
struct Timed {
    #[command(flatten)]
    counted: Counted,
    /// Only time it: half the work, and a peak of memory without the listener's.
    #[arg(long)]
    no_breakdown: bool,
}

#[derive(Serialize)]
struct Timing {
    /// Of each iteration, nobody listening.
    seconds: Vec<f64>,
    median: f64,
    /// Of convolutions and matrix products, a multiplication and an addition counted as two; a backward pass counts as
    /// two forward ones.
    gflop: f64,
    peak_rss_bytes: u64,
    /// Buffers allocated during the timed iterations, each.
    fresh_buffers: f64,
    /// Where the time of the listened iterations went, which alternate with the timed ones: means over their middle
    /// half. The sum of all rows is the mean time of such an iteration.
    breakdown: Vec<Row>,
    /// The median of the listened iterations.
    traced_median: Option<f64>,
    /// The last row, `other`, over the median: what no other row accounts for.
    other_share: Option<f64>,
    /// The sum of all other rows over the median.
    rows_share: Option<f64>,
    threads: usize,
    simd: &'static str,
}

pub fn run(args: Args) -> Result<()> {
    match args.what {
        What::Step(timed) => time_network(&timed, None),
        What::Infer { timed, precision } => time_network(&timed, Some(precision.checked()?)),
        What::Roofline(counted) => roofline::run(&counted),
        What::Scaling(args) => scaling::run(&args),
        What::Load(args) => load::run(&args),
        What::Conv { iterations, json } => {
            report(&timing(job::measure(&mut Conv::new(), iterations, false)?, false)?, json)
        }
        What::Agree { file } => agree::run(&file),
    }
}

/// Times a training step, or the prediction of disparities in some numbers.
fn time_network(Timed { counted, no_breakdown }: &Timed, infer: Option<Precision>) -> Result<()> {
    let mut network = Network::new(&counted.sizes, counted.seed, infer)?;
    let measured = job::measure(&mut network, counted.iterations, !no_breakdown)?;
    report(&timing(measured, infer.is_none())?, counted.sizes.json)
}

fn timing(measured: Measured, step: bool) -> Result<Timing> {
    let median = median(&measured.seconds);
    let rows = breakdown::rows(&measured.profiles);
    let other = rows.last().map(Row::milliseconds);
    let all: f64 = rows.iter().map(Row::milliseconds).sum();
    let traced: Vec<f64> = measured.profiles.iter().map(|p| p.total.as_secs_f64()).collect();
    Ok(Timing {
        median,
        gflop: measured.forward_flops as f64 * 1e-9 * if step { 3.0 } else { 1.0 },
        peak_rss_bytes: peak_rss(),
        fresh_buffers: measured.fresh_buffers,
        traced_median: (!traced.is_empty()).then(|| self::median(&traced)),
        other_share: other.map(|ms| ms * 1e-3 / median),
        rows_share: other.map(|ms| (all - ms) * 1e-3 / median),
        breakdown: rows,
        threads: parallax::tensor::parallel::threads(),
        simd: parallax::tensor::simd::level()?,
        seconds: measured.seconds,
    })
}

fn report(timing: &Timing, json: bool) -> Result<()> {
    if json {
        return super::print_json(timing);
    }
    if !timing.breakdown.is_empty() {
        say!(
            "{:32} {:16} {:>5} {:>8} {:>8} {:>10} {:>11} {:>6}",
            "op",
            "kernel path",
            "calls",
            "GFLOP",
            "MB",
            "forward ms",
            "backward ms",
            "share"
        );
    }
    for r in &timing.breakdown {
        say!(
            "{:32} {:16} {:5} {:8.3} {:8.1} {:10.2} {:11.2} {:5.1}%",
            r.op,
            r.algo,
            r.calls,
            r.gflop + r.backward_gflop,
            (r.bytes + r.backward_bytes) as f64 * 1e-6,
            r.forward_ms,
            r.backward_ms,
            0.1 * r.milliseconds() / timing.median
        );
    }
    if let (Some(rows), Some(other)) = (timing.rows_share, timing.other_share) {
        say!("\nthe rows are {:.1}% of the median, {:.1}% is in none", 100.0 * rows, 100.0 * other);
    }
    say!(
        "median {:.4} s on {} threads ({}), {:.2} GFLOP, {:.1} GFLOP/s, peak memory {:.0} MiB, {:.1} fresh buffers",
        timing.median,
        timing.threads,
        timing.simd,
        timing.gflop,
        timing.gflop / timing.median,
        timing.peak_rss_bytes as f64 / f64::from(1 << 20),
        timing.fresh_buffers
    );
    Ok(())
}

/// The middle one of some numbers (the upper, where two are).
fn median(numbers: &[f64]) -> f64 {
    let mut sorted = numbers.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[sorted.len() / 2]
}

/// The largest resident memory of this process so far, where the system tells it (Linux), else 0.
fn peak_rss() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    line.and_then(|l| l.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()).map_or(0, |kb| kb * 1024)
}
