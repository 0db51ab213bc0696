//! Convolution: direct loops on one thread, and the whole im2col matrix with one product of faer's, on its own threads.

mod common;

use common::{compare, random};
use criterion::{Criterion, criterion_group, criterion_main};
use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};
use parallax::ops::Conv2d;
use parallax::tensor::{Tensor, Var};

/// `x [batch, h, w, from]` with `w [k, k, from, to]`, zeros around.
fn naive(v: &[Tensor<f32>]) -> Vec<f32> {
    let (x, weights) = (v[0].data(), v[1].data());
    let (&[batch, h, w, from], &[k, _, _, to]) = (v[0].dims(), v[1].dims()) else { panic!("an image and a kernel") };
    let mut y = vec![0.0; batch * h * w * to];
    for (place, y) in y.chunks_exact_mut(to).enumerate() {
        let (sample, row, column) = (place / (h * w), place / w % h, place % w);
        for dy in 0..k {
            for dx in 0..k {
                let (r, c) = ((row + dy).wrapping_sub(k / 2), (column + dx).wrapping_sub(k / 2));
                if r >= h || c >= w {
                    continue;
                }
                for i in 0..from {
                    for o in 0..to {
                        y[o] += x[((sample * h + r) * w + c) * from + i] * weights[((dy * k + dx) * from + i) * to + o];
                    }
                }
            }
        }
    }
    y
}

/// Every pixel's patch is written out as a row of a matrix; then one product.
fn by_faer(v: &[Tensor<f32>]) -> Vec<f32> {
    let x = v[0].data();
    let (&[batch, h, w, from], &[k, _, _, to]) = (v[0].dims(), v[1].dims()) else { panic!("an image and a kernel") };
    let (rows, columns) = (batch * h * w, k * k * from);
    let mut patches = vec![0.0; rows * columns];
    for (place, patch) in patches.chunks_exact_mut(columns).enumerate() {
        let (sample, row, column) = (place / (h * w), place / w % h, place % w);
        for (tap, patch) in patch.chunks_exact_mut(from).enumerate() {
            let (r, c) = ((row + tap / k).wrapping_sub(k / 2), (column + tap % k).wrapping_sub(k / 2));
            if r < h && c < w {
                patch.copy_from_slice(&x[((sample * h + r) * w + c) * from..][..from]);
            }
        }
    }
    let mut y = vec![0.0; rows * to];
    let out = MatMut::from_column_major_slice_mut(&mut y, to, rows).transpose_mut();
    let patches = MatRef::from_row_major_slice(&patches, rows, columns);
    let weights = MatRef::from_row_major_slice(v[1].data(), columns, to);
    matmul(out, Accum::Replace, patches, weights, 1.0, Par::rayon(0));
    y
}

fn benches(c: &mut Criterion) {
    let sizes = [
        (3, 2, 320, 320, 3, 16),
        (3, 4, 96, 320, 8, 8),
        (3, 4, 48, 160, 16, 16),
        (3, 1, 96, 320, 64, 64),
        (1, 4, 48, 160, 32, 32),
        (1, 4, 12, 40, 256, 64),
    ];
    for (k, batch, h, w, from, to) in sizes {
        let inputs = [random([batch, h, w, from]), random([k, k, from, to])];
        let ours = |v: &[Var<f32>]| v[0].conv2d(&v[1], None, Conv2d::padded(k / 2));
        let size = format!("{batch}x{h}x{w}x{from} to {to}");
        compare(c, &format!("conv2d {k}x{k}"), &size, &inputs, ours, &[("naive", &naive), ("faer", &by_faer)]);
    }
}

criterion_group!(all, benches);
criterion_main!(all);
