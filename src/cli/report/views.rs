//! The part of the page that shows a run's views: errors, warped neighbours, attention, time by op, path, worst samples.

use maud::{Markup, PreEscaped, html};
use parallax::report::plot::{Line, Plot};
use parallax::train::views::{AT_END, Group, Views};

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
        @if kinds.is_empty() {
            p.note { "No errors, warped neighbours or attention are recorded: validations of runs of this version leave them." }
        }
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
        h2 { "Where a step's time goes" }
        @if known.is_empty() { p.note { "It is not recorded: the first validation of a run of this version measures it." } }
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

/// The camera's path from above, of all runs in one chart; nothing where none is known.
pub fn path(runs: &[Record]) -> Markup {
    let known: Vec<(&Record, &Views)> =
        runs.iter().filter_map(|run| Some((run, views_of(run).find(|views| views.path.len() > 1)?))).collect();
    let Some((_, first)) = known.first() else { return html! {} };
    let unit = if known.iter().all(|(_, views)| views.metres) { "m" } else { "unit of predicted depth" };
    let line = |(run, views): &(&Record, &Views)| Line {
        name: run.name.clone(),
        points: views.path.clone(),
        marked: views.path.len() < 30,
    };
    let plot = Plot {
        title: "Path of the camera, from above".into(),
        x: format!("right, {unit}"),
        y: format!("forward, {unit}"),
        lines: known.iter().map(line).collect(),
        equal: true,
        ..Plot::default()
    };
    let end = first.path[first.path.len() - 1];
    let words = format!(
        "{} frames that were never trained on, as the pose network joins them; {} ends {:.1} to the right and {:.1} ahead ({unit})",
        first.path.len(),
        known[0].0.name,
        end[0],
        end[1],
    );
    html! {
        h2 { "Path of the camera" }
        div.charts {
            figure {
                div.scroll role="img" tabindex="0" aria-label={ "Path of the camera from above. " (words) } { (PreEscaped(plot.svg())) }
                figcaption { (words) }
            }
        }
    }
}
