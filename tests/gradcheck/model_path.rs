//! What a real training step runs: nothing that is not checked, and the same bits every time.

use std::collections::BTreeSet;

use parallax::data::batch::{Augment, batch_of_step};
use parallax::data::street::{Street, StreetConfig};
use parallax::monovit::evaluation::Predictor;
use parallax::monovit::run::RunConfig;
use parallax::monovit::{Preset, Trainer};
use parallax::nn::Params;
use parallax::ops::{registry, trace};
use parallax::tensor::parallel;

fn street(height: usize, width: usize) -> Street {
    Street::render(&StreetConfig { height, width, sequences: 1, frames: 6, ..StreetConfig::default() }, None)
}

#[test]
fn every_kernel_path_of_a_training_step_and_of_a_prediction_is_checked() {
    let checked: BTreeSet<(&str, &str)> =
        registry::all().iter().flat_map(|e| e.cases()).map(|c| (c.op(), c.algo())).collect();
    let street = street(96, 320);
    let config = RunConfig::new(Preset::Nano, 10);
    let mut trainer = Trainer::new(config.model(), config.optim, config.loss, 0);
    let batch = batch_of_step(&street, Augment::default(), 2, 0, 0).expect("a batch");
    let (step, mut entries) = trace::record(false, || trainer.step(&batch));
    step.expect("a step");
    let image = street.frame(0, 1).clone();
    let predict = || Predictor::new(&trainer.model, &trainer.params, &config.loss).disparity(&image);
    entries.extend(trace::record(false, predict).1);
    let ran: BTreeSet<(&str, &str)> = entries.iter().map(|e| (e.op, e.algo)).collect();
    assert!(ran.len() > 30, "only {} kernel paths were recorded", ran.len());
    let unchecked: Vec<_> = ran.difference(&checked).collect();
    assert!(unchecked.is_empty(), "kernel paths without a gradient check: {unchecked:?}");
}

#[test]
fn one_and_two_threads_train_the_same_bits() {
    let street = street(64, 96);
    let train = |threads: usize| -> Params<f32> {
        parallel::with_threads(threads, || {
            let config = RunConfig::new(Preset::Pico, 10);
            let mut trainer = Trainer::new(config.model(), config.optim, config.loss, 7);
            for step in 0..3 {
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
fn a_number_that_is_not_finite_stops_the_step_and_names_the_op() {
    let street = street(64, 64);
    let config = RunConfig::new(Preset::Pico, 10);
    let mut trainer = Trainer::new(config.model(), config.optim, config.loss, 0);
    let batch = batch_of_step(&street, Augment::default(), 2, 0, 0).expect("a batch");
    let id = trainer.params.find("encoder.mhca_stages.1.aggregate.conv.weight").expect("a weight");
    trainer.params.value_mut(id).data_mut()[0] = f32::NAN;
    let error = trainer.step(&batch).expect_err("not finite").to_string();
    assert!(error.contains("step 1") && error.contains("conv2d [pointwise]"), "{error}");
}
