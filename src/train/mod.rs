//! Training: the recipe, what it starts from, the step, and the run that keeps it all in a folder.

pub mod rotations;
pub mod run;
pub mod start;
pub mod trainer;

pub use trainer::{OptimConfig, StepReport, Trainer};
