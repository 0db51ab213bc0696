//! How small an error of a gradient the checker notices, and whether it cries wolf: a table, one line for each kind and
//! size of error. `benches/pytorch/detection.py` prints the same for PyTorch and JAX beside it.
//!
//! Twelve functions at eight points of five numbers each. The gradient is scaled as a whole, or one of its numbers is off
//! by so much of the largest.

use parallax::gradcheck::{Options, check_fn};
use parallax::random::Random;

type Function = (fn(f64) -> f64, fn(f64) -> f64);

/// Value and derivative: what the Python side has, too.
const FUNCTIONS: [Function; 12] = [
    (|x| x * x, |x| 2.0 * x),
    (|x| x * x * x, |x| 3.0 * x * x),
    (f64::sin, f64::cos),
    (f64::exp, f64::exp),
    (f64::tanh, |x| 1.0 - x.tanh() * x.tanh()),
    (|x| 1.0 / (1.0 + x * x), |x| -2.0 * x / ((1.0 + x * x) * (1.0 + x * x))),
    (|x| (2.0 + x).ln(), |x| 1.0 / (2.0 + x)),
    (|x| (2.0 + x).sqrt(), |x| 0.5 / (2.0 + x).sqrt()),
    (|x| x * x.sin(), |x| x.sin() + x * x.cos()),
    (|x| (10.0 * x).sin(), |x| 10.0 * (10.0 * x).cos()),
    (|x| (-x * x).exp(), |x| -2.0 * x * (-x * x).exp()),
    (|x| x.exp().ln_1p(), |x| 1.0 / (1.0 + (-x).exp())),
];
const POINTS: u64 = 8;
const NUMBERS: usize = 5;

fn noticed(one: bool, error: f64) -> usize {
    let mut count = 0;
    for (f, df) in FUNCTIONS {
        for seed in 0..POINTS {
            let mut random = Random::new(seed, 0);
            let x: Vec<f64> = (0..NUMBERS).map(|_| random.uniform(-1.5, 1.5)).collect();
            let f = |x: &[f64]| {
                let (x, y) = (x.to_vec(), x.iter().map(|&x| f(x)).collect::<Vec<f64>>());
                let vjp = move |g: &[f64]| -> Vec<f64> {
                    let mut d: Vec<f64> = x.iter().zip(g).map(|(&x, g)| g * df(x)).collect();
                    let largest = d.iter().fold(0.0_f64, |m, d| m.max(d.abs()));
                    if one {
                        d[0] += error * largest
                    } else {
                        d.iter_mut().for_each(|d| *d *= 1.0 + error)
                    }
                    d
                };
                (y, vjp)
            };
            count += usize::from(check_fn(f, &x, &Options::default()).failure().is_some());
        }
    }
    count
}

fn main() {
    let of = FUNCTIONS.len() * POINTS as usize;
    for (kind, one) in [("all", false), ("one", true)] {
        for error in [0.0, 1e-8, 1e-7, 3e-7, 1e-6, 1e-5, 1e-4, 1e-3, 3e-3, 1e-2, 1e-1] {
            println!("parallax {kind} {error:e} {} {of}", noticed(one, error));
        }
    }
}
