//! Which samples are set aside for validation and test, where no list says so.

use std::collections::{BTreeMap, BTreeSet};

use super::DataSource;

/// Of ten frames one is set aside.
const SHARE: usize = 10;
/// Frames between the last one that is trained on and the first that is set aside: with both of their neighbours no
/// picture is in two samples.
const GAP: usize = 2;

/// Samples to train on, and samples that are set aside: the last tenth of each recording, with a gap before it, so that no
/// frame of one kind is a frame or neighbour of the other. Of recordings with fewer frames than eight, which would lose
/// too many, every tenth is set aside as a whole.
///
/// Two cameras of one recording see the same things at the same time, and are cut at the same frame.
pub fn set_aside(data: &dyn DataSource) -> (Vec<usize>, Vec<usize>) {
    let mut recordings: BTreeMap<usize, BTreeSet<usize>> = BTreeMap::new();
    for place in (0..data.len()).map(|sample| data.place(sample)) {
        recordings.entry(place.sequence).or_default().insert(place.frame);
    }
    let mut short = 0;
    // Of each recording the first frame that is set aside, if any is.
    let mut cuts: BTreeMap<usize, usize> = BTreeMap::new();
    for (&sequence, frames) in &recordings {
        let n = frames.len();
        let aside = if n >= 8 {
            n.div_ceil(SHARE)
        } else {
            short += 1;
            if short % SHARE == 0 { n } else { 0 }
        };
        if let Some(&first) = frames.iter().nth(n - aside) {
            cuts.insert(sequence, first);
        }
    }
    let (mut train, mut aside) = (Vec::new(), Vec::new());
    for sample in 0..data.len() {
        let place = data.place(sample);
        match cuts.get(&place.sequence) {
            Some(&first) if place.frame >= first => aside.push(sample),
            Some(&first) if place.frame + GAP >= first => {}
            _ => train.push(sample),
        }
    }
    (train, aside)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use image::RgbImage;

    use super::*;
    use crate::Result;
    use crate::camera::Intrinsics;
    use crate::data::Place;
    use crate::depth::DepthMap;

    /// Nothing but places.
    struct Places(Vec<Place>);

    impl DataSource for Places {
        fn len(&self) -> usize {
            self.0.len()
        }
        fn name(&self, sample: usize) -> String {
            format!("{:?}", self.0[sample])
        }
        fn image(&self, _: usize, _: i32) -> Result<Arc<RgbImage>> {
            unreachable!("nobody looks at pictures")
        }
        fn intrinsics(&self, _: usize) -> Intrinsics {
            Intrinsics::KITTI
        }
        fn place(&self, sample: usize) -> Place {
            self.0[sample]
        }
        fn depth(&self, _: usize) -> Result<Option<DepthMap>> {
            Ok(None)
        }
    }

    /// Recordings of so many frames.
    fn of(lengths: &[usize]) -> Places {
        let all = lengths.iter().enumerate();
        Places(all.flat_map(|(sequence, &n)| (1..=n).map(move |frame| Place { sequence, frame })).collect())
    }

    #[test]
    fn no_frame_of_one_kind_is_a_frame_or_neighbour_of_the_other() {
        for lengths in [&[100][..], &[40, 9, 8, 25], &[5; 23], &[8], &[30, 3]] {
            let data = of(lengths);
            let (train, aside) = set_aside(&data);
            assert!(!train.is_empty() && !aside.is_empty(), "{lengths:?}: {} and {}", train.len(), aside.len());
            for place in aside.iter().map(|&sample| data.place(sample)) {
                for other in train.iter().map(|&sample| data.place(sample)) {
                    let near = place.sequence == other.sequence && place.frame.abs_diff(other.frame) < 3;
                    assert!(!near, "{lengths:?}: {place:?} beside {other:?}");
                }
            }
        }
    }

    #[test]
    fn about_a_tenth_is_set_aside_and_little_is_lost() {
        let data = of(&[100, 50]);
        let (train, aside) = set_aside(&data);
        assert_eq!((train.len(), aside.len()), (150 - 15 - 4, 15));
        // Too few to set any aside.
        assert_eq!(set_aside(&of(&[7])), ((0..7).collect(), vec![]));
    }

    #[test]
    fn two_cameras_are_cut_at_the_same_frame() {
        let mut both = of(&[20]).0;
        both.extend(of(&[20]).0);
        let data = Places(both);
        let (_, aside) = set_aside(&data);
        assert_eq!(aside, [18, 19, 38, 39]);
    }
}
