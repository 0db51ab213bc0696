//! Gradients: accumulated in place by the kernels of the backward pass, read by whoever made the leaves.

use super::data::Tensor;
use super::float::Float;
use super::gemm::Accum;
use super::profile;
use super::shape::Shape;
use super::tape::Tape;
use super::var::Var;

/// The gradients of a node's outputs; `None` for an output that nothing depends on.
pub struct Upstream<T: Float>(pub(crate) Vec<Option<Tensor<T>>>);

impl<T: Float> Upstream<T> {
    /// The gradient of the only differentiable output.
    ///
    /// # Panics
    /// If the op has several differentiable outputs; those take them one by one.
    #[track_caller]
    pub fn only(mut self) -> Tensor<T> {
        assert_eq!(self.0.len(), 1, "only() is for ops with one differentiable output");
        self.0[0].take().expect("a node without upstream gradients is not run")
    }

    /// The gradient of output `i`, if anything depends on it.
    pub fn take(&mut self, i: usize) -> Option<Tensor<T>> {
        self.0[i].take()
    }
}

/// Destination of a backward rule: takes the gradients of the op's inputs.
///
/// An input may appear twice (`f(x, x)`), and may already hold the gradient of another use: both ways in add up.
pub struct GradSink<'a, T: Float> {
    inputs: &'a [Option<usize>],
    slots: &'a mut [Option<Tensor<T>>],
    shapes: &'a [Shape],
}

impl<'a, T: Float> GradSink<'a, T> {
    pub(crate) fn new(inputs: &'a [Option<usize>], slots: &'a mut [Option<Tensor<T>>], shapes: &'a [Shape]) -> Self {
        GradSink { inputs, slots, shapes }
    }

    /// Whether anybody wants the gradient of input `i`.
    pub fn wants(&self, i: usize) -> bool {
        self.inputs.get(i).is_some_and(Option::is_some)
    }

    /// Hands over the finished gradient of input `i`. Ignored if nobody wants it.
    ///
    /// # Panics
    /// If its shape is not that of the input.
    #[track_caller]
    pub fn give(&mut self, i: usize, gradient: Tensor<T>) {
        let Some(slot) = self.inputs[i] else { return };
        assert_eq!(*gradient.shape(), self.shapes[slot], "a gradient has the shape of its input");
        #[cfg(mutants)]
        if super::regime::mutants::overwrites() {
            self.slots[slot] = None;
        }
        match &mut self.slots[slot] {
            Some(sum) => profile::phase("gradient accumulation", || sum.add_assign(&gradient)),
            empty => *empty = Some(gradient),
        }
    }

    /// Lets a kernel write the gradient of input `i` where it belongs: over stale values with [`Accum::Replace`], or
    /// onto what is there with [`Accum::Add`]. Not called if nobody wants it.
    pub fn accumulate(&mut self, i: usize, kernel: impl FnOnce(&mut [T], Accum)) {
        if let Some((out, accum)) = self.place(i) {
            #[cfg(mutants)]
            let accum = if super::regime::mutants::overwrites() { Accum::Replace } else { accum };
            kernel(out, accum);
        }
    }

    /// Where the gradient of input `i` belongs, and whether there is one already.
    fn place(&mut self, i: usize) -> Option<(&mut [T], Accum)> {
        let slot = self.inputs.get(i).copied().flatten()?;
        let accum = if self.slots[slot].is_some() { Accum::Add } else { Accum::Replace };
        let gradient = self.slots[slot].get_or_insert_with(|| Tensor::build(self.shapes[slot], |_| ()));
        Some((gradient.data_mut(), accum))
    }
}

/// The result of a backward pass: the gradient of every leaf that the output depends on.
pub struct Gradients<T: Float> {
    tape: Tape<T>,
    slots: Vec<Option<Tensor<T>>>,
}

impl<T: Float> Gradients<T> {
    pub(crate) fn new(tape: Tape<T>, slots: Vec<Option<Tensor<T>>>) -> Self {
        Gradients { tape, slots }
    }

    /// The gradient of a leaf; `None` if the output does not depend on it.
    ///
    /// Gradients of intermediate values are freed as the backward pass goes.
    pub fn get(&self, leaf: &Var<T>) -> Option<&Tensor<T>> {
        self.slots[leaf.slot_on(&self.tape)?].as_ref()
    }

    /// Takes out the gradient of a leaf; `None` if the output does not depend on it.
    pub fn take(&mut self, leaf: &Var<T>) -> Option<Tensor<T>> {
        self.slots[leaf.slot_on(&self.tape)?].take()
    }
}
