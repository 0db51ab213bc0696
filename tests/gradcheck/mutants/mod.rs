//! Mutants: ops of this crate with one bug planted in the backward pass, each of a kind that was found in the wild. The
//! checks must notice every one of them.
//!
//! A mutant wraps the real op: its forward pass, its shapes, its cases and its finite differences are the op's own. Only
//! the gradients are changed, or how they are handed over. No case exists for a mutant's sake.

mod bugs;

use std::collections::BTreeMap;
use std::rc::Rc;

use parallax::ops::registry::{self, AnyCase};
use parallax::ops::{Case, Checked, CustomOp, Needs, Op, ShapeError};
use parallax::tensor::{Float, GradSink, Shape, Tape, Tensor, Upstream, Var};

use crate::checks::{CHECKS, Subject};

/// The gradients of the inputs; `None` where they are not wanted.
pub type Gradients = Vec<Option<Tensor<f64>>>;

/// One planted bug.
pub struct Mutant {
    /// What is wrong.
    pub name: &'static str,
    /// The op that it is planted in.
    pub op: &'static str,
    /// The kind of bug.
    pub class: &'static str,
    /// How the gradients reach the inputs.
    pub hand_over: HandOver,
    /// The wrong gradients.
    pub gradients: fn(&Backward) -> Gradients,
}

/// How gradients reach the inputs.
#[derive(Clone, Copy, PartialEq)]
pub enum HandOver {
    /// As they should.
    Right,
    /// Over what is there already.
    Overwriting,
    /// Onto whatever the memory holds.
    OntoStale,
}

/// What a bug has to work with.
pub struct Backward<'a> {
    pub case: &'a dyn AnyCase,
    pub inputs: &'a [Tensor<f64>],
    /// Whose gradients are wanted.
    pub wanted: &'a [bool],
    pub upstream: Vec<Tensor<f64>>,
    /// Whether the op runs in f32.
    pub single: bool,
}

impl Backward<'_> {
    /// The op itself, if it is the type that a bug knows.
    pub fn op<O: 'static>(&self) -> &O {
        &self.case.as_any().downcast_ref::<Case<O>>().expect("the bug knows the type of its op").op
    }

    /// The upstream gradient of the first output.
    pub fn g(&self) -> &Tensor<f64> {
        &self.upstream[0]
    }

    /// An input.
    pub fn x(&self, i: usize) -> &Tensor<f64> {
        &self.inputs[i]
    }

    /// The right gradients.
    pub fn right(&self) -> Gradients {
        self.at(self.inputs, &self.upstream)
    }

    /// The right gradients at other inputs, or for other upstream gradients.
    pub fn at(&self, inputs: &[Tensor<f64>], upstream: &[Tensor<f64>]) -> Gradients {
        self.of(inputs, upstream, |vars| self.case.run(vars))
    }

    /// The right gradients of the same op with other attributes, or of another function, if its outputs have the
    /// same shapes.
    pub fn of(
        &self,
        inputs: &[Tensor<f64>],
        upstream: &[Tensor<f64>],
        run: impl Fn(&[&Var<f64>]) -> Vec<Var<f64>>,
    ) -> Gradients {
        let tape = Tape::new();
        let leaf = |(x, &on): (&Tensor<f64>, &bool)| if on { tape.leaf(x.clone()) } else { x.clone().into() };
        let vars: Vec<Var<f64>> = inputs.iter().zip(self.wanted).map(leaf).collect();
        let outputs = run(&vars.iter().collect::<Vec<_>>());
        if outputs.iter().zip(upstream).any(|(y, g)| y.shape() != g.shape()) {
            return self.right();
        }
        let seeds: Vec<_> = outputs.iter().zip(upstream.iter().cloned()).collect();
        let mut all = tape.backward(&seeds);
        vars.iter().map(|v| all.take(v)).collect()
    }

    /// The right gradients, with that of one input changed.
    pub fn changed(&self, input: usize, change: impl FnOnce(&mut Tensor<f64>)) -> Gradients {
        let mut gradients = self.right();
        if let Some(g) = gradients.get_mut(input).and_then(Option::as_mut) {
            change(g);
        }
        gradients
    }

    /// The gradient of one input computed element by element from (upstream, input), both of one shape.
    pub fn by_element(&self, f: impl Fn(f64, f64) -> f64) -> Gradients {
        self.changed(0, |d| {
            let terms = d.data_mut().iter_mut().zip(self.upstream[0].data().iter().zip(self.inputs[0].data()));
            terms.for_each(|(d, (&g, &x))| *d = f(g, x));
        })
    }

    /// The right gradient, but a constant where the argument is so.
    pub fn by_element_where(&self, at: impl Fn(f64) -> bool, gradient: f64) -> Gradients {
        self.changed(0, |d| {
            let arguments = d.data_mut().iter_mut().zip(self.inputs[0].data());
            arguments.filter(|(_, x)| at(**x)).for_each(|(d, _)| *d = gradient);
        })
    }
}

/// A mutant beside one case of its op.
#[derive(Clone)]
struct Planted {
    real: Rc<dyn AnyCase>,
    mutant: &'static Mutant,
}

impl CustomOp for Planted {
    const NAME: &'static str = "mutant";
}

impl Checked for Planted {
    /// Those of the real ops, for every mutant.
    fn cases() -> Vec<Case<Self>> {
        bugs::ALL.iter().flat_map(planted).collect()
    }
}

/// A mutant's cases, beside the real ones.
fn planted(mutant: &'static Mutant) -> Vec<Case<Planted>> {
    let entry = registry::all().into_iter().find(|e| e.name == mutant.op);
    let cases = entry.unwrap_or_else(|| panic!("no op is called {}", mutant.op)).cases();
    let plant = |real: Box<dyn AnyCase>| {
        let real: Rc<dyn AnyCase> = real.into();
        let terms = Box::new(real.terms().clone());
        Case { op: Planted { real, mutant }, terms }
    };
    cases.into_iter().map(plant).collect()
}

/// The forward pass of the real op, in either type.
trait Runs: Float {
    fn run(case: &dyn AnyCase, inputs: &[&Var<Self>]) -> Vec<Var<Self>>;
    const SINGLE: bool;
}

impl Runs for f64 {
    fn run(case: &dyn AnyCase, inputs: &[&Var<Self>]) -> Vec<Var<Self>> {
        case.run(inputs)
    }
    const SINGLE: bool = false;
}

impl Runs for f32 {
    fn run(case: &dyn AnyCase, inputs: &[&Var<Self>]) -> Vec<Var<Self>> {
        case.run_f32(inputs)
    }
    const SINGLE: bool = true;
}

impl<T: Runs> Op<T> for Planted {
    /// The inputs, and the number of outputs that are differentiated.
    type Saved = (Vec<Tensor<T>>, Vec<Shape>);

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        self.real.outputs(inputs)
    }

    fn auxiliary(&self) -> usize {
        self.real.auxiliary()
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let vars: Vec<Var<T>> = inputs.iter().map(|&x| x.clone().into()).collect();
        let outputs = T::run(self.real.as_ref(), &vars.iter().collect::<Vec<_>>());
        let outputs: Vec<Tensor<T>> = outputs.into_iter().map(Var::into_value).collect();
        let shapes = outputs[..outputs.len() - self.real.auxiliary()].iter().map(|y| *y.shape()).collect();
        (outputs, (inputs.iter().map(|&x| x.clone()).collect(), shapes))
    }

    fn backward(&self, (inputs, shapes): Self::Saved, mut upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let inputs: Vec<Tensor<f64>> = inputs.iter().map(Tensor::cast).collect();
        let wanted: Vec<bool> = (0..inputs.len()).map(|i| sink.wants(i)).collect();
        let given = |(o, shape): (usize, &Shape)| upstream.take(o).map_or_else(|| Tensor::zeros(*shape), |g| g.cast());
        let upstream = shapes.iter().enumerate().map(given).collect();
        let case = self.real.as_ref();
        let wrong = Backward { case, inputs: &inputs, wanted: &wanted, upstream, single: T::SINGLE };
        for (i, gradient) in (self.mutant.gradients)(&wrong).into_iter().enumerate() {
            let Some(gradient) = gradient.map(|g| g.cast::<T>()) else { continue };
            let terms =
                |out: &mut [T], f: fn(&mut T, T)| out.iter_mut().zip(gradient.data()).for_each(|(o, &g)| f(o, g));
            match self.mutant.hand_over {
                HandOver::Right => sink.give(i, gradient),
                HandOver::Overwriting => sink.accumulate(i, |out, _| terms(out, |o, g| *o = g)),
                HandOver::OntoStale => sink.accumulate(i, |out, _| terms(out, |o, g| *o += g)),
            }
        }
    }
}

#[test]
fn every_planted_bug_is_noticed() {
    let _turn = crate::take_turns();
    let mut missed = Vec::new();
    let mut useful: BTreeMap<&str, usize> = BTreeMap::new();
    let mut real: BTreeMap<&str, Vec<Subject>> = BTreeMap::new();
    let columns: Vec<&str> = CHECKS.iter().map(|(name, _)| *name).collect();
    println!("{:14} {:44} noticed by", "class", "mutant");
    for mutant in bugs::ALL {
        let mut noticed = vec![false; CHECKS.len()];
        // The finite differences are the op's own, and taken once.
        let known = real.entry(mutant.op).or_insert_with(|| {
            let cases = registry::all().into_iter().filter(|e| e.name == mutant.op).flat_map(|e| e.cases());
            cases.map(|real| Subject::new(Box::leak(real), 1)).collect::<Vec<_>>()
        });
        for (case, real) in planted(mutant).into_iter().zip(known) {
            let subject = real.altered(&case);
            for (noticed, (_, check)) in noticed.iter_mut().zip(CHECKS) {
                *noticed = check(&subject).is_err();
            }
            // All checks of the first case that shows it.
            if noticed.contains(&true) {
                break;
            }
        }
        let by: Vec<&str> = columns.iter().zip(&noticed).filter(|(_, n)| **n).map(|(c, _)| *c).collect();
        println!("{:14} {:44} {}", mutant.class, format!("{} {}", mutant.op, mutant.name), by.join(" "));
        match by[..] {
            [] => missed.push(format!("{} {}", mutant.op, mutant.name)),
            [only] => *useful.entry(only).or_default() += 1,
            _ => {}
        }
    }
    let alone: Vec<_> = columns.iter().map(|c| format!("{c} {}", useful.get(c).unwrap_or(&0))).collect();
    println!("{} mutants, {} missed; noticed by one check alone: {}", bugs::ALL.len(), missed.len(), alone.join(", "));
    assert!(missed.is_empty(), "bugs that no check notices: {missed:?}");
}

#[test]
fn the_mutants_are_many_and_of_every_class() {
    assert!(bugs::ALL.len() >= 40, "only {}", bugs::ALL.len());
    let classes: std::collections::BTreeSet<&str> = bugs::ALL.iter().map(|m| m.class).collect();
    assert_eq!(classes.into_iter().collect::<Vec<_>>(), bugs::CLASSES);
    let names: std::collections::BTreeSet<_> = bugs::ALL.iter().map(|m| (m.op, m.name)).collect();
    assert_eq!(names.len(), bugs::ALL.len(), "two mutants have one name");
    assert!(Planted::cases().len() >= bugs::ALL.len());
}
