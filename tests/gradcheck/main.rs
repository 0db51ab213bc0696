//! The gradient-check suite: loops over the registry, so that nobody has to remember anything.
//!
//! `checks` is what every case must pass, `every_op` runs it over the registry, `mutants` over gradients that are wrong
//! on purpose. `regressions` are bugs of other libraries with the inputs that exposed them (`CATALOGUE.md` lists them),
//! `regimes` whole ranges of sizes and geometries; `model_path` and `whole_model` hold the network to the ops,
//! `ablations` what is left when parts of it are taken away.

mod ablations;
mod catalogue;
mod checks;
mod drawn;
mod every_op;
mod model_path;
mod mutants;
mod regimes;
mod regressions;
mod whole_model;

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Poisoned memory is a switch of the whole process: the tests that turn it take turns.
fn take_turns() -> MutexGuard<'static, ()> {
    static TURN: Mutex<()> = Mutex::new(());
    TURN.lock().unwrap_or_else(PoisonError::into_inner)
}
