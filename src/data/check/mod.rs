//! Inspection of a data set before training: still stretches, exposure jumps, cuts, unreadable frames.

mod sheet;
mod survey;
mod times;

use std::collections::BTreeMap;
use std::sync::Arc;

use image::RgbImage;
use rayon::prelude::*;
use serde::Serialize;

use super::DataSource;
use super::aside::set_aside;
use crate::{Error, Result};

pub use sheet::contact_sheet;
pub(super) use survey::frame_files;
pub use survey::{Folder, OfSize, survey};

/// Neighbours that differ by less than so many of 255 levels on average: the camera stood still, and nothing can be learnt.
const STILL: f64 = 0.7;
/// Neighbours whose mean brightness differs by more levels: the exposure jumped.
const JUMP: f64 = 20.0;
/// Neighbours that differ by more levels on average: another scene.
const CUT: f64 = 50.0;
/// Of what share of still pairs on a recording is said to stand still.
const MANY: f64 = 0.3;

/// Statistics of one recording.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Recording {
    /// The name of its first sample.
    pub first: String,
    /// Samples: frames with both neighbours.
    pub samples: usize,
    /// Pairs of neighbours between which nothing moves.
    pub still: usize,
    /// Samples after which the exposure jumps.
    pub jumps: Vec<String>,
    /// Samples after which another scene begins.
    pub cuts: Vec<String>,
    /// Samples with ground-truth depth.
    pub with_depth: usize,
}

/// Result of the inspection of a data set.
#[derive(Clone, Debug, Serialize)]
pub struct Findings {
    /// One by one.
    pub recordings: Vec<Recording>,
    /// Frames that cannot be read: name, and why.
    pub unreadable: Vec<(String, String)>,
    /// The cameras, and where they were found.
    pub cameras: Vec<String>,
    /// Samples that would be trained on.
    pub train: usize,
    /// Samples that would be set aside.
    pub aside: usize,
}

impl Findings {
    /// Faults that make training on the data impossible, one sentence for each fault; empty if there is none.
    pub fn faults(&self) -> Vec<String> {
        let mut faults = Vec::new();
        if let Some((name, why)) = self.unreadable.first() {
            let n = self.unreadable.len();
            faults.push(format!(
                "{n} frames cannot be read (the first: {name}: {why}): restore them, or train with --skip-bad-frames"
            ));
        }
        if self.train == 0 {
            faults.push("there is no frame with both neighbours to train on".to_owned());
        }
        faults
    }

    /// Advice on things to look at, one sentence for each; empty if there is nothing.
    pub fn advice(&self) -> Vec<String> {
        let mut advice = Vec::new();
        for recording in &self.recordings {
            let Recording { first, samples, still, jumps, cuts, .. } = recording;
            if *still as f64 > MANY * *samples as f64 {
                advice.push(format!(
                    "{still} of the {samples} pairs from {first} on stand still: leave such stretches out, or take every \
                     second or third frame"
                ));
            }
            if let Some(name) = cuts.first() {
                let n = cuts.len();
                advice.push(format!(
                    "another scene begins after {name} ({n} such places): give each a folder of its own"
                ));
            }
            if let Some(name) = jumps.first() {
                let n = jumps.len();
                advice.push(format!(
                    "the exposure jumps after {name} ({n} such places): brightness is taken for motion there"
                ));
            }
        }
        if self.aside == 0 {
            advice.push("too few frames to set any aside: the last weights would count as the best".to_owned());
        }
        advice
    }
}

/// Samples whose frames are decoded at a time.
const AT_A_TIME: usize = 32;

/// Looks at every sample and its next frame, at the size the networks see. `progress` hears how many are done. Frames that
/// turn out to be unreadable are among the findings.
pub fn check(data: &dyn DataSource, mut progress: impl FnMut(usize)) -> Findings {
    let mut recordings: BTreeMap<usize, Recording> = BTreeMap::new();
    let mut unreadable = data.unreadable().to_vec();
    let note = |unreadable: &mut Vec<(String, String)>, sample: usize, error: &Error| {
        let why = error.to_string();
        // A frame is the neighbour of others: it is named once.
        if !unreadable.iter().any(|(_, known)| *known == why) {
            unreadable.push((data.name(sample), why));
        }
    };
    for first in (0..data.len()).step_by(AT_A_TIME) {
        let samples = first..(first + AT_A_TIME).min(data.len());
        type Seen = (Result<[Arc<RgbImage>; 2]>, Result<bool>);
        let look = |sample: usize| -> Seen {
            let frames = data.image(sample, 0).and_then(|frame| Ok([frame, data.image(sample, 1)?]));
            (frames, data.depth(sample).map(|depth| depth.is_some()))
        };
        let seen: Vec<Seen> = samples.clone().into_par_iter().map(look).collect();
        for (sample, (frames, depth)) in samples.zip(seen) {
            let recording = recordings.entry(data.place(sample).sequence).or_default();
            if recording.samples == 0 {
                recording.first = data.name(sample);
            }
            recording.samples += 1;
            match depth {
                Ok(there) => recording.with_depth += usize::from(there),
                Err(error) => note(&mut unreadable, sample, &error),
            }
            match frames {
                Ok([frame, next]) => recording.compare(&data.name(sample), &frame, &next),
                Err(error) => note(&mut unreadable, sample, &error),
            }
            progress(sample + 1);
        }
    }
    let (train, aside) = set_aside(data);
    Findings {
        recordings: recordings.into_values().collect(),
        unreadable,
        cameras: data.cameras(),
        train: train.len(),
        aside: aside.len(),
    }
}

impl Recording {
    /// Notes what lies between a sample and its next frame.
    fn compare(&mut self, name: &str, frame: &RgbImage, next: &RgbImage) {
        let (apart, brighter) = difference(frame, next);
        if apart > CUT {
            self.cuts.push(name.to_owned());
        } else if brighter.abs() > JUMP {
            self.jumps.push(name.to_owned());
        }
        self.still += usize::from(apart < STILL);
    }
}

/// The mean absolute difference of two pictures in levels, and how much brighter the second is.
fn difference(a: &RgbImage, b: &RgbImage) -> (f64, f64) {
    let pairs = || a.as_raw().iter().zip(b.as_raw());
    let n = a.as_raw().len().max(1) as f64;
    let apart: f64 = pairs().map(|(&x, &y)| f64::from(x.abs_diff(y))).sum();
    let brighter: f64 = pairs().map(|(&x, &y)| f64::from(y) - f64::from(x)).sum();
    (apart / n, brighter / n)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::camera::Intrinsics;
    use crate::data::Place;
    use crate::depth::DepthMap;

    /// A sequence of grey frames with a pattern that moves, of the given brightness and phase.
    struct Grey(Vec<(u8, u8)>);

    impl DataSource for Grey {
        fn len(&self) -> usize {
            self.0.len() - 2
        }
        fn name(&self, sample: usize) -> String {
            format!("frame {}", sample + 1)
        }
        fn image(&self, sample: usize, offset: i32) -> Result<Arc<RgbImage>> {
            let (level, phase) = self.0[(sample + 1).checked_add_signed(offset as isize).unwrap()];
            let pixel = |x: u32, _| image::Rgb([level + 20 * u8::from((x as u8 + phase) % 4 < 2); 3]);
            Ok(Arc::new(RgbImage::from_fn(16, 4, pixel)))
        }
        fn intrinsics(&self, _: usize) -> Intrinsics {
            Intrinsics::KITTI
        }
        fn place(&self, sample: usize) -> Place {
            Place { sequence: 0, frame: sample + 1 }
        }
        fn depth(&self, _: usize) -> Result<Option<DepthMap>> {
            Ok(None)
        }
    }

    fn found(frames: &[(u8, u8)]) -> Findings {
        check(&Grey(frames.to_vec()), |_| ())
    }

    #[test]
    fn a_drive_that_moves_gives_no_advice() {
        let moving: Vec<(u8, u8)> = (0..14).map(|i| (100, i)).collect();
        let findings = found(&moving);
        assert_eq!((findings.recordings[0].samples, findings.train, findings.aside), (12, 8, 2));
        assert!(findings.advice().is_empty(), "{:?}", findings.advice());
    }

    #[test]
    fn still_stretches_jumps_and_cuts_are_named() {
        let mut frames: Vec<(u8, u8)> = (0..6).map(|i| (50, i)).collect();
        frames.extend([(50, 5); 10]);
        let advice = found(&frames).advice();
        assert!(advice.len() == 1 && advice[0].contains("stand still") && advice[0].contains("frame 1"), "{advice:?}");
        let mut frames: Vec<(u8, u8)> = (0..14).map(|i| (50, i)).collect();
        frames[5..].iter_mut().for_each(|frame| frame.0 = 85);
        frames[10..].iter_mut().for_each(|frame| frame.0 = 200);
        let advice = found(&frames).advice();
        assert!(advice.iter().any(|a| a.contains("exposure jumps after frame 4")), "{advice:?}");
        assert!(advice.iter().any(|a| a.contains("another scene begins after frame 9")), "{advice:?}");
    }

    /// A data set in which a frame cannot be decoded.
    struct Broken(Grey, usize);

    impl DataSource for Broken {
        fn len(&self) -> usize {
            self.0.len()
        }
        fn name(&self, sample: usize) -> String {
            self.0.name(sample)
        }
        fn image(&self, sample: usize, offset: i32) -> Result<Arc<RgbImage>> {
            match sample.checked_add_signed(offset as isize) {
                Some(frame) if frame == self.1 => Err(Error::file(format!("{frame}.png"), "ends early")),
                _ => self.0.image(sample, offset),
            }
        }
        fn intrinsics(&self, _: usize) -> Intrinsics {
            Intrinsics::KITTI
        }
        fn depth(&self, _: usize) -> Result<Option<DepthMap>> {
            Ok(None)
        }
    }

    #[test]
    fn a_frame_that_cannot_be_decoded_is_a_fault_and_named_once() {
        let moving: Vec<(u8, u8)> = (0..50).map(|i| (100, i)).collect();
        let found = check(&Broken(Grey(moving), 37), |_| ());
        assert_eq!(found.unreadable.len(), 1, "{:?}", found.unreadable);
        let faults = found.faults();
        assert!(faults.len() == 1 && faults[0].contains("1 frames") && faults[0].contains("37.png"), "{faults:?}");
        assert_eq!(found.recordings[0].samples, 48);
    }

    #[test]
    fn a_contact_sheet_shows_frames_with_their_neighbours() {
        let sheet = contact_sheet(&Grey((0..5).map(|i| (20 * i, 0)).collect())).unwrap();
        assert_eq!(sheet.dimensions(), (3 * 16, 3 * 4));
        // The last column's lowest row is the last frame.
        assert_eq!(sheet.get_pixel(47, 11).0[0], 80);
    }
}
