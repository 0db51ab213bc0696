//! The output of `parallax eval`: data, protocol, results.

use std::path::PathBuf;

use parallax::data::kitti::LeftOut;
use parallax::eval::breakdown::{Group, Set};
use parallax::eval::metrics::{Metrics, Report};
use parallax::eval::protocol::{Logarithm, Protocol};
use parallax::eval::scale::Scale;
use parallax::eval::study::{Difference, Interval, Study};
use parallax::report::plot::{Line, Plot};
use parallax::train::data::is_rendered;
use serde::Serialize;

use super::Args;
use crate::cli::sizes::Numbers;

/// A measurement: its data, its settings, its results.
#[derive(Serialize)]
pub struct Measured {
    weights: Option<String>,
    disparities: Option<PathBuf>,
    predictions: Option<PathBuf>,
    data: String,
    split: Option<PathBuf>,
    protocol: Protocol,
    #[serde(serialize_with = "in_words")]
    scale: Scale,
    flip: bool,
    precision: Option<Numbers>,
    skipped: Vec<Skipped>,
    #[serde(flatten)]
    first: One,
    others: Vec<One>,
}

/// A predictor and its results.
pub struct One {
    pub name: String,
    pub height: usize,
    pub width: usize,
    /// All that were looked at: those that were measured, and those that were not.
    pub frames: usize,
    pub study: Study,
    /// From the first.
    pub difference: Option<Difference>,
}

/// [`One`] in JSON.
#[derive(Serialize)]
struct Written<'a> {
    name: &'a str,
    height: usize,
    width: usize,
    frames: usize,
    #[serde(flatten)]
    report: &'a Report,
    sequences: &'a [usize],
    interval: &'a Option<Interval>,
    distances: &'a [Group],
    regions: &'a [Group],
    sets: &'a [Set],
    #[serde(skip_serializing_if = "Option::is_none")]
    difference: &'a Option<Difference>,
}

impl Serialize for One {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let One { name, height, width, frames, study, difference } = self;
        let Study { report, sequences, interval, distances, regions, sets } = study;
        let (height, width, frames) = (*height, *width, *frames);
        let written =
            Written { name, height, width, frames, report, sequences, interval, distances, regions, sets, difference };
        written.serialize(serializer)
    }
}

fn in_words<S: serde::Serializer>(scale: &Scale, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(scale)
}

/// Frames that are in none of the numbers.
#[derive(Serialize)]
struct Skipped {
    why: &'static str,
    frames: usize,
    first: Option<String>,
}

/// The frames that are not in a report, by why.
fn skipped(report: &Report, left_out: &LeftOut) -> Vec<Skipped> {
    let listed = |why, names: &[String]| Skipped { why, frames: names.len(), first: names.first().cloned() };
    let missing = left_out.first_depth.as_ref().map(|path| path.display().to_string());
    let all = [
        Skipped { why: "no ground-truth depth", frames: left_out.without_depth, first: missing },
        listed("no ground-truth depth", &report.without_depth),
        listed("no pixel of the ground truth counts under this protocol", &report.without_pixels),
        listed("no road to measure the camera's height over", &report.without_scale),
    ];
    all.into_iter().filter(|skipped| skipped.frames > 0).collect()
}

/// The names of the seven metrics, as papers head their columns.
fn columns(logarithm: Logarithm) -> [&'static str; 7] {
    let log = match logarithm {
        Logarithm::Natural => "RMSE log",
        Logarithm::Ten => "log10",
    };
    ["Abs Rel", "Sq Rel", "RMSE", log, "a1", "a2", "a3"]
}

impl Measured {
    /// The predictor, as it was asked for; of several, the first is what the others are compared with.
    pub fn new(args: &Args, mut found: Vec<One>, left_out: &LeftOut) -> Measured {
        let first = found.remove(0);
        let of_weights = args.disparities.is_none() && args.predictions.is_none();
        Measured {
            weights: of_weights.then(|| first.name.clone()),
            disparities: args.disparities.clone(),
            predictions: args.predictions.clone(),
            data: match args.data.as_str() {
                rendered if is_rendered(rendered) => format!("{rendered} of seed {}", args.seed),
                folder => folder.to_owned(),
            },
            split: args.split.clone(),
            protocol: args.protocol,
            scale: args.scale,
            flip: args.flip,
            precision: of_weights.then_some(args.precision),
            skipped: skipped(&first.study.report, left_out),
            first,
            others: found,
        }
    }

    fn all(&self) -> impl Iterator<Item = &One> {
        std::iter::once(&self.first).chain(&self.others)
    }

    /// Every study by its name.
    pub fn studies(&self) -> Vec<(&str, &Study)> {
        self.all().map(|one| (one.name.as_str(), &one.study)).collect()
    }

    /// Abs Rel by distance.
    pub fn plot(&self) -> Plot {
        // The truth is the same for all, and so are its bins.
        let categories: Vec<String> = self.first.study.distances.iter().map(|group| group.name.clone()).collect();
        let place = |group: &Group| categories.iter().position(|name| *name == group.name);
        let line = |one: &One| {
            let groups = one.study.distances.iter();
            let points = groups.filter_map(|group| Some([place(group)? as f64, group.metrics.abs_rel])).collect();
            Line { name: one.name.clone(), points, marked: true }
        };
        Plot {
            title: format!("{}, protocol {}", self.data, self.protocol),
            x: "true distance".into(),
            y: "Abs Rel".into(),
            lines: self.all().map(line).collect(),
            categories: categories.clone(),
            from_zero: true,
            equal: false,
        }
    }

    /// Prints the table; with `details` errors by distance, region and sequence.
    pub fn print(&self, details: bool) {
        let One { height, width, study, frames, .. } = &self.first;
        let report = &study.report;
        let flipped = if self.flip { ", joined with the mirrored picture's" } else { "" };
        let numbers = if self.precision == Some(Numbers::Bf16) { ", products in bf16" } else { "" };
        match (&self.weights, &self.disparities) {
            (_, Some(file)) => say!("file      {}, maps of {width}x{height}", file.display()),
            (weights, None) => {
                say!(
                    "weights   {}, maps of {width}x{height}{flipped}{numbers}",
                    weights.as_deref().unwrap_or_default()
                );
            }
        }
        for (letter, One { name, height, width, .. }) in ('B'..='Z').zip(&self.others) {
            say!("  and {letter}   {name}, maps of {width}x{height}{flipped}{numbers}");
        }
        let listed = self.split.as_ref().map_or_else(String::new, |list| format!(", frames of {}", list.display()));
        say!("data      {}{listed}", self.data);
        say!("protocol  {}: {}", self.protocol, self.protocol.rules().pixels);
        say!("scaling   {}", self.scale.in_words());
        say!("images    {} of {frames} frames", report.images);
        for Skipped { why, frames, first } in &self.skipped {
            let first = first.as_ref().map_or_else(String::new, |first| format!(" (the first: {first})"));
            say!("skipped   {frames}: {why}{first}");
        }
        if let Some(interval) = &study.interval {
            say!("intervals {}", said(interval));
        }
        self.print_metrics();
        if let (Some(ratio), Some(std)) = (report.ratio_median, report.ratio_std) {
            say!("scale     median ratio {ratio:.3}, deviation {std:.3}");
        }
        if details {
            self.all().for_each(|one| self.print_details(one));
        }
    }

    /// A line for each metric.
    fn print_metrics(&self) {
        let columns = columns(self.protocol.rules().logarithm);
        let range = |interval: &Option<Interval>, k: usize, signed: bool| match interval {
            Some(Interval { ends, .. }) => {
                let (low, high) = (ends.low.to_array()[k], ends.high.to_array()[k]);
                if signed { format!(" [{low:+.4}, {high:+.4}]") } else { format!(" [{low:.4}, {high:.4}]") }
            }
            None => String::new(),
        };
        for (k, name) in columns.into_iter().enumerate() {
            let value = |study: &Study| study.report.metrics.to_array()[k];
            let mut line =
                format!("{name:9} {:.4}{}", value(&self.first.study), range(&self.first.study.interval, k, false));
            for (letter, other) in ('B'..='Z').zip(&self.others) {
                line += &format!("   {letter} {:.4}", value(&other.study));
                if let Some(difference) = &other.difference {
                    let by = difference.metrics.to_array()[k];
                    line += &format!(", {by:+.4}{}", range(&difference.interval, k, true));
                }
            }
            say!("{line}");
        }
    }

    /// Errors by distance, region and sequence.
    fn print_details(&self, one: &One) {
        let line = |name: &str, count: usize, m: Metrics| {
            say!("  {name:30} {count:>10}   {:.4}   {:8.4}   {:.4}", m.abs_rel, m.rmse, m.a1);
        };
        let study = &one.study;
        for (what, groups) in [("by true distance", &study.distances), ("by region", &study.regions)] {
            say!("\n{}, {what}: pixels, Abs Rel, RMSE, a1", one.name);
            groups.iter().for_each(|group| line(&group.name, group.pixels, group.metrics));
        }
        if study.sets.len() > 1 {
            say!("\n{}, by sequence: images, Abs Rel, RMSE, a1", one.name);
            study.sets.iter().for_each(|set| line(&set.name, set.images, set.metrics));
        }
    }
}

/// The units that intervals were resampled from.
fn said(interval: &Interval) -> String {
    use parallax::eval::bootstrap::Unit;
    let what = match interval.unit {
        Unit::Images => "images of one sequence, which look alike: the intervals are too narrow",
        Unit::Sequences => "whole sequences",
    };
    format!("95 %, bootstrap of {} draws from {} {what}", interval.replicates, interval.units)
}
