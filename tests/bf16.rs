//! Products in bf16, against those in f32: within what 8 bits allow, op by op, and for the whole network.
//!
//! Each factor is off by at most 2^-9 of itself, so a product by 2^-8 and a little, and a sum of products by that of the
//! sum of their sizes. Gradients are f32's: the bits of an op that was never told of bf16.

use parallax::data::batch::to_tensor;
use parallax::monovit::Preset;
use parallax::networks::DepthNetwork;
use parallax::nn::Folded;
use parallax::ops::product::linear::Linear;
use parallax::ops::{Conv2d, apply1};
use parallax::random::Random;
use parallax::street::{Street, StreetConfig};
use parallax::tensor::{Precision, Shape, Tape, Tensor, Var};

/// 2^-8, the rounding of both factors, their product, and sums in f32.
const PART: f32 = 1.02 / 256.0;

fn draw(random: &mut Random, shape: impl Into<Shape>) -> Tensor<f32> {
    Tensor::build(shape.into(), |out| out.iter_mut().for_each(|x| *x = random.uniform(-1.0, 1.0) as f32))
}

fn sizes(x: &Tensor<f32>) -> Tensor<f32> {
    Tensor::from_vec(*x.shape(), x.data().iter().map(|x| x.abs()).collect())
}

/// Compares an op in both precisions: values within the bound, gradients bit by bit. Returns whether any value differs:
/// whether anything was in bf16.
fn compare(what: &str, inputs: &[Tensor<f32>], op: impl Fn(&[Var<f32>], Precision) -> Var<f32>) -> bool {
    let run = |inputs: &[Tensor<f32>], precision| {
        let tape = Tape::new();
        let leaves: Vec<Var<f32>> = inputs.iter().map(|x| tape.leaf(x.clone())).collect();
        let y = op(&leaves, precision);
        let mut gradients = tape.backward(&[(&y, Tensor::full(*y.shape(), 1.0))]);
        let gradients: Vec<_> = leaves.iter().map(|x| gradients.take(x).expect("a gradient")).collect();
        (y.into_value(), gradients)
    };
    let (exact, in_f32) = run(inputs, Precision::F32);
    let (rounded, in_bf16) = run(inputs, Precision::Bf16);
    // The same of all sizes: what a sum could be if nothing cancelled.
    let (bound, _) = run(&inputs.iter().map(sizes).collect::<Vec<_>>(), Precision::F32);
    let mut differs = false;
    for ((&x, &y), &size) in rounded.data().iter().zip(exact.data()).zip(bound.data()) {
        assert!((x - y).abs() <= PART * size, "{what}: {x} for {y}, where sizes add up to {size}");
        differs |= x != y;
    }
    for (i, (a, b)) in in_f32.iter().zip(&in_bf16).enumerate() {
        assert!(a.same_bits(b), "{what}: the gradient of input {i} is not f32's");
    }
    differs
}

#[test]
fn every_product_is_as_near_as_eight_bits_allow() {
    let here = Precision::Bf16.is_available();
    let mut random = Random::new(5, 0);
    let mut draws =
        |shapes: &[&[usize]]| -> Vec<Tensor<f32>> { shapes.iter().map(|s| draw(&mut random, *s)).collect() };
    let same = Conv2d::padded(1);
    type Case<'a> = (&'a str, Conv2d, &'a [usize], &'a [usize], bool);
    let convolutions: [Case; 7] = [
        ("3x3", same, &[2, 7, 19, 16], &[3, 3, 16, 40], true),
        ("3x3, mirrored", same.reflecting(), &[1, 6, 21, 8], &[3, 3, 8, 17], true),
        ("1x1", Conv2d::default(), &[2, 5, 23, 34], &[1, 1, 34, 50], true),
        ("side by side", same, &[1, 4, 16, 2], &[3, 3, 2, 8], true),
        ("long sums", same, &[1, 3, 12, 96], &[3, 3, 96, 33], true),
        ("stride 2", same.strided(2), &[1, 9, 20, 16], &[3, 3, 16, 24], false),
        ("an odd number of columns", same, &[1, 5, 11, 3], &[3, 3, 3, 20], false),
    ];
    for (what, op, x, w, rounds) in convolutions {
        let inputs = draws(&[x, w, &[w[3]]]);
        let found = compare(what, &inputs, |v, precision| v[0].conv2d(&v[1], Some(&v[2]), Conv2d { precision, ..op }));
        // Where it is known which kernel runs: that of the instruction, or f32's.
        assert!(found == (here && rounds) || !rounds, "{what}: in bf16: {found}");
    }
    let inputs = draws(&[&[3, 41, 30], &[30, 70], &[70]]);
    let linear = |v: &[Var<f32>], precision| apply1(Linear { precision, ..Linear::default() }, &[&v[0], &v[1], &v[2]]);
    assert_eq!(compare("linear", &inputs, linear), here);
    let inputs = draws(&[&[1, 4, 9, 6], &[1, 8, 18, 4], &[3, 3, 10, 20]]);
    let upsampled = |v: &[Var<f32>], precision| {
        Var::conv2d_of_upsampled(&v[0], &[&v[1]], &v[2], None, Conv2d { precision, ..same.reflecting() })
    };
    assert_eq!(compare("upsampled", &inputs, upsampled), here);
}

#[test]
fn the_whole_network_moves_by_less_than_is_seen() {
    if !Precision::Bf16.is_available() {
        return;
    }
    let street = StreetConfig { height: 96, width: 320, sequences: 1, frames: 3, ..StreetConfig::default() };
    let street = Street::render(&street, None);
    let images = to_tensor(&[street.frame(0, 1).as_ref()]);
    let (model, params) = DepthNetwork::new::<f32>(Preset::Nano.config(), 0);
    let predict = |precision| model.predict(&Folded::new(&params).with_precision(precision), &images).swap_remove(0);
    let (exact, rounded) = (predict(Precision::F32), predict(Precision::Bf16));
    let off = exact.data().iter().zip(rounded.data()).map(|(x, y)| ((x - y) / x).abs());
    let (mean, worst) = off.fold((0.0, 0.0_f32), |(sum, worst), off| (sum + off / exact.len() as f32, worst.max(off)));
    assert!(mean > 0.0 && mean < 0.01 && worst < 0.1, "disparities move by {mean} on average, by {worst} at most");
}

#[test]
fn a_machine_without_the_instruction_says_so() {
    let out = std::process::Command::new(env!("CARGO_BIN_EXE_parallax"))
        .args(["bench", "infer", "--preset", "pico", "--height", "64", "--width", "64", "--precision", "bf16"])
        .env("PARALLAX_SIMD", "scalar")
        .output()
        .expect("the program runs");
    let said = String::from_utf8_lossy(&out.stderr);
    assert_eq!(out.status.code(), Some(2), "{said}");
    assert!(said.contains("--precision") && said.contains("BF16"), "{said}");
}
