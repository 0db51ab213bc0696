//! Layer normalisation: row by row on one thread.

mod common;

use common::{compare, random};
use criterion::{Criterion, criterion_group, criterion_main};
use parallax::tensor::{Tensor, Var};

const EPS: f64 = 1e-6;

/// `(x - mean) / sqrt(variance + eps) * weight + bias`, the statistics of each row.
fn naive(v: &[Tensor<f32>]) -> Vec<f32> {
    let channels = v[0].shape().last();
    let mut y = Vec::with_capacity(v[0].len());
    for x in v[0].data().chunks_exact(channels) {
        let mean = x.iter().sum::<f32>() / channels as f32;
        let variance = x.iter().map(|x| (x - mean) * (x - mean)).sum::<f32>() / channels as f32;
        let scale = 1.0 / (variance + EPS as f32).sqrt();
        let affine = v[1].data().iter().zip(v[2].data());
        y.extend(x.iter().zip(affine).map(|(x, (w, b))| (x - mean) * scale * w + b));
    }
    y
}

fn benches(c: &mut Criterion) {
    for (rows, channels) in [(4 * 48 * 160, 32), (4 * 24 * 80, 48), (4 * 6 * 20, 96), (12 * 40, 216)] {
        let inputs = [random([rows, channels]), random([channels]), random([channels])];
        let ours = |v: &[Var<f32>]| v[0].layer_norm(&v[1], &v[2], EPS);
        compare(c, "layer_norm", &format!("{rows}x{channels}"), &inputs, ours, &[("naive", &naive)]);
    }
}

criterion_group!(all, benches);
criterion_main!(all);
