//! Flags of `train` about rates, what is learnt, and what is kept.

use parallax::train::RunConfig;
use parallax::train::schedule::RateDecay;
use parallax::{Error, Result};

#[derive(clap::Args, Clone)]
#[command(next_help_heading = "Rates, and what is learnt and kept")]
pub struct Control {
    /// Average the gradients of this many batches in every step: a batch of N times the size, in the memory of one
    /// (normalisations see the small batches) [default: 1].
    #[arg(long, value_name = "N")]
    accumulate: Option<usize>,
    /// Learning rate of the depth encoder [default: 0.001, or 0.00005 where training starts from weights].
    #[arg(long, value_name = "RATE")]
    encoder_rate: Option<f64>,
    /// Learning rate of the pose networks [default: 0.0028; 0.001 with --init, 0.0001 with --init-encoder].
    #[arg(long, value_name = "RATE")]
    pose_rate: Option<f64>,
    /// Schedule of the rates after the warm-up: constant; step:FACTOR@SHARE (once, after a share of the steps);
    /// exponential:FACTOR (after every pass over the data); cosine:END (the factor at the last step)
    /// [default: cosine:0.01].
    #[arg(long, value_name = "KIND[:NUMBER]")]
    schedule: Option<RateDecay>,
    /// Leave parameters as they are whose names match, `*` being any characters: `encoder.*`. Their normalisations use and
    /// keep the statistics that they have. Several times for several patterns [default: none].
    #[arg(long, value_name = "PATTERN")]
    freeze: Vec<String>,
    /// Number of states to keep: the newest and those before it; from 3 on each under its step, too, as
    /// checkpoints/step-N.safetensors. The best weights are kept in any case [default: 2].
    #[arg(long, value_name = "N")]
    keep: Option<usize>,
    /// Stop when this many validations in a row have found no new best [default: never].
    #[arg(long, value_name = "N")]
    patience: Option<u64>,
}

impl Control {
    /// Puts what the flags say over a configuration.
    ///
    /// # Errors
    /// If a number cannot be used.
    pub fn apply(&self, config: &mut RunConfig) -> Result<()> {
        config.accumulate = self.accumulate.unwrap_or(config.accumulate);
        let optim = &mut config.optim;
        for (flag, rate, to) in [
            ("--encoder-rate", self.encoder_rate, &mut optim.encoder_rate),
            ("--pose-rate", self.pose_rate, &mut optim.pose_rate),
        ] {
            let Some(rate) = rate else { continue };
            if !(rate >= 0.0 && rate.is_finite()) {
                return Err(Error::setting(flag, format!("{rate} is not a number from 0")));
            }
            *to = rate;
        }
        optim.schedule.decay = self.schedule.unwrap_or(optim.schedule.decay);
        if !self.freeze.is_empty() {
            config.freeze = self.freeze.clone();
        }
        self.apply_kept(config);
        Ok(())
    }

    /// Puts those over a configuration that may change while a run goes on.
    pub fn apply_kept(&self, config: &mut RunConfig) {
        config.keep = self.keep.unwrap_or(config.keep);
        config.patience = self.patience.or(config.patience);
    }

    /// Flags that are part of a run, and whether they are given.
    pub fn fixed(&self) -> [(&'static str, bool); 5] {
        [
            ("--accumulate", self.accumulate.is_some()),
            ("--encoder-rate", self.encoder_rate.is_some()),
            ("--pose-rate", self.pose_rate.is_some()),
            ("--schedule", self.schedule.is_some()),
            ("--freeze", !self.freeze.is_empty()),
        ]
    }
}
