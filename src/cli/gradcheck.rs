//! `parallax gradcheck`.

use std::collections::BTreeMap;
use std::time::Instant;

use parallax::gradcheck::{CaseReport, check_case};
use parallax::ops::registry;
use parallax::{Error, Result};
use serde::Serialize;

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
    milliseconds: f64,
}

#[derive(Serialize)]
struct Table {
    ops: Vec<Row>,
    failed: usize,
    /// The whole report of every case that failed.
    failures: Vec<CaseReport>,
}

pub fn run(args: Args) -> Result<()> {
    let chosen: Vec<_> =
        registry::all().into_iter().filter(|e| args.op.as_deref().is_none_or(|name| name == e.name)).collect();
    if chosen.is_empty() {
        let names: Vec<_> = registry::all().iter().map(|e| e.name).collect();
        return Err(Error::setting("--op", format!("there is no such op; there are {}", names.join(", "))));
    }
    let mut table = Table { ops: Vec::new(), failed: 0, failures: Vec::new() };
    for entry in chosen {
        let mut rows: BTreeMap<&str, Row> = BTreeMap::new();
        for case in entry.cases() {
            let start = Instant::now();
            let found = check_case(case.as_ref(), args.seed);
            let row = rows.entry(found.algo).or_insert(Row {
                op: entry.name,
                algo: found.algo,
                cases: 0,
                elements: 0,
                kinks: 0,
                max_error: 0.0,
                milliseconds: 0.0,
            });
            row.cases += 1;
            row.elements += found.report.elements();
            row.kinks += found.report.kinks();
            row.max_error = row.max_error.max(found.report.error());
            row.milliseconds += start.elapsed().as_secs_f64() * 1e3;
            if found.report.failure().is_some() {
                table.failed += 1;
                note!("{found}\n");
                table.failures.push(found);
            }
        }
        table.ops.extend(rows.into_values());
    }
    if args.json {
        super::print_json(&table)?;
    } else {
        say!(
            "{:24} {:16} {:>5} {:>8} {:>5} {:>9} {:>8}",
            "op",
            "kernel path",
            "cases",
            "elements",
            "kinks",
            "max error",
            "ms"
        );
        for r in &table.ops {
            say!(
                "{:24} {:16} {:5} {:8} {:5} {:9.1e} {:8.1}",
                r.op,
                r.algo,
                r.cases,
                r.elements,
                r.kinks,
                r.max_error,
                r.milliseconds
            );
        }
        say!("{} ops and kernel paths, {} failed", table.ops.len(), table.failed);
    }
    match table.failed {
        0 => Ok(()),
        n => Err(Error::Failed(format!("{n} gradients are wrong (see above)"))),
    }
}
