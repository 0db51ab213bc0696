//! The markup of the page: one file, nothing from elsewhere.
//!
//! `maud` checks the markup when the program is compiled and escapes every value.

use std::collections::BTreeSet;

use maud::{DOCTYPE, Markup, PreEscaped, html};
use parallax::train::health::CHECKS;
use serde_json::Value;

use super::curves;
use super::pictures::Album;
use super::record::Record;
use super::views;

const STYLE: &str = include_str!("page.css");
const SCRIPT: &str = include_str!("page.js");
/// The most validations of which pictures are shown, evenly over all.
const SHOWN: usize = 20;

/// The page of a run, or of several compared; `running` if the first is being trained now.
pub fn page(runs: &[Record], running: bool, missing: &[String]) -> String {
    let names: Vec<&str> = runs.iter().map(|run| run.name.as_str()).collect();
    let title = match &names[..] {
        [name] => format!("Run {name}"),
        _ => format!("Runs {}", names.join(", ")),
    };
    let mut album = Album::default();
    let shown =
        html! { (over_time(runs, &mut album)) (last_pictures(runs, &mut album)) (views::views(runs, &mut album)) };
    let markup = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                link rel="icon" href="data:,";
                title { (title) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                main {
                    h1 { (title) }
                    @for word in missing { p.note { (word) } }
                    @for run in runs { @for word in &run.problems { p.note { (run.name) ": " (word) } } }
                    (summary(runs, running))
                    (health(runs))
                    (shown)
                    @if album.left_out > 0 {
                        p.note { (album.left_out) " pictures are left out to keep the page below 10 MB." }
                    }
                    @if album.unreadable > 0 { p.note { (album.unreadable) " pictures cannot be read." } }
                    h2 { "Curves" }
                    div.charts {
                        @for chart in curves::all(runs) {
                            figure {
                                div.scroll role="img" tabindex="0" aria-label={ (chart.title) ". " (chart.words) } {
                                    (PreEscaped(chart.svg))
                                }
                                figcaption { (chart.words) }
                            }
                        }
                    }
                    (views::path(runs))
                    (views::time(runs))
                    (settings(runs))
                    (machines(runs))
                }
                script { (PreEscaped(SCRIPT)) }
            }
        }
    };
    markup.into_string()
}

/// A table with a column for each run.
fn table(runs: &[Record], caption: &str, rows: &[(String, Vec<String>)]) -> Markup {
    html! {
        div.scroll role="region" tabindex="0" aria-label=(caption) {
            table {
                caption { (caption) }
                thead { tr { th scope="col" { "" } @for run in runs { th scope="col" { (run.name) } } } }
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

/// How a run stands, in words.
fn state(run: &Record, running: bool) -> String {
    let (last, all) = (run.last_step(), run.setting("steps").unwrap_or("?"));
    if run.finished() {
        format!("finished after {last} steps")
    } else if running {
        format!("being trained: step {last} of {all}; load the page again to see more")
    } else {
        format!("not at its end: step {last} of {all}")
    }
}

fn summary(runs: &[Record], running: bool) -> Markup {
    let row = |name: &str, of: &dyn Fn(&Record) -> String| (name.to_owned(), runs.iter().map(of).collect());
    let least = |run: &Record, at: &str| {
        let values = run.validations.iter().filter_map(|line| line[at].as_f64());
        values.min_by(f64::total_cmp).map_or_else(|| "–".into(), |v| format!("{v:.4}"))
    };
    let last = |lines: &[Value], at: &str| lines.last().map_or_else(|| "–".into(), |line| number(&line[at]));
    let rows = [
        row("State", &|run| state(run, running)),
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
    ];
    html! { h2 { "Summary" } (table(runs, "Summary", &rows)) }
}

fn health(runs: &[Record]) -> Markup {
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
                            @for line in lines.iter().take(10) {
                                li {
                                    "step " (line["step"]) ": "
                                    (if line["begins"] == true { "begins" } else { "ends" })
                                    ", " (check.figure) " " (number(&line["figure"])) ", limit " (number(&line["limit"]))
                                }
                            }
                            @if lines.len() > 10 { li { "and " (lines.len() - 10) " more" } }
                        }
                    }
                }
            }
        }
    }
}

/// Depth as training went on: a slider over the steps.
fn over_time(runs: &[Record], album: &mut Album) -> Markup {
    let steps: BTreeSet<u64> = runs.iter().flat_map(|run| &run.snapshots).map(|s| s.0).collect();
    if steps.is_empty() {
        return html! { p.note { "No pictures of the time of training are recorded: runs of older versions have none." } };
    }
    let all: Vec<u64> = steps.into_iter().collect();
    let wanted = all.len().min(SHOWN);
    let kept: Vec<u64> = (1..=wanted).map(|i| all[i * all.len() / wanted - 1]).collect();
    html! {
        h2 { "Depth as training went on" }
        p { "Each picture: the frame, its predicted disparity, and the true one where it is known. Bright is near." }
        div.film {
            label { "Validation " input type="range" min="0" max=(kept.len() - 1) value=(kept.len() - 1); }
            output { "step " (kept[kept.len() - 1]) }
            @for (i, step) in kept.iter().enumerate() {
                div.frames data-step=(step) hidden[i + 1 != kept.len()] {
                    @for run in runs {
                        @for (_, sample, path) in run.snapshots.iter().filter(|s| s.0 == *step) {
                            @if let Some(address) = album.address(path) {
                                figure {
                                    img src=(address) alt={ "Frame, disparity and truth of sample " (sample) " after step " (step) ", run " (run.name) };
                                    figcaption { (run.name) ", sample " (sample) }
                                }
                            }
                        }
                    }
                }
            }
        }
    }
}

/// Pictures of the last validation, those of several runs beside each other.
fn last_pictures(runs: &[Record], album: &mut Album) -> Markup {
    let count = runs.iter().map(|run| run.pictures.len()).max().unwrap_or(0);
    html! {
        h2 { "Pictures that were never trained on" }
        @if count == 0 { p.note { "There are none in the folder images." } }
        div.pictures {
            @for i in 0..count {
                @for run in runs {
                    @if let Some(address) = run.pictures.get(i).and_then(|path| album.address(path)) {
                        figure {
                            img src=(address) alt={ "Frame, predicted disparity and truth, picture " (i) ", run " (run.name) };
                            figcaption { (run.name) ", picture " (i) }
                        }
                    }
                }
            }
        }
    }
}

fn settings(runs: &[Record]) -> Markup {
    let names: BTreeSet<&String> = runs.iter().flat_map(|run| &run.config).map(|(name, _)| name).collect();
    let row = |name: &&String| {
        let value = |run: &Record| run.setting(name).unwrap_or("–").to_owned();
        ((*name).clone(), runs.iter().map(value).collect::<Vec<_>>())
    };
    let all: Vec<_> = names.iter().map(row).collect();
    let differ: Vec<_> = all.iter().filter(|(_, v)| v.iter().any(|other| *other != v[0])).cloned().collect();
    html! {
        h2 { "Configuration" }
        @if runs.len() > 1 {
            @if differ.is_empty() { p { "The configurations are equal." } }
            @else { (table(runs, "Differences of the configurations", &differ)) }
        }
        details { summary { "Whole configuration" } (table(runs, "Configuration", &all)) }
    }
}

fn machines(runs: &[Record]) -> Markup {
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
