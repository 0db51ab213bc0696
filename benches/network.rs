//! The training step and the inference of the reduced network as wholes.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use parallax::data::batch::{Augment, batch_of_step};
use parallax::monovit::Preset;
use parallax::nn::Context;
use parallax::street::{Street, StreetConfig};
use parallax::tensor::Var;
use parallax::train::RunConfig;
use parallax::train::Trainer;

fn benches(c: &mut Criterion) {
    rayon::ThreadPoolBuilder::new().use_current_thread().build_global().expect("the first pool of this process");
    let street = Street::render(&StreetConfig { sequences: 1, frames: 6, ..StreetConfig::default() }, None);
    let mut config = RunConfig::new(Preset::Nano, 1_000_000);
    // The step as it is for most of the run.
    config.auto_mask_delay = 0.0;
    config.rotations.keep = 0.0;
    let batch = batch_of_step(&street, Augment::default(), 4, 0, 0).expect("a batch");
    let mut trainer = Trainer::new(config.model(), config.plan());
    let mut group = c.benchmark_group("nano 320x96, batch 4");
    group.sample_size(10);
    group.bench_function("inference", |b| {
        b.iter(|| {
            let c = Context::inference(&trainer.params);
            black_box(trainer.model.disparities(&c, &Var::constant(batch.target.clone())))
        });
    });
    group.bench_function("training step", |b| b.iter(|| black_box(trainer.step(&batch).expect("a finite loss"))));
}

criterion_group!(all, benches);
criterion_main!(all);
