//! Warping by depth and motion: pixel by pixel on one thread.

mod common;

use common::{compare, random};
use criterion::{Criterion, criterion_group, criterion_main};
use parallax::tensor::{Tensor, Var};

/// Back-projected, moved, projected, sampled: the published combination of grids.
fn naive(v: &[Tensor<f32>], intrinsics: &[[f64; 4]]) -> Vec<f32> {
    let &[batch, h, w, channels] = v[0].dims() else { panic!("an image") };
    let mut out = Vec::with_capacity(v[0].len());
    for place in 0..batch * h * w {
        let (sample, row, column) = (place / (h * w), (place / w % h) as f64, (place % w) as f64);
        let ([fx, fy, cx, cy], depth) = (intrinsics[sample], f64::from(v[1].data()[place]));
        let point = [depth * (column - cx) / fx, depth * (row - cy) / fy, depth, 1.0];
        let moved: Vec<f64> = v[2].data()[sample * 12..][..12]
            .chunks_exact(4)
            .map(|m| m.iter().zip(point).map(|(&m, p)| f64::from(m) * p).sum())
            .collect();
        let [x, y, z] = [moved[0], moved[1], moved[2]];
        let (u, t) = ((fx * x + cx * z) / (z + 1e-7), (fy * y + cy * z) / (z + 1e-7));
        let inside = |at: f64, n: usize| (at * n as f64 / (n - 1) as f64 - 0.5).clamp(0.0, (n - 1) as f64);
        let (u, t) = (inside(u, w), inside(t, h));
        let (left, top) = ((u as usize).min(w - 2), (t as usize).min(h - 2));
        let (a, b) = ((u - left as f64) as f32, (t - top as f64) as f32);
        for c in 0..channels {
            let at = |r: usize, k: usize| v[0].data()[((sample * h + r) * w + k) * channels + c];
            let upper = (1.0 - a) * at(top, left) + a * at(top, left + 1);
            let lower = (1.0 - a) * at(top + 1, left) + a * at(top + 1, left + 1);
            out.push((1.0 - b) * upper + b * lower);
        }
    }
    out
}

fn benches(c: &mut Criterion) {
    for (batch, h, w) in [(4, 96, 320), (1, 192, 640)] {
        // Smooth, as pictures are: between neighbours of white noise, rounding in the place would be all there is.
        let source = Var::constant(random([batch, h / 8, w / 8, 3])).resize_bilinear(h, w, false).into_value();
        let depth = random([batch, h, w, 1]).map(|x| 6.0 + x);
        let motion = [1.0, -0.02, 0.01, 0.1, 0.02, 1.0, 0.0, 0.05, -0.01, 0.0, 1.0, 0.3].repeat(batch);
        let inputs = [source, depth, Tensor::from_vec([batch, 3, 4], motion)];
        let (wide, high) = (w as f64, h as f64);
        let intrinsics = vec![[0.58 * wide, 1.92 * high, 0.5 * wide, 0.5 * high]; batch];
        let ours = |v: &[Var<f32>]| v[0].warp(&v[1], &v[2], &intrinsics, false);
        let plain = |v: &[Tensor<f32>]| naive(v, &intrinsics);
        compare(c, "warp", &format!("{batch}x{h}x{w}x3"), &inputs, ours, &[("naive", &plain)]);
    }
}

criterion_group!(all, benches);
criterion_main!(all);
