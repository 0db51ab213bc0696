//! Models: the gradient of a loss with respect to parameters, by name.

use super::function::Function;
use super::{Options, Report, check_function};
use crate::nn::{Context, ParamId, Params};
use crate::random::{Random, Stream};
use crate::tensor::{Tape, Tensor, Var};

/// Compares the gradient of a loss with respect to every parameter that is learnt with finite differences, element by
/// element, or along [random directions](Options::directions) of each parameter, which is what a model of any size needs.
///
/// `loss` runs in training mode, with the same dice every time. The report and its failure name the parameters.
///
/// ```
/// use parallax::gradcheck::{check_params, Options};
/// use parallax::nn::{Init, Builder, Layout, Params};
/// use parallax::random::Random;
/// use parallax::tensor::{Tensor, Var};
/// let (mut params, mut random) = (Params::<f64>::new(), Random::new(1, 0));
/// let weight = Builder::new(&mut params, &mut random).param("w", [3, 2], Layout::Same, Init::Constant(0.5));
/// let x = Var::constant(Tensor::full([4, 3], 0.3));
/// let report = check_params(&params, |c| x.matmul(c.var(weight)).square().mean_all(), &Options::default());
/// assert!(report.failure().is_none(), "{report}");
/// ```
pub fn check_params(params: &Params<f64>, loss: impl Fn(&Context<f64>) -> Var<f64>, options: &Options) -> Report {
    let learnt: Vec<ParamId> = params.iter().filter(|(_, p)| p.learnt).map(|(id, _)| id).collect();
    let names = learnt.iter().map(|&id| params.get(id).name().to_owned()).collect();
    let values: Vec<Tensor<f64>> = learnt.iter().map(|&id| params.get(id).value.clone()).collect();
    let options = Options { names, ..options.clone() };
    check_function(&Model { params, loss, learnt, options: &options }, &values, &options)
}

struct Model<'a, F> {
    params: &'a Params<f64>,
    loss: F,
    learnt: Vec<ParamId>,
    options: &'a Options,
}

impl<F: Fn(&Context<f64>) -> Var<f64>> Model<'_, F> {
    /// Runs the loss with other numbers in the parameters.
    fn run<R>(&self, values: &[Tensor<f64>], then: impl FnOnce(&Tape<f64>, Context<f64>, Var<f64>) -> R) -> R {
        let mut params = self.params.clone();
        self.learnt.iter().zip(values).for_each(|(&id, value)| params.set(id, value.clone()));
        let tape = Tape::new();
        let context = Context::training(&params, &tape, Random::of(self.options.seed, Stream::Dropout(0)));
        let loss = (self.loss)(&context);
        then(&tape, context, loss)
    }
}

impl<F: Fn(&Context<f64>) -> Var<f64>> Function for Model<'_, F> {
    fn epsilon(&self) -> f64 {
        f64::EPSILON
    }

    fn round(&self, x: f64) -> f64 {
        x
    }

    fn recorded(&self, values: &[Tensor<f64>]) -> Vec<(Tensor<f64>, bool)> {
        self.run(values, |_, _, loss| vec![(loss.value().clone(), loss.is_tracked())])
    }

    fn values(&self, values: &[Tensor<f64>]) -> Vec<Tensor<f64>> {
        self.run(values, |_, _, loss| vec![loss.value().clone()])
    }

    fn pull(&self, values: &[Tensor<f64>], cotangents: &[Option<Tensor<f64>>]) -> Vec<Option<Tensor<f64>>> {
        self.run(values, |tape, context, loss| {
            let seeds: Vec<_> = cotangents.iter().flatten().map(|c| (&loss, c.clone())).collect();
            let mut all = context.gradients(&mut tape.backward(&seeds));
            context.into_moved();
            let tracked = self.options.tracked(values.len());
            let zeros = |i: usize| Tensor::zeros(*values[i].shape());
            let take = |(i, id): (usize, &ParamId)| {
                tracked.contains(&i).then(|| all[id.index()].take().unwrap_or_else(|| zeros(i)))
            };
            self.learnt.iter().enumerate().map(take).collect()
        })
    }
}
