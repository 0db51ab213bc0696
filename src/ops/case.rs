//! Gradient-check cases: an op, its attributes, and what its inputs are filled with.

use std::fmt;

use crate::random::{Random, Stream};
use crate::tensor::{Shape, Tensor};

/// The largest error that a smooth op may show: |analytic - numeric| / max |analytic|, per input, in f64.
pub const TOLERANCE: f64 = 1e-7;

/// One input of a case.
#[derive(Clone, Debug)]
pub struct Input {
    /// Its name in reports.
    pub name: &'static str,
    /// Its shape.
    pub shape: Shape,
    /// Distribution of its elements.
    pub fill: Fill,
    /// Reason why it is not differentiated, for constants.
    pub constant: Option<&'static str>,
    /// Whether its gradient may rightly be zero in this case, though others are not.
    pub ignored: bool,
}

/// Distribution of an input's elements.
#[derive(Clone, Debug)]
pub enum Fill {
    /// Uniform random numbers.
    Uniform {
        /// The least.
        low: f64,
        /// The greatest.
        high: f64,
    },
    /// Uniform random numbers that keep a distance from given points (kinks).
    Away {
        /// The least.
        low: f64,
        /// The greatest.
        high: f64,
        /// Where the function has no derivative.
        kinks: Vec<f64>,
        /// How far to stay away.
        margin: f64,
    },
    /// Evenly spaced different numbers in random order: no ties, and none nearly so.
    Distinct {
        /// The least.
        low: f64,
        /// The greatest.
        high: f64,
    },
    /// Uniform random numbers, the same for every seed: where a draw could fall on a kink.
    Fixed {
        /// The least.
        low: f64,
        /// The greatest.
        high: f64,
    },
    /// Given numbers.
    Values(Vec<f64>),
}

impl Input {
    fn new(name: &'static str, shape: impl Into<Shape>, fill: Fill) -> Self {
        Input { name, shape: shape.into(), fill, constant: None, ignored: false }
    }

    /// Uniform random numbers in [-1, 1].
    pub fn random(name: &'static str, shape: impl Into<Shape>) -> Self {
        Self::uniform(name, shape, -1.0, 1.0)
    }

    /// Uniform random numbers.
    pub fn uniform(name: &'static str, shape: impl Into<Shape>, low: f64, high: f64) -> Self {
        Self::new(name, shape, Fill::Uniform { low, high })
    }

    /// Uniform random numbers in [low, high] at least 0.01 from the given points, where the function has kinks.
    pub fn away(name: &'static str, shape: impl Into<Shape>, low: f64, high: f64, kinks: &[f64]) -> Self {
        Self::new(name, shape, Fill::Away { low, high, kinks: kinks.to_vec(), margin: 0.01 })
    }

    /// Different numbers in [-1, 1], evenly spaced, in random order: for ops that compare.
    pub fn distinct(name: &'static str, shape: impl Into<Shape>) -> Self {
        Self::distinct_in(name, shape, -1.0, 1.0)
    }

    /// Different numbers, evenly spaced between two others, in random order.
    pub fn distinct_in(name: &'static str, shape: impl Into<Shape>, low: f64, high: f64) -> Self {
        Self::new(name, shape, Fill::Distinct { low, high })
    }

    /// Uniform random numbers that are the same for every seed: for kinks that lie where no rule can keep away from.
    pub fn fixed(name: &'static str, shape: impl Into<Shape>, low: f64, high: f64) -> Self {
        Self::new(name, shape, Fill::Fixed { low, high })
    }

    /// Given numbers.
    ///
    /// # Panics
    /// If their number is not that of the shape.
    #[track_caller]
    pub fn values(name: &'static str, shape: impl Into<Shape>, values: impl Into<Vec<f64>>) -> Self {
        let (shape, values) = (shape.into(), values.into());
        assert_eq!(shape.len(), values.len(), "input {name}");
        Self::new(name, shape, Fill::Values(values))
    }

    /// The same input, declared not differentiable, with the reason.
    pub fn constant(mut self, reason: &'static str) -> Self {
        self.constant = Some(reason);
        self
    }

    /// The same input, whose gradient may rightly be zero in this case though others are not.
    pub fn ignored(mut self) -> Self {
        self.ignored = true;
        self
    }

    /// Draws the numbers.
    pub fn draw(&self, random: &mut Random) -> Tensor<f64> {
        let n = self.shape.len();
        let numbers = match &self.fill {
            Fill::Uniform { low, high } => (0..n).map(|_| random.uniform(*low, *high)).collect(),
            Fill::Away { low, high, kinks, margin } => (0..n)
                .map(|_| {
                    loop {
                        let x = random.uniform(*low, *high);
                        if kinks.iter().all(|k| (x - k).abs() > *margin) {
                            return x;
                        }
                    }
                })
                .collect(),
            Fill::Distinct { low, high } => {
                let mut all: Vec<f64> = (0..n).map(|i| low + (high - low) * (i as f64 + 0.5) / n as f64).collect();
                random.shuffle(&mut all);
                all
            }
            Fill::Fixed { low, high } => {
                let mut random = Random::of(0, Stream::FixedInputs);
                (0..n).map(|_| random.uniform(*low, *high)).collect()
            }
            Fill::Values(values) => values.clone(),
        };
        Tensor::from_vec(self.shape, numbers)
    }
}

/// An op with attributes and inputs on which its gradient is compared with finite differences.
#[derive(Clone, Debug)]
pub struct Case<O> {
    /// The op.
    pub op: O,
    /// Everything else, which does not depend on the op: compiled once, not once for each op.
    pub terms: Box<Terms>,
}

/// The inputs of a [`Case`], and what is promised of its gradients.
#[derive(Clone, Debug)]
pub struct Terms {
    /// The name of the case: what is special about it.
    pub name: &'static str,
    /// The inputs of the op.
    pub inputs: Vec<Input>,
    /// The largest error allowed.
    pub tolerance: f64,
    /// Why the tolerance is looser than [`TOLERANCE`], if it is.
    pub reason: Option<&'static str>,
    /// How many elements sit exactly on a kink, where the function has no derivative.
    pub kinks: usize,
    /// An input, and its gradient for cotangents of one: what the op documents, as on its kinks.
    pub promise: Option<(usize, Vec<f64>)>,
    /// Whether all gradients are zero here, and rightly so.
    pub flat: bool,
}

impl Terms {
    /// The shapes of the inputs.
    pub fn shapes(&self) -> Vec<Shape> {
        self.inputs.iter().map(|i| i.shape).collect()
    }

    fn new(name: &'static str, inputs: Vec<Input>) -> Box<Self> {
        Box::new(Terms { name, inputs, tolerance: TOLERANCE, reason: None, kinks: 0, promise: None, flat: false })
    }
}

impl<O> Case<O> {
    /// A case at the usual tolerance.
    pub fn new(name: &'static str, op: O, inputs: impl Into<Vec<Input>>) -> Self {
        Case { op, terms: Terms::new(name, inputs.into()) }
    }

    /// A case that was drawn: its name says what.
    pub fn drawn(op: O, inputs: impl Into<Vec<Input>>) -> Self
    where
        O: fmt::Debug,
    {
        let inputs = inputs.into();
        let shapes: Vec<Shape> = inputs.iter().map(|input| input.shape).collect();
        // Names live as long as the program; there are some thousands of these at most.
        Self::new(format!("{op:?} of {shapes:?}").leak(), op, inputs)
    }

    /// Allows a larger error, for a reason that is printed.
    pub fn tolerance(mut self, tolerance: f64, reason: &'static str) -> Self {
        (self.terms.tolerance, self.terms.reason) = (tolerance, Some(reason));
        self
    }

    /// Says that this many elements sit on a kink; which value the op has there is [promised](Case::promises).
    pub fn kinks(mut self, count: usize) -> Self {
        self.terms.kinks = count;
        self
    }

    /// Says that the gradient of an input may rightly be zero here, though others are not.
    pub fn ignores(mut self, input: usize) -> Self {
        self.terms.inputs[input].ignored = true;
        self
    }

    /// Says what the gradient of an input is for cotangents of one.
    pub fn promises(mut self, input: usize, gradient: impl Into<Vec<f64>>) -> Self {
        self.terms.promise = Some((input, gradient.into()));
        self
    }

    /// Says that every gradient is rightly zero here (an empty input, a saturated clamp).
    pub fn flat(mut self) -> Self {
        self.terms.flat = true;
        self
    }
}
