//! Normalisations as modules.

use super::{Builder, Context, Init, Layout, ParamId};
use crate::ops::normalise::batch_norm::Activation;
use crate::tensor::{Float, Tensor, Var};

/// Batch normalisation (Ioffe and Szegedy, 1502.03167) over all but the channels, with an activation behind it.
///
/// Training uses the batch's mean and biased variance, and moves the running ones by a tenth (the unbiased variance);
/// evaluation, and training with frozen statistics ([`Context::training_part`]), uses the running ones.
#[derive(Clone, Debug)]
pub struct BatchNorm {
    pub(super) weight: ParamId,
    pub(super) bias: ParamId,
    pub(super) running_mean: ParamId,
    pub(super) running_var: ParamId,
    pub(super) activation: Activation,
}

impl BatchNorm {
    /// Added to the variance under the root.
    pub const EPS: f64 = 1e-5;
    /// Momentum: the share of a new batch in the running statistics.
    pub const MOMENTUM: f64 = 0.1;

    /// The parameters stand directly under the builder's path.
    pub fn new<T: Float>(b: &mut Builder<T>, channels: usize, activation: Activation) -> Self {
        BatchNorm {
            weight: b.param("weight", [channels], Layout::Same, Init::Constant(1.0)),
            bias: b.param("bias", [channels], Layout::Same, Init::Constant(0.0)),
            running_mean: b.buffer("running_mean", [channels], 0.0),
            running_var: b.buffer("running_var", [channels], 1.0),
            activation,
        }
    }

    /// `[.., C] -> [.., C]`.
    #[track_caller]
    pub fn forward<T: Float>(&self, c: &Context<T>, x: &Var<T>) -> Var<T> {
        let (weight, bias) = (c.var(self.weight), c.var(self.bias));
        if !c.is_training() || c.is_frozen(self.running_mean) {
            let (mean, var) = (c.var(self.running_mean), c.var(self.running_var));
            return x.batch_norm_eval(weight, bias, mean, var, Self::EPS, self.activation);
        }
        let (y, mean, var) = x.batch_norm(weight, bias, Self::EPS, self.activation);
        let n = x.shape().rows() as f64;
        let unbiased: Tensor<T> = var.map(|v| v * T::of(n / (n - 1.0).max(1.0)));
        c.move_running(self.running_mean, &mean, Self::MOMENTUM);
        c.move_running(self.running_var, &unbiased, Self::MOMENTUM);
        y
    }
}

/// Layer normalisation (Ba et al., 1607.06450) over the channels of each token.
#[derive(Clone, Debug)]
pub struct LayerNorm {
    weight: ParamId,
    bias: ParamId,
    eps: f64,
}

impl LayerNorm {
    /// What is added to the variance under the root, unless said otherwise: that of vision transformers. PyTorch's own
    /// default is 1e-5.
    pub const EPS: f64 = 1e-6;

    /// The parameters stand directly under the builder's path.
    pub fn new<T: Float>(b: &mut Builder<T>, channels: usize) -> Self {
        LayerNorm {
            weight: b.param("weight", [channels], Layout::Same, Init::Constant(1.0)),
            bias: b.param("bias", [channels], Layout::Same, Init::Constant(0.0)),
            eps: Self::EPS,
        }
    }

    /// This normalisation with another number added to the variance.
    pub fn with_eps(self, eps: f64) -> Self {
        LayerNorm { eps, ..self }
    }

    /// `[.., C] -> [.., C]`.
    #[track_caller]
    pub fn forward<T: Float>(&self, c: &Context<T>, x: &Var<T>) -> Var<T> {
        x.layer_norm(c.var(self.weight), c.var(self.bias), self.eps)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::Params;
    use crate::random::{Random, Stream};

    /// With variances near eps the choice shows: (x - 2e-3) / sqrt(1e-6 + eps).
    #[test]
    fn layer_norm_takes_the_eps_of_the_network_it_belongs_to() {
        let (mut params, mut random) = (Params::<f64>::new(), Random::of(0, Stream::Only));
        let norm = LayerNorm::new(&mut Builder::new(&mut params, &mut random), 2);
        let c = Context::inference(&params);
        let x = Var::constant(Tensor::from_vec([1, 2], vec![1e-3, 3e-3]));
        for (norm, eps) in [(norm.clone(), 1e-6), (norm.with_eps(1e-5), 1e-5)] {
            let expected = 1e-3 / (1e-6f64 + eps).sqrt();
            let y = norm.forward(&c, &x).into_value();
            assert!((y.data()[1] - expected).abs() < 1e-9, "{y:?} for {eps}");
        }
    }
}
