//! Optimisation: AdamW with parameter groups, learning-rate schedules, clipping, and an average of the weights.

mod adamw;
mod average;
mod clip;
mod schedule;

pub use adamw::{AdamW, Group};
pub use average::Average;
pub use clip::{add, clip_from, clip_norm, norm, norms, scale};
pub use schedule::{Decay, Schedule};
