//! The gradient checker: analytic gradients against finite differences in f64, for any function of [`Var`]s.
//!
//! The cotangent is random, never ones: a sum as the loss would hide every error that cancels in it (softmax and the
//! normalisations would have nothing left to check). Outputs are differenced *before* they meet the cotangent. The error
//! of an input is max |analytic - numeric| / max |analytic| over its elements. Where the one-sided differences disagree
//! there is a kink: the analytic value must lie between the one-sided ones, the gradients of elements that tie must add
//! up to what they have together, and a check must say how many kinks it expects.
//!
//! ```
//! use parallax::gradcheck::{check, Options};
//! use parallax::tensor::Tensor;
//! let x = Tensor::from_vec([3], vec![0.5, -1.0, 2.0]);
//! let report = check(|v| vec![(&v[0] * &v[0]).sigmoid()], &[x], &Options::default());
//! assert!(report.failure().is_none(), "{report}");
//! ```
//!
//! [`check`] is three steps that can be had one by one: [`gradients`] (by the backward pass), [`differences()`] (by
//! moving one number after the other) and [`Report::new`] (what the two have to do with each other). [`taylor`] needs no
//! step at all.

mod cases;
mod differences;
mod options;
mod report;
mod taylor;
#[cfg(test)]
mod tests;

pub use cases::{CaseReport, check_case, draw, options_of};
pub use differences::{Differences, Measured, Quotient, Tie, differences};
pub use options::{Cotangents, Kinks, Options, Stencil, Tolerance};
pub use report::{InputReport, Outside, Report};
pub use taylor::{taylor, taylor_slope};

use crate::random::{Random, Stream};
use crate::tensor::{Tape, Tensor, Var};

/// Compares the gradient of `f` at `inputs` with finite differences.
///
/// `f` gets one [`Var`] per input and returns its outputs; untracked outputs are not differentiated. It is called many
/// times, and must do the same every time. Nothing panics on a wrong gradient: the report says what is wrong.
pub fn check(f: impl Fn(&[Var<f64>]) -> Vec<Var<f64>>, inputs: &[Tensor<f64>], options: &Options) -> Report {
    let (outputs, tracked) = evaluate(&f, inputs, options);
    if let Some(why) = unusable(&f, &outputs, inputs, options) {
        return Report::broken(why);
    }
    let cotangents: Vec<Vec<Option<Tensor<f64>>>> = match &options.cotangents {
        Cotangents::Random => vec![cotangents(&outputs, options.seed)],
        Cotangents::OneHot => one_hot(&outputs),
        Cotangents::Given(given) => match place(&outputs, given) {
            Ok(placed) => vec![placed],
            Err(why) => return Report::broken(why),
        },
    };
    drop(outputs);
    let mut rows = Vec::new();
    for cotangents in cotangents {
        let once = gradients_for(&f, inputs, options, &cotangents);
        let twice = gradients_for(&f, inputs, options, &cotangents);
        for (i, (a, b)) in once.inputs.iter().zip(&twice.inputs).enumerate() {
            if let (Some(a), Some(b)) = (a, b)
                && differs(a, b, options.nondeterminism)
            {
                let name = options.name(i);
                return Report::broken(format!("the gradient of {name} differs from one run to the next"));
            }
        }
        match differences(&f, inputs, &tracked, &cotangents, options) {
            Ok(measured) => rows.push((once, measured)),
            Err(why) => return Report::broken(why),
        }
    }
    Report::of_rows(&rows.iter().map(|(g, m)| (g, m)).collect::<Vec<_>>(), options)
}

/// Runs `f` on a tape of its own; and which inputs are tracked.
fn evaluate(
    f: impl Fn(&[Var<f64>]) -> Vec<Var<f64>>,
    inputs: &[Tensor<f64>],
    options: &Options,
) -> (Vec<Var<f64>>, Vec<usize>) {
    let tracked = options.tracked(inputs.len());
    let tape = Tape::new();
    let vars: Vec<_> = (0..inputs.len()).map(|i| leaf(&tape, &inputs[i], tracked.contains(&i))).collect();
    (f(&vars), tracked)
}

fn leaf(tape: &Tape<f64>, value: &Tensor<f64>, tracked: bool) -> Var<f64> {
    if tracked { tape.leaf(value.clone()) } else { Var::constant(value.clone()) }
}

/// Why a function cannot be checked at these inputs, if so.
fn unusable(
    f: impl Fn(&[Var<f64>]) -> Vec<Var<f64>>,
    outputs: &[Var<f64>],
    inputs: &[Tensor<f64>],
    options: &Options,
) -> Option<String> {
    if !outputs.iter().any(Var::is_tracked) {
        return Some("no output depends on any input by a recorded op".into());
    }
    let again = evaluate(f, inputs, options).0;
    let shapes = |outputs: &[Var<f64>]| outputs.iter().map(|y| *y.shape()).collect::<Vec<_>>();
    if shapes(outputs) != shapes(&again) {
        let (first, second) = (shapes(outputs), shapes(&again));
        return Some(format!("the outputs have shapes {first:?}, and {second:?} when it is called again"));
    }
    for (o, (y, z)) in outputs.iter().zip(&again).enumerate().filter(|(_, (y, _))| y.is_tracked()) {
        if let Some(k) = y.value().data().iter().position(|y| y.is_nan()) {
            return Some(format!("output {o}, element {k} is NaN at these inputs: there is nothing to differentiate"));
        }
        if differs(y.value(), z.value(), options.nondeterminism) {
            return Some(format!("output {o} differs from one call to the next, on the same inputs"));
        }
    }
    None
}

/// Whether two tensors of one shape are further apart than allowed; at 0, whether a bit differs.
fn differs(a: &Tensor<f64>, b: &Tensor<f64>, allowed: f64) -> bool {
    let apart = |(a, b): (&f64, &f64)| (a - b).abs() > allowed || a.is_nan() != b.is_nan();
    !a.same_bits(b) && (allowed == 0.0 || a.data().iter().zip(b.data()).any(apart))
}

/// The analytic side: what the backward pass says.
#[derive(Clone, Debug)]
pub struct Gradients {
    /// The cotangent of every tracked output.
    pub cotangents: Vec<Option<Tensor<f64>>>,
    /// The gradient of every input; `None` for constants.
    pub inputs: Vec<Option<Tensor<f64>>>,
}

/// The gradients of `f` at `inputs` by the backward pass, for random cotangents; `None` if no output is tracked.
pub fn gradients(
    f: impl Fn(&[Var<f64>]) -> Vec<Var<f64>>,
    inputs: &[Tensor<f64>],
    options: &Options,
) -> Option<Gradients> {
    let outputs = evaluate(&f, inputs, options).0;
    let cotangents = cotangents(&outputs, options.seed);
    outputs.iter().any(Var::is_tracked).then(|| gradients_for(f, inputs, options, &cotangents))
}

/// The gradients for given cotangents of the tracked outputs.
fn gradients_for(
    f: impl Fn(&[Var<f64>]) -> Vec<Var<f64>>,
    inputs: &[Tensor<f64>],
    options: &Options,
    cotangents: &[Option<Tensor<f64>>],
) -> Gradients {
    let tracked = options.tracked(inputs.len());
    let tape = Tape::new();
    let vars: Vec<_> = (0..inputs.len()).map(|i| leaf(&tape, &inputs[i], tracked.contains(&i))).collect();
    let outputs = f(&vars);
    let seeds: Vec<_> = outputs.iter().zip(cotangents).filter_map(|(y, c)| Some((y, c.clone()?))).collect();
    let mut all = tape.backward(&seeds);
    let mut take = |i: usize| all.take(&vars[i]).unwrap_or_else(|| Tensor::zeros(*inputs[i].shape()));
    let inputs = (0..inputs.len()).map(|i| tracked.contains(&i).then(|| take(i))).collect();
    Gradients { cotangents: cotangents.to_vec(), inputs }
}

/// A random cotangent for every tracked output: of magnitude 0.5 to 1.5, of either sign, so that no element is lost.
pub fn cotangents(outputs: &[Var<f64>], seed: u64) -> Vec<Option<Tensor<f64>>> {
    let mut random = Random::of(seed, Stream::Cotangents);
    outputs
        .iter()
        .map(|y| {
            y.is_tracked().then(|| {
                Tensor::build(*y.shape(), |out| {
                    out.iter_mut().for_each(|c| *c = random.uniform(0.5, 1.5) * if random.coin() { 1.0 } else { -1.0 })
                })
            })
        })
        .collect()
}

/// For every element of every tracked output: 1 there, 0 elsewhere.
fn one_hot(outputs: &[Var<f64>]) -> Vec<Vec<Option<Tensor<f64>>>> {
    let zeros: Vec<_> = outputs.iter().map(|y| y.is_tracked().then(|| Tensor::zeros(*y.shape()))).collect();
    let mut all = Vec::new();
    for (o, y) in outputs.iter().enumerate().filter(|(_, y)| y.is_tracked()) {
        for k in 0..y.value().len() {
            let mut hot = zeros.clone();
            hot[o].as_mut().expect("tracked").data_mut()[k] = 1.0;
            all.push(hot);
        }
    }
    all
}

/// Given cotangents, beside the outputs that they belong to.
fn place(outputs: &[Var<f64>], given: &[Tensor<f64>]) -> Result<Vec<Option<Tensor<f64>>>, String> {
    let shapes: Vec<_> = outputs.iter().filter(|y| y.is_tracked()).map(|y| *y.shape()).collect();
    let found: Vec<_> = given.iter().map(|c| *c.shape()).collect();
    if shapes != found {
        return Err(format!("cotangents of shapes {found:?} were given for outputs of shapes {shapes:?}"));
    }
    let mut given = given.iter().cloned();
    Ok(outputs.iter().map(|y| y.is_tracked().then(|| given.next()).flatten()).collect())
}
