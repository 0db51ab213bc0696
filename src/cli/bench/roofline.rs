//! `parallax bench roofline`: what each op reaches of what this machine could do with it.
//!
//! An op cannot be faster than its arithmetic at the speed of a large matrix product, nor than its least memory traffic
//! at the speed of a large copy (Williams, Waterman and Patterson, Roofline, 2009). Both ceilings are measured here,
//! now. Data that is still in a cache comes faster than from memory: small ops can exceed the second ceiling.

use std::time::Instant;

use parallax::Result;
use parallax::random::Random;
use parallax::tensor::gemm::{Rows, RowsMut, gemm};
use parallax::tensor::simd::Vector;
use parallax::tensor::{Accum, parallel, simd};
use serde::Serialize;

use super::breakdown::{self, Row};
use super::job::{self, Network};
use super::{Counted, median};

/// What this machine can do, on the threads that there are.
#[derive(Clone, Copy, Debug, Serialize)]
struct Ceilings {
    /// GFLOP/s of a product of two 1024x1024 matrices in f32, by the product that the ops use.
    gemm_gflops: f64,
    /// GB/s of `a = b + s c` over three arrays of 128 MiB, each counted once.
    memory_gbs: f64,
}

/// One pass of an op on one kernel path.
#[derive(Serialize)]
struct Pass {
    op: String,
    algo: String,
    pass: &'static str,
    calls: usize,
    milliseconds: f64,
    gflops: f64,
    gbs: f64,
    /// FLOP for each byte that has to be moved.
    intensity: f64,
    /// Which ceiling is the lower one at this intensity.
    bound: &'static str,
    /// The least time over the time it took.
    share: f64,
}

#[derive(Serialize)]
struct Roofline {
    threads: usize,
    simd: &'static str,
    #[serde(flatten)]
    ceilings: Ceilings,
    /// The median training step.
    median: f64,
    gflop: f64,
    /// The step's GFLOP/s over those of the large product.
    gemm_share: f64,
    /// What the ops would take if each reached its ceiling.
    least_seconds: f64,
    passes: Vec<Pass>,
}

pub fn run(Counted { sizes, iterations, seed }: &Counted) -> Result<()> {
    let mut network = Network::new(sizes, *seed, None)?;
    let ceilings = Ceilings { gemm_gflops: gemm_ceiling(), memory_gbs: memory_ceiling() };
    let measured = job::measure(&mut network, *iterations, true)?;
    let rows = breakdown::rows(&measured.profiles);
    let mut passes: Vec<Pass> = rows.iter().flat_map(|row| passes(row, ceilings)).collect();
    passes.sort_by(|a, b| b.milliseconds.total_cmp(&a.milliseconds));
    let (median, gflop) = (median(&measured.seconds), 3e-9 * measured.forward_flops as f64);
    let roofline = Roofline {
        threads: parallel::threads(),
        simd: simd::level()?,
        ceilings,
        median,
        gflop,
        gemm_share: gflop / median / ceilings.gemm_gflops,
        least_seconds: passes.iter().map(|p| p.share * p.milliseconds * 1e-3).sum(),
        passes,
    };
    if sizes.json { super::super::print_json(&roofline) } else { print(&roofline) }
}

/// The passes of a row that had anything to do.
fn passes(row: &Row, ceilings: Ceilings) -> Vec<Pass> {
    let both = [
        ("forward", row.gflop, row.bytes, row.forward_ms),
        ("backward", row.backward_gflop, row.backward_bytes, row.backward_ms),
    ];
    let busy = both.into_iter().filter(|&(_, gflop, bytes, ms)| ms > 0.0 && (gflop > 0.0 || bytes > 0));
    busy.map(|(pass, gflop, bytes, milliseconds)| {
        let (gigabytes, seconds) = (bytes as f64 * 1e-9, milliseconds * 1e-3);
        let (arithmetic, memory) = (gflop / ceilings.gemm_gflops, gigabytes / ceilings.memory_gbs);
        Pass {
            op: row.op.clone(),
            algo: row.algo.clone(),
            pass,
            calls: row.calls,
            milliseconds,
            gflops: gflop / seconds,
            gbs: gigabytes / seconds,
            intensity: gflop / gigabytes,
            bound: if arithmetic > memory { "arithmetic" } else { "memory" },
            share: arithmetic.max(memory) / seconds,
        }
    })
    .collect()
}

fn print(roofline: &Roofline) -> Result<()> {
    let Ceilings { gemm_gflops, memory_gbs } = roofline.ceilings;
    say!(
        "on {} threads ({}): {gemm_gflops:.1} GFLOP/s in a product of 1024x1024 matrices, {memory_gbs:.1} GB/s in a = b + s c\n",
        roofline.threads,
        roofline.simd
    );
    say!(
        "{:26} {:16} {:8} {:>5} {:>8} {:>8} {:>7} {:>9} {:10} {:>6}",
        "op",
        "kernel path",
        "pass",
        "calls",
        "ms",
        "GFLOP/s",
        "GB/s",
        "FLOP/byte",
        "bound by",
        "share"
    );
    for p in &roofline.passes {
        say!(
            "{:26} {:16} {:8} {:5} {:8.2} {:8.1} {:7.1} {:9.1} {:10} {:5.0}%",
            p.op,
            p.algo,
            p.pass,
            p.calls,
            p.milliseconds,
            p.gflops,
            p.gbs,
            p.intensity,
            p.bound,
            100.0 * p.share
        );
    }
    say!(
        "\nmedian step {:.4} s, {:.2} GFLOP: {:.1} GFLOP/s, {:.0}% of the large product's; at their ceilings the ops take {:.4} s",
        roofline.median,
        roofline.gflop,
        roofline.gflop / roofline.median,
        100.0 * roofline.gemm_share,
        roofline.least_seconds
    );
    Ok(())
}

/// The best of `times` runs, in seconds, after one that is not counted.
fn best(times: usize, mut f: impl FnMut()) -> f64 {
    f();
    let run = |_| {
        let start = Instant::now();
        f();
        start.elapsed().as_secs_f64()
    };
    (0..times).map(run).fold(f64::INFINITY, f64::min)
}

fn gemm_ceiling() -> f64 {
    const N: usize = 1024;
    let mut random = Random::new(1, 3);
    let mut draw = || -> Vec<f32> { (0..N * N).map(|_| random.uniform(-1.0, 1.0) as f32).collect() };
    let (a, b, mut out) = (draw(), draw(), vec![0.0f32; N * N]);
    // As large tiles as there can be: this is about the machine, not about the same bits for any number of threads.
    let tile = N.div_ceil(parallel::threads());
    let seconds = best(20, || {
        parallel::for_each_chunk(&mut out, tile * N, usize::MAX, |i, out| {
            let rows = out.len() / N;
            let (a, b) = (Rows::dense(&a, N, N).rows(i * tile, rows), Rows::dense(&b, N, N));
            gemm(RowsMut::dense(out, rows, N), Accum::Replace, a, b, 1.0);
        });
    });
    2e-9 * (N * N * N) as f64 / seconds
}

fn memory_ceiling() -> f64 {
    const N: usize = 1 << 25;
    const CHUNK: usize = 1 << 16;
    let (b, c, mut a) = (vec![1.0f32; N], vec![2.0f32; N], vec![0.0f32; N]);
    let seconds = best(6, || {
        parallel::for_each_chunk(&mut a, CHUNK, usize::MAX, |i, a| {
            let (b, c) = (&b[i * CHUNK..][..a.len()], &c[i * CHUNK..][..a.len()]);
            f32::dispatch(
                #[inline(always)]
                || a.iter_mut().zip(b.iter().zip(c)).for_each(|(a, (&b, &c))| *a = c.mul_add(0.5, b)),
            );
        });
    });
    (3 * N * size_of::<f32>()) as f64 * 1e-9 / seconds
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lower_ceiling_counts() {
        let ceilings = Ceilings { gemm_gflops: 100.0, memory_gbs: 10.0 };
        let row = Row {
            gflop: 1.0,
            bytes: 1_000_000,
            forward_ms: 20.0,
            backward_bytes: 40_000_000,
            backward_gflop: 0.1,
            backward_ms: 5.0,
            ..Row::default()
        };
        let both = passes(&row, ceilings);
        // 1 GFLOP at 100 GFLOP/s takes 10 ms of 20; 40 MB at 10 GB/s take 4 ms of 5.
        assert_eq!((both[0].bound, both[1].bound), ("arithmetic", "memory"));
        assert!((both[0].share - 0.5).abs() < 1e-12 && (both[1].share - 0.8).abs() < 1e-12);
        assert!((both[0].gflops - 50.0).abs() < 1e-9 && (both[1].gbs - 8.0).abs() < 1e-9);
        assert!(passes(&Row { forward_ms: 1.0, ..Row::default() }, ceilings).is_empty(), "AdamW has no ceiling here");
    }
}
