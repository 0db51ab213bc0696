//! Outputs and gradients of an op, in either element type; and how far two such outcomes are apart.

use crate::tensor::{Float, Tape, Tensor, Var};

/// Outputs, and the gradients of the tracked inputs.
pub(super) type Outcome<T> = (Vec<Tensor<T>>, Vec<Option<Tensor<T>>>);

/// How an op runs in an element type.
pub(super) type Run<'a, T> = &'a dyn Fn(&[&Var<T>]) -> Vec<Var<T>>;

/// Leaves where an input is tracked, constants elsewhere.
pub(super) fn leaves<T: Float>(tape: &Tape<T>, inputs: &[Tensor<T>], tracked: &[bool]) -> Vec<Var<T>> {
    let leaf = |(x, &on): (&Tensor<T>, &bool)| if on { tape.leaf(x.clone()) } else { Var::constant(x.clone()) };
    inputs.iter().zip(tracked).map(leaf).collect()
}

/// The cotangents of outputs.
pub(super) type Seeds<'a, T> = &'a dyn Fn(&[Var<T>]) -> Vec<Option<Tensor<T>>>;

/// Runs an op forward and backward. `before` is what each leaf's gradient already holds.
pub(super) fn outcome<T: Float>(
    run: Run<T>,
    inputs: &[Tensor<T>],
    tracked: &[bool],
    seeds: Seeds<T>,
    before: Option<&[Tensor<T>]>,
) -> Outcome<T> {
    let tape = Tape::new();
    let vars = leaves(&tape, inputs, tracked);
    let outputs = run(&vars.iter().collect::<Vec<_>>());
    let mut all: Vec<_> = outputs.iter().zip(seeds(&outputs)).filter_map(|(y, c)| Some((y, c?))).collect();
    if let Some(before) = before {
        all.extend(vars.iter().zip(before).zip(tracked).filter(|(_, on)| **on).map(|((x, c), _)| (x, c.clone())));
    }
    let mut gradients = tape.backward(&all);
    let gradients = vars.iter().map(|x| gradients.take(x)).collect();
    (outputs.into_iter().map(Var::into_value).collect(), gradients)
}

/// Where two outcomes have other bits, if anywhere. A gradient that only one of them has is no difference.
pub(super) fn same<T: Float>(a: &Outcome<T>, b: &Outcome<T>) -> Result<(), String> {
    for (i, (x, y)) in a.0.iter().zip(&b.0).enumerate() {
        if !x.same_bits(y) {
            return Err(format!("output {i} differs"));
        }
    }
    for (i, (x, y)) in a.1.iter().zip(&b.1).enumerate() {
        if let (Some(x), Some(y)) = (x, y)
            && !x.same_bits(y)
        {
            return Err(format!("the gradient of input {i} differs"));
        }
    }
    Ok(())
}

/// The largest difference of two lists of tensors, of the largest number in each tensor; infinite where one is finite and
/// the other is not.
pub(super) fn distance<'a, T: Float, U: Float>(
    found: impl Iterator<Item = &'a Tensor<T>>,
    expected: impl Iterator<Item = &'a Tensor<U>>,
) -> f64 {
    let mut worst = 0.0_f64;
    for (x, y) in found.zip(expected) {
        let scale = y.data().iter().map(|y| y.f64().abs()).filter(|y| y.is_finite()).fold(1e-30, f64::max);
        for (x, y) in x.data().iter().zip(y.data()) {
            let (x, y) = (x.f64(), y.f64());
            worst = worst.max(match (x.is_finite(), y.is_finite()) {
                (true, true) => (x - y).abs() / scale,
                (false, false) => 0.0,
                _ => f64::INFINITY,
            });
        }
    }
    worst
}
