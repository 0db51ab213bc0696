//! Every check on every case of every op; whether the comparison with finite differences would have seen a wrong
//! gradient; and what the suite lets pass, counted.

use std::collections::{BTreeMap, BTreeSet};

use parallax::gradcheck::{Check, Gradients, Report, check_case, for_each_case};
use parallax::ops::case::TOLERANCE;
use parallax::ops::registry;
use parallax::ops::{Case, Checked, CustomOp, Input, Needs, Op, ShapeError};
use parallax::tensor::{Float, GradSink, Shape, Tensor, Upstream};

use crate::checks::{CHECKS, Subject};

/// A row of the table that the suite prints.
#[derive(Default)]
struct Row {
    cases: usize,
    error: f64,
    changed: usize,
}

/// The same gradients, with that of one input multiplied.
fn scaled(gradients: &Gradients, input: usize, factor: f64) -> Gradients {
    let mut changed = gradients.clone();
    if let Some(g) = &mut changed.inputs[input] {
        g.data_mut().iter_mut().for_each(|g| *g *= factor);
    }
    changed
}

#[test]
fn every_op_passes_every_check_and_no_changed_gradient_does() {
    let _turn = crate::take_turns();
    let found = for_each_case(&registry::all(), |entry, case| {
        let subject = Subject::new(case, 1);
        let complain =
            |(name, check): &(&str, Check)| Some(format!("{}, {name}: {}", subject.what(), check(&subject).err()?));
        let mut failures: Vec<String> = CHECKS.iter().filter_map(complain).collect();
        let (analytic, report) = (subject.gradients(), subject.report());
        let mut changed = 0;

        // The comparison itself: a gradient that is off by ten times the tolerance, or missing, must not pass.
        for (i, input) in report.inputs.iter().enumerate() {
            if input.as_ref().is_none_or(|r| r.scale == 0.0) {
                continue;
            }
            for (how, factor) in [("scaled", 1.0 + 10.0 * case.tolerance()), ("dropped", 0.0)] {
                changed += 1;
                let changed = scaled(&analytic, i, factor);
                if Report::new(&changed, subject.measured(), &subject.options).failure().is_none() {
                    failures.push(format!("{}: a {how} gradient of input {i} passes", subject.what()));
                }
            }
        }
        (entry.name, report.error(), changed, failures)
    });
    let (mut failures, mut table) = (Vec::new(), BTreeMap::<&str, Row>::new());
    for (op, error, changed, complaints) in found {
        let row = table.entry(op).or_default();
        *row = Row { cases: row.cases + 1, error: row.error.max(error), changed: row.changed + changed };
        failures.extend(complaints);
    }
    for (op, Row { cases, error, changed }) in &table {
        println!("{op:32} {cases:3} cases  {error:.1e}  {changed:3} changed gradients caught");
    }
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
}

/// Other inputs, other cotangents: what is right must not depend on the draw. Every fourth case once; `PARALLAX_SEEDS`
/// asks for so many draws of all.
#[test]
fn no_seed_raises_a_false_alarm() {
    let asked = std::env::var("PARALLAX_SEEDS").ok().and_then(|n| n.parse().ok());
    let (count, step) = asked.map_or((1, 4), |count| (count, 1));
    let mut failures = Vec::new();
    for seed in 100..100 + count {
        for case in registry::all().iter().flat_map(|e| e.cases()).step_by(step) {
            let found = check_case(case.as_ref(), seed);
            if let Some(why) = found.report.failure() {
                failures.push(format!("seed {seed}, {} [{}] \"{}\": {why}", found.op, found.algo, found.case));
            }
        }
    }
    assert!(failures.is_empty(), "{} false alarms:\n{}", failures.len(), failures.join("\n"));
}

/// What the cases of an op leave open, if anything.
fn gap(entry: &registry::Entry) -> Option<String> {
    let cases = entry.cases();
    if cases.is_empty() {
        return Some("no cases".into());
    }
    if cases.iter().all(|c| c.flat()) {
        return Some("every case is flat".into());
    }
    let names: BTreeSet<&str> = cases.iter().flat_map(|c| c.inputs()).map(|i| i.name).collect();
    for name in names {
        let uses = || cases.iter().filter(|c| !c.flat()).flat_map(|c| c.inputs()).filter(|i| i.name == name);
        let perturbed = uses().any(|i| i.constant.is_none() && !i.shape.is_empty());
        let declared = uses().all(|i| i.constant.is_some_and(|reason| !reason.is_empty()));
        if !perturbed && !declared {
            return Some(format!("input {name} is perturbed in no case"));
        }
    }
    let silent = cases.iter().find(|c| c.kinks() > 0 && c.promise().is_none());
    silent.map(|case| format!("\"{}\" does not say which value it has on its kinks", case.name()))
}

#[test]
fn every_op_has_cases_and_every_input_is_perturbed_somewhere() {
    let open: Vec<_> = registry::all().iter().filter_map(|e| Some((e.name, gap(e)?))).collect();
    assert!(open.is_empty(), "{open:?}");
}

/// An op whose cases are whatever a test wants: y = x.
#[derive(Clone)]
struct Identity<const WHICH: usize>;

impl<const WHICH: usize> CustomOp for Identity<WHICH> {
    const NAME: &'static str = "identity";
}

impl<const WHICH: usize> Checked for Identity<WHICH> {
    fn cases() -> Vec<Case<Self>> {
        let case = |input| Case::new("a case", Identity, [input]);
        match WHICH {
            0 => vec![],
            1 => vec![case(Input::random("x", [0])).flat()],
            2 => vec![case(Input::random("x", [0]))],
            3 => vec![case(Input::random("x", [2]).constant(""))],
            4 => vec![case(Input::random("x", [2])).kinks(1)],
            _ => vec![case(Input::random("x", [2]))],
        }
    }
}

impl<T: Float, const WHICH: usize> Op<T> for Identity<WHICH> {
    type Saved = ();
    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        Ok(vec![inputs[0]])
    }
    fn forward(&self, x: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, ()) {
        (vec![x[0].clone()], ())
    }
    fn backward(&self, _: (), upstream: Upstream<T>, sink: &mut GradSink<T>) {
        sink.give(0, upstream.only());
    }
}

#[test]
fn an_op_whose_cases_show_nothing_is_refused() {
    use registry::Entry;
    let found = [
        gap(&Entry::of::<Identity<0>>()),
        gap(&Entry::of::<Identity<1>>()),
        gap(&Entry::of::<Identity<2>>()),
        gap(&Entry::of::<Identity<3>>()),
        gap(&Entry::of::<Identity<4>>()),
        gap(&Entry::of::<Identity<5>>()),
    ];
    let said = ["no cases", "every case is flat", "perturbed in no case", "perturbed in no case", "on its kinks"];
    for (found, said) in found.iter().zip(said) {
        assert!(found.as_ref().is_some_and(|gap| gap.contains(said)), "{found:?}, not {said}");
    }
    assert_eq!(found[5], None);
}

/// What the suite lets pass for a stated reason. The numbers are pinned, so that none grows unseen.
#[test]
fn exceptions_are_counted() {
    let (mut kinks, mut loosened, mut constants) = (BTreeMap::new(), BTreeMap::new(), BTreeSet::new());
    let mut ignored = 0;
    for case in registry::all().iter().flat_map(|e| e.cases()) {
        if case.kinks() > 0 {
            *kinks.entry(case.op()).or_insert(0) += case.kinks();
        }
        if case.tolerance() > TOLERANCE {
            assert!(case.reason().is_some_and(|r| !r.is_empty()), "{}: a tolerance without a reason", case.op());
            *loosened.entry(case.op()).or_insert(0) += 1;
        }
        constants.extend(case.inputs().iter().filter(|i| i.constant.is_some()).map(|i| (case.op(), i.name)));
        ignored += case.inputs().iter().filter(|i| i.ignored).count();
    }
    println!("kinks {kinks:?}\nloosened tolerances {loosened:?}\nnot differentiated {constants:?}\nignored {ignored}");
    let found = [kinks.values().sum::<usize>(), loosened.values().sum::<usize>(), constants.len(), ignored];
    assert_eq!(found, EXCEPTIONS, "kinks, cases with a loosened tolerance, inputs not differentiated, inputs ignored");
}

/// Elements on kinks, cases with a loosened tolerance, inputs that are declared not differentiable, inputs whose
/// gradient is rightly zero in a case.
const EXCEPTIONS: [usize; 4] = [65, 2, 10, 54];
