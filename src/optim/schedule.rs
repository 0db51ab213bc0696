//! Learning-rate schedules: a warm-up, then a decay.

use serde::{Deserialize, Serialize};

/// Learning-rate schedule: a factor on the rate for every step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Schedule {
    /// Number of warm-up steps, over which the rate grows linearly from nothing.
    pub warm_up: u64,
    /// Decay after the warm-up.
    pub decay: Decay,
}

/// Decay of a learning rate.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "kind")]
pub enum Decay {
    /// No decay.
    Constant,
    /// By `factor`, once, from step `at` on.
    Step {
        /// The step.
        at: u64,
        /// The factor.
        factor: f64,
    },
    /// By `factor` after every `every` steps.
    Exponential {
        /// The steps between two falls.
        every: u64,
        /// The factor.
        factor: f64,
    },
    /// Along half a cosine wave down to `end` times the rate at the last of `steps`.
    Cosine {
        /// The number of steps.
        steps: u64,
        /// What is left at the end.
        end: f64,
    },
}

impl Schedule {
    /// The factor at a step; the first step is 1.
    pub fn factor(&self, step: u64) -> f64 {
        let warm = if step < self.warm_up { step as f64 / self.warm_up as f64 } else { 1.0 };
        warm * match self.decay {
            Decay::Constant => 1.0,
            Decay::Step { at, factor } => {
                if step > at {
                    factor
                } else {
                    1.0
                }
            }
            Decay::Exponential { every, factor } => factor.powf(((step.max(1) - 1) / every.max(1)) as f64),
            Decay::Cosine { steps, end } => {
                let span = steps.saturating_sub(self.warm_up).max(1) as f64;
                let t = (step.saturating_sub(self.warm_up) as f64 / span).min(1.0);
                end + (1.0 - end) * 0.5 * (1.0 + (std::f64::consts::PI * t).cos())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warm_up_grows_to_the_full_rate() {
        let s = Schedule { warm_up: 100, decay: Decay::Constant };
        assert_eq!((s.factor(1), s.factor(50), s.factor(100), s.factor(101)), (0.01, 0.5, 1.0, 1.0));
    }

    #[test]
    fn each_decay_ends_where_it_says() {
        let after = |decay, step| Schedule { warm_up: 0, decay }.factor(step);
        assert_eq!(after(Decay::Step { at: 10, factor: 0.1 }, 10), 1.0);
        assert_eq!(after(Decay::Step { at: 10, factor: 0.1 }, 11), 0.1);
        assert_eq!(after(Decay::Exponential { every: 5, factor: 0.5 }, 5), 1.0);
        assert_eq!(after(Decay::Exponential { every: 5, factor: 0.5 }, 11), 0.25);
        assert!((after(Decay::Cosine { steps: 10, end: 0.1 }, 10) - 0.1).abs() < 1e-12);
        assert!((after(Decay::Cosine { steps: 10, end: 0.0 }, 5) - 0.5).abs() < 1e-12);
    }
}
