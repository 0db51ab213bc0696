//! `parallax gradcheck`.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use parallax::gradcheck::{CHECKS, Complaint, Regimes, Subject, Verdict, check_everything, for_each_case};
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
    let mut regimes = Regimes::default();
    for found in checked(&chosen, args.seed) {
        table.add(found, &mut regimes);
    }
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

/// A case that was checked.
struct Checked {
    op: &'static str,
    algo: &'static str,
    verdict: Verdict,
    milliseconds: f64,
}

/// Checks all cases of some ops.
fn checked(chosen: &[Entry], seed: u64) -> Vec<Checked> {
    let count = chosen.iter().map(|entry| entry.cases().len() as u64).sum();
    let progress = Mutex::new((0, Progress::new("cases", count)));
    let found = for_each_case(chosen, |entry, case| {
        let start = Instant::now();
        let verdict = check_everything(&Subject::new(case, seed));
        if let Ok(mut progress) = progress.lock() {
            progress.0 += 1;
            let done = progress.0;
            progress.1.set(done, entry.name);
        }
        let milliseconds = start.elapsed().as_secs_f64() * 1e3;
        Checked { op: entry.name, algo: case.algo(), verdict, milliseconds }
    });
    if let Ok(progress) = progress.lock() {
        progress.1.finish();
    }
    found
}

impl Table {
    /// Adds a case to the row of its op and kernel path.
    fn add(&mut self, Checked { op, algo, verdict, milliseconds }: Checked, regimes: &mut Regimes) {
        regimes.add(&verdict.cuts);
        let i = self.ops.iter().position(|row| (row.op, row.algo) == (op, algo)).unwrap_or_else(|| {
            let (max_error, milliseconds) = (0.0, 0.0);
            self.ops.push(Row { op, algo, cases: 0, elements: 0, kinks: 0, max_error, cut: 0, wrong: 0, milliseconds });
            self.ops.len() - 1
        });
        let row = &mut self.ops[i];
        row.cases += 1;
        row.elements += verdict.report.elements();
        row.kinks += verdict.report.kinks();
        row.max_error = row.max_error.max(verdict.report.error());
        row.cut += verdict.sizes;
        row.wrong += verdict.complaints.len();
        row.milliseconds += milliseconds;
        self.complaints.extend(verdict.complaints.into_iter().map(|complaint| Wrong { op, complaint }));
    }
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
