//! What every case of an op must pass: a list of named checks, for the ops of this crate and for those from elsewhere.

use std::cell::OnceCell;
use std::fmt;
use std::sync::{Mutex, PoisonError};

use serde::Serialize;

use super::outcome::{leaves, outcome, same};
use super::single::all_the_same_in_f32;
use super::{Gradients, Kinks, Measured, Options, Pieces, Report, SIZES, cotangents, differences, draw, options_of};
use crate::ops::Op;
use crate::ops::case::Fill;
use crate::ops::registry::{AnyCase, Entry};
use crate::tensor::regime::Cut;
use crate::tensor::{Tape, Tensor, Var, parallel, pool};

/// Outputs and gradients of a case in f64.
type Outcome = super::outcome::Outcome<f64>;

/// A case under check: inputs, options, and what was computed of it so far.
pub struct Subject<'a> {
    /// The case.
    pub case: &'a dyn AnyCase,
    /// Its inputs, as they were drawn.
    pub inputs: Vec<Tensor<f64>>,
    /// What it says of its own check.
    pub options: Options,
    /// Which inputs are differentiated.
    pub all: Vec<bool>,
    seed: u64,
    measured: OnceCell<Measured>,
    first: OnceCell<Outcome>,
}

impl<'a> Subject<'a> {
    /// A case with inputs and cotangents from a seed.
    pub fn new(case: &'a dyn AnyCase, seed: u64) -> Self {
        let options = options_of(case, seed);
        let all = (0..case.inputs().len()).map(|i| !options.constant.contains(&i)).collect();
        let inputs = draw(case, seed);
        Subject { case, inputs, options, all, seed, measured: OnceCell::new(), first: OnceCell::new() }
    }

    /// A case that was drawn ([`Entry::draw`]): nobody has looked at how many numbers sit on a kink, and whether an input
    /// has no say.
    pub fn drawn(case: &'a dyn AnyCase, seed: u64) -> Self {
        let mut subject = Self::new(case, seed);
        subject.options.kinks = Kinks::Any;
        subject.options.ignored = (0..case.inputs().len()).collect();
        subject
    }

    /// The same inputs to another op with the same forward pass, whose finite differences are known therefore.
    pub fn altered<'b>(&self, case: &'b dyn AnyCase) -> Subject<'b> {
        let measured = OnceCell::from(self.measured().clone());
        let (inputs, options, all) = (self.inputs.clone(), self.options.clone(), self.all.clone());
        Subject { case, inputs, options, all, seed: self.seed, measured, first: OnceCell::new() }
    }

    /// The seed of its inputs and cotangents.
    pub(super) fn seed(&self) -> u64 {
        self.seed
    }

    /// Name in messages: op, kernel path, case.
    pub fn what(&self) -> String {
        format!("{} [{}] \"{}\"", self.case.op(), self.case.algo(), self.case.name())
    }

    fn run(&self, vars: &[Var<f64>]) -> Vec<Var<f64>> {
        self.case.run(&vars.iter().collect::<Vec<_>>())
    }

    /// Outputs and gradients of the op, computed once.
    pub fn first(&self) -> &Outcome {
        self.first.get_or_init(|| self.outcome(&self.inputs, &self.all))
    }

    fn outcome(&self, inputs: &[Tensor<f64>], tracked: &[bool]) -> Outcome {
        let run = |vars: &[&Var<f64>]| self.case.run(vars);
        outcome(&run, inputs, tracked, &|outputs| cotangents(outputs, self.seed), None)
    }

    /// Finite differences, computed once.
    pub fn measured(&self) -> &Measured {
        self.measured.get_or_init(|| {
            let tracked: Vec<usize> = (0..self.inputs.len()).filter(|&i| self.all[i]).collect();
            let cotangents = self.gradients().cotangents;
            let measured = differences(|v| self.run(v), &self.inputs, &tracked, &cotangents, &self.options);
            measured.unwrap_or_else(|why| panic!("{}: {why}", self.what()))
        })
    }

    /// Analytic gradients in the form that [`Report::new`] takes.
    pub fn gradients(&self) -> Gradients {
        let vars = leaves(&Tape::new(), &self.inputs, &self.all);
        let cotangents = cotangents(&self.run(&vars), self.seed);
        let zero = |(i, g): (usize, &Option<Tensor<f64>>)| {
            self.all[i].then(|| g.clone().unwrap_or_else(|| Tensor::zeros(*self.inputs[i].shape())))
        };
        Gradients { cotangents, inputs: self.first().1.iter().enumerate().map(zero).collect() }
    }

    /// Comparison of analytic gradients and finite differences.
    pub fn report(&self) -> Report {
        Report::new(&self.gradients(), self.measured(), &self.options)
    }
}

/// A check of a case: `Err` says what is wrong.
pub type Check = fn(&Subject) -> Result<(), String>;

/// The checks that every case must pass, by name.
pub const CHECKS: [(&str, Check); 11] = [
    ("differences", against_differences),
    ("promises", keeps_its_promise),
    ("accumulation", adds_to_what_is_there),
    ("repetition", adds_up_over_several_places),
    ("subsets", is_the_same_for_every_subset_of_tracked_inputs),
    ("again", is_the_same_again),
    ("threads", is_the_same_on_one_and_two_threads),
    ("poison", is_the_same_over_poisoned_memory),
    ("zeros", is_the_same_over_poisoned_memory_at_zeros),
    ("single", is_nearly_the_same_in_single_precision),
    ("f32", all_the_same_in_f32),
];

/// Analytic gradients against finite differences; at kinks between the one-sided ones, at ties in sum.
fn against_differences(s: &Subject) -> Result<(), String> {
    s.report().failure().map_or(Ok(()), |why| Err(why.to_string()))
}

/// The gradient that the case states, but for rounding.
fn keeps_its_promise(s: &Subject) -> Result<(), String> {
    let Some((input, promised)) = s.case.promise() else { return Ok(()) };
    let tape = Tape::new();
    let vars = leaves(&tape, &s.inputs, &s.all);
    let outputs = s.run(&vars);
    let tracked = outputs.iter().filter(|y| y.is_tracked());
    let seeds: Vec<_> = tracked.map(|y| (y, Tensor::full(*y.shape(), 1.0))).collect();
    let found = tape.backward(&seeds).take(&vars[input]);
    let found = found.as_ref().map_or(&[][..], Tensor::data);
    let close = |(a, b): (&f64, &f64)| (a - b).abs() <= 1e-14 * b.abs();
    let kept = found.len() == promised.len() && found.iter().zip(promised).all(close);
    if kept { Ok(()) } else { Err(format!("input {input} has the gradient {found:?}, and {promised:?} was promised")) }
}

/// Where an input already has a gradient from elsewhere, the op's own is added to it.
fn adds_to_what_is_there(s: &Subject) -> Result<(), String> {
    let tape = Tape::new();
    let vars = leaves(&tape, &s.inputs, &s.all);
    let outputs = s.run(&vars);
    let mut seeds: Vec<_> =
        outputs.iter().zip(cotangents(&outputs, s.seed)).filter_map(|(y, c)| Some((y, c?))).collect();
    let elsewhere = cotangents(&vars, s.seed + 1);
    seeds.extend(vars.iter().zip(&elsewhere).filter_map(|(x, c)| Some((x, c.clone()?))));
    let mut together = tape.backward(&seeds);
    for (i, (x, elsewhere)) in vars.iter().zip(&elsewhere).enumerate() {
        let (Some(sum), Some(elsewhere)) = (together.take(x), elsewhere) else { continue };
        for (k, (&sum, &other)) in sum.data().iter().zip(elsewhere.data()).enumerate() {
            let expected = s.first().1[i].as_ref().map_or(0.0, |g| g.data()[k]) + other;
            if (sum - expected).abs() > 1e-12 * expected.abs().max(1.0) || sum.is_nan() != expected.is_nan() {
                return Err(format!("input {i}, element {k}: {sum:e} where {expected:e} had to be the sum"));
            }
        }
    }
    Ok(())
}

/// Two inputs of one shape that are one value: its gradient is the sum of what separate ones with its numbers get.
fn adds_up_over_several_places(s: &Subject) -> Result<(), String> {
    for j in 1..s.inputs.len() {
        for i in 0..j {
            if !(s.all[i] && s.all[j]) || s.inputs[i].shape() != s.inputs[j].shape() {
                continue;
            }
            let mut numbers = s.inputs.clone();
            numbers[i] = numbers[j].clone();
            let apart = s.outcome(&numbers, &s.all).1;
            let tape = Tape::new();
            let mut vars = leaves(&tape, &numbers, &s.all);
            vars[i] = vars[j].clone();
            let outputs = s.run(&vars);
            let seeds: Vec<_> =
                outputs.iter().zip(cotangents(&outputs, s.seed)).filter_map(|(y, c)| Some((y, c?))).collect();
            let Some(together) = tape.backward(&seeds).take(&vars[j]) else { continue };
            for (k, &g) in together.data().iter().enumerate() {
                let sum: f64 = [i, j].iter().filter_map(|&i| apart[i].as_ref()).map(|g| g.data()[k]).sum();
                if (g - sum).abs() > 1e-12 * sum.abs().max(1.0) || g.is_nan() != sum.is_nan() {
                    return Err(format!("one value as inputs {i} and {j}, element {k}: {g:e} for {sum:e}"));
                }
            }
        }
    }
    Ok(())
}

/// The gradient of an input does not depend on whose else is wanted.
fn is_the_same_for_every_subset_of_tracked_inputs(s: &Subject) -> Result<(), String> {
    for subset in 1..1usize << s.inputs.len().min(4) {
        let tracked: Vec<bool> =
            s.all.iter().enumerate().map(|(i, &d)| d && (i >= 4 || subset >> i & 1 == 1)).collect();
        if !tracked.contains(&true) {
            continue;
        }
        let part = s.outcome(&s.inputs, &tracked);
        same(s.first(), &part).map_err(|why| format!("{why} where {tracked:?} are tracked"))?;
        for (i, (gradient, &on)) in part.1.iter().zip(&tracked).enumerate() {
            if gradient.is_some() != (on && s.first().1[i].is_some()) {
                return Err(format!("input {i}: a gradient missing, or one too many, where {tracked:?} are tracked"));
            }
        }
    }
    Ok(())
}

fn is_the_same_again(s: &Subject) -> Result<(), String> {
    same(s.first(), &s.outcome(&s.inputs, &s.all))
}

fn is_the_same_on_one_and_two_threads(s: &Subject) -> Result<(), String> {
    for threads in [1, 2] {
        let again = parallel::with_threads(threads, || s.outcome(&s.inputs, &s.all));
        same(s.first(), &again).map_err(|why| format!("{why} on {threads} threads"))?;
    }
    Ok(())
}

/// Buffers full of NaN instead of what was left in them: whoever reads before writing is found.
fn is_the_same_over_poisoned_memory(s: &Subject) -> Result<(), String> {
    same(s.first(), &poisoned(|| s.outcome(&s.inputs, &s.all)))
}

/// Runs something over buffers full of NaN. The switch is one for the whole process: those who come here take turns.
pub(super) fn poisoned<R>(run: impl FnOnce() -> R) -> R {
    static TURN: Mutex<()> = Mutex::new(());
    /// Turns the poison off, also where the op panics.
    struct Clean;
    impl Drop for Clean {
        fn drop(&mut self) {
            pool::set_poison(false);
        }
    }
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let _clean = Clean;
    pool::set_poison(true);
    run()
}

/// The same where numbers are exactly zero: loops that skip zeros leave what they should have written.
fn is_the_same_over_poisoned_memory_at_zeros(s: &Subject) -> Result<(), String> {
    let mut inputs = s.inputs.clone();
    for (x, input) in inputs.iter_mut().zip(s.case.inputs()) {
        if input.constant.is_none() && !matches!(input.fill, Fill::Values(_)) {
            x.data_mut().iter_mut().step_by(2).for_each(|x| *x = 0.0);
        }
    }
    let clean = || s.outcome(&inputs, &s.all);
    let (once, again, over_nan) = (clean(), clean(), poisoned(clean));
    same(&once, &again).and_then(|()| same(&once, &over_nan)).map_err(|why| format!("{why} where inputs are zero"))
}

/// The kernels in f32 against those in f64, forward and backward, on the same (rounded) numbers.
fn is_nearly_the_same_in_single_precision(s: &Subject) -> Result<(), String> {
    let single: Vec<Tensor<f32>> = s.inputs.iter().map(Tensor::cast).collect();
    let rounded: Vec<Tensor<f64>> = single.iter().map(Tensor::cast).collect();
    let double = s.outcome(&rounded, &s.all);
    let tape = Tape::new();
    let leaf = |(x, &on): (&Tensor<f32>, &bool)| if on { tape.leaf(x.clone()) } else { Var::constant(x.clone()) };
    let vars: Vec<Var<f32>> = single.iter().zip(&s.all).map(leaf).collect();
    let outputs = s.case.run_f32(&vars.iter().collect::<Vec<_>>());
    for (i, (y, exact)) in outputs.iter().zip(&double.0).enumerate() {
        close(y.value(), exact).map_err(|why| format!("output {i}, {why}"))?;
    }
    let seeds64 = cotangents(&s.run(&leaves(&Tape::new(), &rounded, &s.all)), s.seed);
    let seeds: Vec<_> = outputs.iter().zip(&seeds64).filter_map(|(y, c)| Some((y, c.as_ref()?.cast()))).collect();
    let gradients = tape.backward(&seeds);
    for (i, (v, exact)) in vars.iter().zip(&double.1).enumerate() {
        if let (Some(g), Some(exact)) = (gradients.get(v), exact) {
            close(g, exact).map_err(|why| format!("the gradient of input {i}, {why}"))?;
        }
    }
    Ok(())
}

fn close(single: &Tensor<f32>, double: &Tensor<f64>) -> Result<(), String> {
    let finite = |x: f64| if x.is_finite() { x.abs() } else { 0.0 };
    let scale = double.data().iter().fold(1e-3, |m: f64, &x| m.max(finite(x)));
    for (k, (&x, &y)) in single.data().iter().zip(double.data()).enumerate() {
        let close = (x as f64 - y).abs() <= 1e-4 * scale || (x as f64 == y) || (x.is_nan() && y.is_nan());
        if !close {
            return Err(format!("element {k}: {x} in f32, {y} in f64 (scale {scale:e})"));
        }
    }
    Ok(())
}

/// Failure of one check on one case.
#[derive(Clone, Debug, Serialize)]
pub struct Complaint {
    /// The case.
    pub case: &'static str,
    /// The kernel path.
    pub algo: &'static str,
    /// The check, by its name in [`CHECKS`] or [`Found`](super::Found).
    pub check: &'static str,
    /// What is wrong.
    pub why: String,
}

/// Result of all checks of one case.
pub struct Verdict {
    /// The comparison with finite differences.
    pub report: Report,
    /// The cuts of all runs with small pieces.
    pub cuts: Vec<Cut>,
    /// How many sizes of pieces cut anything.
    pub sizes: usize,
    /// What is wrong.
    pub complaints: Vec<Complaint>,
}

/// Every check of one case: those of [`CHECKS`], and those of [`Pieces`] with pieces of each of [`SIZES`].
pub fn check_everything(subject: &Subject) -> Verdict {
    let case = subject.case;
    let mut complaints = Vec::new();
    let mut complain = |check, why| complaints.push(Complaint { case: case.name(), algo: case.algo(), check, why });
    for (name, check) in CHECKS {
        if let Err(why) = check(subject) {
            complain(name, why);
        }
    }
    let pieces = Pieces::new(subject);
    let (mut cuts, mut sizes) = (Vec::new(), 0);
    for size in SIZES {
        let found = pieces.check(size);
        sizes += usize::from(found.cuts.iter().any(|cut| cut.pieces > 1));
        cuts.extend(found.cuts);
        for (check, why) in found.complaints {
            complain(check, format!("with pieces of {size}: {why}"));
        }
    }
    Verdict { report: subject.report(), cuts, sizes, complaints }
}

/// Result of [`check_op`].
#[derive(Clone, Debug, Serialize)]
pub struct OpReport {
    /// The op.
    pub op: &'static str,
    /// Its cases.
    pub cases: usize,
    /// What is wrong.
    pub complaints: Vec<Complaint>,
}

impl OpReport {
    /// Whether the op passes every check on every case, of which there must be one.
    pub fn is_right(&self) -> bool {
        self.cases > 0 && self.complaints.is_empty()
    }
}

impl fmt::Display for OpReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for Complaint { case, algo, check, why } in &self.complaints {
            writeln!(f, "{} [{algo}] \"{case}\", {check}: {why}", self.op)?;
        }
        let verdict = if self.is_right() { "right" } else { "WRONG" };
        write!(f, "{} in {} cases: {verdict}", self.op, self.cases)
    }
}

/// Holds an op to everything that the ops of this crate are held to, on its own cases: finite differences, what it adds
/// to gradients that are there already, one value as several inputs, subsets of tracked inputs, repetition, threads,
/// memory full of NaN (also where inputs are zero), f32 against f64; and all of it with small pieces of work, if the op cuts
/// its work at [`regime::size`](crate::tensor::regime::size).
///
/// The poison of memory is a switch of the whole process: an op that runs on another thread meanwhile and reads what it
/// did not write sees NaN, too.
pub fn check_op<O: Op<f64> + Op<f32>>() -> OpReport {
    let entry = Entry::of::<O>();
    let cases = entry.cases();
    let complaints =
        cases.iter().flat_map(|case| check_everything(&Subject::new(case.as_ref(), 1)).complaints).collect();
    OpReport { op: entry.name, cases: cases.len(), complaints }
}
