//! Depthwise convolution: direct loops on one thread. There is no matrix product in it for faer to do.

mod common;

use common::{compare, random};
use criterion::{Criterion, criterion_group, criterion_main};
use parallax::tensor::{Tensor, Var};

/// `x [batch, h, w, channels]` with `w [k, k, channels]`, zeros around.
fn naive(v: &[Tensor<f32>]) -> Vec<f32> {
    let (x, weights) = (v[0].data(), v[1].data());
    let (&[batch, h, w, channels], &[k, ..]) = (v[0].dims(), v[1].dims()) else { panic!("an image and a kernel") };
    let mut y = vec![0.0; batch * h * w * channels];
    for (place, y) in y.chunks_exact_mut(channels).enumerate() {
        let (sample, row, column) = (place / (h * w), place / w % h, place % w);
        for dy in 0..k {
            for dx in 0..k {
                let (r, c) = ((row + dy).wrapping_sub(k / 2), (column + dx).wrapping_sub(k / 2));
                if r >= h || c >= w {
                    continue;
                }
                for i in 0..channels {
                    y[i] += x[((sample * h + r) * w + c) * channels + i] * weights[(dy * k + dx) * channels + i];
                }
            }
        }
    }
    y
}

fn benches(c: &mut Criterion) {
    for (h, w, channels, k) in [(48, 160, 32, 3), (24, 80, 48, 7), (12, 40, 64, 5), (12, 40, 64, 3)] {
        let inputs = [random([4, h, w, channels]), random([k, k, channels])];
        let ours = |v: &[Var<f32>]| v[0].depthwise_conv2d(&v[1], None, 1, k / 2);
        let size = format!("4x{h}x{w}x{channels}");
        compare(c, &format!("depthwise_conv2d {k}x{k}"), &size, &inputs, ours, &[("naive", &naive)]);
    }
}

criterion_group!(all, benches);
criterion_main!(all);
