//! The gradient checker: analytic gradients against finite differences, for any function of [`Var`]s and for plain
//! closures.
//!
//! The cotangent is random, never ones: a sum as the loss would hide every error that cancels in it (softmax and the
//! normalisations would have nothing left to check). Outputs are differenced *before* they meet the cotangent. The error
//! of an input is max |analytic - numeric| / max |analytic| over its elements.
//!
//! Every difference is taken with two steps at least, and with a ladder of steps where those disagree, so that it knows
//! how far it may be off. A report tells apart
//!
//! - **wrong**: analytic and numeric are further apart than the tolerance and what the difference may be off;
//! - **at a kink**: the one-sided differences disagree however short the step. The analytic value must lie between them,
//!   the gradients of elements that tie must add up to what they have together, and a check must say how many kinks it
//!   expects;
//! - **cannot be decided**: no step is short enough for how the function bends and long enough for how it rounds;
//! - and, as [warnings](Report::warnings) of a right gradient: derivatives that rounding blurs, derivatives too small
//!   beside the largest for the tolerance to see, inputs that are stationary here.
//!
//! ```
//! use parallax::gradcheck::{check, Options};
//! use parallax::tensor::Tensor;
//! let x = Tensor::from_vec([3], vec![0.5, -1.0, 2.0]);
//! let report = check(|v| vec![(&v[0] * &v[0]).sigmoid()], &[x], &Options::default());
//! assert!(report.failure().is_none(), "{report}");
//! ```
//!
//! # Which function to call
//!
//! | what you have | call |
//! |---|---|
//! | a function of `Var<f64>`, of `Var<f32>` | [`check`], [`check_f32`] |
//! | an op of your own, with cases | [`check_op`]: all that the ops of this crate are held to |
//! | a model and its loss | [`check_params`] |
//! | a closure over plain numbers, of any library | [`check_fn`] |
//! | second derivatives | [`hvp`], [`check_hvp`] |
//!
//! [`check`] is three steps that can be had one by one: [`gradients`] (by the backward pass), [`differences()`] (by
//! moving one number after the other) and [`Report::new`] (what the two have to do with each other). [`taylor`] needs no
//! step at all.
//!
//! # Check your own op, of any library
//!
//! A function and its vector-Jacobian product over plain slices are enough. The gradient of x sin(x), by hand:
//!
//! ```
//! use parallax::gradcheck::{check_fn, Options};
//! let f = |x: &[f64]| {
//!     let x = x.to_vec();
//!     let y: Vec<f64> = x.iter().map(|x| x * x.sin()).collect();
//!     let vjp = move |g: &[f64]| -> Vec<f64> {
//!         x.iter().zip(g).map(|(x, g)| g * (x.sin() + x * x.cos())).collect()
//!     };
//!     (y, vjp)
//! };
//! let report = check_fn(f, &[0.3, -1.2, 2.0], &Options::default());
//! assert!(report.failure().is_none(), "{report}");
//! ```
//!
//! A custom op of candle, whose loss with the cotangent is a product and a sum (a sketch; in f64 on the CPU):
//!
//! ```ignore
//! let f = |x: &[f64]| {
//!     let x = Var::from_slice(x, x.len(), &Device::Cpu).unwrap();
//!     let y = x.apply_op1(MyOp).unwrap();
//!     let numbers: Vec<f64> = y.to_vec1().unwrap();
//!     (numbers, move |g: &[f64]| {
//!         let g = Tensor::from_slice(g, g.len(), &Device::Cpu).unwrap();
//!         let gradients = (&y * g).unwrap().sum_all().unwrap().backward().unwrap();
//!         gradients.get(&x).unwrap().to_vec1().unwrap()
//!     })
//! };
//! check_fn(f, &numbers, &Options::default());
//! ```
//!
//! The same for burn, with a backend that computes in f32 (a sketch):
//!
//! ```ignore
//! type B = Autodiff<NdArray<f32>>;
//! let f = |x: &[f64]| {
//!     let x = Tensor::<B, 1>::from_data(TensorData::from(x).convert::<f32>(), &device).require_grad();
//!     let y = my_op(x.clone());
//!     let numbers: Vec<f64> = y.to_data().convert::<f64>().to_vec().unwrap();
//!     (numbers, move |g: &[f64]| {
//!         let g = Tensor::<B, 1>::from_data(TensorData::from(g).convert::<f32>(), &device);
//!         let gradients = (y.clone() * g).sum().backward();
//!         x.grad(&gradients).unwrap().into_data().convert::<f64>().to_vec().unwrap()
//!     })
//! };
//! check_fn(f, &numbers, &Options::single());
//! ```
//!
//! # How small an error it notices
//!
//! Twelve functions at eight points, with a gradient that is off as a whole, or in one number by so much of the largest;
//! in percent noticed, each checker with its defaults (`benches/pytorch/detection.py`; PyTorch 2.15, JAX 0.10, in f64):
//!
//! | off by | 1e-7 | 3e-7 | 1e-6 | 1e-5 | 1e-4 | 1e-3 | 3e-3 | right |
//! |---|---|---|---|---|---|---|---|---|
//! | [`check`], all | 0 | 100 | 100 | 100 | 100 | 100 | 100 | 0 |
//! | `torch.autograd.gradcheck`, all | 0 | 0 | 0 | 0 | 0 | 0 | 100 | 0 |
//! | `jax.test_util.check_grads`, all | 0 | 0 | 0 | 1 | 97 | 100 | 100 | 0 |
//! | [`check`], one | 0 | 100 | 100 | 100 | 100 | 100 | 100 | 0 |
//! | `torch.autograd.gradcheck`, one | 0 | 0 | 0 | 43 | 100 | 100 | 100 | 0 |
//! | `jax.test_util.check_grads`, one | 0 | 0 | 0 | 21 | 100 | 100 | 100 | 0 |
//!
//! # What is not there
//!
//! Derivatives in forward mode, complex numbers, sparse tensors, and second derivatives by a backward pass through the
//! backward pass: [`hvp`] takes differences of gradients.

mod cases;
mod differences;
mod function;
mod many;
mod options;
mod outcome;
mod params;
mod pieces;
mod plain;
mod report;
mod second;
mod single;
mod suite;
mod taylor;
#[cfg(test)]
mod tests;

pub use cases::{CaseReport, check_case, draw, options_of};
pub use differences::{Differences, Measured, Quotient, Tie, differences};
pub use many::for_each_case;
pub use options::{Cotangents, Kinks, Options, Stencil, Tolerance};
pub use params::check_params;
pub use pieces::{Crossed, Found, Pieces, Regimes, SIZES};
pub use plain::{Numbers, check_fn};
pub use report::{InputReport, Outside, Report};
pub use second::{Hvp, check_hvp, hvp};
pub use suite::{CHECKS, Check, Complaint, OpReport, Subject, Verdict, check_everything, check_op};
pub use taylor::{taylor, taylor_slope};

use crate::random::{Random, Stream};
use crate::tensor::{Tensor, Var};
use function::{Function, OfVars};

/// Compares the gradient of `f` at `inputs` with finite differences.
///
/// `f` gets one [`Var`] per input and returns its outputs; untracked outputs are not differentiated. It is called many
/// times, and must do the same every time. Nothing panics on a wrong gradient: the report says what is wrong.
pub fn check(f: impl Fn(&[Var<f64>]) -> Vec<Var<f64>>, inputs: &[Tensor<f64>], options: &Options) -> Report {
    check_function(&OfVars::new(f, &options.tracked(inputs.len())), inputs, options)
}

/// [`check`] of a function that computes in f32, with options that follow from [`Options::single`].
///
/// The differences are taken of what the function computes in f32, so that they are known to three digits or so: errors
/// below a thousandth are not seen. A function that is generic over the element type is better checked in f64.
///
/// ```
/// use parallax::gradcheck::{check_f32, Options};
/// use parallax::tensor::Tensor;
/// let x = Tensor::from_vec([3], vec![0.5f32, -1.0, 2.0]);
/// let report = check_f32(|v| vec![(&v[0] * &v[0]).sigmoid()], &[x], &Options::single());
/// assert!(report.failure().is_none(), "{report}");
/// ```
pub fn check_f32(f: impl Fn(&[Var<f32>]) -> Vec<Var<f32>>, inputs: &[Tensor<f32>], options: &Options) -> Report {
    let inputs: Vec<Tensor<f64>> = inputs.iter().map(Tensor::cast).collect();
    check_function(&OfVars::new(f, &options.tracked(inputs.len())), &inputs, options)
}

/// [`check`] of anything that has outputs and a backward pass.
fn check_function(f: &dyn Function, inputs: &[Tensor<f64>], options: &Options) -> Report {
    let outputs = f.recorded(inputs);
    if let Some(why) = unusable(f, &outputs, inputs, options) {
        return Report::broken(why);
    }
    let cotangents: Vec<Vec<Option<Tensor<f64>>>> = match &options.cotangents {
        Cotangents::Random => vec![random_cotangents(&outputs, options.seed)],
        Cotangents::OneHot => one_hot(&outputs),
        Cotangents::Given(given) => match place(&outputs, given) {
            Ok(placed) => vec![placed],
            Err(why) => return Report::broken(why),
        },
    };
    let tracked = options.tracked(inputs.len());
    let mut rows = Vec::new();
    for cotangents in cotangents {
        let once = f.pull(inputs, &cotangents);
        let twice = f.pull(inputs, &cotangents);
        for (i, (a, b)) in once.iter().zip(&twice).enumerate() {
            if let (Some(a), Some(b)) = (a, b)
                && differs(a, b, options.nondeterminism)
            {
                let name = options.name(i);
                return Report::broken(format!("the gradient of {name} differs from one run to the next"));
            }
        }
        match differences::measure(f, inputs, &tracked, &cotangents, options) {
            Ok(measured) => rows.push((Gradients { cotangents, inputs: once }, measured)),
            Err(why) => return Report::broken(why),
        }
    }
    Report::of_rows(&rows.iter().map(|(g, m)| (g, m)).collect::<Vec<_>>(), options)
}

/// Why a function cannot be checked at these inputs, if so.
fn unusable(
    f: &dyn Function,
    outputs: &[(Tensor<f64>, bool)],
    inputs: &[Tensor<f64>],
    options: &Options,
) -> Option<String> {
    if !outputs.iter().any(|(_, tracked)| *tracked) {
        return Some("no output depends on any input by a recorded op".into());
    }
    let again = f.recorded(inputs);
    let shapes = |outputs: &[(Tensor<f64>, bool)]| outputs.iter().map(|(y, _)| *y.shape()).collect::<Vec<_>>();
    if shapes(outputs) != shapes(&again) {
        let (first, second) = (shapes(outputs), shapes(&again));
        return Some(format!("the outputs have shapes {first:?}, and {second:?} when it is called again"));
    }
    for (o, ((y, _), (z, _))) in outputs.iter().zip(&again).enumerate().filter(|(_, ((_, tracked), _))| *tracked) {
        if let Some(k) = y.data().iter().position(|y| y.is_nan()) {
            return Some(format!("output {o}, element {k} is NaN at these inputs: there is nothing to differentiate"));
        }
        if differs(y, z, options.nondeterminism) {
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

/// Analytic gradients, by the backward pass, and the cotangents that they are for.
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
    let tracked = options.tracked(inputs.len());
    let f = OfVars::new(f, &tracked);
    let outputs = f.recorded(inputs);
    let cotangents = random_cotangents(&outputs, options.seed);
    let any = outputs.iter().any(|(_, tracked)| *tracked);
    any.then(|| Gradients { inputs: f.pull(inputs, &cotangents), cotangents })
}

/// A random cotangent for every tracked output: of magnitude 0.5 to 1.5, of either sign, so that no element is lost.
pub fn cotangents(outputs: &[Var<f64>], seed: u64) -> Vec<Option<Tensor<f64>>> {
    let outputs: Vec<_> = outputs.iter().map(|y| (y.value().clone(), y.is_tracked())).collect();
    random_cotangents(&outputs, seed)
}

/// [`cotangents`] of outputs, each with whether it is differentiated.
fn random_cotangents(outputs: &[(Tensor<f64>, bool)], seed: u64) -> Vec<Option<Tensor<f64>>> {
    let mut random = Random::of(seed, Stream::Cotangents);
    let mut draw = |_| random.uniform(0.5, 1.5) * if random.coin() { 1.0 } else { -1.0 };
    let mut fill = |y: &Tensor<f64>| Tensor::from_vec(*y.shape(), (0..y.len()).map(&mut draw).collect());
    outputs.iter().map(|(y, tracked)| tracked.then(|| fill(y))).collect()
}

/// For every element of every tracked output: 1 there, 0 elsewhere.
fn one_hot(outputs: &[(Tensor<f64>, bool)]) -> Vec<Vec<Option<Tensor<f64>>>> {
    let zeros: Vec<_> = outputs.iter().map(|(y, tracked)| tracked.then(|| Tensor::zeros(*y.shape()))).collect();
    let mut all = Vec::new();
    for (o, (y, _)) in outputs.iter().enumerate().filter(|(_, (_, tracked))| *tracked) {
        for k in 0..y.len() {
            let mut hot = zeros.clone();
            hot[o].as_mut().expect("tracked").data_mut()[k] = 1.0;
            all.push(hot);
        }
    }
    all
}

/// Given cotangents, beside the outputs that they belong to.
fn place(outputs: &[(Tensor<f64>, bool)], given: &[Tensor<f64>]) -> Result<Vec<Option<Tensor<f64>>>, String> {
    let shapes: Vec<_> = outputs.iter().filter(|(_, tracked)| *tracked).map(|(y, _)| *y.shape()).collect();
    let found: Vec<_> = given.iter().map(|c| *c.shape()).collect();
    if shapes != found {
        return Err(format!("cotangents of shapes {found:?} were given for outputs of shapes {shapes:?}"));
    }
    let mut given = given.iter().cloned();
    Ok(outputs.iter().map(|(_, tracked)| tracked.then(|| given.next()).flatten()).collect())
}
