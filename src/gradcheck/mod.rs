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

mod cases;

pub use cases::{CaseReport, check_case, draw};

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

/// What the check of one input found.
#[derive(Clone, Debug)]
pub struct InputReport {
    /// max |analytic - numeric| / max |analytic|, kinks left out.
    pub error: f64,
    /// The element where they differ most.
    pub worst: usize,
    /// The analytic derivative there.
    pub analytic: f64,
    /// The numeric derivative there.
    pub numeric: f64,
    /// The largest analytic derivative.
    pub scale: f64,
    /// Elements compared.
    pub elements: usize,
    /// Elements at a kink.
    pub kinks: Vec<usize>,
}

/// What a check found.
#[derive(Clone, Debug)]
pub struct Report {
    /// For each input; `None` for constants.
    pub inputs: Vec<Option<InputReport>>,
    /// The options it was made with.
    pub options: Options,
    /// What made comparison impossible, if anything did.
    pub broken: Option<String>,
}

impl Report {
    /// The largest error of any input.
    pub fn error(&self) -> f64 {
        self.inputs.iter().flatten().map(|i| i.error).fold(0.0, f64::max)
    }

    /// The number of elements compared.
    pub fn elements(&self) -> usize {
        self.inputs.iter().flatten().map(|i| i.elements).sum()
    }

    /// The number of elements at a kink.
    pub fn kinks(&self) -> usize {
        self.inputs.iter().flatten().map(|i| i.kinks.len()).sum()
    }

    /// What is wrong, in a sentence; `None` if nothing is.
    pub fn failure(&self) -> Option<String> {
        if let Some(why) = &self.broken {
            return Some(why.clone());
        }
        for (i, input) in self.inputs.iter().enumerate() {
            let Some(r) = input else { continue };
            if r.error.is_nan() || r.error > self.options.tolerance {
                return Some(format!(
                    "input {i}, element {}: analytic {:e}, numeric {:e}, error {:.1e} of {:.1e} allowed",
                    r.worst, r.analytic, r.numeric, r.error, self.options.tolerance
                ));
            }
        }
        if self.kinks() != self.options.kinks {
            let at: Vec<_> = self.inputs.iter().flatten().map(|i| &i.kinks).collect();
            return Some(format!("{} elements at a kink, {} were declared: {at:?}", self.kinks(), self.options.kinks));
        }
        let zero = self.inputs.iter().flatten().all(|r| r.scale == 0.0);
        if zero != self.options.flat {
            return Some(match zero {
                true => "every gradient is zero: nothing was checked".into(),
                false => "a gradient is not zero, though declared flat".into(),
            });
        }
        None
    }
}

/// Compares the gradient of `f` at `inputs` with central differences.
///
/// `f` gets one [`Var`] per input and returns its outputs; untracked outputs are not differentiated.
pub fn check(f: impl Fn(&[Var<f64>]) -> Vec<Var<f64>>, inputs: &[Tensor<f64>], options: &Options) -> Report {
    let mut report = Report { inputs: vec![None; inputs.len()], options: options.clone(), broken: None };
    let tracked: Vec<usize> = (0..inputs.len()).filter(|i| !options.constant.contains(i)).collect();
    let Some((cotangents, gradients)) = analytic(&f, inputs, &tracked, options.seed) else {
        report.broken = Some("no output depends on any input by a recorded op".into());
        return report;
    };
    let constants = |inputs: &[Tensor<f64>]| inputs.iter().cloned().map(Var::constant).collect::<Vec<_>>();
    let evaluate = |inputs: &[Tensor<f64>]| -> Vec<Tensor<f64>> {
        f(&constants(inputs)).into_iter().map(Var::into_value).collect()
    };
    let centre = evaluate(inputs);
    if centre.iter().zip(&cotangents).any(|(y, c)| c.as_ref().is_some_and(|c| c.shape() != y.shape())) {
        report.broken = Some("the outputs have other shapes when nothing is tracked".into());
        return report;
    }
    for (&i, gradient) in tracked.iter().zip(&gradients) {
        let mut moved = inputs.to_vec();
        let mut numeric = Vec::with_capacity(inputs[i].len());
        let mut kinks = Vec::new();
        let scale = gradient.data().iter().fold(0.0, |m: f64, g| if g.is_nan() { f64::NAN } else { m.max(g.abs()) });
        for k in 0..inputs[i].len() {
            let x = inputs[i].data()[k];
            let h = options.step * x.abs().max(1.0);
            // The step that was really taken, after rounding.
            let (up, down) = (x + h, x - h);
            moved[i].data_mut()[k] = up;
            let above = evaluate(&moved);
            moved[i].data_mut()[k] = down;
            let below = evaluate(&moved);
            moved[i].data_mut()[k] = x;
            let right = slope(&above, &centre, &cotangents, up - x);
            let left = slope(&centre, &below, &cotangents, x - down);
            numeric.push(slope(&above, &below, &cotangents, up - down));
            // A smooth function's one-sided slopes differ by its curvature times the step.
            if (right - left).abs() > 1e-2 * scale.max(left.abs()).max(right.abs()) {
                kinks.push(k);
            }
        }
        report.inputs[i] = Some(compare(gradient, &numeric, scale, kinks));
    }
    report
}

/// Random cotangents for the tracked outputs, and the gradients of the tracked inputs by them.
type Analytic = (Vec<Option<Tensor<f64>>>, Vec<Tensor<f64>>);

fn analytic(
    f: &impl Fn(&[Var<f64>]) -> Vec<Var<f64>>,
    inputs: &[Tensor<f64>],
    tracked: &[usize],
    seed: u64,
) -> Option<Analytic> {
    let tape = Tape::new();
    let vars: Vec<Var<f64>> = (0..inputs.len())
        .map(|i| if tracked.contains(&i) { tape.leaf(inputs[i].clone()) } else { Var::constant(inputs[i].clone()) })
        .collect();
    let outputs = f(&vars);
    let cotangents = cotangents(&outputs, seed);
    let seeds: Vec<_> = outputs.iter().zip(&cotangents).filter_map(|(y, c)| Some((y, c.clone()?))).collect();
    if seeds.is_empty() {
        return None;
    }
    let mut gradients = tape.backward(&seeds);
    let gradients =
        tracked.iter().map(|&i| gradients.take(&vars[i]).unwrap_or_else(|| Tensor::zeros(*inputs[i].shape())));
    Some((cotangents, gradients.collect()))
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

/// The difference of two outputs, met with the cotangents, over the step.
fn slope(above: &[Tensor<f64>], below: &[Tensor<f64>], cotangents: &[Option<Tensor<f64>>], step: f64) -> f64 {
    let mut sum = 0.0;
    for ((a, b), c) in above.iter().zip(below).zip(cotangents) {
        if let Some(c) = c {
            // An infinity that does not move has no slope of its own, and must not become NaN.
            let difference = |(&a, &b): (&f64, &f64)| if a == b { 0.0 } else { a - b };
            sum += a.data().iter().zip(b.data()).map(difference).zip(c.data()).map(|(d, c)| d * c).sum::<f64>();
        }
    }
    sum / step
}

fn compare(analytic: &Tensor<f64>, numeric: &[f64], scale: f64, kinks: Vec<usize>) -> InputReport {
    let mut r =
        InputReport { error: 0.0, worst: 0, analytic: 0.0, numeric: 0.0, scale, elements: analytic.len(), kinks };
    for (k, (&a, &n)) in analytic.data().iter().zip(numeric).enumerate() {
        if r.kinks.contains(&k) {
            continue;
        }
        let difference = (a - n).abs();
        // Where the analytic gradient is zero throughout, the numeric one is held to the same size as an absolute error.
        let error = difference / if scale > 0.0 { scale } else { 1.0 };
        if error.is_nan() || error > r.error {
            (r.error, r.worst, r.analytic, r.numeric) = (error, k, a, n);
        }
    }
    r
}
