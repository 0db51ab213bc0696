//! Small and strided matrix products: ours from registers, faer's, and matrixmultiply's, by turns on one thread. Every
//! shape is one that the networks or their losses take, or that a user of small networks would.

// Of what the benches share, only the random numbers.
#[allow(dead_code)]
mod common;

use std::hint::black_box;

use common::random;
use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use parallax::tensor::gemm::{Rows, RowsMut, gemm};
use parallax::tensor::gemm_small::sgemm;
use parallax::tensor::{Accum, Var, parallel};

/// Rows, terms and columns of a product, and what it is.
const SHAPES: [(usize, usize, usize, &str); 8] = [
    (4, 4, 4, "a transform of the camera"),
    (8, 8, 8, "one head of nano's attention"),
    (16, 32, 16, "a head of small's"),
    (32, 64, 10, "the last layer of a digits network"),
    (32, 784, 64, "its first layer"),
    (480, 64, 64, "a token mixer at 1/32"),
    (1920, 27, 16, "the first convolution's patches"),
    (256, 256, 256, "a square"),
];

fn products(c: &mut Criterion) {
    for (m, k, n, what) in SHAPES {
        let (x, w) = (Var::constant(random([m, k])), Var::constant(random([k, n])));
        let (a, b) = (x.value().data(), w.value().data());
        let mut group = c.benchmark_group(format!("{m}x{k}x{n}, {what}"));
        group.bench_function(BenchmarkId::from_parameter("register tiles"), |bench| {
            bench.iter(|| parallel::with_threads(1, || black_box(x.linear(&w, None))));
        });
        group.bench_function(BenchmarkId::from_parameter("faer"), |bench| {
            let mut out = vec![0.0; m * n];
            bench.iter(|| {
                let (a, b) = (Rows::dense(a, m, k), Rows::dense(b, k, n));
                gemm(RowsMut::dense(&mut out, m, n), Accum::Replace, a, b, 1.0);
                black_box(&mut out);
            });
        });
        group.bench_function(BenchmarkId::from_parameter("matrixmultiply"), |bench| {
            bench.iter(|| black_box(sgemm(m, k, n, a, b)));
        });
    }
}

criterion_group!(all, products);
criterion_main!(all);
