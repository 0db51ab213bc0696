//! Where errors are: by distance, by region of the picture, by set (sequence, weather).
//!
//! A group holds pixels of all images, each with the same weight; its metrics are those of the whole group, not means over
//! images (an image may have a single pixel in it). Sets are means over their images, as the whole is.

use std::collections::BTreeMap;

use serde::Serialize;

use super::compare::Comparison;
use super::metrics::{Metrics, PerImage, Sums};
use super::protocol::Logarithm;
use crate::{Error, Result};

/// Where bins of distance begin and end, in metres, if nothing else is asked for.
pub const BINS: [f64; 8] = [0.0, 5.0, 10.0, 20.0, 30.0, 40.0, 60.0, 80.0];

/// The rows and columns of regions, from the top left.
const ROWS: [&str; 3] = ["top", "middle", "bottom"];
const COLUMNS: [&str; 3] = ["left", "centre", "right"];

/// Pixels that have something in common.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Group {
    /// The label that they have in common.
    pub name: String,
    /// How many there are.
    pub pixels: usize,
    /// Their metrics.
    #[serde(flatten)]
    pub metrics: Metrics,
}

/// Images that have something in common.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Set {
    /// The sequence.
    pub name: String,
    /// How many images it has.
    pub images: usize,
    /// The means over them.
    #[serde(flatten)]
    pub metrics: Metrics,
}

/// Sums by group, over images.
#[derive(Clone, Debug)]
pub struct Breakdown {
    edges: Vec<f64>,
    distances: Vec<Sums>,
    regions: [[Sums; 3]; 3],
    logarithm: Logarithm,
}

impl Breakdown {
    /// Nothing yet; bins of true distance from each of `edges` (metres) to the next, the last without an end.
    ///
    /// # Errors
    /// If there is no edge, or they do not rise from 0 or more.
    pub fn new(edges: &[f64], logarithm: Logarithm) -> Result<Breakdown> {
        let rise = edges.windows(2).all(|pair| pair[0] < pair[1]);
        if !rise || edges.first().is_none_or(|first| *first < 0.0) || edges.iter().any(|edge| !edge.is_finite()) {
            let message = format!("expected metres from 0 up, each more than the one before, found {edges:?}");
            return Err(Error::setting("bins", message));
        }
        Ok(Breakdown {
            edges: edges.to_vec(),
            distances: vec![Sums::default(); edges.len()],
            regions: Default::default(),
            logarithm,
        })
    }

    /// Adds the pixels of an image that count.
    pub fn add(&mut self, compared: &Comparison) {
        let (height, width) = compared.size;
        for pair in &compared.pairs {
            let bin = self.edges.partition_point(|edge| *edge <= pair.truth);
            if let Some(sums) = bin.checked_sub(1).and_then(|bin| self.distances.get_mut(bin)) {
                sums.add(pair.truth, pair.prediction);
            }
            let (row, column) = (3 * pair.row / height, 3 * pair.column / width);
            self.regions[row.min(2)][column.min(2)].add(pair.truth, pair.prediction);
        }
    }

    /// Errors by true distance; bins without a pixel are left out.
    pub fn distances(&self) -> Vec<Group> {
        let name = |bin: usize| match self.edges.get(bin + 1) {
            Some(end) => format!("{} to {end} m", self.edges[bin]),
            None => format!("{} m and more", self.edges[bin]),
        };
        let groups = self.distances.iter().enumerate();
        groups.filter_map(|(bin, sums)| self.group(name(bin), sums)).collect()
    }

    /// Errors by ninths of the picture, from the top left; those without a pixel are left out.
    pub fn regions(&self) -> Vec<Group> {
        let ninths =
            self.regions.iter().zip(ROWS).flat_map(|(row, name)| row.iter().zip(COLUMNS).map(move |c| (name, c)));
        ninths.filter_map(|(row, (sums, column))| self.group(format!("{row} {column}"), sums)).collect()
    }

    fn group(&self, name: String, sums: &Sums) -> Option<Group> {
        sums.metrics(self.logarithm).map(|metrics| Group { name, pixels: sums.pixels(), metrics })
    }
}

/// The means by sequence, in the order of their numbers; `sequences` says that of each image. A sequence has the name that
/// its images' names have in common.
pub fn by_set(images: &[PerImage], sequences: &[usize]) -> Vec<Set> {
    let mut sets: BTreeMap<usize, Vec<&PerImage>> = BTreeMap::new();
    for (image, &sequence) in images.iter().zip(sequences) {
        sets.entry(sequence).or_default().push(image);
    }
    let set = |images: Vec<&PerImage>| {
        let names: Vec<&str> = images.iter().map(|image| image.name.as_str()).collect();
        let metrics = Metrics::mean(images.iter().map(|image| image.metrics))?;
        Some(Set { name: common_name(&names), images: images.len(), metrics })
    };
    sets.into_values().filter_map(set).collect()
}

/// The words that names begin with; of a single name all but its last word.
fn common_name(names: &[&str]) -> String {
    let words = |name: &str| name.split_whitespace().map(str::to_owned).collect::<Vec<_>>();
    let Some((first, others)) = names.split_first() else { return String::new() };
    let mut common = words(first);
    if let ([], Some(_)) = (others, common.get(1)) {
        common.pop();
    }
    for other in others {
        let other = words(other);
        let same = common.iter().zip(&other).take_while(|(a, b)| a == b).count();
        common.truncate(same);
    }
    let name = common.join(" ");
    let name = name.strip_suffix("frame").unwrap_or(&name).trim_end_matches([',', ' ']);
    if name.is_empty() { (*first).to_owned() } else { name.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::compare::Pair;

    fn compared(pairs: &[(usize, usize, f64, f64)]) -> Comparison {
        let pair = |&(row, column, truth, prediction)| Pair { row, column, truth, prediction };
        let pairs = pairs.iter().map(pair).collect();
        Comparison { size: (30, 60), pairs, ratio: None, factor: 1.0, logarithm: Logarithm::Natural }
    }

    #[test]
    fn pixels_fall_into_their_bins_and_regions_and_count_once() {
        let mut found = Breakdown::new(&[0.0, 10.0, 20.0], Logarithm::Natural).unwrap();
        // On an edge the farther bin; the last row and column are the last region.
        found.add(&compared(&[(0, 0, 5.0, 6.0), (29, 59, 10.0, 12.0), (9, 20, 9.0, 9.0)]));
        found.add(&compared(&[(29, 0, 5.0, 5.0), (15, 30, 40.0, 20.0)]));
        let distances = found.distances();
        let short: Vec<(&str, usize)> = distances.iter().map(|g| (g.name.as_str(), g.pixels)).collect();
        assert_eq!(short, [("0 to 10 m", 3), ("10 to 20 m", 1), ("20 m and more", 1)]);
        assert!((distances[0].metrics.abs_rel - 0.2 / 3.0).abs() < 1e-12);
        assert!((distances[0].metrics.rmse - (1.0f64 / 3.0).sqrt()).abs() < 1e-12);
        assert!((distances[2].metrics.sq_rel - 10.0).abs() < 1e-12);
        let regions = found.regions();
        let short: Vec<(&str, usize)> = regions.iter().map(|g| (g.name.as_str(), g.pixels)).collect();
        let expected =
            [("top left", 1), ("top centre", 1), ("middle centre", 1), ("bottom left", 1), ("bottom right", 1)];
        assert_eq!(short, expected);
        assert_eq!(regions[4].metrics.abs_rel, 0.2);
    }

    #[test]
    fn edges_have_to_rise() {
        for bad in [&[][..], &[1.0, 1.0], &[5.0, 2.0], &[-1.0, 2.0], &[f64::NAN], &[0.0, f64::INFINITY]] {
            assert!(Breakdown::new(bad, Logarithm::Natural).unwrap_err().to_string().contains("bins"), "{bad:?}");
        }
    }

    #[test]
    fn sets_are_named_by_what_their_images_have_in_common() {
        let image = |name: &str, abs_rel| {
            let metrics = Metrics { abs_rel, ..Metrics::default() };
            PerImage { name: name.to_owned(), pixels: 1, ratio: None, metrics }
        };
        let images = [
            image("day/drive_1 12 l", 0.2),
            image("day/drive_2 13 l", 0.5),
            image("day/drive_1 13 l", 0.4),
            image("street seed 3, sequence 0, frame 1", 0.1),
            image("street seed 3, sequence 0, frame 2", 0.1),
        ];
        let sets = by_set(&images, &[0, 1, 0, 2, 2]);
        let short: Vec<(&str, usize)> = sets.iter().map(|s| (s.name.as_str(), s.images)).collect();
        assert_eq!(short, [("day/drive_1", 2), ("day/drive_2 13", 1), ("street seed 3, sequence 0", 2)]);
        assert!((sets[0].metrics.abs_rel - 0.3).abs() < 1e-12);
    }
}
