//! What is checked: a function with a backward pass, in whatever element type it computes.

use crate::tensor::{Float, Tape, Tensor, Var};

/// A function as the checker sees it: numbers in f64 on the outside, whatever it computes in inside.
pub(super) trait Function {
    /// The distance from 1 to the next number that it computes with.
    fn epsilon(&self) -> f64;
    /// The nearest number that it can take.
    fn round(&self, x: f64) -> f64;
    /// The outputs while gradients are recorded, and which of them are differentiated.
    fn recorded(&self, inputs: &[Tensor<f64>]) -> Vec<(Tensor<f64>, bool)>;
    /// The outputs alone.
    fn values(&self, inputs: &[Tensor<f64>]) -> Vec<Tensor<f64>>;
    /// The gradient of every tracked input, for cotangents of the outputs that are differentiated.
    fn pull(&self, inputs: &[Tensor<f64>], cotangents: &[Option<Tensor<f64>>]) -> Vec<Option<Tensor<f64>>>;
}

/// A function of variables on a tape.
pub(super) struct OfVars<'a, F, T> {
    pub f: F,
    /// Which inputs are differentiated.
    pub tracked: &'a [usize],
    pub element: std::marker::PhantomData<T>,
}

impl<'a, F: Fn(&[Var<T>]) -> Vec<Var<T>>, T: Float> OfVars<'a, F, T> {
    pub fn new(f: F, tracked: &'a [usize]) -> Self {
        OfVars { f, tracked, element: std::marker::PhantomData }
    }

    fn vars(&self, tape: &Tape<T>, inputs: &[Tensor<f64>]) -> Vec<Var<T>> {
        let var = |(i, x): (usize, &Tensor<f64>)| {
            if self.tracked.contains(&i) { tape.leaf(x.cast()) } else { Var::constant(x.cast()) }
        };
        inputs.iter().enumerate().map(var).collect()
    }
}

impl<F: Fn(&[Var<T>]) -> Vec<Var<T>>, T: Float> Function for OfVars<'_, F, T> {
    fn epsilon(&self) -> f64 {
        T::EPSILON.f64()
    }

    fn round(&self, x: f64) -> f64 {
        T::of(x).f64()
    }

    fn recorded(&self, inputs: &[Tensor<f64>]) -> Vec<(Tensor<f64>, bool)> {
        let outputs = (self.f)(&self.vars(&Tape::new(), inputs));
        outputs.iter().map(|y| (y.value().cast(), y.is_tracked())).collect()
    }

    fn values(&self, inputs: &[Tensor<f64>]) -> Vec<Tensor<f64>> {
        let constants: Vec<_> = inputs.iter().map(|x| Var::constant(x.cast())).collect();
        (self.f)(&constants).iter().map(|y| y.value().cast()).collect()
    }

    fn pull(&self, inputs: &[Tensor<f64>], cotangents: &[Option<Tensor<f64>>]) -> Vec<Option<Tensor<f64>>> {
        let tape = Tape::new();
        let vars = self.vars(&tape, inputs);
        let outputs = (self.f)(&vars);
        let seeds: Vec<_> = outputs.iter().zip(cotangents).filter_map(|(y, c)| Some((y, c.as_ref()?.cast()))).collect();
        let mut all = tape.backward(&seeds);
        let mut take = |i: usize| all.take(&vars[i]).map_or_else(|| Tensor::zeros(*inputs[i].shape()), |g| g.cast());
        (0..inputs.len()).map(|i| self.tracked.contains(&i).then(|| take(i))).collect()
    }
}
