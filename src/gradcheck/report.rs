//! What a check found, and whether that will do.

use std::fmt;

use serde::Serialize;

use super::Gradients;
use super::differences::{Differences, Measured, Tie};
use super::options::{Kinks, Options};

/// Comparison of one input's analytic and numeric derivatives.
#[derive(Clone, Debug, Serialize)]
pub struct InputReport {
    /// Its name, or its number.
    pub name: String,
    /// |analytic - numeric| at the worst element, over the largest analytic derivative (over 1 if that is 0). Kinks are
    /// left out.
    pub error: f64,
    /// The element (or direction) where they differ most, beside what is allowed there.
    pub worst: usize,
    /// The analytic derivative there.
    pub analytic: f64,
    /// The numeric derivative there.
    pub numeric: f64,
    /// How far that may be off, as the differences say themselves.
    pub uncertainty: f64,
    /// The largest analytic derivative.
    pub scale: f64,
    /// Derivatives compared.
    pub elements: usize,
    /// Elements at a kink: they are held between their one-sided derivatives, and in sum where they tie.
    pub kinks: Vec<usize>,
    /// Whether every difference is within the tolerance, as far as differences can say.
    pub within: bool,
    /// Whether the worst element is left open: the two are apart by no more than the differences may be off.
    pub undecided: bool,
    /// Derivatives that are known less exactly than the tolerance asks for.
    pub blunt: usize,
    /// Derivatives that are smaller than what is allowed for them: they could be anything of their size and pass.
    pub unseen: usize,
    /// The first of those that the differences contradict nevertheless: element, analytic, numeric.
    pub contradicted: Option<(usize, f64, f64)>,
    /// An element at a kink whose analytic value is none of its one-sided ones, nor between them.
    pub outside: Option<Outside>,
}

/// An analytic value that a kink does not allow.
#[derive(Clone, Debug, Serialize)]
pub struct Outside {
    /// The element.
    pub element: usize,
    /// Its analytic derivative.
    pub analytic: f64,
    /// The least that it may be.
    pub low: f64,
    /// The greatest.
    pub high: f64,
}

impl InputReport {
    /// `rows` are the gradient of the input and its differences, for each cotangent; `tied` gives the bounds of those
    /// elements of a row that tie with others.
    fn new(
        name: String,
        rows: &[(&[f64], &Differences)],
        tied: impl Fn(usize, usize) -> Option<[f64; 2]>,
        options: &Options,
    ) -> Self {
        let largest = |m: f64, g: &f64| if g.is_nan() || m.is_nan() { f64::NAN } else { m.max(g.abs()) };
        let analytic: Vec<Vec<f64>> = rows.iter().map(|(g, d)| d.along(g)).collect();
        let scale = analytic.iter().flatten().fold(0.0, largest);
        let measured = |m: f64, d: &&Differences| d.quotients.iter().fold(m, |m, q| m.max(q.central.abs()));
        let size = rows.iter().map(|(_, d)| d).fold(0.0, measured);
        let mut r = InputReport {
            name,
            error: 0.0,
            worst: 0,
            analytic: 0.0,
            numeric: 0.0,
            uncertainty: 0.0,
            scale,
            elements: 0,
            kinks: vec![],
            within: true,
            undecided: false,
            blunt: 0,
            unseen: 0,
            contradicted: None,
            outside: None,
        };
        let mut share = 0.0;
        for (row, (analytic, (_, differences))) in analytic.iter().zip(rows).enumerate() {
            for (k, (&a, q)) in analytic.iter().zip(&differences.quotients).enumerate() {
                r.elements += 1;
                if q.is_kink() {
                    if !r.kinks.contains(&k) {
                        r.kinks.push(k);
                    }
                    // One-sided quotients are off by half the curvature times the step.
                    let slack = 1e-3 * size.max(q.left.abs()).max(q.right.abs());
                    let [low, high] = tied(row, k).unwrap_or([q.low, q.high]);
                    if !(low - slack..=high + slack).contains(&a) {
                        r.outside = Some(Outside { element: k, analytic: a, low, high });
                    }
                    continue;
                }
                let (apart, allowed) = ((a - q.central).abs(), options.tolerance.allowed(q.central, scale));
                let known = |apart: f64| apart > ROOM * q.error;
                let largest = a.abs().max(q.central.abs());
                if known(q.central.abs()) && largest <= allowed {
                    r.unseen += 1;
                    if r.contradicted.is_none() && known(apart) && apart > 1e-2 * largest {
                        r.contradicted = Some((k, a, q.central));
                    }
                }
                let mut part = apart / allowed;
                let mut undecided = false;
                if part > 1.0 && apart <= allowed + ROOM * q.error {
                    // Either three digits are known, or rounding leaves no more to be known.
                    if q.error <= 1e-3 * scale || q.error <= q.rounding {
                        (part, r.blunt) = (1.0, r.blunt + 1);
                    } else {
                        undecided = true;
                    }
                }
                if part.is_nan() || part > share && !share.is_nan() {
                    (share, r.worst, r.analytic, r.numeric) = (part, k, a, q.central);
                    (r.uncertainty, r.undecided) = (q.error, undecided);
                    r.error = apart / if scale > 0.0 { scale } else { 1.0 };
                    r.within &= part <= 1.0;
                }
            }
        }
        r
    }
}

/// Analytic and numeric derivatives may be apart by so many times what the differences say that they may be off.
const ROOM: f64 = 4.0;
/// Result of a gradient check, with what is wrong and what is worth a warning.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// For each input; `None` for constants.
    pub inputs: Vec<Option<InputReport>>,
    /// Groups of tied elements whose derivatives were compared in sum.
    pub ties: usize,
    /// What is not wrong, but was not seen clearly either: each a sentence.
    pub warnings: Vec<String>,
    failure: Option<String>,
}

impl Report {
    /// Compares gradients with differences, input by input.
    pub fn new(gradients: &Gradients, measured: &Measured, options: &Options) -> Self {
        Self::of_rows(&[(gradients, measured)], options)
    }

    /// The same for several cotangents, each with its gradients and differences.
    pub(super) fn of_rows(rows: &[(&Gradients, &Measured)], options: &Options) -> Self {
        let count = rows.first().map_or(0, |(g, _)| g.inputs.len());
        let input = |i: usize| {
            let pairs = rows.iter().map(|(g, m)| Some((g.inputs[i].as_ref()?.data(), m.inputs[i].as_ref()?)));
            let tied = |row: usize, k: usize| {
                let ties: &[Tie] = &rows[row].1.ties;
                let place = |tie: &Tie| tie.members.iter().position(|&m| m == (i, k)).map(|m| tie.bounds[m]);
                ties.iter().find_map(place)
            };
            Some(InputReport::new(options.name(i), &pairs.collect::<Option<Vec<_>>>()?, tied, options))
        };
        let inputs: Vec<_> = (0..count).map(input).collect();
        let ties = rows.iter().map(|(_, m)| m.ties.len()).sum();
        let mut report = Report { inputs, ties, warnings: vec![], failure: None };
        report.warnings = report.warn(options);
        report.failure = report.judge(rows, options);
        report
    }

    /// A report that says only why nothing could be compared.
    pub(super) fn broken(why: impl Into<String>) -> Self {
        Report { inputs: vec![], ties: 0, warnings: vec![], failure: Some(why.into()) }
    }

    /// The largest error of any input.
    pub fn error(&self) -> f64 {
        self.inputs.iter().flatten().map(|i| i.error).fold(0.0, |m: f64, e| if e.is_nan() { e } else { m.max(e) })
    }

    /// The number of derivatives compared.
    pub fn elements(&self) -> usize {
        self.inputs.iter().flatten().map(|i| i.elements).sum()
    }

    /// The number of elements at a kink.
    pub fn kinks(&self) -> usize {
        self.inputs.iter().flatten().map(|i| i.kinks.len()).sum()
    }

    /// Failure in a sentence; `None` if the gradients are right.
    pub fn failure(&self) -> Option<&str> {
        self.failure.as_deref()
    }

    fn warn(&self, options: &Options) -> Vec<String> {
        let mut all = Vec::new();
        for (i, r) in self.inputs.iter().enumerate().filter_map(|(i, r)| Some((i, r.as_ref()?))) {
            let name = &r.name;
            if r.blunt > 0 {
                all.push(format!("{name}: {} derivatives are known less exactly than the tolerance asks for", r.blunt));
            }
            if r.unseen > 0 && r.scale > 0.0 {
                let what = r.contradicted.map_or_else(String::new, |(k, analytic, numeric)| {
                    format!(": element {k} has analytic {analytic:e}, numeric {numeric:e}")
                });
                all.push(format!(
                    "{name}: {} derivatives are smaller than what the tolerance allows beside the largest, {:e}; \
                     `Tolerance::Elementwise` would compare them{what}",
                    r.unseen, r.scale
                ));
            }
            if r.scale == 0.0 && r.elements > 0 && !options.flat && !options.ignored.contains(&i) {
                all.push(format!("{name}: every derivative is zero here; another point would show more"));
            }
        }
        all
    }

    fn judge(&self, rows: &[(&Gradients, &Measured)], options: &Options) -> Option<String> {
        let inputs = || self.inputs.iter().enumerate().filter_map(|(i, r)| Some((i, r.as_ref()?)));
        if inputs().all(|(_, r)| r.elements == 0) && !options.flat {
            return Some("nothing was compared: no input that is differentiated has an element".into());
        }
        for (_, r) in inputs() {
            let name = &r.name;
            if !r.within && r.numeric.is_nan() && !r.analytic.is_nan() {
                return Some(format!(
                    "{name}, element {}: analytic {:e}, and no number on one of its sides: not inside the domain",
                    r.worst, r.analytic,
                ));
            }
            if !r.within && r.undecided {
                return Some(format!(
                    "{name}, element {}, cannot be decided: analytic {:e}, numeric {:e} give or take {:.1e}: every step is \
                     too long for how the function bends, or too short for how it rounds",
                    r.worst, r.analytic, r.numeric, r.uncertainty,
                ));
            }
            if !r.within {
                return Some(format!(
                    "{name}, {} {}: analytic {:e}, numeric {:e}: {:.1e} apart, {:.1e} of the largest",
                    if options.directions.is_some() { "element or direction" } else { "element" },
                    r.worst,
                    r.analytic,
                    r.numeric,
                    (r.analytic - r.numeric).abs(),
                    r.error,
                ));
            }
            if let Some(Outside { element, analytic, low, high }) = r.outside {
                return Some(format!(
                    "{name}, element {element}, at a kink: analytic {analytic:e} is not between {low:e} and {high:e}, \
                     the one-sided derivatives"
                ));
            }
        }
        for (gradients, measured) in rows {
            for tie in &measured.ties {
                let gradient = |&(i, k): &(usize, usize)| gradients.inputs[i].as_ref().map_or(0.0, |g| g.data()[k]);
                let sum: f64 = tie.members.iter().map(gradient).sum();
                let expected = tie.quotient.central;
                let scale = tie.members.iter().map(gradient).fold(expected.abs(), |m, g| m.max(g.abs()));
                let apart = (sum - expected).abs();
                // NaN is not within anything.
                if apart.is_nan() || apart > options.tolerance.allowed(expected, scale) + ROOM * tie.quotient.error {
                    let members = &tie.members;
                    return Some(format!(
                        "the tied elements {members:?} (input, element) have derivatives that sum to {sum:e}; together \
                         they have {expected:e}"
                    ));
                }
            }
        }
        if let Kinks::Exactly(declared) = options.kinks
            && self.kinks() != declared
        {
            let at: Vec<_> = inputs().filter(|(_, r)| !r.kinks.is_empty()).map(|(_, r)| (&r.name, &r.kinks)).collect();
            return Some(format!("{} elements at a kink, {declared} were declared: {at:?}", self.kinks()));
        }
        let mut zero = inputs().filter(|(_, r)| r.scale == 0.0).peekable();
        let moves = |i: usize| rows.iter().any(|(_, m)| m.moves[i]);
        if options.flat {
            let count = inputs().count();
            return (zero.count() < count).then(|| "a gradient is not zero, though declared flat".into());
        }
        if inputs().all(|(i, r)| r.scale == 0.0 && !moves(i)) {
            return Some("every gradient is zero: nothing was checked".into());
        }
        let ignored = zero.find(|(i, r)| r.elements > 0 && !options.ignored.contains(i) && !moves(*i));
        ignored.map(|(_, r)| {
            format!("{}: every derivative is zero: the function ignores it; declare it so if that is right", r.name)
        })
    }
}

/// The table that a person reads.
impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.inputs.is_empty() {
            writeln!(
                f,
                "{:20} {:>8} {:>6} {:>8} {:>13} {:>13} {:>9} {:>9}",
                "input", "elements", "kinks", "worst", "analytic", "numeric", "absolute", "relative"
            )?;
        }
        for r in self.inputs.iter().flatten() {
            let apart = (r.analytic - r.numeric).abs();
            writeln!(
                f,
                "{:20} {:8} {:6} {:>8} {:13.5e} {:13.5e} {apart:9.1e} {:9.1e}",
                r.name,
                r.elements,
                r.kinks.len(),
                r.worst,
                r.analytic,
                r.numeric,
                r.error
            )?;
        }
        for warning in &self.warnings {
            writeln!(f, "note: {warning}")?;
        }
        match &self.failure {
            Some(why) => write!(f, "WRONG: {why}"),
            None => write!(f, "right"),
        }
    }
}
