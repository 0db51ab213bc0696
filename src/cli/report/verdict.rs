//! How a run went, told from what it recorded: its warnings, its validations, its metrics. Nothing is guessed.

use parallax::train::health::CHECKS;
use serde_json::Value;

use super::record::Record;

/// How a run went.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Standing {
    /// Nothing speaks against it.
    Healthy,
    /// A warning stands that need not be the end of it.
    Doubtful,
    /// It has not learnt depth.
    Failed,
    /// Too little is recorded.
    Unknown,
}

impl Standing {
    /// The word for it.
    pub fn word(self) -> &'static str {
        match self {
            Standing::Healthy => "healthy",
            Standing::Doubtful => "look at the warnings",
            Standing::Failed => "has not learnt depth",
            Standing::Unknown => "cannot be told yet",
        }
    }

    /// The class of its colour in the page's style.
    pub fn class(self) -> &'static str {
        match self {
            Standing::Healthy => "good",
            Standing::Doubtful | Standing::Unknown => "doubt",
            Standing::Failed => "bad",
        }
    }
}

/// How a run went, why, and the figure that says it shortest.
pub struct Verdict {
    /// How it went.
    pub standing: Standing,
    /// Reasons, the gravest first.
    pub reasons: Vec<String>,
    /// Its error, where one is recorded.
    pub figure: Option<Figure>,
}

/// An error of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Figure {
    /// Its name.
    pub name: &'static str,
    /// The pictures that it is of.
    pub on: &'static str,
    /// Its value; less is better.
    pub value: f64,
}

/// Warnings that, standing at the end, mean that nothing was learnt.
const FATAL: [&str; 5] = [
    "disparity collapsed",
    "disparity saturated",
    "pose is the identity",
    "frames are static",
    "warped not better than unwarped",
];
/// Settings that decide which pictures an error is of.
const PICTURES: [&str; 6] = ["data", "seed", "split", "val_split", "height", "width"];

impl Verdict {
    /// That of a run.
    pub fn of(run: &Record) -> Self {
        let mut reasons = Vec::new();
        let standing = run.standing();
        let meaning = |name: &str| CHECKS.iter().find(|check| check.name == name).map_or("", |check| check.meaning);
        for name in FATAL.iter().filter(|name| standing.contains(name)) {
            reasons.push(format!("{name}: {}", meaning(name)));
        }
        let broken = |line: &Value| line.get("loss").is_some_and(Value::is_null);
        if run.steps.last().is_some_and(broken) {
            reasons.push("the loss is no finite number".into());
        }
        let last = run.validations.last();
        let validated = last.and_then(|line| Some([line["warped"].as_f64()?, line["unwarped"].as_f64()?]));
        if let Some([warped, unwarped]) = validated.filter(|[warped, unwarped]| warped >= unwarped) {
            reasons.push(format!(
                "on validation data warping explains neighbours no better than standing still does ({warped:.3} against {unwarped:.3})"
            ));
        }
        let [after, mean] = ["after", "mean_map"].map(|name| run.metrics[name]["abs_rel"].as_f64());
        if let Some((after, mean)) = after.zip(mean).filter(|(after, mean)| after >= mean) {
            reasons.push(format!(
                "its depth is no better than one mean depth map for all pictures (Abs Rel {after:.3} against {mean:.3})"
            ));
        }
        let failed = !reasons.is_empty();
        for name in standing.iter().filter(|name| !FATAL.contains(name)) {
            reasons.push(format!("{name}: {}", meaning(name)));
        }
        let standing = match (failed, reasons.is_empty(), last) {
            (true, ..) => Standing::Failed,
            (false, false, _) => Standing::Doubtful,
            (false, true, None) => Standing::Unknown,
            (false, true, Some(_)) => Standing::Healthy,
        };
        if standing == Standing::Healthy {
            reasons.push("no warning stands at the end of the log".into());
            if let Some([warped, unwarped]) = validated {
                let less = 100.0 * (1.0 - warped / unwarped.max(f64::MIN_POSITIVE));
                reasons.push(format!("on validation data warping leaves {less:.0} % less error than standing still"));
            }
        }
        if standing == Standing::Unknown {
            reasons.push("no validation is recorded".into());
        }
        Verdict { standing, reasons, figure: figure(run) }
    }
}

/// The error that says most of a run: Abs Rel of what nothing was chosen on, or else of validation data, or else the
/// photometric error.
fn figure(run: &Record) -> Option<Figure> {
    let last = |at: &str| run.validations.iter().rev().find_map(|line| line[at].as_f64());
    let found = |name, on, value: Option<f64>| value.map(|value| Figure { name, on, value });
    found("Abs Rel", "test data", run.metrics["after"]["abs_rel"].as_f64())
        .or_else(|| found("Abs Rel", "validation data, last", last("abs_rel")))
        .or_else(|| found("photometric error", "validation data, last", last("photometric")))
}

/// A sentence on several runs: who learnt depth, and whose error is the least, where that can be compared.
pub fn compared(runs: &[Record], verdicts: &[Verdict]) -> Vec<String> {
    let mut words = Vec::new();
    let named = |standing: Standing| -> Vec<&str> {
        let all = runs.iter().zip(verdicts).filter(|(_, verdict)| verdict.standing == standing);
        all.map(|(run, _)| run.name.as_str()).collect()
    };
    for (standing, one, many) in [
        (Standing::Healthy, "is healthy", "are healthy"),
        (Standing::Doubtful, "has warnings to be looked at", "have warnings to be looked at"),
        (Standing::Failed, "has not learnt depth", "have not learnt depth"),
        (Standing::Unknown, "cannot be told yet", "cannot be told yet"),
    ] {
        match &named(standing)[..] {
            [] => {}
            [name] => words.push(format!("{name} {one}.")),
            names => words.push(format!("{} {many}.", names.join(", "))),
        }
    }
    let figures: Option<Vec<Figure>> = verdicts.iter().map(|verdict| verdict.figure).collect();
    let Some(figures) = figures.filter(|all| !all.is_empty()) else { return words };
    let alike = figures.iter().all(|f| (f.name, f.on) == (figures[0].name, figures[0].on));
    let same = |name: &&&str| runs.iter().all(|run| run.setting(name) == runs[0].setting(name));
    let differ: Vec<&str> = PICTURES.iter().filter(|name| !same(name)).copied().collect();
    if !alike {
        words.push("Their errors are not of the same kind and cannot be compared.".into());
    } else if !differ.is_empty() {
        words.push(format!(
            "Their errors are of different pictures ({} differ) and cannot be compared.",
            differ.join(", ")
        ));
    } else {
        let mut order: Vec<(&Record, f64)> = runs.iter().zip(figures.iter().map(|f| f.value)).collect();
        order.sort_by(|a, b| a.1.total_cmp(&b.1));
        let list: Vec<String> = order.iter().map(|(run, value)| format!("{} {value:.3}", run.name)).collect();
        words.push(format!("{} on {}, best first: {}.", figures[0].name, figures[0].on, list.join(", ")));
    }
    words
}
