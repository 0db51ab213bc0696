//! The check of an op's case.

use super::{Options, Report, check};
use crate::ops::registry::AnyCase;
use crate::random::Random;
use crate::tensor::{Tensor, Var};

/// What the check of one case found.
#[derive(Clone, Debug)]
pub struct CaseReport {
    /// The op.
    pub op: &'static str,
    /// The kernel path.
    pub algo: &'static str,
    /// The case.
    pub case: &'static str,
    /// The comparison.
    pub report: Report,
}

/// The inputs of a case, drawn from a seed.
pub fn draw(case: &dyn AnyCase, seed: u64) -> Vec<Tensor<f64>> {
    let mut random = Random::new(seed, 0xCA5E);
    case.inputs().iter().map(|input| input.draw(&mut random)).collect()
}

/// What a case says of its own check.
pub fn options_of(case: &dyn AnyCase, seed: u64) -> Options {
    Options {
        tolerance: case.tolerance(),
        kinks: case.kinks(),
        constant: (0..case.inputs().len()).filter(|&i| case.inputs()[i].constant.is_some()).collect(),
        flat: case.flat(),
        seed,
        ..Options::default()
    }
}

/// Checks one case of an op against central differences.
pub fn check_case(case: &dyn AnyCase, seed: u64) -> CaseReport {
    let run = |vars: &[Var<f64>]| case.run(&vars.iter().collect::<Vec<_>>());
    let report = check(run, &draw(case, seed), &options_of(case, seed));
    CaseReport { op: case.op(), algo: case.algo(), case: case.name(), report }
}
