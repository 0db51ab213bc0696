//! Training on stereo pairs: alone, and together with neighbours in time.

use parallax::data::batch::{Augment, Batch, Making, batch_of_step};
use parallax::data::stereo::Sources;
use parallax::monovit::Preset;
use parallax::street::{Street, StreetConfig};
use parallax::tensor::Tensor;
use parallax::train::{RunConfig, Trainer};

fn street() -> Street {
    Street::render(
        &StreetConfig { height: 64, width: 96, sequences: 1, frames: 6, baseline: 0.54, ..StreetConfig::default() },
        None,
    )
}

fn making(sources: Sources) -> Making {
    Making { augment: Augment { flip: true, jitter: true, sensor: false }, sources, ..Making::default() }
}

fn config(sources: Sources) -> RunConfig {
    RunConfig { height: 64, width: 96, batch: 2, sources, ..RunConfig::new(Preset::Pico, 10) }
}

/// The names of the parameters that a step of a recipe moves.
fn moved(sources: Sources) -> Vec<String> {
    let config = config(sources);
    let mut trainer = Trainer::new(config.model(), config.plan());
    let before = trainer.params.clone();
    let batch = batch_of_step(&street(), making(sources), 2, 0, 0).expect("a batch");
    let report = trainer.step(&batch).expect("a step");
    assert!(report.loss > 0.0 && report.warped > 0.0 && report.unwarped > 0.0);
    let pairs = before.iter().zip(trainer.params.iter());
    pairs.filter(|((_, a), (_, b))| !a.value.same_bits(&b.value)).map(|((_, a), _)| a.name().to_owned()).collect()
}

#[test]
fn pairs_alone_teach_depth_and_no_motion() {
    let any = |names: &[String], part: &str| names.iter().any(|name| name.starts_with(part));
    let stereo = moved(Sources::Stereo);
    assert!(any(&stereo, "encoder.") && any(&stereo, "depth.") && !any(&stereo, "pose"), "{stereo:?}");
    let both = moved(Sources::Both);
    assert!(any(&both, "encoder.") && any(&both, "depth.") && any(&both, "pose"), "{both:?}");
}

#[test]
fn pairs_alone_need_no_lessons_of_rotations() {
    assert!(config(Sources::Both).plan().rotations.steps > 0);
    let plan = config(Sources::Stereo).plan();
    assert_eq!((plan.rotations.steps, plan.rotations.keep), (0, 0));
}

/// Where neighbours explain every pixel better than a pair that depth does not fit yet, the pair is listened to at first:
/// with neighbours that show nothing depth learns the same, and the pose networks learn all the while.
#[test]
fn depth_learns_from_pairs_alone_before_they_share_a_loss_with_neighbours() {
    let batch = batch_of_step(&street(), making(Sources::Both), 2, 0, 0).expect("a batch");
    let step = |pairs_first: f64, change: &dyn Fn(&mut Batch)| {
        let config = RunConfig { pairs_first, ..config(Sources::Both) };
        let mut trainer = Trainer::new(config.model(), config.plan());
        let mut batch = batch.clone();
        change(&mut batch);
        let report = trainer.step(&batch).expect("a step");
        assert!(report.grad_norms.iter().all(|norm| *norm > 0.0), "every part learns: {report:?}");
        report.grad_norms
    };
    let grey = |batch: &mut Batch| batch.sources[0] = Tensor::full([2, 64, 96, 3], 0.4);
    let nearer = |batch: &mut Batch| batch.shifts.iter_mut().flatten().for_each(|x| *x *= 0.5);
    let [encoder, decoder, pose] = step(1.0, &|_| ());
    let changed = step(1.0, &grey);
    assert!(changed[..2] == [encoder, decoder] && changed[2] != pose, "{changed:?} {encoder} {decoder} {pose}");
    let changed = step(1.0, &nearer);
    assert!(changed[0] != encoder && changed[1] != decoder && changed[2] == pose, "{changed:?}");
    assert!(step(0.0, &grey)[0] != step(0.0, &|_| ())[0], "later neighbours teach depth, too");
    assert_eq!(config(Sources::Both).plan().pairs_first, 5);
}

/// The error of a pair is that of its own warp: another baseline, or the other camera's picture exchanged, changes it,
/// and the minimum over three sources is at most that over two.
#[test]
fn validation_takes_the_smallest_error_over_all_sources() {
    let street = street();
    let errors = |sources: Sources, change: &dyn Fn(&mut Batch)| {
        let config = config(sources);
        let trainer = Trainer::new(config.model(), config.plan());
        let plain = Making { augment: Augment { flip: false, jitter: false, sensor: false }, ..making(sources) };
        let mut batch = batch_of_step(&street, plain, 2, 0, 0).expect("a batch");
        change(&mut batch);
        trainer.validate(&trainer.params, &[batch])
    };
    let [mono, stereo, both] = [Sources::Mono, Sources::Stereo, Sources::Both].map(|s| errors(s, &|_| ()));
    for i in 1..3 {
        assert!(both[i] < mono[i] && both[i] < stereo[i], "{mono:?} {stereo:?} {both:?}");
    }
    let nearer = errors(Sources::Stereo, &|batch| batch.shifts.iter_mut().flatten().for_each(|x| *x *= 0.5));
    assert!(nearer[1] != stereo[1] && nearer[2] == stereo[2], "only the warp knows of the baseline");
    let grey = |batch: &mut Batch| batch.sources[0] = Tensor::full([2, 64, 96, 3], 0.5);
    assert!(errors(Sources::Stereo, &grey)[2] != stereo[2]);
}
