//! The instruction sets that this machine would not choose: every case of every op, and two training steps, held to
//! AVX2 and to the baseline, against what the best set gives.
//!
//! The set is chosen once for a process, so each level has a process of its own: this program again, told by
//! `PARALLAX_SIMD`, which runs the ignored test alone and leaves its numbers in a file.

use std::path::Path;
use std::process::Command;

use parallax::data::batch::{Augment, batch_of_step};
use parallax::gradcheck::{cotangents, draw};
use parallax::monovit::Preset;
use parallax::ops::registry::{self, AnyCase};
use parallax::street::{Street, StreetConfig};
use parallax::tensor::{Float, Tape, Tensor, Var, simd};
use parallax::train::RunConfig;
use parallax::train::Trainer;

/// Where the process of a level leaves its numbers.
const OUT: &str = "PARALLAX_SIMD_TEST_OUT";

/// Outputs and gradients of one case in one element type.
struct Numbers {
    what: String,
    single: bool,
    tensors: Vec<Vec<f64>>,
}

fn leaves<T: Float>(tape: &Tape<T>, case: &dyn AnyCase, inputs: &[Tensor<T>]) -> Vec<Var<T>> {
    let leaf = |(x, input): (&Tensor<T>, &parallax::ops::Input)| match input.constant {
        None => tape.leaf(x.clone()),
        Some(_) => Var::constant(x.clone()),
    };
    inputs.iter().zip(case.inputs()).map(leaf).collect()
}

fn outcome<T: Float>(
    case: &dyn AnyCase,
    inputs: &[Tensor<T>],
    seeds: &[Option<Tensor<f64>>],
    run: impl Fn(&[&Var<T>]) -> Vec<Var<T>>,
) -> Vec<Vec<f64>> {
    let tape = Tape::new();
    let vars = leaves(&tape, case, inputs);
    let outputs = run(&vars.iter().collect::<Vec<_>>());
    let seeds: Vec<_> = outputs.iter().zip(seeds).filter_map(|(y, c)| Some((y, c.as_ref()?.cast()))).collect();
    let gradients = tape.backward(&seeds);
    let numbers = |t: &Tensor<T>| t.data().iter().map(|x| x.f64()).collect();
    let of_outputs = outputs.iter().map(|y| numbers(y.value()));
    of_outputs.chain(vars.iter().filter_map(|v| gradients.get(v)).map(numbers)).collect()
}

/// Every case in f64 and in f32, on the same (rounded) numbers.
fn every_case() -> Vec<Numbers> {
    let mut all = Vec::new();
    for case in registry::all().iter().flat_map(|entry| entry.cases()) {
        let case = case.as_ref();
        let single: Vec<Tensor<f32>> = draw(case, 1).iter().map(Tensor::cast).collect();
        let double: Vec<Tensor<f64>> = single.iter().map(Tensor::cast).collect();
        let vars = leaves(&Tape::new(), case, &double);
        let seeds = cotangents(&case.run(&vars.iter().collect::<Vec<_>>()), 1);
        let what = format!("{} [{}] \"{}\"", case.op(), case.algo(), case.name());
        let exact = outcome(case, &double, &seeds, |v| case.run(v));
        let rounded = outcome(case, &single, &seeds, |v| case.run_f32(v));
        all.push(Numbers { what: what.clone(), single: false, tensors: exact });
        all.push(Numbers { what, single: true, tensors: rounded });
    }
    all
}

/// The losses of three training steps: what AdamW does to the weights shows in the second and third.
fn losses() -> Numbers {
    let street = Street::render(
        &StreetConfig { height: 64, width: 96, sequences: 1, frames: 4, ..StreetConfig::default() },
        None,
    );
    let mut config = RunConfig::new(Preset::Pico, 10);
    (config.auto_mask_delay, config.rotations.keep) = (0.0, 0.0);
    let mut trainer = Trainer::new(config.model(), config.plan());
    let batch = batch_of_step(&street, Augment::default(), 1, 0, 0).expect("a batch");
    let losses = (0..3).map(|_| trainer.step(&batch).expect("a finite loss").loss).collect();
    Numbers { what: "three training steps".into(), single: true, tensors: vec![losses] }
}

fn everything() -> Vec<Numbers> {
    let mut all = every_case();
    all.push(losses());
    all
}

#[test]
#[ignore = "run by the other test, in a process of its own for each level"]
fn leaves_its_numbers() {
    let asked = std::env::var("PARALLAX_SIMD").expect("the level");
    assert_eq!(simd::level().expect("a level of this machine"), asked, "the level that kernels are held to");
    let flat: Vec<u8> =
        everything().iter().flat_map(|n| n.tensors.concat()).flat_map(|x: f64| x.to_le_bytes()).collect();
    std::fs::write(std::env::var_os(OUT).expect("a place"), flat).expect("the numbers are written");
}

/// What the process of a level found, flat.
fn numbers_of(level: &str, folder: &Path) -> Vec<f64> {
    let path = folder.join(level);
    let child = Command::new(std::env::current_exe().expect("this test"))
        .args(["leaves_its_numbers", "--exact", "--ignored"])
        .env("PARALLAX_SIMD", level)
        .env(OUT, &path)
        .output()
        .expect("this program again");
    assert!(child.status.success(), "{level}: {}", String::from_utf8_lossy(&child.stdout));
    let bytes = std::fs::read(path).expect("its numbers");
    bytes.as_chunks::<8>().0.iter().map(|&b| f64::from_le_bytes(b)).collect()
}

/// Whether two tensors are the same but for rounding, in `bound` of their largest element.
fn close(found: &[f64], expected: &[f64], bound: f64) -> Result<(), String> {
    let finite = |x: f64| if x.is_finite() { x.abs() } else { 0.0 };
    let scale = expected.iter().fold(1e-3, |m: f64, &x| m.max(finite(x)));
    for (k, (&x, &y)) in found.iter().zip(expected).enumerate() {
        if !((x - y).abs() <= bound * scale || x == y || (x.is_nan() && y.is_nan())) {
            return Err(format!("element {k}: {x:e} for {y:e} (scale {scale:e})"));
        }
    }
    Ok(())
}

#[test]
fn every_level_gives_the_same_but_for_rounding() {
    let folder = tempfile::tempdir().expect("a folder");
    let best = simd::level().expect("no level asked for, or one of this machine");
    let here = everything();
    let has_avx2 = matches!(best, "avx512" | "avx2");
    for level in ["avx2", "scalar"].into_iter().filter(|&level| level == "scalar" || has_avx2) {
        let flat = numbers_of(level, folder.path());
        let (mut rest, mut compared, mut failures) = (&flat[..], 0, Vec::new());
        for numbers in &here {
            for (i, expected) in numbers.tensors.iter().enumerate() {
                assert!(rest.len() >= expected.len(), "{level}: fewer numbers than here");
                let (found, after) = rest.split_at(expected.len());
                (rest, compared) = (after, compared + found.len());
                let bound = if numbers.single { 1e-4 } else { 1e-11 };
                let wrong = close(found, expected, bound).err();
                failures.extend(wrong.map(|why| format!("{level}: {}, tensor {i}, {why}", numbers.what)));
            }
        }
        assert!(rest.is_empty(), "{level}: more numbers than here");
        assert!(failures.is_empty(), "{} differences:\n{}", failures.len(), failures.join("\n"));
        assert!(compared > 10_000, "{level}: only {compared} numbers were compared");
        println!("{level} against {best}: {compared} numbers of {} outcomes", here.len());
    }
}

#[test]
fn the_comparison_sees_a_wrong_number() {
    assert!(close(&[1.0, 2.0], &[1.0, 2.0 + 1e-12], 1e-11).is_ok());
    assert!(close(&[1.0, f64::NAN], &[1.0, 2.0], 1e-4).is_err());
    assert!(close(&[1.0, 2.001], &[1.0, 2.0], 1e-4).is_err());
}
