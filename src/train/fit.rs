//! A training made to fit into a given memory: what is computed again instead of kept, and how a batch is cut.

use super::cost::Cost;
use super::data::bytes_held;
use super::recipe::RunConfig;
use crate::error::{Error, Result};

/// What a training needs, and what was changed to get there.
#[derive(Clone, Debug, PartialEq)]
pub struct Fitted {
    /// Estimated memory of the process, in bytes: a step, and the pictures that are held meanwhile.
    pub bytes: f64,
    /// The changes in words; none if the training fits as it is.
    pub changes: Vec<String>,
}

/// Changes a configuration until a training needs at most `most` bytes, by the first of these that is enough: nothing;
/// computing transformer layers again in the backward pass, which learns the same and takes longer; taking the batch in
/// two, three, ... parts of one size whose gradients are averaged, as the weights see it the same batch, but for the
/// normalisations, whose statistics are those of a part; both.
///
/// # Errors
/// If even single samples do not fit, with the memory that they need; if a step on small pictures cannot be taken.
pub fn fit_memory(config: &mut RunConfig, most: f64) -> Result<Fitted> {
    let network = config.architecture().config(&config.ablation)?;
    let held = bytes_held(config);
    let mut least = f64::INFINITY;
    for parts in (1..=config.batch).filter(|parts| config.batch.is_multiple_of(*parts)) {
        for recompute in [false, true] {
            if config.recompute && !recompute {
                continue;
            }
            let batch = config.batch / parts;
            let cost = Cost::of(network.clone(), [config.height, config.width], batch, recompute)?;
            // The sum of the parts' gradients stays between them.
            let sums = if parts * config.accumulate > 1 { cost.bytes_parameters } else { 0.0 };
            let bytes = held + cost.bytes_step + sums;
            least = least.min(bytes);
            if bytes > most {
                continue;
            }
            let mut changes = Vec::new();
            if recompute && !config.recompute {
                changes.push("transformer layers are computed again in the backward pass (recompute)".to_owned());
            }
            if parts > 1 {
                changes.push(format!(
                    "a batch of {} is taken in {parts} parts of {batch}, whose gradients are averaged (batch, accumulate); \
                     normalisations see the parts",
                    config.batch
                ));
            }
            config.recompute = recompute;
            config.accumulate *= parts;
            config.batch = batch;
            return Ok(Fitted { bytes, changes });
        }
    }
    let mib = |bytes: f64| bytes / f64::from(1 << 20);
    Err(Error::setting(
        "memory",
        format!(
            "training {} at {}x{} needs about {:.0} MiB with one sample at a time, and {:.0} MiB are allowed: take smaller \
             pictures or a smaller preset",
            config.preset.name(),
            config.width,
            config.height,
            mib(least),
            mib(most)
        ),
    ))
}
