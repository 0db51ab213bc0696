//! Tests of batches: augmented geometry, pairs, damaged samples, the order.

use std::sync::Arc;

use super::*;
use crate::data::augment::flip;
use crate::error::Error;
use crate::street::{Street, StreetConfig};
use crate::tensor::Var;

#[test]
fn smaller_sources_are_made_like_the_pyramid_of_the_target() {
    let config = StreetConfig { height: 64, width: 96, sequences: 1, frames: 5, ..StreetConfig::default() };
    let street = Street::render(&config, None);
    let plain = Augment { flip: false, jitter: false, sensor: false };
    let mut batch = batch_of_step(&street, plain, 2, 0, 0).unwrap();
    batch.sources[1] = batch.pyramid[0].clone();
    let smaller = batch.smaller_sources();
    assert_eq!(smaller.len(), 3);
    for (scale, of) in smaller.iter().enumerate() {
        let [previous, next] = &of[..] else { panic!("two sources") };
        assert!(next.same_bits(&batch.pyramid[scale + 1]), "scale {}", scale + 1);
        assert!(!previous.same_bits(next));
    }
}

/// The mean difference between a batch's targets and its next frames, warped by true depths and poses, sample by
/// sample.
fn warped_with_the_truth(street: &Street, batch: &Batch, samples: &[usize], mirrored: &[bool]) -> Vec<f64> {
    let (height, width) = (street.config().height, street.config().width);
    let (mut depths, mut poses) = (Vec::new(), Vec::new());
    for (&sample, &mirrored) in samples.iter().zip(mirrored) {
        let depth = street.depth(sample).unwrap().unwrap();
        let metres: Vec<f32> = depth.metres.iter().map(|&m| if m > 0.0 { m } else { 500.0 }).collect();
        depths.extend(if mirrored { crate::eval::metrics::mirror(&metres, width) } else { metres });
        // With x the other way round on both sides.
        let sign = |axis: usize| if mirrored && axis == 0 { -1.0 } else { 1.0 };
        for (i, row) in street.relative_pose(sample, 1).iter().enumerate() {
            poses.extend((0..4).map(|j| (row[j] * sign(i) * sign(j)) as f32));
        }
    }
    let tensor =
        |shape: &[usize], values: &[f32]| Var::constant(Tensor::build(shape, |out| out.copy_from_slice(values)));
    let depth = tensor(&[samples.len(), height, width, 1], &depths);
    let pose = tensor(&[samples.len(), 3, 4], &poses);
    let warped = Var::constant(batch.sources[1].clone()).warp(&depth, &pose, &batch.intrinsics, true);
    let each = 3 * height * width;
    let pairs = warped.value().data().chunks(each).zip(batch.pyramid[0].data().chunks(each));
    let sum = |(a, b): (&[f32], &[f32])| a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs())).sum::<f64>();
    pairs.map(|pair| sum(pair) / each as f64).collect()
}

#[test]
fn known_depth_is_mirrored_with_the_pictures_and_the_sky_is_far() {
    let street = Street::render(&StreetConfig { sequences: 2, frames: 6, ..StreetConfig::default() }, None);
    let making = |flip: bool, depth: bool| Making {
        augment: Augment { flip, jitter: false, sensor: false },
        depth,
        ..Making::default()
    };
    let of = |flip: bool| batch_of_step(&street, making(flip, true), 4, 0, 0).unwrap();
    let (plain, mixed) = (of(false), of(true));
    assert!(batch_of_step(&street, making(false, false), 4, 0, 0).unwrap().depth.is_none());
    let (plain_depth, mixed_depth) = (plain.depth.unwrap(), mixed.depth.unwrap());
    assert_eq!(plain_depth.shape().dims(), [4, 96, 320, 1]);
    let (pictures, each) = (plain.pyramid[0].data(), 96 * 320);
    for (i, &sample) in samples_of_step(street.len(), 4, 0, 0).iter().enumerate() {
        let truth = street.depth(sample).unwrap().unwrap().metres;
        let far: Vec<f32> = truth.iter().map(|&m| if m > 0.0 { m } else { f32::INFINITY }).collect();
        assert_eq!(plain_depth.data()[i * each..][..each], far);
        let mirrored = pictures[3 * i * each..][..3 * each] != mixed.pyramid[0].data()[3 * i * each..][..3 * each];
        let expected = if mirrored { crate::eval::metrics::mirror(&far, 320) } else { far };
        assert_eq!(mixed_depth.data()[i * each..][..each], expected);
    }
}

#[test]
fn a_sensor_changes_what_the_networks_see_and_not_what_the_loss_compares() {
    let street = Street::render(&StreetConfig { sequences: 1, frames: 6, ..StreetConfig::default() }, None);
    let of = |sensor: bool| batch_of_step(&street, Augment { flip: true, jitter: false, sensor }, 1, 0, 0).unwrap();
    let (plain, sensed) = (of(false), of(true));
    assert!(plain.pyramid[0].same_bits(&sensed.pyramid[0]) && plain.sources[1].same_bits(&sensed.sources[1]));
    assert!(!plain.target.same_bits(&sensed.target) && sensed.target.same_bits(&of(true).target));
}

#[test]
fn a_mirrored_street_warps_as_well_as_the_street() {
    let street = Street::render(&StreetConfig { sequences: 2, frames: 6, ..StreetConfig::default() }, None);
    let samples = samples_of_step(street.len(), 4, 0, 0);
    let of = |flip: bool| batch_of_step(&street, Augment { flip, jitter: false, sensor: false }, 4, 0, 0).unwrap();
    let (plain, mixed) = (of(false), of(true));
    let each = 3 * 96 * 320;
    let parts = plain.pyramid[0].data().chunks(each).zip(mixed.pyramid[0].data().chunks(each));
    let mirrored: Vec<bool> = parts.map(|(a, b)| a != b).collect();
    assert!(mirrored.contains(&true) && mirrored.contains(&false), "{mirrored:?}");
    let found = warped_with_the_truth(&street, &plain, &samples, &[false; 4]);
    let again = warped_with_the_truth(&street, &mixed, &samples, &mirrored);
    for (a, b) in found.iter().zip(&again) {
        assert!((a / b - 1.0).abs() < 1e-4, "{found:?} {again:?}");
    }
    // A pixel beside the true principal point is seen: the comparison above is worth something.
    let mut beside = mixed;
    for (k, &mirrored) in beside.intrinsics.iter_mut().zip(&mirrored) {
        assert_eq!(k[2], if mirrored { 159.0 } else { 160.0 });
        k[2] = 160.0;
    }
    let beside = warped_with_the_truth(&street, &beside, &samples, &mirrored);
    assert!(beside.iter().zip(&again).zip(&mirrored).all(|((a, b), &m)| (a != b) == m), "{beside:?} {again:?}");
}

/// The mean difference between targets and what the other camera saw, warped by true depths and `metres` to it.
fn warped_from_the_other_camera(street: &Street, batch: &Batch, samples: &[usize], mirrored: &[bool]) -> f64 {
    let (height, width) = (street.config().height, street.config().width);
    let mut depths = Vec::new();
    for (&sample, &mirrored) in samples.iter().zip(mirrored) {
        let depth = street.depth(sample).unwrap().unwrap();
        let metres: Vec<f32> = depth.metres.iter().map(|&m| if m > 0.0 { m } else { 500.0 }).collect();
        depths.extend(if mirrored { crate::eval::metrics::mirror(&metres, width) } else { metres });
    }
    let depth = Var::constant(Tensor::from_vec([samples.len(), height, width, 1], depths));
    let transform = Var::constant(batch.to_other_camera().unwrap());
    let other = batch.sources.last().unwrap().clone();
    let warped = Var::constant(other).warp(&depth, &transform, &batch.intrinsics, true);
    let pairs = warped.value().data().iter().zip(batch.pyramid[0].data());
    pairs.map(|(a, b)| f64::from((a - b).abs())).sum::<f64>() / batch.pyramid[0].len() as f64
}

#[test]
fn the_other_camera_of_a_pair_is_where_the_batch_says_also_in_a_mirror() {
    let config = StreetConfig { sequences: 2, frames: 5, baseline: 0.54, ..StreetConfig::default() };
    let street = Street::render(&config, None);
    let samples = samples_of_step(street.len(), 4, 0, 0);
    let of = |flip: bool, sources: Sources| {
        let augment = Augment { flip, jitter: false, sensor: false };
        batch_of_step(&street, Making { augment, sources, ..Making::default() }, 4, 0, 0).unwrap()
    };
    let (plain, mixed) = (of(false, Sources::Both), of(true, Sources::Both));
    let each = 3 * 96 * 320;
    let parts = plain.pyramid[0].data().chunks(each).zip(mixed.pyramid[0].data().chunks(each));
    let mirrored: Vec<bool> = parts.map(|(a, b)| a != b).collect();
    assert!(mirrored.contains(&true) && mirrored.contains(&false), "{mirrored:?}");
    let shifts: Vec<f64> = mirrored.iter().map(|&m| if m { 0.54 } else { -0.54 }).collect();
    assert_eq!(mixed.shifts.as_ref(), Some(&shifts));

    let good = warped_from_the_other_camera(&street, &plain, &samples, &[false; 4]);
    let again = warped_from_the_other_camera(&street, &mixed, &samples, &mirrored);
    assert!((good / again - 1.0).abs() < 1e-3, "{good} {again}");
    // The wrong side, or another distance, is seen.
    for factor in [-1.0, 0.0, 0.8, 1.25] {
        let mut wrong = plain.clone();
        wrong.shifts.iter_mut().flatten().for_each(|shift| *shift *= factor);
        let wrong = warped_from_the_other_camera(&street, &wrong, &samples, &[false; 4]);
        assert!(wrong > 1.2 * good, "{factor}: {wrong} {good}");
    }

    let (stereo, mono) = (of(true, Sources::Stereo), of(true, Sources::Mono));
    assert_eq!((mono.sources.len(), mixed.sources.len(), stereo.sources.len()), (2, 3, 1));
    assert!(mono.shifts.is_none() && stereo.neighbours.is_none());
    assert!(stereo.sources[0].same_bits(&mixed.sources[2]) && mono.sources[1].same_bits(&mixed.sources[1]));
    assert!(mono.target.same_bits(&stereo.target));
}

#[test]
fn a_street_of_one_camera_has_no_pairs() {
    let config = StreetConfig { height: 32, width: 64, sequences: 1, frames: 4, ..StreetConfig::default() };
    let making = Making { sources: Sources::Stereo, ..Making::default() };
    let error = batch_of_step(&Street::render(&config, None), making, 1, 0, 0).unwrap_err().to_string();
    assert!(error.contains("frame 1 has no second camera") || error.contains("frame 2 has no second"), "{error}");
    assert!(error.contains("--sources mono"), "{error}");
}

/// A street of which some samples cannot be read.
struct Damaged(Street, fn(usize) -> bool);

impl DataSource for Damaged {
    fn len(&self) -> usize {
        self.0.len()
    }
    fn name(&self, sample: usize) -> String {
        format!("sample {sample}")
    }
    fn image(&self, sample: usize, offset: i32) -> Result<Arc<RgbImage>> {
        match (self.1)(sample) && offset == 1 {
            true => Err(Error::file("lost.png", format!("number {sample} cannot be decoded"))),
            false => self.0.image(sample, offset),
        }
    }
    fn intrinsics(&self, sample: usize) -> Intrinsics {
        self.0.intrinsics(sample)
    }
    fn depth(&self, _sample: usize) -> Result<Option<crate::depth::DepthMap>> {
        Ok(None)
    }
}

fn damaged(bad: fn(usize) -> bool) -> Arc<Damaged> {
    let config = StreetConfig { height: 64, width: 96, sequences: 1, frames: 8, ..StreetConfig::default() };
    Arc::new(Damaged(Street::render(&config, None), bad))
}

#[test]
fn what_stopped_the_batches_is_said_as_often_as_it_is_asked() {
    let mut loader = Loader::start(damaged(|_| true), Augment::default(), 2, 0, 0, None).unwrap();
    let first = loader.next_batch().unwrap_err();
    assert!(matches!(&first, Error::File { path, .. } if path.ends_with("lost.png")), "{first}");
    for _ in 0..3 {
        let later = loader.next_batch().unwrap_err();
        assert!(matches!(later, Error::File { .. }));
        assert_eq!(later.to_string(), first.to_string());
    }
}

#[test]
fn samples_that_cannot_be_read_are_passed_over_and_counted() {
    let bad = |sample| sample == 1 || sample == 2;
    let (data, skip) = (damaged(bad), SkipList::default());
    let plain = Augment { flip: true, jitter: false, sensor: false };
    let mut loader = Loader::start(data.clone(), plain, 3, 5, 0, Some(skip.clone())).unwrap();
    let again = SkipList::default();
    for step in 0..4 {
        let batch = loader.next_batch().unwrap();
        // The others are what they would be without; 3 stands for 1 and 2.
        let whole = batch_of_step(&data.0, plain, 3, 5, step).unwrap();
        let known = batch_of_readable(data.as_ref(), plain, 3, 5, step, &again).unwrap();
        assert!(batch.sources[1].same_bits(&known.sources[1]), "whether it is known beforehand is no matter");
        let each = 3 * 64 * 96;
        for (i, sample) in samples_of_step(6, 3, 5, step).into_iter().enumerate() {
            let of = |batch: &Batch| batch.pyramid[0].data()[i * each..][..each].to_vec();
            assert_eq!(of(&batch) == of(&whole), !bad(sample), "sample {sample}");
            if bad(sample) {
                let three = data.0.image(3, 0).unwrap();
                let both = [to_tensor(&[&three]), to_tensor(&[&flip(&three)])];
                assert!(both.iter().any(|image| image.data() == of(&batch)));
            }
        }
    }
    assert_eq!(skip.count(), 2);
    let first = skip.first().unwrap();
    assert!(first.starts_with("sample ") && first.contains("lost.png") && first.contains("decoded"), "{first}");

    let error = batch_of_readable(damaged(|_| true).as_ref(), plain, 1, 0, 0, &SkipList::default()).unwrap_err();
    assert!(error.to_string().contains("none of the 6 samples can be read"), "{error}");
}

#[test]
fn every_epoch_sees_every_sample_once() {
    let seen: Vec<usize> = (0..5).flat_map(|step| samples_of_step(10, 4, 3, step)).collect();
    for epoch in seen.chunks(10) {
        let mut sorted = epoch.to_vec();
        sorted.sort_unstable();
        assert_eq!(sorted, (0..10).collect::<Vec<_>>());
    }
    assert_ne!(seen[..10], seen[10..], "a new order each epoch");
}
