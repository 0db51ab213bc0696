//! Batch normalisation folded into the convolution in front of it, for inference.
//!
//! With given statistics a normalisation is a factor and a shift for each channel, and a convolution is linear in its
//! weights: `(conv(x, w) - mean) s + beta = conv(x, w s) + (beta - mean s)`, s = gamma / sqrt(var + eps). What was two
//! passes over memory, and a third for the activation, is then the convolution alone.

use super::{BatchNorm, Params};
use crate::tensor::{Float, Precision};

/// Parameters whose normalisations have been folded: for [`Context::folded`](super::Context::folded) alone, since only
/// modules that know of it may use them.
#[derive(Clone, Debug)]
pub struct Folded<T: Float> {
    params: Params<T>,
    precision: Precision,
}

impl<T: Float> Folded<T> {
    /// Folds every normalisation that stands directly behind a convolution: the weight takes the factor, and the
    /// normalisation's bias becomes the shift.
    pub fn new(params: &Params<T>) -> Self {
        let mut folded = params.clone();
        for (weight, bn) in &params.normalised {
            let of = |id| params.get(id).value.data();
            let (gamma, beta) = (of(bn.weight), of(bn.bias));
            let (mean, var) = (of(bn.running_mean), of(bn.running_var));
            // In f64: the product of rounded factors would be rounded three times.
            let scale: Vec<f64> =
                (gamma.iter().zip(var)).map(|(g, v)| g.f64() / (v.f64() + BatchNorm::EPS).sqrt()).collect();
            for row in folded.value_mut(*weight).data_mut().chunks_exact_mut(scale.len()) {
                row.iter_mut().zip(&scale).for_each(|(w, s)| *w = T::of(w.f64() * s));
            }
            let shift = folded.value_mut(bn.bias).data_mut().iter_mut().zip(beta.iter().zip(mean).zip(&scale));
            shift.for_each(|(b, ((beta, mean), s))| *b = T::of(beta.f64() - mean.f64() * s));
        }
        Folded { params: folded, precision: Precision::F32 }
    }

    /// These parameters, with products of convolutions and linear layers in other numbers.
    ///
    /// # Panics
    /// If this machine has not the instruction for it: see [`Precision::is_available`].
    pub fn with_precision(self, precision: Precision) -> Self {
        assert!(precision.is_available(), "this machine multiplies no numbers in {precision:?}");
        Folded { precision, ..self }
    }

    /// The numbers in which products are taken.
    pub fn precision(&self) -> Precision {
        self.precision
    }

    pub(super) fn params(&self) -> &Params<T> {
        &self.params
    }
}
