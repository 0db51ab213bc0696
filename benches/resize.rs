//! Bilinear resizing and nearest upsampling: pixel by pixel on one thread.

mod common;

use common::{compare, random};
use criterion::{Criterion, criterion_group, criterion_main};
use parallax::tensor::{Tensor, Var};

/// The two rows (or columns) that place `i` of `n` lies between among `from`, and the second one's share.
fn between(i: usize, n: usize, from: usize) -> (usize, usize, f32) {
    let at = ((i as f32 + 0.5) * from as f32 / n as f32 - 0.5).max(0.0);
    let first = (at as usize).min(from - 1);
    (first, (first + 1).min(from - 1), at - first as f32)
}

fn bilinear(x: &Tensor<f32>, height: usize, width: usize) -> Vec<f32> {
    let &[batch, h, w, channels] = x.dims() else { panic!("an image") };
    let mut out = Vec::with_capacity(batch * height * width * channels);
    for place in 0..batch * height * width {
        let sample = place / (height * width);
        let (top, bottom, b) = between(place / width % height, height, h);
        let (left, right, a) = between(place % width, width, w);
        for c in 0..channels {
            let at = |r: usize, k: usize| x.data()[((sample * h + r) * w + k) * channels + c];
            let upper = (1.0 - a) * at(top, left) + a * at(top, right);
            let lower = (1.0 - a) * at(bottom, left) + a * at(bottom, right);
            out.push((1.0 - b) * upper + b * lower);
        }
    }
    out
}

fn nearest(x: &Tensor<f32>) -> Vec<f32> {
    let &[batch, h, w, channels] = x.dims() else { panic!("an image") };
    let mut out = Vec::with_capacity(4 * x.len());
    for place in 0..4 * batch * h * w {
        let (row, column) = (place / (2 * w) / 2, place % (2 * w) / 2);
        out.extend_from_slice(&x.data()[(row * w + column) * channels..][..channels]);
    }
    out
}

fn benches(c: &mut Criterion) {
    let (height, width) = (96, 320);
    for scale in [2, 8] {
        let inputs = [random([4, height / scale, width / scale, 1])];
        let ours = |v: &[Var<f32>]| v[0].resize_bilinear(height, width, false);
        let plain = |v: &[Tensor<f32>]| bilinear(&v[0], height, width);
        compare(c, "resize_bilinear", &format!("4x96x320x1 from 1/{scale}"), &inputs, ours, &[("naive", &plain)]);
    }
    for (h, w, channels) in [(48, 160, 8), (12, 40, 64)] {
        let inputs = [random([4, h, w, channels])];
        let ours = |v: &[Var<f32>]| v[0].upsample_nearest(2);
        let plain = |v: &[Tensor<f32>]| nearest(&v[0]);
        compare(c, "upsample_nearest", &format!("4x{h}x{w}x{channels}"), &inputs, ours, &[("naive", &plain)]);
    }
}

criterion_group!(all, benches);
criterion_main!(all);
