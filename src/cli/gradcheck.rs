//! `parallax gradcheck`.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use parallax::gradcheck::{CHECKS, Complaint, Regimes, Subject, check_everything};
use parallax::ops::registry::{self, Entry};
use parallax::random::{Random, Stream};
use parallax::{Error, Result};
use serde::Serialize;

use super::progress::Progress;

#[derive(clap::Args)]
pub struct Args {
    /// Check only this op [default: all].
    #[arg(long, value_name = "NAME")]
    op: Option<String>,
    /// Seed of inputs and cotangents.
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Then draw cases from the ranges of every op's attributes, for an hour.
    #[arg(long)]
    thorough: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// A row: one op, one kernel path.
#[derive(Serialize)]
struct Row {
    op: &'static str,
    algo: &'static str,
    cases: usize,
    elements: usize,
    kinks: usize,
    max_error: f64,
    /// Runs with pieces of work so small that something was cut.
    cut: usize,
    wrong: usize,
    milliseconds: f64,
}

#[derive(Serialize)]
struct Table {
    ops: Vec<Row>,
    /// Names of the checks of each case.
    checks: Vec<&'static str>,
    /// Cases that were drawn at random.
    drawn: usize,
    /// Places in the source at which work was cut.
    places: usize,
    /// Failed checks.
    complaints: Vec<Wrong>,
}

#[derive(Serialize)]
struct Wrong {
    op: &'static str,
    #[serde(flatten)]
    complaint: Complaint,
}

pub fn run(args: Args) -> Result<()> {
    let chosen: Vec<_> =
        registry::all().into_iter().filter(|e| args.op.as_deref().is_none_or(|name| name == e.name)).collect();
    if chosen.is_empty() {
        let names: Vec<_> = registry::all().iter().map(|e| e.name).collect();
        return Err(Error::setting("--op", format!("there is no such op; there are {}", names.join(", "))));
    }
    let began = Instant::now();
    let checks = CHECKS.iter().map(|(name, _)| *name).collect();
    let mut table = Table { ops: Vec::new(), checks, drawn: 0, places: 0, complaints: Vec::new() };
    let (mut regimes, mut progress) = (Regimes::default(), Progress::new("ops", chosen.len() as u64));
    for (done, entry) in chosen.iter().enumerate() {
        table.ops.extend(rows(entry, args.seed, &mut regimes, &mut table.complaints));
        progress.set(done as u64 + 1, entry.name);
    }
    progress.finish();
    if args.thorough {
        table.drawn = drawn(&chosen, args.seed, &mut table.complaints);
    }
    table.places = regimes.places();
    for Wrong { op, complaint: Complaint { case, algo, check, why } } in &table.complaints {
        note!("{op} [{algo}] \"{case}\", {check}: {why}\n");
    }
    if args.json {
        super::print_json(&table)?
    } else {
        print(&table, began)
    }
    match table.complaints.len() {
        0 => Ok(()),
        n => Err(Error::Failed(format!("{n} checks failed (see above)"))),
    }
}

/// Checks an op: a row for each of its kernel paths.
fn rows(entry: &Entry, seed: u64, regimes: &mut Regimes, wrong: &mut Vec<Wrong>) -> Vec<Row> {
    let mut rows: BTreeMap<&str, Row> = BTreeMap::new();
    for case in entry.cases() {
        let start = Instant::now();
        let found = check_everything(&Subject::new(case.as_ref(), seed));
        regimes.add(&found.cuts);
        let (op, algo) = (entry.name, case.algo());
        let none =
            Row { op, algo, cases: 0, elements: 0, kinks: 0, max_error: 0.0, cut: 0, wrong: 0, milliseconds: 0.0 };
        let row = rows.entry(algo).or_insert(none);
        row.cases += 1;
        row.elements += found.report.elements();
        row.kinks += found.report.kinks();
        row.max_error = row.max_error.max(found.report.error());
        row.cut += found.sizes;
        row.wrong += found.complaints.len();
        row.milliseconds += start.elapsed().as_secs_f64() * 1e3;
        wrong.extend(found.complaints.into_iter().map(|complaint| Wrong { op, complaint }));
    }
    rows.into_values().collect()
}

/// How long cases are drawn.
const THOROUGH: Duration = Duration::from_secs(3600);

/// Checks cases that nobody listed, of one op after the other, until the time is up; how many.
fn drawn(entries: &[Entry], seed: u64, wrong: &mut Vec<Wrong>) -> usize {
    note!("drawing cases for an hour, from seed {seed}");
    let (began, mut random, mut count) = (Instant::now(), Random::of(seed, Stream::CaseInputs), 0);
    let mut progress = Progress::new("minutes", THOROUGH.as_secs() / 60);
    while began.elapsed() < THOROUGH {
        let before = count;
        for entry in entries {
            let Some(case) = entry.draw(&mut random) else { continue };
            count += 1;
            let found = check_everything(&Subject::drawn(case.as_ref(), seed.wrapping_add(count as u64)));
            wrong.extend(found.complaints.into_iter().map(|complaint| Wrong { op: entry.name, complaint }));
            progress.set(began.elapsed().as_secs() / 60, &format!("{count} cases"));
        }
        if count == before {
            note!("none of these ops has attributes to draw");
            break;
        }
    }
    progress.finish();
    count
}

fn print(table: &Table, began: Instant) {
    say!(
        "{:24} {:20} {:>5} {:>8} {:>5} {:>9} {:>4} {:>5} {:>8}",
        "op",
        "kernel path",
        "cases",
        "elements",
        "kinks",
        "max error",
        "cut",
        "wrong",
        "ms"
    );
    for r in &table.ops {
        say!(
            "{:24} {:20} {:5} {:8} {:5} {:9.1e} {:4} {:5} {:8.1}",
            r.op,
            r.algo,
            r.cases,
            r.elements,
            r.kinks,
            r.max_error,
            r.cut,
            r.wrong,
            r.milliseconds
        );
    }
    let sum = |of: fn(&Row) -> usize| table.ops.iter().map(of).sum::<usize>();
    say!(
        "\n{} ops and kernel paths, {} cases in {:.0} s; of each: {}",
        table.ops.len(),
        sum(|r| r.cases),
        began.elapsed().as_secs_f64(),
        table.checks.join(", ")
    );
    say!(
        "with small pieces of work, at {} places in the source, {} runs: differences, values, accumulation, f32, 1 to 8 threads",
        table.places,
        sum(|r| r.cut)
    );
    if table.drawn > 0 {
        say!("{} more cases were drawn", table.drawn);
    }
    say!("{} checks failed", table.complaints.len());
}
