//! The hot ops of a training step of the reduced network, forward and backward: `cargo bench`.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use parallax::ops::Conv2d;
use parallax::ops::batch_norm::Activation;
use parallax::random::Random;
use parallax::tensor::{Shape, Tape, Tensor, Var};

fn random(shape: impl Into<Shape>) -> Tensor<f32> {
    let mut random = Random::new(1, 2);
    Tensor::build(shape, |out| out.iter_mut().for_each(|x| *x = random.uniform(-1.0, 1.0) as f32))
}

/// Times `f` alone, and with the backward pass.
fn both(c: &mut Criterion, name: &str, size: &str, inputs: &[Tensor<f32>], f: impl Fn(&[Var<f32>]) -> Var<f32>) {
    let mut group = c.benchmark_group(name);
    group.sample_size(20);
    group.bench_function(BenchmarkId::new("forward", size), |b| {
        let constants: Vec<_> = inputs.iter().cloned().map(Var::constant).collect();
        b.iter(|| black_box(f(&constants)));
    });
    group.bench_function(BenchmarkId::new("forward and backward", size), |b| {
        let shape = *f(&inputs.iter().cloned().map(Var::constant).collect::<Vec<_>>()).shape();
        let cotangent = random(shape);
        b.iter(|| {
            let tape = Tape::new();
            let leaves: Vec<_> = inputs.iter().map(|x| tape.leaf(x.clone())).collect();
            let y = f(&leaves);
            black_box(tape.backward(&[(&y, cotangent.clone())]))
        });
    });
}

fn convolution(c: &mut Criterion) {
    let sizes = [(2, 320, 320, 3, 16), (4, 96, 320, 8, 8), (4, 48, 160, 16, 16), (1, 96, 320, 64, 64)];
    for (batch, h, w, from, to) in sizes {
        let size = format!("{batch}x{h}x{w}x{from} to {to}");
        let inputs = [random([batch, h, w, from]), random([3, 3, from, to])];
        both(c, "conv2d 3x3", &size, &inputs, |v| v[0].conv2d(&v[1], None, Conv2d::padded(1)));
    }
    for (h, w, channels, k) in [(48, 160, 32, 3), (24, 80, 48, 7), (12, 40, 64, 3)] {
        let inputs = [random([4, h, w, channels]), random([k, k, channels])];
        let size = format!("4x{h}x{w}x{channels}, {k}x{k}");
        both(c, "depthwise_conv2d", &size, &inputs, |v| v[0].depthwise_conv2d(&v[1], None, 1, k / 2));
    }
}

fn normalisation(c: &mut Criterion) {
    for (rows, channels) in [(4 * 48 * 160, 32), (4 * 12 * 40, 64)] {
        let inputs = [random([rows, channels]), random([channels]), random([channels])];
        both(c, "batch_norm and hardswish", &format!("{rows}x{channels}"), &inputs, |v| {
            v[0].batch_norm(&v[1], &v[2], 1e-5, Activation::Hardswish).0
        });
    }
}

fn attention(c: &mut Criterion) {
    for (height, width, channels) in [(24, 80, 48), (6, 20, 96)] {
        let qkv = random([4, height * width, 3 * channels]);
        let size = format!("4x{height}x{width}x{channels}");
        both(c, "factorised_attention", &size, std::slice::from_ref(&qkv), |v| v[0].factorised_attention(8));
        let per_head = channels / 8;
        let mut inputs = vec![qkv];
        let windows = [(3, 2), (5, 3), (7, 3)];
        for (k, heads) in windows {
            inputs.extend([random([k, k, heads * per_head]), random([heads * per_head])]);
        }
        both(c, "conv_relative_position", &size, &inputs, |v| {
            let list: Vec<_> =
                windows.iter().zip(v[1..].chunks(2)).map(|(&(k, h), wb)| (k, h, &wb[0], &wb[1])).collect();
            v[0].conv_relative_position(height, width, 8, &list)
        });
    }
}

criterion_group!(benches, convolution, normalisation, attention);
criterion_main!(benches);
