//! `parallax bench`.

use std::collections::BTreeMap;
use std::time::Instant;

use parallax::Result;
use parallax::data::batch::Batch;
use parallax::monovit::Trainer;
use parallax::monovit::run::RunConfig;
use parallax::nn::Folded;
use parallax::ops::trace::{self, Entry};
use parallax::random::Random;
use parallax::tensor::{Tensor, Var, pool};
use serde::Serialize;

use super::sizes::Sizes;

#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand)]
enum What {
    /// A whole training step: four networks, four scales, the loss, backward, AdamW.
    Step(Timed),
    /// Disparities of pictures, nothing recorded.
    Infer(Timed),
}

#[derive(clap::Args)]
struct Timed {
    #[command(flatten)]
    sizes: Sizes,
    /// How often it is timed, after three times that are not counted.
    #[arg(long, value_name = "N", default_value_t = 10)]
    iterations: usize,
}

/// Where the time goes: one op on one kernel path.
#[derive(Serialize)]
struct Row {
    op: String,
    algo: String,
    calls: usize,
    gflop: f64,
    forward_ms: f64,
    backward_ms: f64,
}

#[derive(Serialize)]
struct Timing {
    seconds: Vec<f64>,
    median: f64,
    /// Of convolutions and matrix products, a multiplication and an addition counted as two.
    gflop: f64,
    peak_rss_bytes: u64,
    /// Buffers allocated during the timed iterations, each.
    fresh_buffers: f64,
    breakdown: Vec<Row>,
}

pub fn run(args: Args) -> Result<()> {
    let (Timed { sizes, iterations }, step) = match &args.what {
        What::Step(timed) => (timed, true),
        What::Infer(timed) => (timed, false),
    };
    sizes.check()?;
    let mut config = RunConfig::new(sizes.preset, 1_000_000);
    // The step as it is for most of the run.
    config.loss.auto_mask_after = 0;
    config.loss.shake.keep = 0;
    let mut trainer = Trainer::new(config.model(), config.optim, config.loss, 0);
    let batch = batch(sizes);
    let folded = Folded::new(&trainer.params);
    let infer = |trainer: &Trainer| trainer.model.predict(&folded, &batch.seen[1]);
    let once = |trainer: &mut Trainer| match step {
        true => trainer.step(&batch).map(drop),
        false => {
            infer(trainer);
            Ok(())
        }
    };
    for _ in 0..3 {
        once(&mut trainer)?;
    }
    let fresh = pool::fresh_buffers();
    let mut seconds = Vec::new();
    for _ in 0..(*iterations).max(1) {
        let start = Instant::now();
        once(&mut trainer)?;
        seconds.push(start.elapsed().as_secs_f64());
    }
    let fresh = (pool::fresh_buffers() - fresh) as f64 / seconds.len() as f64;
    let start = Instant::now();
    let (done, entries) = trace::record(false, || once(&mut trainer));
    done?;
    let traced = start.elapsed().as_secs_f64();

    let mut sorted = seconds.clone();
    sorted.sort_by(f64::total_cmp);
    let timing = Timing {
        median: sorted[sorted.len() / 2],
        gflop: flops(&entries, step) as f64 * 1e-9,
        peak_rss_bytes: peak_rss(),
        fresh_buffers: fresh,
        breakdown: breakdown(&entries, traced),
        seconds,
    };
    if sizes.json {
        return super::print_json(&timing);
    }
    println!(
        "{:24} {:16} {:>5} {:>8} {:>10} {:>11}",
        "op", "kernel path", "calls", "GFLOP", "forward ms", "backward ms"
    );
    for r in &timing.breakdown {
        println!(
            "{:24} {:16} {:5} {:8.3} {:10.2} {:11.2}",
            r.op, r.algo, r.calls, r.gflop, r.forward_ms, r.backward_ms
        );
    }
    println!(
        "\nmedian {:.4} s, {:.2} GFLOP, {:.1} GFLOP/s, peak memory {:.0} MiB, {:.1} fresh buffers",
        timing.median,
        timing.gflop,
        timing.gflop / timing.median,
        timing.peak_rss_bytes as f64 / f64::from(1 << 20),
        timing.fresh_buffers
    );
    Ok(())
}

/// Triplets of smooth random pictures.
fn batch(sizes: &Sizes) -> Batch {
    let mut random = Random::new(1, 0);
    let mut picture = |scale: usize| {
        let (h, w) = (sizes.height >> scale, sizes.width >> scale);
        let coarse: Tensor<f32> = Tensor::build([sizes.batch, h.div_ceil(8), w.div_ceil(8), 3], |out| {
            out.iter_mut().for_each(|x| *x = random.unit() as f32)
        });
        Var::constant(coarse).resize_bilinear(h, w, false).into_value()
    };
    let pyramid: Vec<_> = (0..4).map(&mut picture).collect();
    let sources = [picture(0), picture(0)];
    let (w, h) = (sizes.width as f64, sizes.height as f64);
    Batch {
        seen: [sources[0].clone(), pyramid[0].clone(), sources[1].clone()],
        pyramid,
        sources,
        intrinsics: vec![[0.58 * w, 1.92 * h, 0.5 * w, 0.5 * h]; sizes.batch],
    }
}

/// A backward pass does the arithmetic of its forward pass twice: once for inputs, once for weights.
pub fn flops(entries: &[Entry], step: bool) -> u64 {
    entries.iter().map(|e| e.flops).sum::<u64>() * if step { 3 } else { 1 }
}

fn breakdown(entries: &[Entry], total: f64) -> Vec<Row> {
    let mut rows: BTreeMap<(&str, &str), Row> = BTreeMap::new();
    let mut rest = total * 1e3;
    for e in entries {
        let row = rows.entry((e.op, e.algo)).or_insert(Row {
            op: e.op.into(),
            algo: e.algo.into(),
            calls: 0,
            gflop: 0.0,
            forward_ms: 0.0,
            backward_ms: 0.0,
        });
        row.calls += 1;
        row.gflop += e.flops as f64 * 1e-9;
        row.forward_ms += e.forward.as_secs_f64() * 1e3;
        row.backward_ms += e.backward.as_secs_f64() * 1e3;
        rest -= (e.forward + e.backward).as_secs_f64() * 1e3;
    }
    let mut rows: Vec<Row> = rows.into_values().collect();
    rows.sort_by(|a, b| (b.forward_ms + b.backward_ms).total_cmp(&(a.forward_ms + a.backward_ms)));
    // AdamW, running statistics, gradients added where paths meet, and whatever else is no op.
    rows.push(Row {
        op: "other".into(),
        algo: String::new(),
        calls: 1,
        gflop: 0.0,
        forward_ms: rest,
        backward_ms: 0.0,
    });
    rows
}

/// The largest resident memory of this process so far, where the system tells it (Linux), else 0.
fn peak_rss() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    line.and_then(|l| l.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()).map_or(0, |kb| kb * 1024)
}
