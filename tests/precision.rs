//! Functions of one number in f32, over all of f32, against f64: the table that `ops::elementwise` promises.

use parallax::tensor::{Tape, Tensor, Var};

/// A function of a tensor, and the same in f64 with its derivative.
struct Function {
    name: &'static str,
    ours: fn(&Var<f32>) -> Var<f32>,
    value: fn(f64) -> f64,
    slope: fn(f64) -> f64,
    /// Largest error of the value, in units in the last place of f32.
    value_ulp: f64,
    /// The same of the derivative.
    slope_ulp: f64,
    /// Largest error of the derivative beside that, absolute: where it is computed from a rounded result near its limit.
    slope_absolute: f64,
}

/// Below this an error does not count: some last places of the subnormals.
const NOTHING: f64 = 3e-43;

fn phi(x: f64) -> f64 {
    0.5 * libm::erfc(-x / std::f64::consts::SQRT_2)
}

fn density(x: f64) -> f64 {
    (-0.5 * x * x).exp() / (2.0 * std::f64::consts::PI).sqrt()
}

fn sigmoid(x: f64) -> f64 {
    if x >= 0.0 { 1.0 / (1.0 + (-x).exp()) } else { x.exp() / (1.0 + x.exp()) }
}

/// 0 times infinity is 0: the limits at the ends.
fn times(a: f64, b: f64) -> f64 {
    if a == 0.0 || b == 0.0 { 0.0 } else { a * b }
}

fn functions() -> Vec<Function> {
    let f = |name, ours, value, slope, value_ulp, slope_ulp, slope_absolute| Function {
        name,
        ours,
        value,
        slope,
        value_ulp,
        slope_ulp,
        slope_absolute,
    };
    vec![
        f("relu", |x| x.relu(), |x| if x < 0.0 { 0.0 } else { x }, |x| f64::from(x > 0.0), 0.0, 0.0, 0.0),
        f(
            "elu",
            |x| x.elu(),
            |x| if x > 0.0 { x } else { x.exp_m1() },
            |x| if x > 0.0 { 1.0 } else { x.exp() },
            2.0,
            1.0,
            9e-8,
        ),
        f("gelu", |x| x.gelu(), |x| times(x, phi(x)), |x| phi(x) + times(x, density(x)), 5.0, 5.0, 2e-7),
        f(
            "hardswish",
            |x| x.hardswish(),
            |x| times(x, (x + 3.0).clamp(0.0, 6.0)) / 6.0,
            |x| {
                if x >= 3.0 {
                    1.0
                } else if x <= -3.0 {
                    0.0
                } else {
                    (2.0 * x + 3.0) / 6.0
                }
            },
            2.5,
            1.0,
            2e-7,
        ),
        f("sigmoid", |x| x.sigmoid(), sigmoid, |x| sigmoid(x) * sigmoid(-x), 2.5, 2.5, 9e-8),
        f("tanh", |x| x.tanh(), f64::tanh, |x| 1.0 / x.cosh().powi(2), 2.0, 2.0, 2e-7),
        f("exp", |x| x.exp(), f64::exp, f64::exp, 1.0, 1.0, 0.0),
        f("log", |x| x.log(), f64::ln, |x| 1.0 / x, 1.0, 1.0, 0.0),
        f("sqrt", |x| x.sqrt(), f64::sqrt, |x| 0.5 / x.sqrt(), 0.5, 1.5, 0.0),
        f("abs", |x| x.abs(), f64::abs, |x| if x == 0.0 { 0.0 } else { x.signum() }, 0.0, 0.0, 0.0),
        f("reciprocal", |x| x.reciprocal(), |x| 1.0 / x, |x| -1.0 / (x * x), 0.5, 2.5, 0.0),
        f("square", |x| x.square(), |x| x * x, |x| 2.0 * x, 0.5, 0.0, 0.0),
        f("softplus", |x| x.softplus(), |x| x.max(0.0) + (-x.abs()).exp().ln_1p(), sigmoid, 2.0, 2.5, 0.0),
        f(
            "log_sigmoid",
            |x| x.log_sigmoid(),
            |x| x.min(0.0) - (-x.abs()).exp().ln_1p(),
            |x| sigmoid(-x),
            2.0,
            2.5,
            0.0,
        ),
        f(
            "silu",
            |x| x.silu(),
            |x| times(x, sigmoid(x)),
            |x| sigmoid(x) + times(times(x, sigmoid(x)), sigmoid(-x)),
            3.0,
            3.0,
            4e-8,
        ),
        f(
            "leaky_relu",
            |x| x.leaky_relu(0.25),
            |x| if x > 0.0 { x } else { 0.25 * x },
            |x| if x > 0.0 { 1.0 } else { 0.25 },
            0.5,
            0.0,
            0.0,
        ),
        f("relu6", |x| x.relu6(), |x| x.clamp(0.0, 6.0), |x| f64::from(x > 0.0 && x < 6.0), 0.0, 0.0, 0.0),
        f(
            "hardsigmoid",
            |x| x.hardsigmoid(),
            |x| (x / 6.0 + 0.5).clamp(0.0, 1.0),
            |x| if x > -3.0 && x < 3.0 { 1.0 / 6.0 } else { 0.0 },
            3.0,
            0.5,
            0.0,
        ),
    ]
}

/// Numbers from all of f32: every exponent, with several mantissas, both signs, and what is dense around zeros and bends.
fn numbers() -> Vec<f32> {
    let mut all = vec![0.0, -0.0, f32::INFINITY, f32::NEG_INFINITY, f32::NAN];
    for exponent in 0..255u32 {
        for mantissa in [0, 1, 0x2A_AAAA, 0x40_0001, 0x5B_6DB7, 0x7F_FFFF] {
            for sign in [0, 1 << 31] {
                all.push(f32::from_bits(sign | exponent << 23 | mantissa));
            }
        }
    }
    all.extend((-120_000..=120_000).map(|i| i as f32 * 1e-3));
    for bend in [-6.0f32, -3.0, 0.0, 1.0, 3.0, 6.0] {
        for k in 0..2000u32 {
            let near = f32::from_bits(bend.to_bits() + k);
            all.extend([near, bend - (near - bend)]);
        }
    }
    all
}

/// The distance of a number of f32 from the true one, in units in the last place of the true one.
fn error(found: f32, expected: f64) -> (f64, f64) {
    let rounded = expected as f32;
    if expected.is_nan() || found.is_nan() || rounded.is_infinite() || found.is_infinite() {
        let largest = f64::from(f32::MAX);
        // Rounding may overflow just below the largest number, and stay below it just above.
        let near = expected.abs() > 0.999_999 * largest && f64::from(found).abs() > 0.999_999 * largest;
        let same = (expected.is_nan() && found.is_nan()) || found == rounded || near;
        return if same { (0.0, 0.0) } else { (f64::INFINITY, f64::INFINITY) };
    }
    let absolute = (f64::from(found) - expected).abs();
    let exponent = (rounded.to_bits() >> 23 & 0xFF).max(1) as i32;
    (absolute / 2f64.powi(exponent - 127 - 23), absolute)
}

#[test]
fn functions_of_one_number_keep_their_promise_over_all_of_f32() {
    let numbers = numbers();
    let mut failures = Vec::new();
    println!("| function | value, ulp | derivative, ulp | or absolute |");
    for Function { name, ours, value, slope, value_ulp, slope_ulp, slope_absolute } in functions() {
        let tape = Tape::new();
        let x = tape.leaf(Tensor::from_vec([numbers.len()], numbers.clone()));
        let y = ours(&x);
        let values = y.value().clone();
        let mut gradients = tape.backward(&[(&y, Tensor::full([numbers.len()], 1.0f32))]);
        let slopes = gradients.take(&x).expect("a gradient");
        let (mut worst, mut worst_slope, mut worst_absolute) = ((0.0, 0.0f32), (0.0, 0.0f32), 0.0f64);
        for ((&x, &y), &d) in numbers.iter().zip(values.data()).zip(slopes.data()) {
            let (ulp, absolute) = error(y, value(f64::from(x)));
            if absolute > NOTHING && ulp > worst.0 {
                worst = (ulp, x);
            }
            // A derivative at a place where there is none is promised elsewhere.
            if x.is_nan() || [-6.0, -3.0, 0.0, 3.0, 6.0].contains(&x) {
                continue;
            }
            let (ulp, absolute) = error(d, slope(f64::from(x)));
            if absolute > NOTHING.max(slope_absolute) && ulp > worst_slope.0 {
                worst_slope = (ulp, x);
            }
            if ulp > slope_ulp && ulp.is_finite() {
                worst_absolute = worst_absolute.max(absolute);
            }
        }
        println!(
            "| {name} | {:.2} at {:e} | {:.2} at {:e} | {worst_absolute:.1e} |",
            worst.0, worst.1, worst_slope.0, worst_slope.1
        );
        for (what, found, bound) in [("value", worst, value_ulp), ("derivative", worst_slope, slope_ulp)] {
            if found.0 > bound {
                failures.push(format!("{name}: {what} off by {} ulp at {:e}, promised {bound}", found.0, found.1));
            }
        }
    }
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}

/// A row or a channel of numbers whose squares, and even whose sum, overflow f32; and one whose mean is far from 0.
#[test]
fn normalisations_hold_for_any_finite_numbers() {
    let constant = |shape: &[usize], x: Vec<f32>| Var::constant(Tensor::from_vec(shape, x));
    let shape = |n: usize, x: &[f32]| (n, x.to_vec());
    let cases = [
        (shape(4, &[1e20, -1e20, 2e20, -2e20]), [0.632_455_5, -0.632_455_5, 1.264_911, -1.264_911]),
        (shape(4, &[3e38, 2e38, 3e38, 2e38]), [1.0, -1.0, 1.0, -1.0]),
        (shape(4, &[1e6, 1_000_001.0, 1_000_002.0, 1_000_003.0]), [-1.341_635, -0.447_212, 0.447_212, 1.341_635]),
    ];
    for ((n, x), expected) in cases {
        let row = constant(&[1, n], x.clone());
        let layer = row.layer_norm(&constant(&[n], vec![1.0; n]), &constant(&[n], vec![0.0; n]), 1e-5);
        let column = constant(&[n, 1], x);
        let one = |v: f32| constant(&[1], vec![v]);
        let (batch, ..) = column.batch_norm(&one(1.0), &one(0.0), 1e-5, parallax::ops::Activation::None);
        for y in [layer, batch] {
            for (found, expected) in y.value().data().iter().zip(expected) {
                assert!((found - expected).abs() < 2e-5, "{:?}, expected {expected:?}", y.value().data());
            }
        }
    }
}

/// Sums, means, norms, variances and the softmax family over many numbers, huge and tiny ones, and far from 0.
#[test]
fn reductions_keep_their_digits() {
    let constant = |x: &[f32]| Var::constant(Tensor::from_vec([x.len()], x.to_vec()));
    let close = |what: &str, found: f32, expected: f64, ulp: f64| {
        let (error, _) = error(found, expected);
        assert!(error <= ulp, "{what}: {found:e} for {expected:e}, {error} ulp");
    };
    let wide = |x: &[f32]| x.iter().map(|x| f64::from(*x)).collect::<Vec<_>>();
    let many: Vec<f32> = (0..1_000_000).map(|i| 0.1 + (i % 17) as f32 * 1e-3).collect();
    let far: Vec<f32> = (0..10_000).map(|i| 4_000_000.0 + (i % 5) as f32).collect();
    for (name, x) in [("many", &many), ("far from 0", &far)] {
        let numbers = wide(x);
        let (sum, count) = (numbers.iter().sum::<f64>(), numbers.len() as f64);
        close(&format!("sum of {name}"), constant(x).sum_all().value().item(), sum, 8.0);
        close(&format!("mean of {name}"), constant(x).mean_all().value().item(), sum / count, 8.0);
        let var = numbers.iter().map(|v| (v - sum / count).powi(2)).sum::<f64>() / count;
        let found = constant(x).variance(0, 1, 0).value().item();
        assert!((f64::from(found) / var - 1.0).abs() < 1e-4, "variance of {name}: {found} for {var}");
        let last = constant(x).cumsum(0).value().data()[x.len() - 1];
        assert!((f64::from(last) / sum - 1.0).abs() < 1e-4, "running sum of {name}: {last} for {sum}");
    }
    for (name, x) in [("huge", [3e38f32, 1e38, -2e38, 1e20]), ("tiny", [3e-39f32, 1e-40, -2e-39, 1e-45])] {
        let norm = wide(&x).iter().map(|v| v * v).sum::<f64>().sqrt();
        let found = constant(&x).norm(0, 1).value().item();
        assert!((f64::from(found) / norm - 1.0).abs() < 1e-5 || norm > f64::from(f32::MAX), "norm of {name}: {found}");
    }
    let logits = [3e38f32, 3e38, -3e38, 0.0];
    for (found, expected) in constant(&logits).softmax(0).value().data().iter().zip([0.5, 0.5, 0.0, 0.0]) {
        assert_eq!(*found, expected);
    }
    let far = [1e6f32, 1e6 + 1.0, 1e6 - 2.0, 1e6];
    let reference = wide(&far);
    let total = reference.iter().map(|v| (v - 1e6).exp()).sum::<f64>();
    for (k, found) in constant(&far).log_softmax(0).value().data().iter().enumerate() {
        assert!((f64::from(*found) - (reference[k] - 1e6 - total.ln())).abs() < 1e-6, "log softmax {k}: {found}");
    }
    close("log of a sum", constant(&far).log_sum_exp(0).value().item(), 1e6 + total.ln(), 1.0);
}
