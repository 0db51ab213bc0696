//! What a real training step runs: nothing that is not checked, and the same bits every time.

use std::collections::BTreeSet;

use parallax::data::batch::{Augment, batch_of_step};
use parallax::eval::predictor::Predictor;
use parallax::monovit::Preset;
use parallax::networks::{Architecture, EncoderKind, Network};
use parallax::nn::Params;
use parallax::ops::registry;
use parallax::street::{Street, StreetConfig};
use parallax::tensor::parallel;
use parallax::tensor::profile;
use parallax::train::Trainer;
use parallax::train::{Plan, RunConfig};

fn street(height: usize, width: usize) -> Street {
    Street::render(&StreetConfig { height, width, sequences: 1, frames: 6, ..StreetConfig::default() }, None)
}

/// The kernel paths of training (and of what comes before it), of a prediction and of an evaluation of one architecture.
fn paths(
    architecture: Architecture,
    height: usize,
    width: usize,
    batch: usize,
) -> BTreeSet<(&'static str, &'static str)> {
    let street = street(height, width);
    let mut config = RunConfig::new(architecture, 10);
    config.auto_mask_delay = 0.0;
    config.rotations.share = 0.1;
    let mut trainer = Trainer::new(config.model(), config.plan());
    let batch = batch_of_step(&street, Augment::default(), batch, 0, 0).expect("a batch");
    let (step, mut entries) = profile::record(false, || trainer.step(&batch));
    step.expect("a step");
    // The same networks again: once, of the one that is trained.
    if architecture.preset == Preset::Nano {
        let lesson = || trainer.learn_rotations(|| Ok(batch.clone()), |_, _| true);
        let (learnt, more) = profile::record(false, lesson);
        assert!(learnt.expect("a lesson"));
        entries.extend(more);
    }
    let image = street.frame(0, 1).clone();
    let predictor = Predictor::new(&trainer.model, &trainer.params, &config.setup());
    entries.extend(profile::record(false, || predictor.disparity(&image)).1);
    entries.extend(profile::record(false, || predictor.inverse_depth(&image, true)).1);
    entries.iter().map(|e| (e.op, e.algo)).collect()
}

#[test]
fn every_kernel_path_that_training_prediction_and_evaluation_take_is_checked() {
    let checked: BTreeSet<(&str, &str)> =
        registry::all().iter().flat_map(|e| e.cases()).map(|c| (c.op(), c.algo())).collect();
    let mut failures = Vec::new();
    for architecture in Architecture::all() {
        // The reduced networks as they are trained; the published ones small, since their widths decide the paths.
        let (height, width, batch) = if architecture.preset == Preset::Nano { (96, 320, 2) } else { (64, 96, 1) };
        // An encoder takes its paths under either decoder, and ResNet-18 those of ResNet-34.
        let again = match (architecture.network, architecture.encoder) {
            (Network::Monodepth2, EncoderKind::Mpvit) => architecture.preset != Preset::Nano,
            (network, EncoderKind::Resnet18) => network == Network::Monovit,
            (network, EncoderKind::Resnet34) => network == Network::Monodepth2,
            _ => false,
        };
        if again {
            continue;
        }
        let ran = paths(architecture, height, width, batch);
        assert!(ran.len() > 20, "{}: only {} kernel paths were recorded", architecture.name(), ran.len());
        failures.extend(ran.difference(&checked).map(|path| format!("{}: {path:?}", architecture.name())));
    }
    assert!(failures.is_empty(), "kernel paths without a gradient check:\n{}", failures.join("\n"));
}

/// Trains on one thread and on two, and compares every weight.
fn assert_same_bits_on_one_and_two_threads(
    architecture: impl Into<Architecture>,
    height: usize,
    width: usize,
    steps: u64,
) {
    let (street, architecture) = (street(height, width), architecture.into());
    let train = |threads: usize| -> Params<f32> {
        parallel::with_threads(threads, || {
            let config = RunConfig::new(architecture, 10);
            let mut trainer = Trainer::new(config.model(), Plan { seed: 7, ..config.plan() });
            for step in 0..steps {
                let batch = batch_of_step(&street, Augment::default(), 2, 7, step).expect("a batch");
                trainer.step(&batch).expect("a step");
            }
            trainer.weights()
        })
    };
    let (one, two) = (train(1), train(2));
    for ((_, a), (_, b)) in one.iter().zip(two.iter()) {
        assert!(a.value.same_bits(&b.value), "{} differs between one and two threads", a.name());
    }
}

#[test]
fn one_and_two_threads_train_the_same_bits() {
    assert_same_bits_on_one_and_two_threads(Preset::Pico, 64, 96, 3);
}

/// At its real size, where every kernel is cut into more tiles than there are threads.
#[test]
fn one_and_two_threads_train_the_same_bits_of_the_reduced_network() {
    assert_same_bits_on_one_and_two_threads(Preset::Nano, 96, 320, 2);
}

#[test]
fn one_and_two_threads_train_the_same_bits_of_another_network() {
    assert_same_bits_on_one_and_two_threads(Architecture::of(Network::Monodepth2, Preset::Nano), 64, 96, 2);
}

#[test]
fn a_number_that_is_not_finite_stops_the_step_and_names_the_op() {
    let street = street(64, 64);
    let config = RunConfig::new(Preset::Pico, 10);
    let mut trainer = Trainer::new(config.model(), config.plan());
    let batch = batch_of_step(&street, Augment::default(), 2, 0, 0).expect("a batch");
    let id = trainer.params.find("encoder.mhca_stages.1.aggregate.conv.weight").expect("a weight");
    trainer.params.value_mut(id).data_mut()[0] = f32::NAN;
    let error = trainer.step(&batch).expect_err("not finite").to_string();
    assert!(error.contains("step 1") && error.contains("conv2d [parts_pointwise]"), "{error}");
}
