//! The linear layer as a module.

use super::{Builder, Context, Init, Layout, ParamId};
use crate::ops::apply1;
use crate::ops::product::linear;
use crate::tensor::{Float, Var};

/// Linear layer `y = x w (+ b)` with weight `[in, out]` and bias `[out]`.
#[derive(Clone, Debug)]
pub struct Linear {
    weight: ParamId,
    bias: Option<ParamId>,
}

impl Linear {
    /// The parameters stand directly under the builder's path. A bias starts at 0.
    pub fn new<T: Float>(b: &mut Builder<T>, channels: [usize; 2], init: Init, bias: bool) -> Self {
        let weight = b.param("weight", channels, Layout::Linear, init);
        let bias = bias.then(|| b.param("bias", [channels[1]], Layout::Same, Init::Constant(0.0)));
        Linear { weight, bias }
    }

    #[track_caller]
    fn apply<T: Float>(&self, c: &Context<T>, x: &Var<T>, gelu: bool) -> Var<T> {
        let op = linear::Linear { gelu, precision: c.precision(), ..linear::Linear::default() };
        let inputs = [x, c.var(self.weight)].into_iter().chain(self.bias.map(|b| c.var(b)));
        apply1(op, &inputs.collect::<Vec<_>>())
    }

    /// `[.., in] -> [.., out]`.
    #[track_caller]
    pub fn forward<T: Float>(&self, c: &Context<T>, x: &Var<T>) -> Var<T> {
        self.apply(c, x, false)
    }

    /// The layer applied to gelu(x), `[.., in] -> [.., out]`.
    #[track_caller]
    pub fn forward_of_gelu<T: Float>(&self, c: &Context<T>, x: &Var<T>) -> Var<T> {
        self.apply(c, x, true)
    }
}
