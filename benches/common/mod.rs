//! What the benches share: our op beside other ways of writing it, on the same inputs, with the same result.

use std::hint::black_box;
use std::sync::Once;

use criterion::{BenchmarkId, Criterion};
use parallax::random::Random;
use parallax::tensor::{Shape, Tape, Tensor, Var};

/// Uniform numbers in [-1, 1].
pub fn random(shape: impl Into<Shape>) -> Tensor<f32> {
    start_threads();
    let mut random = Random::new(1, 2);
    Tensor::build(shape, |out| out.iter_mut().for_each(|x| *x = random.uniform(-1.0, 1.0) as f32))
}

/// Another way of writing an op's forward pass: its name, and the result from the inputs.
pub type Form<'a> = (&'a str, &'a dyn Fn(&[Tensor<f32>]) -> Vec<f32>);

/// Times an op forward, the other forms of its forward pass, and the op with its backward pass.
///
/// # Panics
/// If another form has another result: its time would mean nothing.
pub fn compare(
    c: &mut Criterion,
    name: &str,
    size: &str,
    inputs: &[Tensor<f32>],
    ours: impl Fn(&[Var<f32>]) -> Var<f32>,
    others: &[Form],
) {
    let constants: Vec<_> = inputs.iter().cloned().map(Var::constant).collect();
    let expected = ours(&constants).into_value();
    let mut group = c.benchmark_group(name);
    group.sample_size(20);
    group.bench_function(BenchmarkId::new("forward", size), |b| b.iter(|| black_box(ours(&constants))));
    for (form, f) in others {
        agree(&format!("{name}, {form}, {size}"), &f(inputs), expected.data());
        group.bench_function(BenchmarkId::new(format!("forward, {form}"), size), |b| b.iter(|| black_box(f(inputs))));
    }
    let cotangent = random(*expected.shape());
    group.bench_function(BenchmarkId::new("forward and backward", size), |b| {
        b.iter(|| {
            let tape = Tape::new();
            let leaves: Vec<_> = inputs.iter().map(|x| tape.leaf(x.clone())).collect();
            let y = ours(&leaves);
            black_box(tape.backward(&[(&y, cotangent.clone())]))
        });
    });
}

fn agree(what: &str, found: &[f32], expected: &[f32]) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let scale = expected.iter().fold(1e-3f32, |m, x| m.max(x.abs()));
    for (i, (x, y)) in found.iter().zip(expected).enumerate() {
        assert!((x - y).abs() <= 1e-3 * scale, "{what}, element {i}: {x}, and {y} by the op");
    }
}

/// Kernels run in a pool of which this thread is a part, as they do in the program: before the first op, which would start
/// another.
fn start_threads() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        rayon::ThreadPoolBuilder::new().use_current_thread().build_global().expect("the first pool of this process");
    });
}
