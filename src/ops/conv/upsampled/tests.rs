//! The op against what it stands for: enlarging, then convolving.

use super::*;
use crate::tensor::Tape;

fn numbers<T: Float>(shape: impl Into<Shape>, seed: u64) -> Tensor<T> {
    let shape = shape.into();
    let number = |i: u64| ((i + 17 * seed).wrapping_mul(2654435761) % 1009) as f64 / 504.5 - 1.0;
    Tensor::from_vec(shape, (0..shape.len() as u64).map(|i| T::of(number(i))).collect())
}

/// The largest difference between the two ways, of the value and of every gradient.
fn difference<T: Float>([b, h, w, c]: [usize; 4], channels: &[usize], [k, n]: [usize; 2], op: Conv2d) -> f64 {
    let both = [false, true].map(|enlarged| {
        let tape = Tape::new();
        let small = tape.leaf(numbers::<T>([b, h, w, c], 1));
        let parts: Vec<Var<T>> =
            channels.iter().enumerate().map(|(i, &c)| tape.leaf(numbers([b, 2 * h, 2 * w, c], i as u64 + 2))).collect();
        let weight = tape.leaf(numbers([k, k, c + channels.iter().sum::<usize>(), n], 8));
        let bias = tape.leaf(numbers([n], 9));
        let parts: Vec<&Var<T>> = parts.iter().collect();
        let y = if enlarged {
            let large = small.upsample_nearest(2);
            let all: Vec<&Var<T>> = [&large].into_iter().chain(parts.iter().copied()).collect();
            Var::conv2d_of_parts(&all, &weight, Some(&bias), op)
        } else {
            Var::conv2d_of_upsampled(&small, &parts, &weight, Some(&bias), op)
        };
        let grads = (&y * &Var::constant(numbers(*y.shape(), 10))).sum_all().backward();
        let leaves = [&small, &weight, &bias].into_iter().chain(parts);
        let mut all: Vec<Tensor<T>> = leaves.map(|leaf| grads.get(leaf).expect("a gradient").clone()).collect();
        all.push(y.value().clone());
        all
    });
    let [ours, theirs] = both;
    let pairs = ours.iter().zip(&theirs).flat_map(|(a, b)| a.data().iter().zip(b.data()));
    pairs.map(|(a, b)| (a.f64() - b.f64()).abs()).fold(0.0, f64::max)
}

#[test]
fn it_is_the_convolution_of_the_enlarged_image() {
    let same = Conv2d::padded(1).reflecting();
    for activation in Activation::ALL {
        for (x, channels, kn, op) in [
            ([2, 3, 5, 4], &[][..], [3, 6], same),
            ([2, 3, 5, 4], &[3, 2], [3, 6], same),
            ([1, 1, 1, 3], &[2], [3, 17], same),
            ([1, 24, 40, 16], &[8], [3, 16], same),
            ([2, 4, 3, 5], &[3], [1, 4], Conv2d::default()),
            ([1, 12, 20, 8], &[16, 8], [1, 24], Conv2d::default()),
        ] {
            let difference = difference::<f64>(x, channels, kn, op.activated(activation));
            assert!(difference < 1e-11, "{x:?} {channels:?} {kn:?}: {difference:e}");
        }
    }
}

#[test]
fn and_so_it_is_in_f32() {
    let found = difference::<f32>([1, 12, 20, 16], &[16], [3, 16], Conv2d::padded(1).reflecting());
    assert!(found < 2e-3, "{found:e}");
}

#[test]
#[should_panic(expected = "keeps its size")]
fn no_other_convolution_will_do() {
    difference::<f64>([1, 2, 2, 1], &[], [3, 1], Conv2d::padded(1));
}
