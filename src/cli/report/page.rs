//! The markup of the page: one file, nothing from elsewhere.
//!
//! `maud` checks the markup when the program is compiled and escapes every value.

use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::cards::cards;
use super::curves::{self, Drawn};
use super::film::{last_pictures, over_time};
use super::pictures::Album;
use super::record::Record;
use super::tables::{differences, gaps, health, machines, settings, summary};
use super::views;

const STYLE: &str = include_str!("page.css");
const SCRIPT: &str = include_str!("page.js");
/// Seconds after which the page of a run that goes on is loaded again.
const AGAIN: u32 = 20;

/// The page of a run, or of several compared; `missing` says which are left out.
pub fn page(runs: &[Record], missing: &[String]) -> String {
    let names: Vec<&str> = runs.iter().map(|run| run.name.as_str()).collect();
    let title = match &names[..] {
        [name] => format!("Run {name}"),
        _ => format!("Runs {}", names.join(", ")),
    };
    // Pictures are counted in the order in which they matter: what comes last is left out first.
    let mut album = Album::default();
    let top = cards(runs, &mut album);
    let pictures =
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
                    @if runs.iter().any(|run| run.running) { (again(runs.len())) }
                    (top)
                    @for word in missing { p.note { (word) } }
                    (gaps(runs))
                    @if album.left_out > 0 {
                        p.note { (album.left_out) " pictures are left out to keep the page below 10 MB." }
                    }
                    @if album.unreadable > 0 { p.note { (album.unreadable) " pictures cannot be read." } }
                    (differences(runs))
                    (summary(runs))
                    (health(runs))
                    (pictures)
                    h2 { "Curves" }
                    div.charts { @for chart in curves::all(runs) { (figure(&chart)) } }
                    @if let Some(path) = views::path(runs) {
                        h2 { "Path of the camera" }
                        div.charts { (figure(&path)) }
                    }
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

/// A chart with its text below, and for those who do not see it.
fn figure(chart: &Drawn) -> Markup {
    html! {
        figure {
            div.scroll role="img" tabindex="0" aria-label={ (chart.title) ". " (chart.words) } { (PreEscaped(&chart.svg)) }
            figcaption { (chart.words) }
        }
    }
}

/// The switch of a page that is written again while a run goes on. A comparison is not.
fn again(runs: usize) -> Markup {
    html! {
        @if runs == 1 {
            p.again {
                label { input type="checkbox" id="again" checked data-seconds=(AGAIN); " Load this page again every " (AGAIN) " seconds, until the run has ended" }
            }
        } @else {
            p.note { "A run here is being trained: `parallax report` shows it as it is when it is called." }
        }
    }
}
