//! `parallax gradcheck`.

use std::collections::BTreeMap;
use std::time::Instant;

use parallax::gradcheck::{CHECKS, Complaint, Regimes, check_everything};
use parallax::ops::registry::{self, Entry};
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
    /// What was done with each case.
    checks: Vec<&'static str>,
    /// Places in the source at which work was cut.
    places: usize,
    /// What is wrong, check by check.
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
    let mut table = Table { ops: Vec::new(), checks, places: 0, complaints: Vec::new() };
    let (mut regimes, mut progress) = (Regimes::default(), Progress::new("ops", chosen.len() as u64));
    for (done, entry) in chosen.iter().enumerate() {
        table.ops.extend(rows(entry, args.seed, &mut regimes, &mut table.complaints));
        progress.set(done as u64 + 1, entry.name);
    }
    progress.finish();
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
        let found = check_everything(case.as_ref(), seed);
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
    say!("{} checks failed", table.complaints.len());
}
