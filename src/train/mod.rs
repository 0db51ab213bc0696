//! Training: the recipe, what it starts from, the step, and the run that keeps it all in a folder.

pub mod recipe;
pub mod rotations;
pub mod run;
pub mod start;
mod state;
pub mod trainer;

pub use recipe::{OptimConfig, Plan, RunConfig};
pub use trainer::{StepReport, Trainer};
