//! What `parallax eval` says: what was measured, how, and what came out.

use std::path::PathBuf;

use parallax::data::kitti::LeftOut;
use parallax::eval::metrics::{Metrics, Report};
use parallax::eval::protocol::{Logarithm, Protocol};
use parallax::eval::scale::Scale;
use serde::Serialize;

use crate::cli::sizes::Numbers;

/// What was measured, and what came out.
#[derive(Serialize)]
pub struct Measured {
    pub weights: Option<String>,
    pub disparities: Option<PathBuf>,
    pub data: String,
    pub split: Option<PathBuf>,
    pub protocol: Protocol,
    #[serde(serialize_with = "in_words")]
    pub scale: Scale,
    pub flip: bool,
    pub precision: Option<Numbers>,
    pub height: usize,
    pub width: usize,
    /// All that were looked at: those that were measured, and those that were not.
    pub frames: usize,
    pub skipped: Vec<Skipped>,
    #[serde(flatten)]
    pub report: Report,
}

fn in_words<S: serde::Serializer>(scale: &Scale, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(scale)
}

/// Frames that are in none of the numbers.
#[derive(Serialize)]
pub struct Skipped {
    why: &'static str,
    frames: usize,
    first: Option<String>,
}

/// The frames that are not in a report, by why.
pub fn skipped(report: &Report, left_out: &LeftOut) -> Vec<Skipped> {
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
pub fn columns(logarithm: Logarithm) -> [&'static str; 7] {
    let log = match logarithm {
        Logarithm::Natural => "RMSE log",
        Logarithm::Ten => "log10",
    };
    ["Abs Rel", "Sq Rel", "RMSE", log, "a1", "a2", "a3"]
}

impl Measured {
    /// Prints the table.
    pub fn print(&self) {
        let Measured { report, height, width, .. } = self;
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
        let listed = self.split.as_ref().map_or_else(String::new, |list| format!(", frames of {}", list.display()));
        say!("data      {}{listed}", self.data);
        say!("protocol  {}: {}", self.protocol, self.protocol.rules().pixels);
        say!("scaling   {}", self.scale.in_words());
        say!("images    {} of {} frames", report.images, self.frames);
        for Skipped { why, frames, first } in &self.skipped {
            let first = first.as_ref().map_or_else(String::new, |first| format!(" (the first: {first})"));
            say!("skipped   {frames}: {why}{first}");
        }
        self.print_metrics(report.metrics);
        if let (Some(ratio), Some(std)) = (report.ratio_median, report.ratio_std) {
            say!("scale     median ratio {ratio:.3}, deviation {std:.3}");
        }
    }

    fn print_metrics(&self, metrics: Metrics) {
        for (name, value) in columns(self.protocol.rules().logarithm).into_iter().zip(metrics.to_array()) {
            say!("{name:9} {value:.4}");
        }
    }
}
