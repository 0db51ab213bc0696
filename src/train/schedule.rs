//! Schedules of the learning rates as a configuration and the command line say them: in shares of the training's steps, or
//! in passes over the data.

use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::recipe::{check, check_share, steps_of};
use crate::error::{Error, Result};
use crate::optim::{Decay, Schedule};

/// A factor on the learning rates, in shares of the training's steps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RateSchedule {
    /// The share of the steps over which the rates grow linearly from nothing.
    pub warm_up: f64,
    /// Decay after the warm-up.
    pub decay: RateDecay,
}

/// Decay of the learning rates, in shares of the training's steps, or in passes over the data.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "kind", deny_unknown_fields)]
pub enum RateDecay {
    /// No decay.
    Constant,
    /// By `factor`, once, after the share `at` of the steps.
    Step {
        /// The share of the steps.
        at: f64,
        /// The factor.
        factor: f64,
    },
    /// By `factor` after every share `every` of the steps.
    Exponential {
        /// The share of the steps between two falls.
        every: f64,
        /// The factor.
        factor: f64,
    },
    /// By `factor` after every epoch. An epoch is one pass over the training samples, rounded up to whole steps.
    Epochs {
        /// The factor.
        factor: f64,
    },
    /// Along half a cosine wave, down to `end` times the rate at the last step.
    Cosine {
        /// The factor at the end.
        end: f64,
    },
}

impl RateSchedule {
    /// The schedule of a training of so many steps, `epoch` of which are a pass over the data.
    pub fn over(&self, steps: u64, epoch: u64) -> Schedule {
        let decay = match self.decay {
            RateDecay::Constant => Decay::Constant,
            RateDecay::Step { at, factor } => Decay::Step { at: steps_of(at, steps), factor },
            RateDecay::Exponential { every, factor } => {
                Decay::Exponential { every: steps_of(every, steps).max(1), factor }
            }
            RateDecay::Epochs { factor } => Decay::Exponential { every: epoch.max(1), factor },
            RateDecay::Cosine { end } => Decay::Cosine { steps, end },
        };
        Schedule { warm_up: steps_of(self.warm_up, steps), decay }
    }

    /// Checks every number.
    ///
    /// # Errors
    /// Names the field that cannot be used.
    pub fn check(&self) -> Result<()> {
        check_share("optim.schedule.warm_up", self.warm_up)?;
        let check_factor = |field: &str, factor: f64| {
            let field = format!("optim.schedule.decay.{field}");
            check(field, factor, factor >= 0.0 && factor.is_finite(), "a factor from 0")
        };
        match self.decay {
            RateDecay::Constant => Ok(()),
            RateDecay::Step { at, factor } => {
                check_share("optim.schedule.decay.at", at)?;
                check_factor("factor", factor)
            }
            RateDecay::Exponential { every, factor } => {
                check_share("optim.schedule.decay.every", every)?;
                check_factor("factor", factor)
            }
            RateDecay::Epochs { factor } => check_factor("factor", factor),
            RateDecay::Cosine { end } => check_factor("end", end),
        }
    }
}

/// `constant`, `step[:FACTOR[@SHARE]]`, `exponential[:FACTOR]` (after every epoch) or `cosine[:END]`.
impl FromStr for RateDecay {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let wrong = || {
            let message = format!(
                "{text} is none of constant, step[:FACTOR[@SHARE]] (0.1@0.75: once, after that share of the steps), \
                 exponential[:FACTOR] (0.9: after every epoch), cosine[:END] (0.01: at the last step)"
            );
            Error::setting("--schedule", message)
        };
        let (kind, rest) = text.split_once(':').map_or((text, None), |(kind, rest)| (kind, Some(rest)));
        let number = |text: &str| text.parse::<f64>().map_err(|_| wrong());
        let or = |usual: f64| rest.map_or(Ok(usual), number);
        let decay = match kind {
            "constant" if rest.is_none() => RateDecay::Constant,
            "exponential" => RateDecay::Epochs { factor: or(0.9)? },
            "cosine" => RateDecay::Cosine { end: or(0.01)? },
            "step" => {
                let (factor, at) = rest.unwrap_or("0.1").split_once('@').unwrap_or((rest.unwrap_or("0.1"), "0.75"));
                RateDecay::Step { at: number(at)?, factor: number(factor)? }
            }
            _ => return Err(wrong()),
        };
        RateSchedule { warm_up: 0.0, decay }.check().map(|()| decay)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_schedule_is_read_from_a_word() {
        let read = |text: &str| text.parse::<RateDecay>();
        assert_eq!(read("constant").unwrap(), RateDecay::Constant);
        assert_eq!(read("step").unwrap(), RateDecay::Step { at: 0.75, factor: 0.1 });
        assert_eq!(read("step:0.5").unwrap(), RateDecay::Step { at: 0.75, factor: 0.5 });
        assert_eq!(read("step:0.5@0.25").unwrap(), RateDecay::Step { at: 0.25, factor: 0.5 });
        assert_eq!(read("exponential").unwrap(), RateDecay::Epochs { factor: 0.9 });
        assert_eq!(read("cosine:0.1").unwrap(), RateDecay::Cosine { end: 0.1 });
        for text in ["", "linear", "constant:1", "step:a", "step:0.1@2", "cosine:-1", "exponential:"] {
            assert!(read(text).is_err(), "{text}");
        }
    }

    /// 10 samples in batches of 4 are an epoch of 3 steps.
    #[test]
    fn an_exponential_schedule_falls_after_every_epoch_however_many_there_are() {
        let schedule = RateSchedule { warm_up: 0.0, decay: RateDecay::Epochs { factor: 0.5 } };
        for steps in [6, 60] {
            let plan = schedule.over(steps, 3);
            let found: Vec<f64> = (1..=7).map(|step| plan.factor(step)).collect();
            assert_eq!(found, [1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.25]);
        }
    }
}
