//! Signs that a training goes wrong, as one list of named warnings over the lines of a run's log.
//!
//! [`CHECKS`] is the list. A [`Monitor`] sees every logged step and tells which warnings begin and end; a run keeps that
//! in `warnings.jsonl`, and prints a warning when it begins for the first time.

use std::collections::VecDeque;

use serde::Serialize;

use super::trainer::StepReport;
use super::vitals::median;

/// The side of a limit on which a warning holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Limit {
    /// The warning holds where the figure is less.
    Below(f64),
    /// The warning holds where the figure is greater.
    Above(f64),
}

impl Limit {
    fn holds(self, figure: f64) -> bool {
        match self {
            Limit::Below(limit) => figure < limit,
            Limit::Above(limit) => figure > limit,
        }
    }
}

/// A named warning: what is looked at, from where on it is a warning, what that means, and what to do.
pub struct Check {
    /// The name, which stays the same.
    pub name: &'static str,
    /// The figure that is compared with the limit, in words.
    pub figure: &'static str,
    /// The threshold.
    pub limit: Limit,
    /// The lines of the log that are looked at together; with fewer there is no warning.
    pub lines: usize,
    /// Meaning of the warning for the training.
    pub meaning: &'static str,
    /// Advice.
    pub advice: &'static str,
    /// The figure; nothing where the question does not arise.
    measure: fn(&Window) -> Option<f64>,
}

/// The last lines of a log, oldest first.
struct Window<'a> {
    lines: &'a [StepReport],
    /// The least mean of loss over unwarped error that any window of [`FEW`] lines had before.
    best: Option<f64>,
}

impl Window<'_> {
    fn mean(&self, of: impl Fn(&StepReport) -> f64) -> f64 {
        self.lines.iter().map(of).sum::<f64>() / self.lines.len().max(1) as f64
    }

    /// The loss, relative to what standing still would give: comparable between easy and hard batches.
    fn relative_loss(&self) -> f64 {
        self.mean(|line| line.loss) / self.mean(|line| line.unwarped).max(f64::MIN_POSITIVE)
    }

    /// The median over the lines, the greater of two: one odd batch does not move it.
    fn median(&self, of: impl Fn(&StepReport) -> f64) -> f64 {
        let mut all: Vec<f64> = self.lines.iter().map(of).collect();
        median(&mut all)
    }

    fn unwarped(&self) -> f64 {
        self.median(|line| line.unwarped)
    }

    fn flow(&self) -> f64 {
        self.median(|line| line.vitals.flow)
    }
}

/// Lines of most windows: a hundred steps, as the log is kept by default.
const FEW: usize = 10;
/// Lines of the windows of what a training from scratch shows at first, too: five hundred steps.
const MANY: usize = 50;
/// The unwarped error below which frames count as the same picture: the noise of a camera makes more.
const SAME: f64 = 0.005;
/// The unwarped error below which frames count as hardly changed.
const ALIKE: f64 = 0.03;

/// All warnings.
pub const CHECKS: [Check; 8] = [
    Check {
        name: "disparity collapsed",
        figure: "standard deviation of the disparity over its mean",
        limit: Limit::Below(0.02),
        // Before it has learnt anything a network predicts one depth, too.
        lines: MANY,
        meaning: "the depth network predicts the same depth for every pixel",
        advice: "take a lower --learning-rate, or start again with another --seed",
        measure: |w| Some(w.median(|line| line.vitals.disparity_spread)),
    },
    Check {
        name: "disparity saturated",
        figure: "share of disparities at an end of the sigmoid",
        limit: Limit::Above(0.6),
        lines: FEW,
        meaning: "most depths are at the end of their range, where the sigmoid hardly has a gradient",
        advice: "take a lower --learning-rate; check that the frames move, and that auto-masking is on",
        measure: |w| Some(w.median(|line| line.vitals.saturated)),
    },
    Check {
        name: "pose is the identity",
        figure: "median motion of warped samples, in pixels",
        limit: Limit::Below(0.1),
        lines: MANY,
        meaning: "the pose network says that the camera stands still, though the frames differ",
        advice: "raise the pose network's rate (--pose-rate), or let it learn rotations first ([rotations] in the configuration)",
        measure: |w| (w.unwarped() >= ALIKE).then(|| w.flow()),
    },
    Check {
        name: "frames are static",
        figure: "photometric error of unwarped neighbours",
        limit: Limit::Below(SAME),
        lines: FEW,
        meaning: "neighbouring frames are the same picture: there is nothing to learn from",
        advice: "leave still frames out of --split; `parallax data check` finds them",
        measure: |w| Some(w.unwarped()),
    },
    Check {
        name: "pair moves too little",
        figure: "median motion of warped samples, in pixels",
        limit: Limit::Below(0.5),
        lines: MANY,
        meaning: "neighbouring frames hardly differ: there is less parallax than a picture can show",
        advice: "take frames that lie further apart in time, or larger pictures (--height, --width)",
        measure: |w| (SAME..ALIKE).contains(&w.unwarped()).then(|| w.flow()),
    },
    Check {
        name: "rate too high",
        figure: "loss over the unwarped error, relative to the least so far",
        limit: Limit::Above(1.35),
        lines: FEW,
        meaning: "the loss was lower before and has risen again",
        advice: "take a lower --learning-rate, or a longer warm-up (optim.schedule.warm_up in the configuration)",
        measure: |w| w.best.map(|best| w.relative_loss() / best.max(f64::MIN_POSITIVE)),
    },
    Check {
        name: "warped not better than unwarped",
        figure: "least error of warped neighbours over that of unwarped ones",
        limit: Limit::Above(1.0),
        lines: MANY,
        meaning: "for all this time the predicted depth and motion explained the neighbours no better than standing still",
        advice: "check the order of the frames and the camera (`parallax data check`); raise the pose network's rate \
                 (--pose-rate)",
        measure: |w| {
            let ratio = |line: &StepReport| line.warped / line.unwarped.max(f64::MIN_POSITIVE);
            (w.unwarped() >= SAME).then(|| w.lines.iter().map(ratio).fold(f64::INFINITY, f64::min))
        },
    },
    Check {
        name: "camera does not fit",
        figure: "share of warped samples inside the source picture",
        limit: Limit::Below(0.6),
        lines: FEW,
        meaning: "much of what the target shows would lie outside of its neighbours",
        advice: "check the camera (--fov, --intrinsics, camera.toml): `parallax data check` shows which one is used",
        measure: |w| Some(w.median(|line| line.vitals.inside)),
    },
];

/// A warning that begins or ends, as a line of `warnings.jsonl`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Warning {
    /// The last step of the window that showed it.
    pub step: u64,
    /// The warning's name.
    pub warning: &'static str,
    /// Whether it begins here; it ends otherwise.
    pub begins: bool,
    /// The figure that is compared.
    pub figure: f64,
    /// The threshold.
    pub limit: f64,
    /// Whether it begins for the first time, which is when it is printed.
    #[serde(skip)]
    pub first: bool,
    /// The warning in a sentence.
    pub message: String,
}

/// Looks at every logged step of a run.
pub struct Monitor {
    window: VecDeque<StepReport>,
    best: Option<f64>,
    active: [bool; CHECKS.len()],
    told: [bool; CHECKS.len()],
}

impl Default for Monitor {
    fn default() -> Self {
        Monitor { window: VecDeque::new(), best: None, active: [false; CHECKS.len()], told: [false; CHECKS.len()] }
    }
}

impl Monitor {
    /// Takes in a logged step; the warnings that begin or end with it.
    pub fn see(&mut self, step: &StepReport) -> Vec<Warning> {
        if self.window.len() == MANY {
            self.window.pop_front();
        }
        self.window.push_back(*step);
        let lines = self.window.make_contiguous();
        let mut changes = Vec::new();
        for (i, check) in CHECKS.iter().enumerate() {
            let Some(first) = lines.len().checked_sub(check.lines) else { continue };
            let figure = (check.measure)(&Window { lines: &lines[first..], best: self.best });
            let holds = figure.is_some_and(|figure| check.limit.holds(figure));
            if holds != self.active[i] {
                self.active[i] = holds;
                let first = holds && !self.told[i];
                self.told[i] |= holds;
                changes.push(check.warning(step.step, holds, first, figure.unwrap_or_default()));
            }
        }
        if let Some(first) = lines.len().checked_sub(FEW) {
            let now = Window { lines: &lines[first..], best: None }.relative_loss();
            self.best = Some(self.best.map_or(now, |best| best.min(now)));
        }
        changes
    }
}

impl Check {
    fn warning(&self, step: u64, begins: bool, first: bool, figure: f64) -> Warning {
        let (side, limit) = match self.limit {
            Limit::Below(limit) => ("below", limit),
            Limit::Above(limit) => ("above", limit),
        };
        let message = if begins {
            format!(
                "step {step}: {}: {} ({} {figure:.3}, {side} {limit}, over the last {} lines of the log): {}",
                self.name, self.meaning, self.figure, self.lines, self.advice
            )
        } else {
            format!("step {step}: no longer: {} ({} {figure:.3})", self.name, self.figure)
        };
        Warning { step, warning: self.name, begins, figure, limit, first, message }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::vitals::Vitals;

    /// A line of a training that goes well.
    fn healthy(step: u64) -> StepReport {
        let loss = 0.1 + 0.05 / step as f64;
        let vitals =
            Vitals { disparity: 0.1, disparity_spread: 0.8, saturated: 0.1, translation: 0.3, flow: 4.0, inside: 0.93 };
        StepReport { step, loss, photometric: loss, warped: 0.12, unwarped: 0.2, vitals, ..StepReport::default() }
    }

    /// The warnings of a log whose lines after the 60th are changed: names, and whether they begin.
    fn told(change: impl Fn(&mut StepReport)) -> Vec<(&'static str, bool)> {
        let mut monitor = Monitor::default();
        let mut all = Vec::new();
        for i in 1..=160 {
            let mut line = healthy(10 * i);
            if i > 60 {
                change(&mut line);
            }
            let found = monitor.see(&line);
            assert!(i > 60 || found.is_empty(), "{found:?}");
            all.extend(found);
        }
        all.iter().for_each(|w| assert!(w.message.contains(w.warning) && w.first == w.begins, "{w:?}"));
        all.into_iter().map(|w| (w.warning, w.begins)).collect()
    }

    #[test]
    fn a_healthy_log_has_no_warning() {
        assert_eq!(told(|_| ()), []);
    }

    #[test]
    fn every_warning_begins_once_where_a_log_deserves_it() {
        assert_eq!(told(|l| l.vitals.disparity_spread = 0.001), [("disparity collapsed", true)]);
        assert_eq!(told(|l| l.vitals.saturated = 0.95), [("disparity saturated", true)]);
        assert_eq!(told(|l| l.vitals.flow = 0.01), [("pose is the identity", true)]);
        let alike = |unwarped: f64| {
            move |l: &mut StepReport| {
                (l.unwarped, l.warped, l.loss) = (unwarped, 0.6 * unwarped, 0.5 * unwarped);
                l.vitals.flow = 0.2;
            }
        };
        assert_eq!(told(alike(0.001)), [("frames are static", true)]);
        assert_eq!(told(alike(0.02)), [("pair moves too little", true)]);
        assert_eq!(told(|l| l.loss = 0.19), [("rate too high", true)]);
        assert_eq!(told(|l| l.warped = 0.21), [("warped not better than unwarped", true)]);
        assert_eq!(told(|l| l.vitals.inside = 0.3), [("camera does not fit", true)]);
    }

    #[test]
    fn a_warning_ends_and_is_not_told_twice() {
        let mut monitor = Monitor::default();
        let mut all = Vec::new();
        for i in 1..=100 {
            let mut line = healthy(i);
            if i / 25 % 2 == 1 {
                line.vitals.inside = 0.1;
            }
            all.extend(monitor.see(&line));
        }
        let found: Vec<_> = all.iter().map(|w| (w.begins, w.first)).collect();
        assert_eq!(found, [(true, true), (false, false), (true, false)]);
        assert!(all.iter().all(|w| w.warning == "camera does not fit"), "{all:?}");
    }

    #[test]
    fn names_differ() {
        for (i, check) in CHECKS.iter().enumerate() {
            assert!(CHECKS[..i].iter().all(|other| other.name != check.name), "{}", check.name);
        }
    }
}
