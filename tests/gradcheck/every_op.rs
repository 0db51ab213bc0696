//! Every case of every op: analytic gradient against central differences in f64.

use std::collections::BTreeMap;

use parallax::gradcheck::check_case;
use parallax::ops::registry;

#[test]
fn every_gradient_agrees_with_finite_differences() {
    let mut failures = Vec::new();
    let mut worst: BTreeMap<&str, (usize, f64)> = BTreeMap::new();
    for entry in registry::all() {
        for case in entry.cases() {
            let found = check_case(case.as_ref(), 1);
            let row = worst.entry(entry.name).or_default();
            *row = (row.0 + 1, row.1.max(found.report.error()));
            if let Some(why) = found.report.failure() {
                failures.push(format!("{} [{}] \"{}\": {why}", found.op, found.algo, found.case));
            }
        }
    }
    for (op, (cases, error)) in worst {
        println!("{op:32} {cases:3} cases  {error:.1e}");
    }
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
}

#[test]
fn every_op_has_cases_and_every_input_is_perturbed_somewhere() {
    for entry in registry::all() {
        let cases = entry.cases();
        assert!(!cases.is_empty(), "{}: no cases", entry.name);
        assert!(cases.iter().any(|c| !c.flat()), "{}: every case is flat", entry.name);
        let names: std::collections::BTreeSet<&str> = cases.iter().flat_map(|c| c.inputs()).map(|i| i.name).collect();
        for name in names {
            let uses = || cases.iter().filter(|c| !c.flat()).flat_map(|c| c.inputs()).filter(|i| i.name == name);
            let perturbed = uses().any(|i| i.constant.is_none() && !i.shape.is_empty());
            let declared = uses().all(|i| i.constant.is_some_and(|reason| !reason.is_empty()));
            assert!(perturbed || declared, "{}: input {name} is perturbed in no case", entry.name);
        }
    }
}
