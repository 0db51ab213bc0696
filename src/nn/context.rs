//! One forward pass: the parameters as variables, what is recorded, and the statistics that move.

use std::cell::{Cell, RefCell};
use std::collections::HashMap;
use std::rc::Rc;
use std::sync::Arc;

use super::Folded;
use super::params::{Identity, ParamId, Params};
use crate::random::{Random, Stream};
use crate::tensor::{Float, Gradients, Precision, Tape, Tensor, Var, profile, recompute};

/// Mode of normalisation layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    /// Use and move the statistics of the batch.
    Training,
    /// Use the running statistics.
    Evaluation,
    /// Nothing: the convolutions in front of them already did.
    Folded,
}

/// Context of one forward pass: the parameters as variables, the mode, running statistics, dropout's random numbers.
///
/// A training step ends with [`into_moved`](Context::into_moved), which gives the running statistics that it moved: a
/// context that gave its gradients and is dropped with statistics in it panics, because a model whose statistics stay
/// behind its weights trains well and predicts badly.
pub struct Context<T: Float> {
    vars: Vec<Var<T>>,
    identities: Arc<Vec<Identity>>,
    mode: Mode,
    precision: Precision,
    /// Running statistics that this pass has moved; later uses in the same pass go on from here.
    moved: RefCell<HashMap<ParamId, Tensor<T>>>,
    /// The dice of DropPath.
    random: RefCell<Random>,
    /// What modules showed, by name; `None` if nobody looks.
    seen: Option<RefCell<HashMap<String, Tensor<T>>>>,
    /// Whether gradients were taken, so that this is a training step.
    differentiated: Cell<bool>,
    /// Whether parts that offer it run once more in the backward pass instead of keeping what they computed.
    recomputing: bool,
    /// The parameters and statistics that stay as they are, by index; empty for none.
    frozen: Arc<[bool]>,
}

impl<T: Float> Context<T> {
    /// Training: parameters are leaves of `tape`, normalisation uses and moves batch statistics.
    pub fn training(params: &Params<T>, tape: &Tape<T>, random: Random) -> Self {
        Self::training_part(params, tape, random, Arc::default())
    }

    /// Training of a part: parameters that are `frozen` (by their order in `params`) are constants without a gradient, and
    /// normalisations whose statistics are frozen use those, as in inference, and do not move them. What has no entry is
    /// not frozen.
    pub fn training_part(params: &Params<T>, tape: &Tape<T>, random: Random, frozen: Arc<[bool]>) -> Self {
        let constant = |i: usize| frozen.get(i).copied().unwrap_or(false);
        let var = |(i, (_, p)): (usize, (ParamId, &super::Param<T>))| {
            if p.learnt && !constant(i) { tape.leaf(p.value.clone()) } else { p.value.clone().into() }
        };
        let vars = profile::phase("parameters to leaves", || params.iter().enumerate().map(var).collect());
        let mut context = Self::with(params, vars, Mode::Training, random);
        context.frozen = frozen;
        context
    }

    /// Inference: nothing is recorded, normalisation uses running statistics.
    pub fn inference(params: &Params<T>) -> Self {
        Self::constant(params, Mode::Evaluation)
    }

    /// Inference with normalisations folded into convolutions: what [`inference`](Context::inference) computes, but for
    /// rounding, and faster.
    pub fn folded(params: &Folded<T>) -> Self {
        let mut context = Self::constant(params.params(), Mode::Folded);
        context.precision = params.precision();
        context
    }

    fn constant(params: &Params<T>, mode: Mode) -> Self {
        let vars =
            profile::phase("parameters to leaves", || params.iter().map(|(_, p)| p.value.clone().into()).collect());
        Self::with(params, vars, mode, Random::of(0, Stream::Only))
    }

    fn with(params: &Params<T>, vars: Vec<Var<T>>, mode: Mode, random: Random) -> Self {
        let identities = params.identities();
        let (moved, random) = (RefCell::default(), RefCell::new(random));
        Context {
            vars,
            identities,
            mode,
            precision: Precision::F32,
            moved,
            random,
            seen: None,
            differentiated: Cell::new(false),
            recomputing: false,
            frozen: Arc::default(),
        }
    }

    /// This pass with the parts that offer it ([`part`](Context::part)) computed again in the backward pass: less memory,
    /// more arithmetic.
    pub fn recomputing(mut self, recomputing: bool) -> Self {
        self.recomputing = recomputing;
        self
    }

    /// `f(x)`, a part of a network that is computed again in the backward pass, if this pass is
    /// [`recomputing`](Context::recomputing). `f` gets a context of its own, which it asks for its parameters. Running
    /// statistics move once, and the dice fall the same both times.
    #[track_caller]
    pub fn part(&self, x: &Var<T>, f: impl Fn(&Context<T>, &Var<T>) -> Var<T> + 'static) -> Var<T> {
        // Whoever looks at intermediate values looks at this context.
        if !self.recomputing || self.seen.is_some() {
            return f(self, x);
        }
        let (identities, mode, precision) = (self.identities.clone(), self.mode, self.precision);
        let frozen = self.frozen.clone();
        let (dice, moved) = (self.random.borrow().clone(), self.moved.borrow().clone());
        // Where the first run leaves its dice and statistics; when it runs again nobody asks.
        let left = Rc::new(RefCell::new(None));
        let leave = Rc::downgrade(&left);
        let run = move |v: &[Var<T>]| {
            let inner = Context {
                vars: v[1..].to_vec(),
                identities: identities.clone(),
                mode,
                precision,
                moved: RefCell::new(moved.clone()),
                random: RefCell::new(dice.clone()),
                seen: None,
                differentiated: Cell::new(false),
                recomputing: false,
                frozen: frozen.clone(),
            };
            let y = f(&inner, &v[0]);
            if let Some(leave) = leave.upgrade() {
                let dice = inner.random.borrow().clone();
                leave.replace(Some((dice, inner.into_moved())));
            }
            y
        };
        let y = recompute(&[x].into_iter().chain(&self.vars).collect::<Vec<_>>(), run);
        if let Some((dice, moved)) = left.take() {
            (*self.random.borrow_mut(), *self.moved.borrow_mut()) = (dice, moved);
        }
        y
    }

    /// This pass with intermediate values kept: those that modules [`observe`](Context::observe).
    pub fn observed(mut self) -> Self {
        self.seen = Some(RefCell::default());
        self
    }

    /// Records an intermediate value under the path of its module, if this pass is [`observed`](Context::observed).
    pub fn observe(&self, name: &str, value: &Var<T>) {
        if let Some(seen) = &self.seen {
            seen.borrow_mut().insert(name.to_owned(), value.value().clone());
        }
    }

    /// Takes the value that the module of this name recorded last, if this pass is [`observed`](Context::observed).
    pub fn take_observed(&self, name: &str) -> Option<Tensor<T>> {
        self.seen.as_ref()?.borrow_mut().remove(name)
    }

    /// A parameter as a variable.
    ///
    /// # Panics
    /// If the parameters of this pass are those of another model than the module's: names both parameters.
    #[track_caller]
    pub fn var(&self, id: ParamId) -> &Var<T> {
        id.check(self.identities.get(id.index()));
        &self.vars[id.index()]
    }

    /// The numbers in which products of convolutions and linear layers are taken.
    pub fn precision(&self) -> Precision {
        self.precision
    }

    /// Whether this is training.
    pub fn is_training(&self) -> bool {
        self.mode == Mode::Training
    }

    /// Whether a parameter or running statistic stays as it is in this pass.
    pub fn is_frozen(&self, id: ParamId) -> bool {
        self.frozen.get(id.index()).copied().unwrap_or(false)
    }

    /// Whether normalisations are folded into the convolutions in front of them.
    pub fn is_folded(&self) -> bool {
        self.mode == Mode::Folded
    }

    /// A running statistic as this pass has left it.
    pub fn running(&self, id: ParamId) -> Tensor<T> {
        self.moved.borrow().get(&id).cloned().unwrap_or_else(|| self.var(id).value().clone())
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

    /// Ends the pass and returns the running statistics that it has updated.
    pub fn into_moved(self) -> HashMap<ParamId, Tensor<T>> {
        std::mem::take(&mut *self.moved.borrow_mut())
    }

    /// Gradients of the parameters, in their order; `None` for those that the output does not depend on.
    pub fn gradients(&self, gradients: &mut Gradients<T>) -> Vec<Option<Tensor<T>>> {
        self.differentiated.set(true);
        profile::phase("leaves to gradients", || self.vars.iter().map(|v| gradients.take(v)).collect())
    }
}

impl<T: Float> Drop for Context<T> {
    fn drop(&mut self) {
        let left = self.differentiated.get() && !self.moved.borrow().is_empty();
        if left && !std::thread::panicking() {
            panic!(
                "a training step moved running statistics that were not put back: after `gradients`, give each value of \
                 `into_moved` to `Params::set` (or drop what `into_moved` returns, to leave them as they were)"
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{Builder, Init, Linear};

    /// A model of one layer.
    fn model(name: &str, inputs: usize) -> (Linear, Params<f64>) {
        let (mut params, mut random) = (Params::new(), Random::of(1, Stream::Only));
        let b = &mut Builder::new(&mut params, &mut random);
        let layer = Linear::new(&mut b.at(name), [inputs, 2], Init::Constant(1.0), true);
        (layer, params)
    }

    #[test]
    fn a_module_with_another_models_parameters_is_refused_with_both_names() {
        let ((encoder, own), (_, others)) = (model("encoder", 3), model("decoder", 3));
        let x = Var::constant(Tensor::zeros([1, 3]));
        encoder.forward(&Context::inference(&own), &x);
        // The same model with other numbers is the same model.
        let (_, averaged) = model("encoder", 3);
        encoder.forward(&Context::inference(&averaged), &x);
        let refused = |params: &Params<f64>| {
            let run = std::panic::AssertUnwindSafe(|| encoder.forward(&Context::inference(params), &x));
            let message = std::panic::catch_unwind(run).err().expect("refused");
            message.downcast_ref::<String>().cloned().unwrap_or_default()
        };
        let message = refused(&others);
        assert!(message.contains("encoder.weight") && message.contains("decoder.weight"), "{message}");
        let message = refused(&model("encoder", 5).1);
        assert!(message.contains("[3, 2]") && message.contains("[5, 2]"), "{message}");
        assert!(refused(&Params::new()).contains("nothing"));
    }

    #[test]
    fn statistics_that_are_not_put_back_are_loud() {
        use crate::nn::BatchNorm;
        let (mut params, mut random) = (Params::<f64>::new(), Random::of(1, Stream::Only));
        let norm =
            BatchNorm::new(&mut Builder::new(&mut params, &mut random).at("bn"), 2, crate::ops::Activation::None);
        let step = |put_back: bool| {
            let tape = Tape::new();
            let c = Context::training(&params, &tape, Random::of(1, Stream::Only));
            let y = norm.forward(&c, &Var::constant(Tensor::from_vec([2, 2], vec![1.0, 2.0, 3.0, 5.0])));
            c.gradients(&mut y.sum_all().backward());
            if put_back {
                assert_eq!(c.into_moved().len(), 2);
            }
        };
        step(true);
        let message = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| step(false))).expect_err("loud");
        assert!(message.downcast_ref::<&str>().is_some_and(|m| m.contains("were not put back")));
    }
}
