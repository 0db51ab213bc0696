//! Factorised attention and its convolutional relative position: loops on one thread; the attention also as products of
//! faer's on its own threads.

mod common;

use common::{compare, random};
use criterion::{Criterion, criterion_group, criterion_main};
use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};
use parallax::tensor::{Tensor, Var};

const HEADS: usize = 8;
/// Windows of the relative position, each with its heads.
const WINDOWS: [(usize, usize); 3] = [(3, 2), (5, 3), (7, 3)];

/// Each head's softmax of k over the tokens, `[tokens, c]`, from `qkv [tokens, 3 C]`.
fn softmax(qkv: &[f32], channels: usize, head: usize) -> Vec<f32> {
    let c = channels / HEADS;
    let mut k: Vec<f32> =
        qkv.chunks_exact(3 * channels).flat_map(|row| &row[channels + head * c..][..c]).copied().collect();
    for i in 0..c {
        let largest = k.iter().skip(i).step_by(c).fold(f32::NEG_INFINITY, |m, &x| m.max(x));
        let mut sum = 0.0;
        for x in k.iter_mut().skip(i).step_by(c) {
            *x = (*x - largest).exp();
            sum += *x;
        }
        k.iter_mut().skip(i).step_by(c).for_each(|x| *x /= sum);
    }
    k
}

/// `c^(-1/2) q (softmax(k)^T v)` for each head.
fn naive(v: &[Tensor<f32>]) -> Vec<f32> {
    let &[_, tokens, all] = v[0].dims() else { panic!("tokens") };
    let (channels, c) = (all / 3, all / 3 / HEADS);
    let mut y = vec![0.0; v[0].len() / 3];
    for (qkv, y) in v[0].data().chunks_exact(tokens * all).zip(y.chunks_exact_mut(tokens * channels)) {
        for head in 0..HEADS {
            let (k, at) = (softmax(qkv, channels, head), head * c);
            let mut context = vec![0.0; c * c];
            for (k, row) in k.chunks_exact(c).zip(qkv.chunks_exact(all)) {
                for i in 0..c {
                    for j in 0..c {
                        context[i * c + j] += k[i] * row[2 * channels + at + j];
                    }
                }
            }
            for (y, row) in y.chunks_exact_mut(channels).zip(qkv.chunks_exact(all)) {
                for i in 0..c {
                    for j in 0..c {
                        y[at + j] += row[at + i] * context[i * c + j] / (c as f32).sqrt();
                    }
                }
            }
        }
    }
    y
}

fn by_faer(v: &[Tensor<f32>]) -> Vec<f32> {
    let &[_, tokens, all] = v[0].dims() else { panic!("tokens") };
    let (channels, c) = (all / 3, all / 3 / HEADS);
    let mut y = vec![0.0; v[0].len() / 3];
    for (qkv, y) in v[0].data().chunks_exact(tokens * all).zip(y.chunks_exact_mut(tokens * channels)) {
        let part = |first: usize| MatRef::from_row_major_slice(qkv, tokens, all).subcols(first, c);
        let mut out = MatMut::from_column_major_slice_mut(y, channels, tokens).transpose_mut();
        for head in 0..HEADS {
            let (k, at) = (softmax(qkv, channels, head), head * c);
            let k = MatRef::from_row_major_slice(&k, tokens, c);
            let mut context = vec![0.0; c * c];
            let product = MatMut::from_column_major_slice_mut(&mut context, c, c).transpose_mut();
            matmul(product, Accum::Replace, k.transpose(), part(2 * channels + at), 1.0, Par::rayon(0));
            let context = MatRef::from_row_major_slice(&context, c, c);
            let out = out.as_mut().subcols_mut(at, c);
            matmul(out, Accum::Replace, part(at), context, 1.0 / (c as f32).sqrt(), Par::rayon(0));
        }
    }
    y
}

/// `q * (depthwise convolution of v + bias)`, a window for each range of heads.
fn relative_position(v: &[Tensor<f32>], height: usize, width: usize) -> Vec<f32> {
    let all = v[0].shape().last();
    let (channels, c) = (all / 3, all / 3 / HEADS);
    let mut y = vec![0.0; v[0].len() / 3];
    let samples = v[0].data().chunks_exact(height * width * all);
    for (qkv, y) in samples.zip(y.chunks_exact_mut(height * width * channels)) {
        let mut first = 0;
        for (i, (k, heads)) in WINDOWS.into_iter().enumerate() {
            let (w, b) = (v[1 + 2 * i].data(), v[2 + 2 * i].data());
            for (place, y) in y.chunks_exact_mut(channels).enumerate() {
                for j in 0..heads * c {
                    let mut sum = b[j];
                    for tap in 0..k * k {
                        let row = (place / width + tap / k).wrapping_sub(k / 2);
                        let column = (place % width + tap % k).wrapping_sub(k / 2);
                        if row < height && column < width {
                            sum +=
                                w[tap * heads * c + j] * qkv[(row * width + column) * all + 2 * channels + first + j];
                        }
                    }
                    y[first + j] = qkv[place * all + first + j] * sum;
                }
            }
            first += heads * c;
        }
    }
    y
}

fn benches(c: &mut Criterion) {
    for (height, width, channels) in [(24, 80, 48), (6, 20, 96)] {
        let qkv = random([4, height * width, 3 * channels]);
        let size = format!("4x{height}x{width}x{channels}");
        let ours = |v: &[Var<f32>]| v[0].factorised_attention(HEADS);
        let others: [common::Form; 2] = [("naive", &naive), ("faer", &by_faer)];
        compare(c, "factorised_attention", &size, std::slice::from_ref(&qkv), ours, &others);
        let mut inputs = vec![qkv];
        for (k, heads) in WINDOWS {
            let width = heads * channels / HEADS;
            inputs.extend([random([k, k, width]), random([width])]);
        }
        let ours = |v: &[Var<f32>]| {
            let list: Vec<_> =
                WINDOWS.iter().zip(v[1..].chunks(2)).map(|(&(k, h), wb)| (k, h, &wb[0], &wb[1])).collect();
            v[0].conv_relative_position(height, width, HEADS, &list)
        };
        let plain = |v: &[Tensor<f32>]| relative_position(v, height, width);
        compare(c, "conv_relative_position", &size, &inputs, ours, &[("naive", &plain)]);
    }
}

criterion_group!(all, benches);
criterion_main!(all);
