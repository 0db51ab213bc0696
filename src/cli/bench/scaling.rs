//! `parallax bench scaling`: how many times faster than on one thread a training step can be on many, as far as the way
//! in which its kernels cut their work goes. A bound from counted work, not a speed: nothing is timed.
//!
//! Each kernel that hands work to threads declares how much there is, in elementary operations, and cuts it into pieces
//! that depend on shapes alone. On N threads it takes at least as long as the thread with the most pieces. The bound is
//! the work of all kernels over the sum of these greatest shares. What a kernel does between two such calls, and the
//! memory that threads share, are not in it.

use std::collections::BTreeMap;

use parallax::Result;
use parallax::tensor::parallel::{self, WORTHWHILE};
use parallax::tensor::regime::{self, Cut};
use serde::Serialize;

use super::job::{Job, Network};
use crate::cli::sizes::Sizes;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    sizes: Sizes,
    /// Seed of the weights and of the pictures.
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// The calls of one place in the source, for one op.
#[derive(Clone, Debug, Default, Serialize)]
struct Place {
    op: String,
    algo: String,
    place: String,
    calls: usize,
    /// The fewest pieces of a call.
    pieces: usize,
    /// Share of the work of the whole step.
    work: f64,
    /// Share of the least time on so many threads.
    time: f64,
}

#[derive(Serialize)]
struct Scaling {
    threads: usize,
    /// Elementary operations, as declared.
    work: f64,
    /// At most so many times as fast as on one thread.
    bound: f64,
    /// Places in the source, the one that costs the most time beyond its share of the work first.
    places: Vec<Place>,
}

/// Places that are printed.
const SHOWN: usize = 20;

/// Says the bound for as many threads as `--threads` says; this machine need not have so many processors.
pub fn run(Args { sizes, seed }: &Args) -> Result<()> {
    let threads = parallel::threads();
    let mut network = Network::new(sizes, *seed, None)?;
    // On one thread, which sees all the calls.
    let (done, cuts) = parallel::with_threads(1, || regime::record(|| network.once()));
    done?;
    let scaling = bound(&cuts, threads);
    if sizes.json { super::super::print_json(&scaling) } else { print(&scaling) }
}

/// The share of a call's work that the busiest of so many threads has.
fn greatest_share(cut: &Cut, threads: usize) -> f64 {
    if cut.pieces < 2 || cut.work < WORTHWHILE {
        return 1.0;
    }
    cut.pieces.div_ceil(threads) as f64 / cut.pieces as f64
}

fn bound(cuts: &[Cut], threads: usize) -> Scaling {
    let mut places: BTreeMap<(&str, &str, String), Place> = BTreeMap::new();
    let (mut work, mut time) = (0.0, 0.0);
    // The pieces of a nested call belong to a piece of the outer one.
    for cut in cuts.iter().filter(|cut| cut.work > 0 && !cut.nested) {
        let mine = cut.work as f64;
        let least = mine * greatest_share(cut, threads);
        (work, time) = (work + mine, time + least);
        let place = places.entry((cut.op, cut.algo, cut.place())).or_default();
        place.pieces = if place.calls == 0 { cut.pieces } else { place.pieces.min(cut.pieces) };
        (place.calls, place.work, place.time) = (place.calls + 1, place.work + mine, place.time + least);
    }
    let named = |((op, algo, at), place): ((&str, &str, String), Place)| Place {
        op: op.into(),
        algo: algo.into(),
        place: at,
        work: place.work / work,
        time: place.time / time,
        ..place
    };
    let mut places: Vec<Place> = places.into_iter().map(named).collect();
    let loss = |place: &Place| place.time * time - place.work * work / threads as f64;
    places.sort_by(|a, b| loss(b).total_cmp(&loss(a)));
    Scaling { threads, work, bound: work / time, places }
}

fn print(scaling: &Scaling) -> Result<()> {
    say!(
        "{:26} {:16} {:38} {:>6} {:>7} {:>7} {:>7}",
        "op",
        "kernel path",
        "where work is cut",
        "calls",
        "pieces",
        "work",
        "time"
    );
    for p in scaling.places.iter().take(SHOWN) {
        say!(
            "{:26} {:16} {:38} {:6} {:7} {:6.2}% {:6.2}%",
            p.op,
            p.algo,
            p.place,
            p.calls,
            p.pieces,
            100.0 * p.work,
            100.0 * p.time
        );
    }
    say!(
        "\nat most {:.1} times as fast on {} threads as on one, as the work is cut ({:.2} G elementary operations)",
        scaling.bound,
        scaling.threads,
        scaling.work * 1e-9
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_busiest_thread_bounds_each_call() {
        let run = || {
            parallel::with_threads(1, || {
                parallel::for_each(6, 60_000, |_| parallel::for_each(2, 20_000, |_| ()));
                parallel::for_each(1, 20_000, |_| ());
                parallel::for_each(8, 100, |_| ());
            });
        };
        let (_, cuts) = regime::record(run);
        let all = 60_000.0 + 20_000.0 + 100.0;
        // Six pieces on four threads: two are the most that one has. One piece and little work stay on one thread.
        let found = bound(&cuts, 4);
        assert_eq!((found.work, found.places.len()), (all, 3));
        assert!((found.bound - all / (20_000.0 + 20_000.0 + 100.0)).abs() < 1e-12, "{}", found.bound);
        assert!((found.places.iter().map(|p| p.time).sum::<f64>() - 1.0).abs() < 1e-12);
        assert_eq!((found.places[0].pieces, found.places[2].pieces), (1, 8), "the serial one first");
        assert_eq!(bound(&cuts, 1).bound, 1.0);
    }
}
