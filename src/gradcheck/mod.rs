//! The gradient checker: analytic gradients against central differences, coordinate by coordinate, in f64.
//!
//! The cotangent is random, never ones: a sum as the loss would hide every error that cancels in it (softmax and the
//! normalisations would have nothing left to check). Outputs are differenced *before* they meet the cotangent. The error
//! of an input is max |analytic - numeric| / max |analytic| over its elements. Where the one-sided differences disagree
//! there is a kink: it is counted, and a case must say how many it has.
//!
//! ```
//! use parallax::gradcheck::{check, Options};
//! use parallax::tensor::Tensor;
//! let x = Tensor::from_vec([3], vec![0.5, -1.0, 2.0]);
//! let report = check(|v| vec![(&v[0] * &v[0]).sigmoid()], &[x], &Options::default());
//! assert!(report.failure().is_none(), "{report:?}");
//! ```
//!
//! [`check`] is three steps that can be had one by one: [`gradients`] (by the backward pass), [`differences()`] (by
//! moving one number after the other) and [`Report::new`] (what the two have to do with each other).

mod cases;
mod differences;
mod report;
mod taylor;

pub use cases::{CaseReport, check_case, draw, options_of};
pub use differences::{Differences, differences};
pub use report::{InputReport, Report};
pub use taylor::taylor_slope;

use crate::random::Random;
use crate::tensor::{Tape, Tensor, Var};

/// How to check.
#[derive(Clone, Debug)]
pub struct Options {
    /// The step is this times max(1, |x|).
    pub step: f64,
    /// The largest error allowed.
    pub tolerance: f64,
    /// How many elements may sit on a kink; exactly so many are expected.
    pub kinks: usize,
    /// Which inputs are constants.
    pub constant: Vec<usize>,
    /// Whether a gradient that is zero throughout is expected.
    pub flat: bool,
    /// The seed of the cotangents.
    pub seed: u64,
}

impl Default for Options {
    fn default() -> Self {
        Options { step: 6e-6, tolerance: crate::ops::case::TOLERANCE, kinks: 0, constant: vec![], flat: false, seed: 0 }
    }
}

impl Options {
    /// The inputs that are differentiated, out of `count`.
    fn tracked(&self, count: usize) -> Vec<usize> {
        (0..count).filter(|i| !self.constant.contains(i)).collect()
    }
}

/// Compares the gradient of `f` at `inputs` with central differences.
///
/// `f` gets one [`Var`] per input and returns its outputs; untracked outputs are not differentiated.
pub fn check(f: impl Fn(&[Var<f64>]) -> Vec<Var<f64>>, inputs: &[Tensor<f64>], options: &Options) -> Report {
    let Some(gradients) = gradients(&f, inputs, options) else {
        return Report::broken(options, "no output depends on any input by a recorded op");
    };
    let tracked = options.tracked(inputs.len());
    match differences(&f, inputs, &tracked, &gradients.cotangents, options.step) {
        Ok(differences) => Report::new(&gradients, &differences, options),
        Err(why) => Report::broken(options, why),
    }
}

/// The analytic side: what the backward pass says.
#[derive(Clone, Debug)]
pub struct Gradients {
    /// The random cotangent of every tracked output.
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
    let tape = Tape::new();
    let tracked = options.tracked(inputs.len());
    let vars: Vec<Var<f64>> = (0..inputs.len())
        .map(|i| if tracked.contains(&i) { tape.leaf(inputs[i].clone()) } else { Var::constant(inputs[i].clone()) })
        .collect();
    let outputs = f(&vars);
    let cotangents = cotangents(&outputs, options.seed);
    let seeds: Vec<_> = outputs.iter().zip(&cotangents).filter_map(|(y, c)| Some((y, c.clone()?))).collect();
    if seeds.is_empty() {
        return None;
    }
    let mut all = tape.backward(&seeds);
    let mut take = |i: usize| all.take(&vars[i]).unwrap_or_else(|| Tensor::zeros(*inputs[i].shape()));
    let inputs = (0..inputs.len()).map(|i| tracked.contains(&i).then(|| take(i))).collect();
    Some(Gradients { cotangents, inputs })
}

/// A random cotangent for every tracked output: of magnitude 0.5 to 1.5, of either sign, so that no element is lost.
pub fn cotangents(outputs: &[Var<f64>], seed: u64) -> Vec<Option<Tensor<f64>>> {
    let mut random = Random::new(seed, 0xC07);
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
