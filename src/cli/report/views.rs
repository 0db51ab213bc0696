//! The part of the page that shows a run's views: errors, warped neighbours, attention, time by op, path, worst samples.

use maud::{Markup, html};
use parallax::report::plot::{Line, Plot};
use parallax::train::views::{AT_END, Group, Views};

use super::curves::Drawn;
use super::pictures::Album;
use super::record::Record;

/// The most rows of the table of times; the others are added up.
const ROWS: usize = 12;

/// All views, kind by kind, those of several runs below each other.
pub fn views(runs: &[Record], album: &mut Album) -> Markup {
    let mut kinds: Vec<&str> = Vec::new();
    for kind in
        runs.iter().flat_map(|run| &run.views).flat_map(|(_, views)| &views.groups).map(|group| group.kind.as_str())
    {
        if !kinds.contains(&kind) {
            kinds.push(kind);
        }
    }
    html! {
        @for kind in kinds {
            h2 { (kind) }
            @for run in runs {
                @for (list, views) in &run.views {
                    @for group in views.groups.iter().filter(|group| group.kind == kind) {
                        (shown(run, &weights(list, views), group, album))
                    }
                }
            }
        }
    }
}

fn views_of(run: &Record) -> impl Iterator<Item = &Views> {
    run.views.iter().map(|(_, views)| views)
}

/// The weights that a list shows, in words.
fn weights(list: &str, views: &Views) -> String {
    if list == AT_END { "best weights".into() } else { format!("step {}", views.step) }
}

fn shown(run: &Record, weights: &str, group: &Group, album: &mut Album) -> Markup {
    html! {
        h3 { (run.name) ", " (group.about) ", " (weights) }
        div.pictures {
            @for view in &group.views {
                @if let Some(address) = album.exact(&run.view(&view.file)) {
                    figure {
                        img src=(address) alt={ (view.title) ", " (group.about) ", run " (run.name) };
                        figcaption {
                            (view.title)
                            @if let Some([dark, bright]) = &view.bar {
                                div.bar { span { (dark) } i {} span { (bright) } }
                            }
                        }
                    }
                }
            }
        }
    }
}

/// Where the time of a step goes, by run.
pub fn time(runs: &[Record]) -> Markup {
    let known: Vec<(&Record, &Views)> =
        runs.iter().filter_map(|run| Some((run, views_of(run).find(|views| !views.time.is_empty())?))).collect();
    html! {
        @if !known.is_empty() { h2 { "Where a step's time goes" } }
        @for (run, views) in known {
            @let all: f64 = views.time.iter().map(|(_, seconds)| seconds).sum();
            @let rest: f64 = views.time.iter().skip(ROWS).map(|(_, seconds)| seconds).sum();
            @let rows = views.time.iter().take(ROWS).map(|(name, t)| (name.as_str(), *t));
            @let rest = (rest > 0.0).then_some(("all others", rest));
            div.scroll role="region" tabindex="0" aria-label={ "Time of a step, run " (run.name) } {
                table {
                    caption { (run.name) ": forward and backward pass of a batch at the first validation" }
                    thead { tr { th scope="col" { "op or part" } th scope="col" { "ms" } th scope="col" { "share" } } }
                    tbody {
                        @for (name, seconds) in rows.chain(rest) {
                            tr {
                                th scope="row" { (name) }
                                td { (format!("{:.1}", 1e3 * seconds)) }
                                td { (format!("{:.1} %", 100.0 * seconds / all.max(f64::MIN_POSITIVE))) }
                            }
                        }
                    }
                }
            }
        }
    }
}

/// The camera's path from above, of all runs in one chart, beside the true one where that is known; nothing where there is
/// none.
pub fn path(runs: &[Record]) -> Option<Drawn> {
    let known: Vec<(&Record, &Views)> =
        runs.iter().filter_map(|run| Some((run, views_of(run).find(|views| views.path.len() > 1)?))).collect();
    let (_, first) = known.first()?;
    let unit = if known.iter().all(|(_, views)| views.metres) { "m" } else { "unit of predicted depth" };
    let line = |name: String, points: &[[f64; 2]]| Line { name, points: points.to_vec(), marked: points.len() < 30 };
    let mut lines: Vec<Line> = known.iter().map(|(run, views)| line(run.name.clone(), &views.path)).collect();
    let mut truths: Vec<&[[f64; 2]]> = Vec::new();
    for (run, views) in &known {
        if views.true_path.len() > 1 && !truths.contains(&&views.true_path[..]) {
            let whose = if truths.is_empty() { String::new() } else { format!(" of {}", run.name) };
            lines.push(line(format!("true path{whose}"), &views.true_path));
            truths.push(&views.true_path);
        }
    }
    let plot = Plot {
        title: "Path of the camera, from above".into(),
        x: format!("right, {unit}"),
        y: format!("forward, {unit}"),
        lines,
        equal: true,
        ..Plot::default()
    };
    let ends = |(run, views): &(&Record, &Views)| {
        let end =
            |path: &[[f64; 2]]| path.last().map(|[x, z]| format!("{x:.1} to the right and {z:.1} ahead ({unit})"));
        let truth = end(&views.true_path).map_or_else(String::new, |truth| format!(", truly {truth}"));
        let off = views
            .path_error
            .map_or_else(String::new, |error| format!("; {error:.2} m off on average once laid over the true path"));
        format!("{} ends {}{truth}{off}", run.name, end(&views.path).unwrap_or_default())
    };
    let words = format!(
        "{} frames that were never trained on, as the pose network joins them; {}",
        first.path.len(),
        known.iter().map(ends).collect::<Vec<_>>().join(". ")
    );
    Some(Drawn { title: plot.title.clone(), words, svg: plot.svg() })
}
