//! Pictures of runs: depth as training went on, and of the last validation.

use std::collections::BTreeSet;

use maud::{Markup, html};

use super::pictures::Album;
use super::record::Record;

/// The most validations of which pictures are shown, evenly over all.
const SHOWN: usize = 20;

/// Depth as training went on: a slider over the steps.
pub fn over_time(runs: &[Record], album: &mut Album) -> Markup {
    let steps: BTreeSet<u64> = runs.iter().flat_map(|run| &run.snapshots).map(|s| s.0).collect();
    if steps.is_empty() {
        return html! {};
    }
    let all: Vec<u64> = steps.into_iter().collect();
    let wanted = all.len().min(SHOWN);
    let kept: Vec<u64> = (1..=wanted).map(|i| all[i * all.len() / wanted - 1]).collect();
    html! {
        h2 id="film" { "Depth as training went on" }
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
pub fn last_pictures(runs: &[Record], album: &mut Album) -> Markup {
    let count = runs.iter().map(|run| run.pictures.len()).max().unwrap_or(0);
    html! {
        @if count > 0 { h2 { "Pictures that were never trained on" } }
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
