//! Several data sets as one.

use std::sync::Arc;

use image::RgbImage;

use super::{DataSource, Place};
use crate::Result;
use crate::camera::Intrinsics;
use crate::depth::DepthMap;

/// The samples of several data sets, one after the other. No recording is in two of them.
pub struct Joined {
    parts: Vec<Arc<dyn DataSource>>,
    /// Of each sample its part, and its number there.
    samples: Vec<(usize, usize)>,
    /// Of each part the number of its first recording.
    first: Vec<usize>,
}

impl Joined {
    /// Joins data sets.
    pub fn new(parts: Vec<Arc<dyn DataSource>>) -> Self {
        let samples = parts.iter().enumerate().flat_map(|(p, part)| (0..part.len()).map(move |i| (p, i))).collect();
        let recordings =
            |part: &Arc<dyn DataSource>| (0..part.len()).map(|i| part.place(i).sequence + 1).max().unwrap_or(0);
        let ends = parts.iter().scan(0, |end, part| {
            *end += recordings(part);
            Some(*end)
        });
        let first = std::iter::once(0).chain(ends).take(parts.len()).collect();
        Joined { parts, samples, first }
    }

    fn of(&self, sample: usize) -> (&dyn DataSource, usize) {
        let (part, sample) = self.samples[sample];
        (self.parts[part].as_ref(), sample)
    }
}

impl DataSource for Joined {
    fn len(&self) -> usize {
        self.samples.len()
    }
    fn name(&self, sample: usize) -> String {
        let (part, sample) = self.of(sample);
        part.name(sample)
    }
    fn image(&self, sample: usize, offset: i32) -> Result<Arc<RgbImage>> {
        let (part, sample) = self.of(sample);
        part.image(sample, offset)
    }
    fn intrinsics(&self, sample: usize) -> Intrinsics {
        let (part, sample) = self.of(sample);
        part.intrinsics(sample)
    }
    fn mirrored_intrinsics(&self, sample: usize, width: usize) -> Intrinsics {
        let (part, sample) = self.of(sample);
        part.mirrored_intrinsics(sample, width)
    }
    fn cameras(&self) -> Vec<String> {
        let mut all: Vec<String> = Vec::new();
        for line in self.parts.iter().flat_map(|part| part.cameras()) {
            if !all.contains(&line) {
                all.push(line);
            }
        }
        all
    }
    fn place(&self, sample: usize) -> Place {
        let (part, place) = (self.samples[sample].0, self.of(sample));
        let Place { sequence, frame } = place.0.place(place.1);
        Place { sequence: self.first[part] + sequence, frame }
    }
    fn recording(&self, sample: usize) -> String {
        let (part, sample) = self.of(sample);
        part.recording(sample)
    }
    fn depth(&self, sample: usize) -> Result<Option<DepthMap>> {
        let (part, sample) = self.of(sample);
        part.depth(sample)
    }
    fn zero_depth_is_sky(&self) -> bool {
        self.parts.iter().all(|part| part.zero_depth_is_sky())
    }
    fn other_camera_at(&self, sample: usize) -> Option<f64> {
        let (part, sample) = self.of(sample);
        part.other_camera_at(sample)
    }
    fn other_image(&self, sample: usize) -> Result<Arc<RgbImage>> {
        let (part, sample) = self.of(sample);
        part.other_image(sample)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::street::{Street, StreetConfig};

    #[test]
    fn samples_follow_one_another_and_recordings_stay_apart() {
        let street = |seed: u64| -> Arc<dyn DataSource> {
            let config =
                StreetConfig { height: 8, width: 16, sequences: 2, frames: 4, seed, ..StreetConfig::default() };
            Arc::new(Street::render(&config, None))
        };
        let (a, b) = (street(1), street(2));
        let joined = Joined::new(vec![a.clone(), b.clone()]);
        assert_eq!((joined.len(), joined.name(1), joined.name(5)), (8, a.name(1), b.name(1)));
        assert_eq!(joined.image(6, 1).unwrap(), b.image(2, 1).unwrap());
        assert_eq!((0..8).map(|i| joined.place(i).sequence).collect::<Vec<_>>(), [0, 0, 1, 1, 2, 2, 3, 3]);
        assert!(joined.zero_depth_is_sky() && joined.depth(3).unwrap() == a.depth(3).unwrap());
    }
}
