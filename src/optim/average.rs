//! An exponential moving average of the weights: smoother than the last step, and often better.

use std::sync::Arc;

use crate::nn::{Identity, Params, same_model};
use crate::tensor::{Float, Tensor, parallel, regime};

/// Elements handed to a thread at a time.
const CHUNK: usize = 1 << 14;

/// Exponential moving average of every tensor of a model (running statistics too), with a decay that warms up with the
/// step: min(decay, (1 + t) / (10 + t)).
#[derive(Clone, Debug)]
pub struct Average<T: Float> {
    /// The share of the old average in the new one, once warm.
    pub decay: f64,
    /// The averages, in the order of the parameters.
    pub values: Vec<Tensor<T>>,
    /// The parameters that it was made for.
    identities: Arc<Vec<Identity>>,
}

impl<T: Float> Average<T> {
    /// Starts at the weights as they are.
    pub fn new(params: &Params<T>, decay: f64) -> Self {
        let values = params.iter().map(|(_, p)| p.value.clone()).collect();
        Average { decay, values, identities: params.identities() }
    }

    /// Takes in the weights after step `t`.
    ///
    /// # Panics
    /// If they are not those of the model that it was made for.
    pub fn update(&mut self, params: &Params<T>, t: u64) {
        same_model("the average", &self.identities, &params.identities());
        let decay = self.decay.min((1.0 + t as f64) / (10.0 + t as f64));
        let take = T::of(1.0 - decay);
        for (average, (_, p)) in self.values.iter_mut().zip(params.iter()) {
            let weights = p.value.data();
            let chunk = regime::size(CHUNK);
            parallel::for_each_chunk(average.data_mut(), chunk, 2 * weights.len(), |i, average| {
                let weights = &weights[i * chunk..][..average.len()];
                T::dispatch(
                    #[inline(always)]
                    || average.iter_mut().zip(weights).for_each(|(a, &w)| *a += take * (w - *a)),
                );
            });
        }
    }

    /// The model with the averages for weights.
    pub fn params(&self, params: &Params<T>) -> Params<T> {
        let mut averaged = params.clone();
        for (value, (id, _)) in self.values.iter().zip(params.iter()) {
            averaged.set(id, value.clone());
        }
        averaged
    }
}
