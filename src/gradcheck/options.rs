//! How to check.

use crate::tensor::Tensor;

/// Settings of a gradient check: step, stencil, tolerance, kinks. The default suits any smooth function of numbers of magnitude one.
#[derive(Clone, Debug)]
pub struct Options {
    /// The step of the differences is this times max(1, |x|).
    pub step: f64,
    /// How many points a difference takes.
    pub stencil: Stencil,
    /// How far analytic and numeric derivatives may be apart.
    pub tolerance: Tolerance,
    /// What to make of elements where the function has no derivative.
    pub kinks: Kinks,
    /// Which inputs are not differentiated.
    pub constant: Vec<usize>,
    /// Which inputs the function rightly ignores here; any other input with a gradient of zeros fails.
    pub ignored: Vec<usize>,
    /// Whether all gradients are rightly zero here.
    pub flat: bool,
    /// What the outputs' differences and the backward pass are met with.
    pub cotangents: Cotangents,
    /// So many random directions for each input that has more elements; every element by itself, without.
    pub directions: Option<usize>,
    /// How far outputs and gradients may differ when everything is run a second time. At 0 they must be the same bits.
    pub nondeterminism: f64,
    /// What the inputs are called in messages; their numbers do where there is no name.
    pub names: Vec<String>,
    /// The seed of cotangents and directions.
    pub seed: u64,
    /// Whether a plain function computes in f32; variables know it themselves.
    pub single: bool,
}

impl Default for Options {
    fn default() -> Self {
        Options {
            step: 6e-6,
            stencil: Stencil::Central,
            tolerance: Tolerance::OfLargest(crate::ops::case::TOLERANCE),
            kinks: Kinks::Exactly(0),
            constant: vec![],
            ignored: vec![],
            flat: false,
            cotangents: Cotangents::Random,
            directions: None,
            nondeterminism: 0.0,
            names: vec![],
            seed: 0,
            single: false,
        }
    }
}

impl Options {
    /// Five points and a longer step: an error of the fourth power of the step, for functions that bend much.
    pub fn five_point() -> Self {
        Options { step: 5e-4, stencil: Stencil::FivePoint, ..Self::default() }
    }

    /// For functions that compute in f32, where a difference quotient has three digits: the cube root of the type's
    /// epsilon as the step, a tolerance of a thousandth.
    pub fn single() -> Self {
        Options { step: 5e-3, tolerance: Tolerance::OfLargest(1e-3), single: true, ..Self::default() }
    }

    /// The inputs that are differentiated, out of `count`.
    pub(super) fn tracked(&self, count: usize) -> Vec<usize> {
        (0..count).filter(|i| !self.constant.contains(i)).collect()
    }

    pub(super) fn name(&self, input: usize) -> String {
        self.names.get(input).map_or_else(|| format!("input {input}"), |name| format!("input {input} ({name})"))
    }
}

/// Stencil of a finite difference.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stencil {
    /// (f(x + h) - f(x - h)) / 2h: exact up to h^2.
    Central,
    /// (8 (f(x + h) - f(x - h)) - (f(x + 2h) - f(x - 2h))) / 12h: exact up to h^4.
    FivePoint,
}

/// Tolerance between analytic and numeric derivatives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Tolerance {
    /// |analytic - numeric| <= this, times the largest analytic derivative of the input.
    OfLargest(f64),
    /// |analytic - numeric| <= `absolute` + `relative` |numeric|, for each element by itself.
    Elementwise {
        /// The part that does not grow.
        absolute: f64,
        /// The part that grows with the derivative.
        relative: f64,
    },
}

impl Tolerance {
    /// What is allowed for a derivative, beside an input whose largest derivative is `scale`.
    pub(super) fn allowed(self, numeric: f64, scale: f64) -> f64 {
        match self {
            // Where the analytic gradient is zero throughout, the numeric one is held to an absolute error.
            Tolerance::OfLargest(part) => part * if scale > 0.0 { scale } else { 1.0 },
            Tolerance::Elementwise { absolute, relative } => absolute + relative * numeric.abs(),
        }
    }
}

/// Treatment of kinks: elements where the one-sided differences disagree. They are listed in the report in any case, and
/// an analytic value that does not lie between the one-sided ones fails in any case.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kinks {
    /// Fail unless there are so many; 0 allows none.
    Exactly(usize),
    /// Allow any number.
    Any,
}

/// Cotangents (the vectors of the vector-Jacobian products) of a check.
#[derive(Clone, Debug)]
pub enum Cotangents {
    /// Random numbers of magnitude 0.5 to 1.5 and either sign: one backward pass, and nothing cancels.
    Random,
    /// Every element of every output by itself: the whole Jacobian, one backward pass for each row.
    OneHot,
    /// These, one a tracked output.
    Given(Vec<Tensor<f64>>),
}
