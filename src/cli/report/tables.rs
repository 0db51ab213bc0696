//! The tables of the page: summary, health warnings, configuration, machine.

use std::collections::BTreeSet;

use maud::{Markup, html};
use parallax::train::health::CHECKS;
use serde_json::Value;

use super::record::Record;

/// The most beginnings and ends of a warning that are listed.
const LISTED: usize = 10;

/// A table with a column for each run.
fn table(runs: &[Record], caption: &str, rows: &[(String, Vec<String>)]) -> Markup {
    html! {
        div.scroll role="region" tabindex="0" aria-label=(caption) {
            table {
                caption { (caption) }
                thead { tr { td {} @for run in runs { th scope="col" { (run.name) } } } }
                tbody {
                    @for (name, values) in rows {
                        tr { th scope="row" { (name) } @for value in values { td { (value) } } }
                    }
                }
            }
        }
    }
}

fn number(value: &Value) -> String {
    value.as_f64().map_or_else(|| "–".into(), |v| format!("{v:.4}"))
}

/// How far a run is, in words.
fn state(run: &Record) -> String {
    let (last, all) = (run.last_step(), run.setting("steps").unwrap_or("?"));
    if run.running {
        format!("being trained: step {last} of {all}")
    } else if run.finished() {
        format!("finished after {last} steps")
    } else {
        format!("not at its end: step {last} of {all}")
    }
}

/// The time that the page and its pictures took, as a share of the training's.
fn page_time(run: &Record) -> String {
    run.page_time().map_or_else(
        || "not recorded".into(),
        |[taken, trained]| format!("{taken:.1} s, {:.1} % of the {trained:.0} s of training", 100.0 * taken / trained),
    )
}

/// The figures that say most.
pub fn summary(runs: &[Record]) -> Markup {
    let row = |name: &str, of: &dyn Fn(&Record) -> String| (name.to_owned(), runs.iter().map(of).collect());
    let least = |run: &Record, at: &str| {
        let values = run.validations.iter().filter_map(|line| line[at].as_f64());
        values.min_by(f64::total_cmp).map_or_else(|| "–".into(), |v| format!("{v:.4}"))
    };
    let last = |lines: &[Value], at: &str| lines.last().map_or_else(|| "–".into(), |line| number(&line[at]));
    let rows = [
        row("State", &state),
        row("Warnings at the end", &|run| match &run.standing()[..] {
            [] => "none".into(),
            names => names.join(", "),
        }),
        row("Loss, last", &|run| last(&run.steps, "loss")),
        row("Photometric error on validation data, best", &|run| least(run, "photometric")),
        row("… unwarped, last", &|run| last(&run.validations, "unwarped")),
        row("Abs Rel on validation data, best", &|run| least(run, "abs_rel")),
        row("Abs Rel on test data, before", &|run| number(&run.metrics["before"]["abs_rel"])),
        row("Abs Rel on test data, mean depth map", &|run| number(&run.metrics["mean_map"]["abs_rel"])),
        row("Abs Rel on test data, trained", &|run| number(&run.metrics["after"]["abs_rel"])),
        row("a1 on test data, trained", &|run| number(&run.metrics["after"]["a1"])),
        row("Time added by this page and its pictures", &page_time),
    ];
    html! { h2 { "Summary" } (table(runs, "Summary", &rows)) }
}

/// The warnings of every run, when they began and ended, with what they mean.
pub fn health(runs: &[Record]) -> Markup {
    html! {
        h2 { "Health warnings" }
        @for run in runs {
            @if runs.len() > 1 { h3 { (run.name) } }
            @if run.warnings.is_empty() { p { "No warning is recorded." } }
            @let standing = run.standing();
            @for check in &CHECKS {
                @let lines: Vec<&Value> = run.warnings.iter().filter(|l| l["warning"] == check.name).collect();
                @if !lines.is_empty() {
                    div.warning {
                        p { strong { (check.name) } @if standing.contains(&check.name) { " (to the end of the log)" } }
                        p { "Meaning: " (check.meaning) ". Advice: " (check.advice) "." }
                        ul {
                            @for line in lines.iter().take(LISTED) {
                                li {
                                    "step " (line["step"]) ": "
                                    (if line["begins"] == true { "begins" } else { "ends" })
                                    ", " (check.figure) " " (number(&line["figure"])) ", limit " (number(&line["limit"]))
                                }
                            }
                            @if lines.len() > LISTED { li { "and " (lines.len() - LISTED) " more" } }
                        }
                    }
                }
            }
        }
    }
}

/// Names of settings, and their value in each run.
fn rows(runs: &[Record]) -> Vec<(String, Vec<String>)> {
    let names: BTreeSet<&String> = runs.iter().flat_map(|run| &run.config).map(|(name, _)| name).collect();
    let value = |run: &Record, name: &str| run.setting(name).unwrap_or("–").to_owned();
    names.into_iter().map(|name| (name.clone(), runs.iter().map(|run| value(run, name)).collect())).collect()
}

/// The settings in which several runs differ; nothing of a single one.
pub fn differences(runs: &[Record]) -> Markup {
    let differ: Vec<_> = rows(runs).into_iter().filter(|(_, v)| v.iter().any(|other| *other != v[0])).collect();
    html! {
        @if runs.len() > 1 {
            h2 { "What differs in the configurations" }
            @if differ.is_empty() { p { "The configurations are equal." } }
            @else { (table(runs, "Differences of the configurations", &differ)) }
        }
    }
}

/// The whole configuration.
pub fn settings(runs: &[Record]) -> Markup {
    html! {
        h2 { "Configuration" }
        details id="configuration" { summary { "Whole configuration" } (table(runs, "Configuration", &rows(runs))) }
    }
}

/// The machines.
pub fn machines(runs: &[Record]) -> Markup {
    let row = |name: &&str| {
        let value = |run: &Record| match &run.machine[*name] {
            Value::Null => "not recorded".to_owned(),
            Value::String(text) => text.clone(),
            other => other.to_string(),
        };
        ((*name).to_owned(), runs.iter().map(value).collect::<Vec<_>>())
    };
    let rows: Vec<_> = ["processor", "architecture", "system", "threads", "simd", "version"].iter().map(row).collect();
    html! { h2 { "Machine" } (table(runs, "Machine", &rows)) }
}

/// What the folders do not hold, and how to get it; what could not be read.
pub fn gaps(runs: &[Record]) -> Markup {
    html! {
        @for run in runs {
            @if !run.gaps.is_empty() || !run.problems.is_empty() {
                section.note aria-label={ "Missing from run " (run.name) } {
                    p { strong { "Not all of " (run.name) " can be shown" } }
                    ul {
                        @for word in &run.problems { li { (word) } }
                        @for gap in &run.gaps { li { (gap.what) ". To get it: " (gap.how) "." } }
                    }
                }
            }
        }
    }
}
