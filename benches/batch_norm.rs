//! Batch normalisation with its activation: channel by channel on one thread.

mod common;

use common::{compare, random};
use criterion::{Criterion, criterion_group, criterion_main};
use parallax::ops::normalise::batch_norm::Activation;
use parallax::tensor::{Tensor, Var};

const EPS: f64 = 1e-5;

/// Hardswish of `(x - mean) / sqrt(variance + eps) * weight + bias`, the statistics of each channel over all rows.
fn naive(v: &[Tensor<f32>]) -> Vec<f32> {
    let (x, channels, rows) = (v[0].data(), v[0].shape().last(), v[0].shape().rows() as f64);
    let mut y = vec![0.0; x.len()];
    for c in 0..channels {
        let column = || x.iter().skip(c).step_by(channels).map(|&x| f64::from(x));
        let mean = column().sum::<f64>() / rows;
        let variance = column().map(|x| (x - mean) * (x - mean)).sum::<f64>() / rows;
        let scale = f64::from(v[1].data()[c]) / (variance + EPS).sqrt();
        for (y, x) in y.iter_mut().skip(c).step_by(channels).zip(column()) {
            let z = (x - mean) * scale + f64::from(v[2].data()[c]);
            *y = (z * (z + 3.0).clamp(0.0, 6.0) / 6.0) as f32;
        }
    }
    y
}

fn benches(c: &mut Criterion) {
    for (rows, channels) in [(4 * 48 * 160, 32), (4 * 24 * 80, 48), (4 * 12 * 40, 64)] {
        let inputs = [random([rows, channels]), random([channels]), random([channels])];
        let ours = |v: &[Var<f32>]| v[0].batch_norm(&v[1], &v[2], EPS, Activation::Hardswish).0;
        compare(c, "batch_norm and hardswish", &format!("{rows}x{channels}"), &inputs, ours, &[("naive", &naive)]);
    }
}

criterion_group!(all, benches);
criterion_main!(all);
