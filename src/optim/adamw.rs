//! AdamW (Loshchilov and Hutter, 1711.05101): Adam with decoupled weight decay.

use std::sync::Arc;

use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;

use crate::nn::{Identity, Params, same_model};
use crate::tensor::{Float, Tensor, parallel, regime};

/// Settings of a parameter group.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Group {
    /// The learning rate.
    pub learning_rate: f64,
    /// Weight decay: each step shrinks a weight by `learning_rate * decay` of itself.
    pub decay: f64,
}

/// AdamW optimiser: first and second moments of every parameter's gradient.
///
/// With bias correction, for gradient g at step t:
/// m = b1 m + (1 - b1) g, v = b2 v + (1 - b2) g^2,
/// w = w (1 - lr decay) - lr (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps).
/// A parameter without a gradient is not touched, not even by the decay.
#[derive(Clone, Debug)]
pub struct AdamW<T: Float> {
    /// Decay rates b1 and b2 of the moments.
    pub betas: [f64; 2],
    /// Added to the square root of the second moment.
    pub eps: f64,
    /// m and v, in the order of the parameters; none yet for a parameter that had no gradient.
    pub moments: Vec<Option<[Tensor<T>; 2]>>,
    /// Number of steps taken.
    pub steps: u64,
    /// The parameters that it was made for.
    identities: Arc<Vec<Identity>>,
}

impl<T: Float> AdamW<T> {
    /// An optimiser that has taken no steps, with betas 0.9 and 0.999 and eps 1e-8.
    pub fn new(params: &Params<T>) -> Self {
        AdamW {
            betas: [0.9, 0.999],
            eps: 1e-8,
            moments: vec![None; params.len()],
            steps: 0,
            identities: params.identities(),
        }
    }

    /// One step. `gradients` are in the order of the parameters; `group` gives each parameter's settings by its name.
    /// Returns whether all weights that it changed are finite.
    ///
    /// # Panics
    /// If the parameters are not those of the model that it was made for: names the first that differs. If a gradient
    /// has another shape than its parameter.
    pub fn step(
        &mut self,
        params: &mut Params<T>,
        gradients: &[Option<Tensor<T>>],
        group: impl Fn(&str) -> Group,
    ) -> bool {
        same_model("AdamW", &self.identities, &params.identities());
        self.steps += 1;
        let finite = AtomicBool::new(true);
        let [b1, b2] = self.betas;
        let correct = |b: f64| 1.0 - b.powi(self.steps.min(i32::MAX as u64) as i32);
        let (root2, eps) = (T::of(correct(b2).sqrt()), T::of(self.eps));
        let groups: Vec<Group> = params.iter().map(|(_, p)| group(p.name())).collect();
        let ids: Vec<_> = params.iter().map(|(id, _)| id).collect();
        for (i, gradient) in gradients.iter().enumerate() {
            let Some(g) = gradient else { continue };
            let weights = params.value_mut(ids[i]);
            assert_eq!(weights.shape(), g.shape(), "a gradient has the shape of its parameter");
            let zeros = || Tensor::zeros(*g.shape());
            let [m, v] = self.moments[i].get_or_insert_with(|| [zeros(), zeros()]);
            let Group { learning_rate: lr, decay } = groups[i];
            let (keep, rate) = (T::of(1.0 - lr * decay), T::of(lr / correct(b1)));
            let (b1, b2, c1, c2) = (T::of(b1), T::of(b2), T::of(1.0 - b1), T::of(1.0 - b2));
            let chunk = regime::size(CHUNK);
            let pieces = weights.data_mut().chunks_mut(chunk).zip(g.data().chunks(chunk));
            let pieces = pieces.zip(m.data_mut().chunks_mut(chunk).zip(v.data_mut().chunks_mut(chunk)));
            parallel::for_each_piece(pieces, 8 * g.len(), |((w, g), (m, v))| {
                let all_finite = T::dispatch(
                    #[inline(always)]
                    || {
                        let mut all_finite = true;
                        for ((w, &g), (m, v)) in w.iter_mut().zip(g).zip(m.iter_mut().zip(v)) {
                            *m = b1 * *m + c1 * g;
                            *v = b2 * *v + c2 * (g * g);
                            *w = *w * keep - rate * *m / (v.sqrt() / root2 + eps);
                            all_finite &= w.is_finite();
                        }
                        all_finite
                    },
                );
                if !all_finite {
                    finite.store(false, Relaxed);
                }
            });
        }
        finite.into_inner()
    }
}

/// Elements handed to a thread at a time.
const CHUNK: usize = 1 << 14;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{Builder, Init, Layout};
    use crate::random::Random;

    #[test]
    fn the_first_step_is_the_learning_rate_against_the_gradients_sign() {
        let mut params = Params::<f64>::new();
        let mut random = Random::new(0, 0);
        let id = Builder::new(&mut params, &mut random).param("w", [2], Layout::Same, Init::Constant(1.0));
        let idle = Builder::new(&mut params, &mut random).param("idle", [1], Layout::Same, Init::Constant(1.0));
        let mut adamw = AdamW::new(&params);
        let gradients = [Some(Tensor::from_vec([2], vec![3.0, -0.01])), None];
        adamw.step(&mut params, &gradients, |_| Group { learning_rate: 0.1, decay: 0.5 });
        let w = params.get(id).value.data();
        assert!((w[0] - (0.95 - 0.1)).abs() < 1e-6 && (w[1] - (0.95 + 0.1)).abs() < 1e-6, "{w:?}");
        assert_eq!(params.get(idle).value.item(), 1.0, "no gradient, no step, no decay");
    }

    #[test]
    fn a_weight_that_is_not_finite_is_told() {
        let mut params = Params::<f64>::new();
        Builder::new(&mut params, &mut Random::new(0, 0)).param("w", [40], Layout::Same, Init::Constant(1.0));
        let mut adamw = AdamW::new(&params);
        let gradients = [Some(Tensor::full([40], 1.0))];
        assert!(adamw.step(&mut params, &gradients, |_| Group { learning_rate: 0.1, decay: 0.5 }));
        assert!(!adamw.step(&mut params, &gradients, |_| Group { learning_rate: f64::MAX, decay: 10.0 }));
    }
}
