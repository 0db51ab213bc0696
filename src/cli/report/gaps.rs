//! What a run's folder does not hold, and how to get it.

use std::path::Path;

use super::record::Record;

/// Something that the page would show and the folder does not hold.
#[derive(Clone, Debug, PartialEq)]
pub struct Gap {
    /// The thing, and what is therefore not shown.
    pub what: String,
    /// The way to get it.
    pub how: String,
}

/// All gaps of a folder; nothing is asked for that a run has only later.
pub fn of(folder: &Path, run: &Record) -> Vec<Gap> {
    let mut gaps = Vec::new();
    let mut add = |what: &str, how: &str| gaps.push(Gap { what: what.into(), how: how.into() });
    let has = |name: &str| folder.join(name).exists();
    let weights = has("best.safetensors") || has("last.safetensors");
    let validated = !run.validations.is_empty();
    if !has("log.jsonl") {
        add(
            "there is no log.jsonl: no curve, validation or loss is shown",
            "copy it from where the run was trained; it cannot be made again without training",
        );
    } else if run.steps.is_empty() {
        add("no step is logged: there are no curves", "wait for the first line of the log, or train on with --resume");
    } else if run.steps.last().is_some_and(|line| line.get("flow").is_none()) {
        add(
            "the log is of an older version: figures it lacks (motion, gradient norms by part, ...) are left out",
            "train on with --resume and more --steps: new lines have them",
        );
    }
    if !has("warnings.jsonl") && !run.steps.is_empty() {
        add(
            "there is no warnings.jsonl: whether warnings were given is not known",
            "train on with --resume: this version writes it",
        );
    }
    if run.views.is_empty() && (validated || run.finished() || run.steps.is_empty()) {
        let how = match (run.running, weights) {
            (true, _) => "its next validation leaves them",
            (false, true) => "`parallax report RUN --views` makes them from its weights",
            (false, false) => {
                "there are no weights to make them from: copy best.safetensors into the folder, then use --views"
            }
        };
        add("there are no views: no errors, warped neighbours, attention, path or worst samples", how);
    }
    if run.snapshots.is_empty() && validated {
        add(
            "there are no pictures of the time of training (pages/)",
            "only validations leave them: those that come with --resume will",
        );
    }
    if run.machine.is_null() {
        add("there is no machine.json: the machine is not known", "train on with --resume: this version writes it");
    }
    if run.metrics.is_null() && !run.running {
        add(
            "there is no metrics.json: the run has not come to its end",
            "`parallax train --resume RUN` takes it there and measures",
        );
    }
    gaps
}
