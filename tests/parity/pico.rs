//! A whole MonoViT with 225,092 parameters against PyTorch reference values: outputs, loss, the gradient of every
//! parameter, three AdamW steps, and evaluation after them.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use parallax::formats::{TensorFile, safetensors};
use parallax::monovit::Preset;
use parallax::monovit::loss::{Loss, LossConfig, Views, loss};
use parallax::networks::DepthNetwork;
use parallax::nn::{Context, Folded, Named, Params, fit};
use parallax::optim::{AdamW, Group};
use parallax::random::Random;
use parallax::tensor::{Float, Tape, Tensor, Var};

use crate::reference::{error, largest};

fn fixture() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/pico.safetensors")
}

struct Reference<T: Float>(HashMap<String, Tensor<T>>);

impl<T: Float> Reference<T> {
    fn read() -> Self {
        Reference(safetensors::read(&fixture()).expect("the fixture").tensors)
    }

    fn get(&self, name: &str) -> &Tensor<T> {
        self.0.get(name).unwrap_or_else(|| panic!("the fixture has no {name}"))
    }

    /// An image or map, from NCHW to NHWC.
    fn map(&self, name: &str) -> Tensor<T> {
        self.get(name).permute(&[0, 2, 3, 1])
    }
}

struct Pico<T: Float> {
    model: DepthNetwork,
    params: Params<T>,
    reference: Reference<T>,
}

impl<T: Float> Pico<T> {
    fn load() -> Self {
        let reference = Reference::read();
        let (model, mut params) = DepthNetwork::new(Preset::Pico.config(), 0);
        let file = TensorFile::open(&fixture()).expect("the fixture");
        let weights: Vec<Named> = file
            .tensors
            .into_iter()
            .filter_map(|(origin, tensor)| {
                let name = origin.strip_prefix("weights/")?.to_owned();
                Some(Named { name, origin, file: Arc::new(fixture()), tensor })
            })
            .collect();
        let fitted = fit(&params, &weights).expect("numbers");
        assert_eq!(fitted.report.problem(), None, "the same names and shapes");
        fitted.put_into(&mut params);
        Pico { model, params, reference }
    }

    fn views(&self) -> Views<T> {
        let k = self.reference.get("in/K");
        let intrinsics = [k.at(&[0, 0]), k.at(&[1, 1]), k.at(&[0, 2]), k.at(&[1, 2])].map(Float::f64);
        let pyramid = ["in/target", "in/pyramid/1", "in/pyramid/2", "in/pyramid/3"];
        Views {
            pyramid: pyramid.map(|n| self.reference.map(n).into()).into(),
            sources: ["in/prev", "in/next"].map(|n| self.reference.map(n).into()).into(),
            smaller_sources: Vec::new(),
            intrinsics: vec![intrinsics; 2],
            depth: None,
        }
    }

    fn forward(&self, tape: &Tape<T>) -> (Context<T>, Vec<Var<T>>, Loss<T>) {
        let c = Context::training(&self.params, tape, Random::new(0, 0));
        let [prev, target, next] = ["in/prev", "in/target", "in/next"].map(|n| Var::constant(self.reference.map(n)));
        let disparities = self.model.disparities(&c, &target);
        let transforms = self.model.transforms(&c, &prev, &target, &next);
        let found = loss(&disparities, &transforms, &self.views(), &LossConfig::default(), None);
        (c, disparities, found)
    }
}

fn assert_error<T: Float>(found: &Tensor<T>, expected: &Tensor<T>, bound: f64, what: &str) {
    let e = error(found, expected);
    assert!(e <= bound, "{what}: error {e:.1e}, at most {bound:.0e} expected");
}

fn outputs_and_gradients<T: Float>(bound: f64, gradient_bound: f64, zero: f64) {
    let pico = Pico::<T>::load();
    let target = Var::constant(pico.reference.map("in/target"));

    let c = Context::training(&pico.params, &Tape::new(), Random::new(0, 0));
    for (i, feature) in pico.model.features(&c, &target).iter().enumerate() {
        assert_error(feature.value(), &pico.reference.map(&format!("out/feature/{i}")), bound, &format!("feature {i}"));
    }
    let [prev, next] = ["in/prev", "in/next"].map(|n| Var::constant(pico.reference.map(n)));
    for (name, first, second) in [("out/pose/prev", &prev, &target), ("out/pose/next", &target, &next)] {
        let motion = pico.model.motion(&c, first, second);
        assert_error(motion.value(), pico.reference.get(name), bound, name);
    }

    let (c, disparities, found) = pico.forward(&Tape::new());
    for (s, disparity) in disparities.iter().enumerate() {
        assert_error(
            disparity.value(),
            &pico.reference.map(&format!("out/disp/{s}")),
            bound,
            &format!("disparity {s}"),
        );
    }
    let expected = pico.reference.get("out/losses").data()[0].f64();
    let total = found.total.value().item().f64();
    assert!((total - expected).abs() <= bound * expected, "loss {total}, expected {expected}");

    let mut all = found.total.backward();
    let gradients = c.gradients(&mut all);
    c.into_moved();
    let mut compared = 0;
    for ((_, p), gradient) in pico.params.iter().zip(&gradients) {
        let expected = pico.reference.0.get(&format!("grad/{}", p.name()));
        assert_eq!(gradient.is_some(), expected.is_some(), "{}: whether there is a gradient", p.name());
        let (Some(gradient), Some(expected)) = (gradient, expected) else { continue };
        compared += 1;
        let gradient = p.layout.export(gradient);
        let scale = largest(expected.data().iter().map(|x| x.f64().abs()));
        for (k, (g, e)) in gradient.data().iter().zip(expected.data()).enumerate() {
            let difference = (g.f64() - e.f64()).abs();
            let bound = gradient_bound * scale + zero;
            assert!(difference <= bound, "{}, element {k}: {g} for {e} (bound {bound:.1e})", p.name());
        }
    }
    assert_eq!(compared, 501, "parameters with a gradient");
}

#[test]
fn outputs_and_gradients_in_f64() {
    outputs_and_gradients::<f64>(1e-10, 1e-8, 1e-15);
}

#[test]
fn outputs_and_gradients_in_f32() {
    // The gradients that are zero by construction (constants before a normalisation) are rounding noise in f32.
    outputs_and_gradients::<f32>(1e-4, 1e-4, 1e-6);
}

#[test]
fn three_steps_and_evaluation_in_f64() {
    let mut pico = Pico::<f64>::load();
    let mut adamw = AdamW::new(&pico.params);
    let losses = pico.reference.get("out/losses").clone();
    for step in 0..3 {
        let (c, _, found) = pico.forward(&Tape::new());
        let (total, expected) = (found.total.value().item(), losses.data()[step]);
        assert!((total - expected).abs() <= 1e-9 * expected, "loss before step {}: {total} for {expected}", step + 1);
        let gradients = c.gradients(&mut found.total.backward());
        adamw.step(&mut pico.params, &gradients, |name| Group {
            learning_rate: if name.starts_with("encoder.") { 5e-5 } else { 1e-4 },
            decay: 0.01,
        });
        for (id, value) in c.into_moved() {
            pico.params.set(id, value);
        }
    }
    for (_, p) in pico.params.iter() {
        let expected = pico.reference.get(&format!("after3/{}", p.name()));
        // Where the gradient is zero by construction, AdamW divides rounding noise by eps: of the order 1e-14 a step.
        let ours = p.layout.export(&p.value);
        let scale = largest(expected.data().iter().map(|x| x.abs()).chain([1e-3]));
        for (k, (x, e)) in ours.data().iter().zip(expected.data()).enumerate() {
            assert!((x - e).abs() <= 1e-9 * scale, "{}, element {k}: {x} for {e}", p.name());
        }
    }
    let c = Context::inference(&pico.params);
    let target = Var::constant(pico.reference.map("in/target"));
    for (s, disparity) in pico.model.disparities(&c, &target).iter().enumerate() {
        let expected = pico.reference.map(&format!("eval_after3/disp/{s}"));
        assert_error(disparity.value(), &expected, 1e-9, &format!("disparity {s}"));
    }
    let folded = pico.model.predict(&Folded::new(&pico.params), target.value());
    for (s, disparity) in folded.iter().enumerate() {
        let expected = pico.reference.map(&format!("eval_after3/disp/{s}"));
        assert_error(disparity, &expected, 1e-9, &format!("disparity {s}, normalisations folded"));
    }
}
