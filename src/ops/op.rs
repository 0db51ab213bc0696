//! What an op is.

use std::fmt;

use super::apply::execute;
use super::case::Case;
use crate::random::Random;
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var};

/// A differentiable function of tensors: its shape rule, its forward pass, its gradient, and (by [`Checked`]) the
/// cases that prove the gradient, side by side in one file.
///
/// An op is a small struct that holds its attributes (stride, axis, eps). It gets plain [`Tensor`]s, so that a backward
/// rule cannot record by accident. Optional inputs (a bias) come last: `inputs.get(2)`.
pub trait Op<T: Float>: Registered + Checked + Clone + 'static {
    /// What the backward pass needs.
    type Saved: 'static;

    /// The shapes of the outputs, or why the inputs do not fit.
    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError>;

    /// How many of the outputs, at the end, are results that nobody differentiates (batch statistics, an index).
    fn auxiliary(&self) -> usize {
        0
    }

    /// The kernel path that these inputs take: coverage tells fast paths apart by it.
    fn algo(&self, inputs: &[Shape]) -> &'static str {
        let _ = inputs;
        "direct"
    }

    /// Multiplications and additions (counted as two) of the forward pass; 0 where it is not a matter of arithmetic.
    fn flops(&self, inputs: &[Shape]) -> u64 {
        let _ = inputs;
        0
    }

    /// The least memory traffic, in elements: of the forward pass, and of the backward pass to the gradients that are
    /// wanted. Unless an op says otherwise, the first reads its inputs and writes its outputs, the second reads its
    /// inputs and the outputs' gradients and writes the inputs', each element once.
    fn traffic(&self, inputs: &[Shape], outputs: &[Shape], needs: &Needs) -> [u64; 2] {
        let elements = |shapes: &[Shape]| shapes.iter().map(|s| s.len() as u64).sum::<u64>();
        let once = elements(inputs) + elements(outputs);
        [once, once + gradients(inputs, needs)]
    }

    /// Computes the outputs, and what the backward pass needs of those inputs whose gradient somebody wants.
    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved);

    /// Turns the gradients of the outputs into those of the inputs.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>);
}

/// The [`traffic`](Op::traffic) of an op whose gradient needs none of its inputs, only the outputs' gradients.
pub(super) fn traffic_without_inputs(inputs: &[Shape], outputs: &[Shape], needs: &Needs) -> [u64; 2] {
    let elements = |shapes: &[Shape]| shapes.iter().map(|s| s.len() as u64).sum::<u64>();
    [elements(inputs) + elements(outputs), elements(outputs) + gradients(inputs, needs)]
}

/// Elements of the gradients that are wanted.
fn gradients(inputs: &[Shape], needs: &Needs) -> u64 {
    inputs.iter().enumerate().filter(|&(i, _)| needs.get(i)).map(|(_, s)| s.len() as u64).sum()
}

/// An op that is in the registry, under its name there; or a [`CustomOp`].
pub trait Registered: Sized {
    /// The name, in snake case.
    const NAME: &'static str;

    /// Runs the op by code that was compiled where the op stands. Called by `apply` alone.
    #[doc(hidden)]
    fn run<T: Float>(self, inputs: &[&Var<T>]) -> Result<Vec<Var<T>>, String>
    where
        Self: Op<T>;
}

/// An op from outside this crate. It has the same duties: cases are required.
pub trait CustomOp {
    /// The name, in snake case.
    const NAME: &'static str;
}

impl<O: CustomOp> Registered for O {
    const NAME: &'static str = <O as CustomOp>::NAME;

    fn run<T: Float>(self, inputs: &[&Var<T>]) -> Result<Vec<Var<T>>, String>
    where
        Self: Op<T>,
    {
        execute(self, inputs)
    }
}

/// An op with gradient-check cases. There is no default: an op without cases does not build.
///
/// This builds:
///
/// ```
/// # use parallax::ops::{registry::Entry, Case, Checked, CustomOp, Input, Needs, Op, ShapeError};
/// # use parallax::tensor::{Float, GradSink, Shape, Tensor, Upstream};
/// #[derive(Clone)]
/// struct Identity;
/// impl CustomOp for Identity { const NAME: &'static str = "identity"; }
/// impl Checked for Identity { fn cases() -> Vec<Case<Self>> { vec![Case::new("any", Identity, [Input::random("x", [3])])] } }
/// impl<T: Float> Op<T> for Identity {
///     // ...
/// #   type Saved = ();
/// #   fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> { Ok(vec![inputs[0]]) }
/// #   fn forward(&self, x: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, ()) { (vec![x[0].clone()], ()) }
/// #   fn backward(&self, _: (), upstream: Upstream<T>, sink: &mut GradSink<T>) { sink.give(0, upstream.only()); }
/// }
/// let entry = Entry::of::<Identity>();
/// assert_eq!(entry.cases().len(), 1);
/// ```
///
/// The same without its cases does not:
///
/// ```compile_fail
/// # use parallax::ops::{registry::Entry, Case, Checked, CustomOp, Input, Needs, Op, ShapeError};
/// # use parallax::tensor::{Float, GradSink, Shape, Tensor, Upstream};
/// #[derive(Clone)]
/// struct Identity;
/// impl CustomOp for Identity { const NAME: &'static str = "identity"; }
/// impl<T: Float> Op<T> for Identity {
///     // ...
/// #   type Saved = ();
/// #   fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> { Ok(vec![inputs[0]]) }
/// #   fn forward(&self, x: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, ()) { (vec![x[0].clone()], ()) }
/// #   fn backward(&self, _: (), upstream: Upstream<T>, sink: &mut GradSink<T>) { sink.give(0, upstream.only()); }
/// }
/// let entry = Entry::of::<Identity>();
/// assert_eq!(entry.cases().len(), 1);
/// ```
///
/// Nor does it without a name, which ops of this crate get from their line in the registry:
///
/// ```compile_fail
/// # use parallax::ops::{registry::Entry, Case, Checked, CustomOp, Input, Needs, Op, ShapeError};
/// # use parallax::tensor::{Float, GradSink, Shape, Tensor, Upstream};
/// #[derive(Clone)]
/// struct Identity;
/// impl Checked for Identity { fn cases() -> Vec<Case<Self>> { vec![Case::new("any", Identity, [Input::random("x", [3])])] } }
/// impl<T: Float> Op<T> for Identity {
///     // ...
/// #   type Saved = ();
/// #   fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> { Ok(vec![inputs[0]]) }
/// #   fn forward(&self, x: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, ()) { (vec![x[0].clone()], ()) }
/// #   fn backward(&self, _: (), upstream: Upstream<T>, sink: &mut GradSink<T>) { sink.give(0, upstream.only()); }
/// }
/// let entry = Entry::of::<Identity>();
/// assert_eq!(entry.cases().len(), 1);
/// ```
pub trait Checked: Sized {
    /// Inputs on which the gradient is compared with finite differences: every kernel path, every input perturbed.
    fn cases() -> Vec<Case<Self>>;

    /// A case with attributes and sizes drawn from their ranges, more often than not at an end of them: how the
    /// combinations that nobody listed are checked. One that the op's shape rule refuses is drawn again. `None` for an op
    /// of which there is nothing to combine.
    fn draw(_: &mut Random) -> Option<Case<Self>> {
        None
    }
}

/// Inputs whose gradients are wanted. Known in the forward pass, so that inference and frozen parts save nothing.
#[derive(Clone, Debug)]
pub struct Needs(pub(crate) Vec<bool>);

impl Needs {
    /// Whether the gradient of input `i` is wanted (an absent optional input's is not).
    pub fn get(&self, i: usize) -> bool {
        self.0.get(i).copied().unwrap_or(false)
    }

    /// Whether any is wanted: whether there will be a backward pass.
    pub fn any(&self) -> bool {
        self.0.contains(&true)
    }
}

/// Error of a shape rule: why the inputs do not fit an op.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ShapeError(pub String);

impl ShapeError {
    /// An error with a message; the op's name and the shapes are added by `apply`.
    pub fn new(message: impl Into<String>) -> Self {
        ShapeError(message.into())
    }
}

impl fmt::Display for ShapeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for ShapeError {}
