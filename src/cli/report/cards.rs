//! The top of the page: how each run went, why, and what its depth looks like.

use maud::{Markup, html};

use super::pictures::Album;
use super::record::Record;
use super::verdict::{Verdict, compared};

/// A sentence on all runs, and a card for each.
pub fn cards(runs: &[Record], album: &mut Album) -> Markup {
    let verdicts: Vec<Verdict> = runs.iter().map(Verdict::of).collect();
    html! {
        @if runs.len() > 1 { p.verdict { (compared(runs, &verdicts).join(" ")) } }
        div class=(if runs.len() > 1 { "cards" } else { "cards one" }) {
            @for (run, verdict) in runs.iter().zip(&verdicts) {
                section class={ "card " (verdict.standing.class()) } aria-label={ "Verdict on run " (run.name) } {
                    h2 { @if runs.len() > 1 { (run.name) } @else { "How it went" } }
                    p.standing { (verdict.standing.word()) }
                    @if let Some(figure) = verdict.figure {
                        p.figure { strong { (format!("{:.3}", figure.value)) } " " (figure.name) " (" (figure.on) ")" }
                    }
                    @if let Some(address) = run.pictures.first().and_then(|path| album.address(path)) {
                        img src=(address) alt={ "A frame, its predicted disparity and the true one, run " (run.name) };
                    }
                    ul { @for reason in verdict.reasons.iter().take(3) { li { (reason) } } }
                }
            }
        }
    }
}
