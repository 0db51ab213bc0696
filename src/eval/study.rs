//! More than a mean: an evaluation with intervals, and with errors by distance, region and sequence.

use serde::Serialize;

use super::bootstrap::{Bootstrap, Intervals, Unit, difference};
use super::breakdown::{BINS, Breakdown, Group, Set, by_set};
use super::evaluate::{Evaluation, Predicts, evaluate_by};
use super::metrics::{Metrics, Report};
use crate::Result;
use crate::data::DataSource;

/// Settings of a study.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Where bins of distance begin, in metres.
    pub bins: Vec<f64>,
    /// How often images are drawn for the intervals; 0 for none.
    pub replicates: usize,
    /// The seed of these draws.
    pub seed: u64,
}

impl Default for Settings {
    /// The usual bins, 1000 draws.
    fn default() -> Self {
        Settings { bins: BINS.to_vec(), replicates: 1000, seed: 0 }
    }
}

/// Intervals, and what they were made of.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Interval {
    /// The units that were drawn.
    pub unit: Unit,
    /// How many there were to draw from.
    pub units: usize,
    /// How often.
    pub replicates: usize,
    /// The ends.
    #[serde(flatten)]
    pub ends: Intervals,
}

/// Evaluation of a set of images, and where its errors are.
#[derive(Clone, Debug, PartialEq)]
pub struct Study {
    /// The means over images, and each image.
    pub report: Report,
    /// The sequence of each image of the report.
    pub sequences: Vec<usize>,
    /// The 95 % intervals of the means; `None` if there is too little to draw from, or none were asked for.
    pub interval: Option<Interval>,
    /// Errors by true distance.
    pub distances: Vec<Group>,
    /// Errors by ninths of the picture.
    pub regions: Vec<Group>,
    /// The means by sequence.
    pub sets: Vec<Set>,
}

/// One evaluation less another, image by image.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// How many images both have.
    pub images: usize,
    /// The means of the differences.
    #[serde(flatten)]
    pub metrics: Metrics,
    /// Their 95 % intervals, of the same draws for both.
    pub interval: Option<Interval>,
}

/// Evaluates whatever predicts on all samples of a data set; `seen` is told how many are done.
///
/// # Errors
/// As [`evaluate_by`]; if the bins do not rise.
pub fn study(
    by: &dyn Predicts,
    data: &dyn DataSource,
    how: Evaluation,
    settings: &Settings,
    mut seen: impl FnMut(usize),
) -> Result<Study> {
    let mut breakdown = Breakdown::new(&settings.bins, how.protocol.rules().logarithm)?;
    let mut sequences = Vec::new();
    let samples: Vec<usize> = (0..data.len()).collect();
    let report = evaluate_by(by, data, &samples, how, |sample, done, compared| {
        if let Some(compared) = compared.filter(|compared| !compared.pairs.is_empty()) {
            breakdown.add(compared);
            sequences.push(data.place(sample).sequence);
        }
        seen(done);
    })?;
    let images: Vec<Metrics> = report.per_image.iter().map(|image| image.metrics).collect();
    let bootstrap = Bootstrap::new(&sequences, settings.replicates, settings.seed);
    Ok(Study {
        interval: interval(&bootstrap, bootstrap.intervals(&images), settings),
        distances: breakdown.distances(),
        regions: breakdown.regions(),
        sets: by_set(&report.per_image, &sequences),
        report,
        sequences,
    })
}

fn interval(bootstrap: &Bootstrap, ends: Option<Intervals>, settings: &Settings) -> Option<Interval> {
    let (unit, units) = (bootstrap.unit(), bootstrap.units());
    ends.map(|ends| Interval { unit, units, replicates: settings.replicates, ends })
}

impl Study {
    /// This study less another of the same data: over the images that both have, by name. `None` if there is none.
    pub fn less(&self, other: &Study, settings: &Settings) -> Option<Difference> {
        let (mut a, mut b, mut sequences) = (Vec::new(), Vec::new(), Vec::new());
        // Both are in the order of the data; a frame that a list names twice is paired twice.
        let mut others = other.report.per_image.iter();
        for (image, &sequence) in self.report.per_image.iter().zip(&self.sequences) {
            let mut ahead = others.clone();
            if let Some(same) = ahead.find(|other| other.name == image.name) {
                others = ahead;
                a.push(same.metrics);
                b.push(image.metrics);
                sequences.push(sequence);
            }
        }
        let mean = Metrics::mean(a.iter().zip(&b).map(|(a, b)| difference(*a, *b)))?;
        let bootstrap = Bootstrap::new(&sequences, settings.replicates, settings.seed);
        let interval = interval(&bootstrap, bootstrap.of_differences(&a, &b), settings);
        Some(Difference { images: a.len(), metrics: mean, interval })
    }

    /// The images with the largest Abs Rel, worst first: their place in the report.
    pub fn worst(&self, count: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.report.per_image.len()).collect();
        let abs_rel = |image: &usize| self.report.per_image[*image].metrics.abs_rel;
        order.sort_by(|a, b| abs_rel(b).total_cmp(&abs_rel(a)));
        order.truncate(count);
        order
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::mean_map::MeanMap;
    use crate::eval::protocol::Protocol;
    use crate::eval::scale::Scale;
    use crate::street::{Street, StreetConfig};

    const HOW: Evaluation = Evaluation { protocol: Protocol::Dense, scale: Scale::Median, flip: false };

    #[test]
    fn groups_of_a_study_hold_all_its_pixels_and_intervals_its_means() {
        let street =
            StreetConfig { height: 32, width: 64, sequences: 3, frames: 5, seed: 8, ..StreetConfig::default() };
        let street = Street::render(&street, None);
        let map = MeanMap::of_dataset(&street).unwrap();
        let settings = Settings { replicates: 200, ..Settings::default() };
        let found = study(&map, &street, HOW, &settings, |_| ()).unwrap();
        let pixels: usize = found.report.per_image.iter().map(|image| image.pixels).sum();
        for groups in [&found.distances, &found.regions] {
            assert_eq!(groups.iter().map(|g| g.pixels).sum::<usize>(), pixels);
        }
        let errors: f64 = found.distances.iter().map(|g| g.metrics.abs_rel * g.pixels as f64).sum();
        let same: f64 = found.report.per_image.iter().map(|i| i.metrics.abs_rel * i.pixels as f64).sum();
        assert!((errors / same - 1.0).abs() < 1e-9);
        assert_eq!((found.sets.len(), found.sets[1].images), (3, 3));
        let interval = found.interval.clone().unwrap();
        assert_eq!((interval.unit, interval.units), (Unit::Sequences, 3));
        let mean = found.report.metrics.abs_rel;
        assert!(interval.ends.low.abs_rel <= mean && mean <= interval.ends.high.abs_rel);
        let worst = found.worst(2);
        let largest = found.report.per_image.iter().map(|i| i.metrics.abs_rel).fold(0.0, f64::max);
        assert_eq!((worst.len(), found.report.per_image[worst[0]].metrics.abs_rel), (2, largest));

        // Flat predictions are worse, and of that there is no doubt.
        let flat = MeanMap { size: (1, 1), inverse_depth: vec![0.1] };
        let flat = study(&flat, &street, HOW, &settings, |_| ()).unwrap();
        let worse = flat.less(&found, &settings).unwrap();
        assert_eq!(worse.images, 9);
        assert!((worse.metrics.abs_rel - (flat.report.metrics.abs_rel - mean)).abs() < 1e-12);
        assert!(worse.interval.unwrap().ends.low.abs_rel > 0.0);
        assert_eq!(found.less(&found, &settings).unwrap().interval.unwrap().ends.high.abs_rel, 0.0);
    }
}
