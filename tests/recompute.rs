//! Transformer layers that are computed again in the backward pass: the same training, in less memory.

use parallax::data::batch::{Augment, Batch, batch_of_step};
use parallax::monovit::Preset;
use parallax::networks::DepthNetwork;
use parallax::nn::{Context, ParamId};
use parallax::random::Random;
use parallax::street::{Street, StreetConfig};
use parallax::tensor::{Tape, Tensor, Var, parallel, pool};
use parallax::train::cost::Cost;
use parallax::train::{RunConfig, Trainer};

fn batch() -> Batch {
    let config = StreetConfig { height: 64, width: 96, sequences: 1, frames: 5, ..StreetConfig::default() };
    batch_of_step(&Street::render(&config, None), Augment::default(), 2, 0, 0).expect("a batch")
}

/// Results of a step's backward pass.
struct Taken {
    /// By every parameter.
    gradients: Vec<Option<Tensor<f64>>>,
    /// The statistics that moved.
    moved: Vec<(ParamId, Tensor<f64>)>,
    /// Nodes on the tape.
    nodes: usize,
}

/// Gradients of the disparities' squares, of a network whose layers are dropped half of the time.
fn taken(recomputing: bool) -> Taken {
    let config = parallax::monovit::Config { drop_path: 0.5, ..Preset::Pico.config() };
    let (model, params) = DepthNetwork::new::<f64>(config, 3);
    let (tape, image) = (Tape::new(), batch().target.cast());
    let c = Context::training(&params, &tape, Random::new(5, 0)).recomputing(recomputing);
    let disparities = model.disparities(&c, &Var::constant(image));
    let sum = disparities.iter().map(|d| d.square().sum_all()).reduce(|a, b| a + b).expect("four scales");
    let nodes = tape.len();
    let gradients = c.gradients(&mut sum.backward());
    let mut moved: Vec<_> = c.into_moved().into_iter().collect();
    moved.sort_by_key(|(id, _)| *id);
    Taken { gradients, moved, nodes }
}

#[test]
fn gradients_and_statistics_are_those_of_layers_that_are_computed_once() {
    let (once, twice) = (taken(false), taken(true));
    assert!(twice.nodes < once.nodes, "{} nodes for {}", twice.nodes, once.nodes);
    assert_eq!(once.moved.len(), twice.moved.len());
    assert!(!once.moved.is_empty());
    for ((a, moved), (b, again)) in once.moved.iter().zip(&twice.moved) {
        assert!(a == b && moved.same_bits(again));
    }
    let mut compared = 0;
    for (a, b) in once.gradients.iter().zip(&twice.gradients) {
        assert_eq!(a.is_some(), b.is_some());
        let (Some(a), Some(b)) = (a, b) else { continue };
        let scale = a.data().iter().fold(0.0f64, |most, x| most.max(x.abs()));
        let off = a.data().iter().zip(b.data()).fold(0.0f64, |most, (a, b)| most.max((a - b).abs()));
        assert!(off <= 1e-12 * scale, "{off:e} of {scale:e}");
        compared += usize::from(scale > 0.0);
    }
    assert!(compared > 50, "only {compared} parameters have gradients");
}

#[test]
fn a_step_has_the_same_loss_and_takes_less_memory() {
    let batch = batch();
    let step = |recompute: bool| {
        let config = RunConfig { height: 64, width: 96, recompute, ..RunConfig::new(Preset::Nano, 100) };
        let mut trainer = Trainer::new(config.model(), config.plan());
        trainer.step(&batch).expect("a step");
        let (report, peak) = pool::peak_of(|| trainer.step(&batch));
        (report.expect("a step"), peak)
    };
    let (once, twice) = parallel::with_threads(1, || (step(false), step(true)));
    assert!((once.0.loss - twice.0.loss).abs() <= 1e-5 * once.0.loss, "{:?} {:?}", once.0, twice.0);
    assert!((once.0.grad_norm / twice.0.grad_norm - 1.0).abs() < 1e-3, "{:?} {:?}", once.0, twice.0);
    assert!((twice.1 as f64) < 0.9 * once.1 as f64, "{} bytes for {}", twice.1, once.1);
    let cost = |recompute| Cost::of(Preset::Nano.config(), [64, 96], 2, recompute).expect("counted");
    let (once, twice) = (cost(false), cost(true));
    assert!(twice.bytes_step < once.bytes_step, "{once:?} {twice:?}");
    assert!(twice.flops_step > once.flops_step && twice.flops_inference == once.flops_inference, "{once:?} {twice:?}");
}
