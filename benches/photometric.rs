//! The photometric error (SSIM and absolute difference): pixel by pixel on one thread.

mod common;

use common::{compare, random};
use criterion::{Criterion, criterion_group, criterion_main};
use parallax::tensor::{Tensor, Var};

const SSIM: f64 = 0.85;

/// The row (or column) that a place outside mirrors.
fn mirror(i: isize, n: usize) -> usize {
    let i = i.unsigned_abs();
    if i >= n { 2 * (n - 1) - i } else { i }
}

fn naive(v: &[Tensor<f32>]) -> Vec<f32> {
    let &[batch, h, w, channels] = v[0].dims() else { panic!("an image") };
    let mut out = vec![0.0; batch * h * w];
    for (place, out) in out.iter_mut().enumerate() {
        let (sample, row, column) = (place / (h * w), place / w % h, place % w);
        for c in 0..channels {
            let at = |image: &Tensor<f32>, dy: isize, dx: isize| {
                let (r, k) = (mirror(row as isize + dy, h), mirror(column as isize + dx, w));
                image.data()[((sample * h + r) * w + k) * channels + c]
            };
            let [mut x, mut y, mut xx, mut yy, mut xy] = [0.0f32; 5];
            for dy in -1..=1 {
                for dx in -1..=1 {
                    let (a, b) = (at(&v[0], dy, dx) / 9.0, at(&v[1], dy, dx) / 9.0);
                    (x, y, xx, yy, xy) = (x + a, y + b, xx + 9.0 * a * a, yy + 9.0 * b * b, xy + 9.0 * a * b);
                }
            }
            let numerator = (2.0 * x * y + 1e-4) * (2.0 * (xy - x * y) + 9e-4);
            let denominator = (x * x + y * y + 1e-4) * ((xx - x * x) + (yy - y * y) + 9e-4);
            let structure = (0.5 - 0.5 * numerator / denominator).clamp(0.0, 1.0);
            let colour = (at(&v[0], 0, 0) - at(&v[1], 0, 0)).abs();
            *out += (SSIM as f32 * structure + (1.0 - SSIM as f32) * colour) / channels as f32;
        }
    }
    out
}

fn benches(c: &mut Criterion) {
    for (batch, h, w) in [(4, 96, 320), (1, 192, 640)] {
        let target = random([batch, h, w, 3]);
        let prediction = target.map(|x| 0.9 * x + 0.05 * (40.0 * x).sin());
        let ours = |v: &[Var<f32>]| v[0].photometric(&v[1], SSIM);
        compare(c, "photometric", &format!("{batch}x{h}x{w}x3"), &[prediction, target], ours, &[("naive", &naive)]);
    }
}

criterion_group!(all, benches);
criterion_main!(all);
