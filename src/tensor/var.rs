//! `Var`: a tensor that a tape may track.

use super::data::Tensor;
use super::float::Float;
use super::gradients::Gradients;
use super::shape::Shape;
use super::tape::Tape;

/// A value in a computation. Ops are its methods; each is in the file of its op under `ops`.
///
/// A `Var` that no tape tracks is a constant: ops on constants record and save nothing, which is inference.
#[derive(Clone)]
pub struct Var<T: Float> {
    value: Tensor<T>,
    place: Option<(Tape<T>, usize)>,
}

impl<T: Float> Var<T> {
    /// A value whose gradient nobody wants.
    pub fn constant(value: Tensor<T>) -> Self {
        Var { value, place: None }
    }

    pub(crate) fn tracked(value: Tensor<T>, tape: Tape<T>, slot: usize) -> Self {
        Var { value, place: Some((tape, slot)) }
    }

    /// The value.
    pub fn value(&self) -> &Tensor<T> {
        &self.value
    }

    /// The value alone, giving up the tape.
    pub fn into_value(self) -> Tensor<T> {
        self.value
    }

    /// The shape of the value.
    pub fn shape(&self) -> &Shape {
        self.value.shape()
    }

    /// The extents of the value.
    pub fn dims(&self) -> &[usize] {
        self.value.dims()
    }

    /// Whether a tape tracks it.
    pub fn is_tracked(&self) -> bool {
        self.place.is_some()
    }

    /// The same value as a constant: gradients stop here.
    pub fn detach(&self) -> Self {
        Var::constant(self.value.clone())
    }

    /// The tape that tracks it.
    pub fn tape(&self) -> Option<&Tape<T>> {
        self.place.as_ref().map(|(tape, _)| tape)
    }

    pub(crate) fn slot(&self) -> Option<usize> {
        self.place.as_ref().map(|&(_, slot)| slot)
    }

    pub(crate) fn slot_on(&self, tape: &Tape<T>) -> Option<usize> {
        self.place.as_ref().filter(|(mine, _)| mine.is(tape)).map(|&(_, slot)| slot)
    }

    /// Reverses the tape from this scalar.
    ///
    /// # Panics
    /// If it has more than one element, or no tape tracks it.
    #[track_caller]
    pub fn backward(&self) -> Gradients<T> {
        assert_eq!(
            self.value.len(),
            1,
            "backward() starts from a single number, not from a tensor of shape {}",
            self.shape()
        );
        let tape = self.tape().expect("backward() of a constant: nothing led to it");
        tape.backward(&[(self, Tensor::full(*self.shape(), T::ONE))])
    }
}

impl<T: Float> From<Tensor<T>> for Var<T> {
    fn from(value: Tensor<T>) -> Self {
        Var::constant(value)
    }
}
