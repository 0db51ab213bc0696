//! One forward pass: the parameters as variables, what is recorded, and the statistics that move.

use std::cell::RefCell;
use std::collections::HashMap;

use super::Folded;
use super::params::{ParamId, Params};
use crate::random::{Random, Stream};
use crate::tensor::{Float, Gradients, Tape, Tensor, Var, profile};

/// What normalisations do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    /// Use and move the statistics of the batch.
    Training,
    /// Use the running statistics.
    Evaluation,
    /// Nothing: the convolutions in front of them already did.
    Folded,
}

/// What a module needs besides its input.
pub struct Context<T: Float> {
    vars: Vec<Var<T>>,
    mode: Mode,
    /// Running statistics that this pass has moved; later uses in the same pass go on from here.
    moved: RefCell<HashMap<ParamId, Tensor<T>>>,
    /// The dice of DropPath.
    random: RefCell<Random>,
    /// What modules showed, by name; `None` if nobody looks.
    seen: Option<RefCell<HashMap<String, Tensor<T>>>>,
}

impl<T: Float> Context<T> {
    /// Training: parameters are leaves of `tape`, normalisation uses and moves batch statistics.
    pub fn training(params: &Params<T>, tape: &Tape<T>, random: Random) -> Self {
        let var = |p: &super::Param<T>| if p.learnt { tape.leaf(p.value.clone()) } else { p.value.clone().into() };
        let vars = profile::phase("parameters to leaves", || params.iter().map(|(_, p)| var(p)).collect());
        Self::with(vars, Mode::Training, random)
    }

    /// Inference: nothing is recorded, normalisation uses running statistics.
    pub fn inference(params: &Params<T>) -> Self {
        Self::constant(params, Mode::Evaluation)
    }

    /// Inference with normalisations folded into convolutions: what [`inference`](Context::inference) computes, but for
    /// rounding, and faster.
    pub fn folded(params: &Folded<T>) -> Self {
        Self::constant(params.params(), Mode::Folded)
    }

    fn constant(params: &Params<T>, mode: Mode) -> Self {
        let vars =
            profile::phase("parameters to leaves", || params.iter().map(|(_, p)| p.value.clone().into()).collect());
        Self::with(vars, mode, Random::of(0, Stream::Only))
    }

    fn with(vars: Vec<Var<T>>, mode: Mode, random: Random) -> Self {
        Context { vars, mode, moved: RefCell::default(), random: RefCell::new(random), seen: None }
    }

    /// The same pass, looked at: what modules [`observe`](Context::observe) is kept.
    pub fn observed(self) -> Self {
        Context { seen: Some(RefCell::default()), ..self }
    }

    /// Shows an intermediate value to whoever looks, under the path of its module. Nothing happens if nobody does.
    pub fn observe(&self, name: &str, value: &Var<T>) {
        if let Some(seen) = &self.seen {
            seen.borrow_mut().insert(name.to_owned(), value.value().clone());
        }
    }

    /// Takes what the module of this name showed last, if this pass is [`observed`](Context::observed).
    pub fn take_observed(&self, name: &str) -> Option<Tensor<T>> {
        self.seen.as_ref()?.borrow_mut().remove(name)
    }

    /// A parameter as a variable.
    pub fn var(&self, id: ParamId) -> &Var<T> {
        &self.vars[id.0]
    }

    /// Whether this is training.
    pub fn is_training(&self) -> bool {
        self.mode == Mode::Training
    }

    /// Whether normalisations are folded into the convolutions in front of them.
    pub fn is_folded(&self) -> bool {
        self.mode == Mode::Folded
    }

    /// A running statistic as this pass has left it.
    pub fn running(&self, id: ParamId) -> Tensor<T> {
        self.moved.borrow().get(&id).cloned().unwrap_or_else(|| self.vars[id.0].value().clone())
    }

    /// Moves a running statistic: `(1 - momentum) old + momentum new`.
    pub fn move_running(&self, id: ParamId, new: &Tensor<T>, momentum: f64) {
        profile::phase("running statistics", || {
            let mut value = self.running(id);
            let (keep, take) = (T::of(1.0 - momentum), T::of(momentum));
            value.data_mut().iter_mut().zip(new.data()).for_each(|(r, &n)| *r = keep * *r + take * n);
            self.moved.borrow_mut().insert(id, value);
        });
    }

    /// DropPath: zeroes the whole branch of a sample with probability `p`, and divides the kept ones by 1 - p.
    pub fn drop_path(&self, x: Var<T>, p: f64) -> Var<T> {
        if !self.is_training() || p == 0.0 {
            return x;
        }
        let mut dims = vec![1; x.shape().rank()];
        dims[0] = x.dims()[0];
        let mut random = self.random.borrow_mut();
        let mask = (0..dims[0]).map(|_| T::of(if random.unit() < p { 0.0 } else { 1.0 / (1.0 - p) })).collect();
        x * Var::constant(Tensor::from_vec(&dims, mask))
    }

    /// Ends the pass: the running statistics it moved.
    pub fn into_moved(self) -> HashMap<ParamId, Tensor<T>> {
        self.moved.into_inner()
    }

    /// The gradient of every parameter that the output depends on.
    pub fn gradients(&self, gradients: &mut Gradients<T>) -> Vec<Option<Tensor<T>>> {
        profile::phase("leaves to gradients", || self.vars.iter().map(|v| gradients.take(v)).collect())
    }
}
