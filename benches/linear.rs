//! The linear layer: three loops on one thread, and one product of faer's on its own threads.

mod common;

use common::{compare, random};
use criterion::{Criterion, criterion_group, criterion_main};
use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};
use parallax::tensor::{Tensor, Var};

/// `y [rows, out] = x [rows, in] w [in, out] + b [out]`.
fn naive(v: &[Tensor<f32>]) -> Vec<f32> {
    let (&[from, to], rows) = (v[1].dims(), v[0].shape().rows()) else { panic!("a matrix") };
    let mut y = v[2].data().repeat(rows);
    for (x, y) in v[0].data().chunks_exact(from).zip(y.chunks_exact_mut(to)) {
        for (x, w) in x.iter().zip(v[1].data().chunks_exact(to)) {
            y.iter_mut().zip(w).for_each(|(y, w)| *y += x * w);
        }
    }
    y
}

fn by_faer(v: &[Tensor<f32>]) -> Vec<f32> {
    let (&[from, to], rows) = (v[1].dims(), v[0].shape().rows()) else { panic!("a matrix") };
    let mut y = v[2].data().repeat(rows);
    let out = MatMut::from_column_major_slice_mut(&mut y, to, rows).transpose_mut();
    let x = MatRef::from_row_major_slice(v[0].data(), rows, from);
    let w = MatRef::from_row_major_slice(v[1].data(), from, to);
    matmul(out, Accum::Add, x, w, 1.0, Par::rayon(0));
    y
}

fn benches(c: &mut Criterion) {
    for (tokens, from, to) in [(24 * 80, 48, 144), (24 * 80, 48, 96), (6 * 20, 96, 192), (12 * 40, 216, 864)] {
        let inputs = [random([4, tokens, from]), random([from, to]), random([to])];
        let ours = |v: &[Var<f32>]| v[0].linear(&v[1], Some(&v[2]));
        let size = format!("4x{tokens}x{from} to {to}");
        compare(c, "linear", &size, &inputs, ours, &[("naive", &naive), ("faer", &by_faer)]);
    }
}

criterion_group!(all, benches);
criterion_main!(all);
