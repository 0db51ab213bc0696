//! How sure a mean over images is: percentile bootstrap intervals (Efron, 1979), of means and of paired differences.
//!
//! What is drawn again, with replacement, are whole sequences where there are several: the frames of one look alike, and
//! single frames drawn from it would make the intervals far too narrow (the cluster bootstrap). Of a single sequence it is
//! images. A replicate is the mean over all images of what was drawn; an interval runs from the 2.5th to the 97.5th
//! percentile of the replicates. Two sets of weights are compared on the same draws.

use std::collections::BTreeMap;

use serde::Serialize;

use super::metrics::Metrics;
use super::statistics::quantile;
use crate::random::{Random, Stream};

/// The share of replicates that lie within an interval.
const COVERED: f64 = 0.95;

/// The units that are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Unit {
    /// Images, because all are of one sequence.
    Images,
    /// Sequences.
    Sequences,
}

/// Images to be drawn again and again: which of them each draw takes is a function of the seed.
#[derive(Clone, Debug)]
pub struct Bootstrap {
    /// The images of each unit, by index.
    units: Vec<Vec<usize>>,
    unit: Unit,
    replicates: usize,
    seed: u64,
}

/// Lower and upper end of an interval for each metric.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Intervals {
    /// The 2.5th percentile.
    pub low: Metrics,
    /// The 97.5th percentile.
    pub high: Metrics,
}

impl Bootstrap {
    /// Draws `replicates` times from images of which `sequences` says the recordings.
    pub fn new(sequences: &[usize], replicates: usize, seed: u64) -> Bootstrap {
        let mut groups: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for (image, &sequence) in sequences.iter().enumerate() {
            groups.entry(sequence).or_default().push(image);
        }
        let (units, unit) = match groups.len() {
            0 | 1 => ((0..sequences.len()).map(|image| vec![image]).collect(), Unit::Images),
            _ => (groups.into_values().collect(), Unit::Sequences),
        };
        Bootstrap { units, unit, replicates, seed }
    }

    /// The units that are drawn.
    pub fn unit(&self) -> Unit {
        self.unit
    }

    /// How many units there are: with fewer than two, nothing is known of how they differ.
    pub fn units(&self) -> usize {
        self.units.len()
    }

    /// The intervals of the means of `images`, one for each image that this was made for. `None` with fewer than two units
    /// or replicates, or another number of images.
    pub fn intervals(&self, images: &[Metrics]) -> Option<Intervals> {
        if self.units.len() < 2 || self.replicates < 2 || self.units.iter().map(Vec::len).sum::<usize>() != images.len()
        {
            return None;
        }
        let of_units: Vec<([f64; 7], f64)> = self.units.iter().map(|unit| sum(unit, images)).collect();
        let mut random = Random::of(self.seed, Stream::Bootstrap);
        let mut columns: [Vec<f64>; 7] = Default::default();
        for _ in 0..self.replicates {
            let (mut total, mut count) = ([0.0; 7], 0.0);
            for _ in 0..of_units.len() {
                let (sums, images) = of_units[random.below(of_units.len())];
                total.iter_mut().zip(sums).for_each(|(t, s)| *t += s);
                count += images;
            }
            columns.iter_mut().zip(total).for_each(|(column, t)| column.push(t / count));
        }
        columns.iter_mut().for_each(|column| column.sort_unstable_by(f64::total_cmp));
        let end = |part: f64| Metrics::from_array(columns.each_ref().map(|c| quantile(c, part).unwrap_or(f64::NAN)));
        Some(Intervals { low: end((1.0 - COVERED) / 2.0), high: end((1.0 + COVERED) / 2.0) })
    }

    /// The intervals of the means of `b - a`, image by image; as [`intervals`](Bootstrap::intervals).
    pub fn of_differences(&self, a: &[Metrics], b: &[Metrics]) -> Option<Intervals> {
        if a.len() != b.len() {
            return None;
        }
        let differences: Vec<Metrics> = a.iter().zip(b).map(|(a, b)| difference(*a, *b)).collect();
        self.intervals(&differences)
    }
}

/// `b - a`, metric by metric.
pub fn difference(a: Metrics, b: Metrics) -> Metrics {
    let (a, b) = (a.to_array(), b.to_array());
    Metrics::from_array(std::array::from_fn(|k| b[k] - a[k]))
}

/// The sums over the images of a unit, and how many they are.
fn sum(unit: &[usize], images: &[Metrics]) -> ([f64; 7], f64) {
    let mut sums = [0.0; 7];
    for &image in unit {
        sums.iter_mut().zip(images[image].to_array()).for_each(|(s, m)| *s += m);
    }
    (sums, unit.len() as f64)
}

#[cfg(test)]
mod tests;
