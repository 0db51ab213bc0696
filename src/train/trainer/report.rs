//! The figures of a training step.

use serde::{Deserialize, Serialize};

use crate::train::vitals::Vitals;

/// The figures of a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StepReport {
    /// The step, from 1.
    pub step: u64,
    /// The total loss.
    pub loss: f64,
    /// The per-pixel minimum of photometric errors.
    pub photometric: f64,
    /// The same over warped neighbours alone.
    pub warped: f64,
    /// The same over unwarped neighbours alone.
    pub unwarped: f64,
    /// The smoothness term, weighted.
    pub smoothness: f64,
    /// The share of pixels that auto-masking leaves in.
    pub auto_mask: f64,
    /// The distance to known depth, not weighted; 0 where there is no such supervision.
    #[serde(default)]
    pub depth_error: f64,
    /// The learning rates: encoder, decoder, pose networks.
    pub learning_rates: [f64; 3],
    /// The norm of all gradients, before clipping.
    pub grad_norm: f64,
    /// The norms of the gradients of the encoder, the decoder and the pose networks, before clipping.
    #[serde(default)]
    pub grad_norms: [f64; 3],
    /// Figures of the networks' predictions.
    #[serde(default, flatten)]
    pub vitals: Vitals,
}

impl StepReport {
    /// The means of what batches show; step, rates and gradients stay empty.
    pub(super) fn mean(of: &[StepReport]) -> StepReport {
        let mean = |figure: fn(&StepReport) -> f64| of.iter().map(figure).sum::<f64>() / of.len().max(1) as f64;
        StepReport {
            loss: mean(|r| r.loss),
            photometric: mean(|r| r.photometric),
            warped: mean(|r| r.warped),
            unwarped: mean(|r| r.unwarped),
            smoothness: mean(|r| r.smoothness),
            auto_mask: mean(|r| r.auto_mask),
            depth_error: mean(|r| r.depth_error),
            vitals: Vitals {
                disparity: mean(|r| r.vitals.disparity),
                disparity_spread: mean(|r| r.vitals.disparity_spread),
                saturated: mean(|r| r.vitals.saturated),
                translation: mean(|r| r.vitals.translation),
                flow: mean(|r| r.vitals.flow),
                inside: mean(|r| r.vitals.inside),
            },
            ..StepReport::default()
        }
    }
}
