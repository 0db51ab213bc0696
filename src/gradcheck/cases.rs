//! The check of an op's case.

use std::fmt;

use serde::Serialize;

use super::{Kinks, Options, Report, Tolerance, check};
use crate::ops::registry::AnyCase;
use crate::random::{Random, Stream};
use crate::tensor::{Tensor, Var};

/// Result of the comparison of one case's gradients with finite differences.
#[derive(Clone, Debug, Serialize)]
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

impl fmt::Display for CaseReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} [{}] \"{}\"\n{}", self.op, self.algo, self.case, self.report)
    }
}

/// The inputs of a case, drawn from a seed.
pub fn draw(case: &dyn AnyCase, seed: u64) -> Vec<Tensor<f64>> {
    let mut random = Random::of(seed, Stream::CaseInputs);
    case.inputs().iter().map(|input| input.draw(&mut random)).collect()
}

/// Options for checking a case: its tolerance, kinks, constant inputs and names.
pub fn options_of(case: &dyn AnyCase, seed: u64) -> Options {
    let numbers = |f: &dyn Fn(&crate::ops::Input) -> bool| {
        case.inputs().iter().enumerate().filter(|(_, input)| f(input)).map(|(i, _)| i).collect()
    };
    Options {
        tolerance: Tolerance::OfLargest(case.tolerance()),
        kinks: Kinks::Exactly(case.kinks()),
        constant: numbers(&|input| input.constant.is_some()),
        ignored: numbers(&|input| input.ignored),
        flat: case.flat(),
        names: case.inputs().iter().map(|input| input.name.to_string()).collect(),
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
