//! Checks with all pieces of work made small: the second chunk, the third tile, the last block that is shorter
//! are compared with finite differences like the first ones. In f64 and f32, on several threads.

use std::collections::BTreeMap;

use super::outcome::{Outcome, distance, outcome, same};
use super::{Gradients, Report, Subject};
use crate::tensor::regime::{self, Cut};
use crate::tensor::{Tensor, Var, parallel};

/// The largest sizes of a piece that are tried, in the unit of whoever cuts: elements, rows, blocks.
pub const SIZES: [usize; 5] = [1, 2, 3, 5, 8];
/// The numbers of threads that must give the same bits as one.
const THREADS: [usize; 3] = [2, 3, 8];
/// Largest error of an f32 output or gradient, of the largest number in it.
const SINGLE: f64 = 1e-4;

/// Result of a case's checks with pieces of one size.
pub struct Found {
    /// The cuts that the op made, forward and backward.
    pub cuts: Vec<Cut>,
    /// Failed checks: name, and why.
    pub complaints: Vec<(&'static str, String)>,
}

/// A case to be checked with small pieces of work: its reference values, computed with pieces of the usual sizes.
pub struct Pieces<'a> {
    subject: &'a Subject<'a>,
    seeds: Vec<Option<Tensor<f64>>>,
    usual: Outcome<f64>,
    /// Gradients that are there before.
    before: Vec<Tensor<f64>>,
    inputs_f32: Vec<Tensor<f32>>,
    seeds_f32: Vec<Option<Tensor<f32>>>,
    /// The numbers of `inputs_f32` in f64.
    widened: Vec<Tensor<f64>>,
}

impl<'a> Pieces<'a> {
    /// Computes the reference values.
    pub fn new(subject: &'a Subject<'a>) -> Self {
        let seeds = subject.gradients().cotangents;
        let usual = outcome(&|vars| subject.case.run(vars), &subject.inputs, &subject.all, &|_| seeds.clone(), None);
        subject.measured();
        let before = |x: &Tensor<f64>| {
            Tensor::build(*x.shape(), |out| out.iter_mut().enumerate().for_each(|(i, o)| *o = 0.25 + (i % 7) as f64))
        };
        let inputs_f32: Vec<Tensor<f32>> = subject.inputs.iter().map(Tensor::cast).collect();
        Pieces {
            before: subject.inputs.iter().map(before).collect(),
            widened: inputs_f32.iter().map(Tensor::cast).collect(),
            seeds_f32: seeds.iter().map(|s| s.as_ref().map(Tensor::cast)).collect(),
            inputs_f32,
            usual,
            seeds,
            subject,
        }
    }

    /// Checks the case with pieces of at most `size` units. Where nothing is cut at that size nothing is compared: it is
    /// what was computed at the usual sizes.
    pub fn check(&self, size: usize) -> Found {
        regime::shrink(size, || self.check_here())
    }

    /// Checks the case with pieces of the size that is set.
    fn check_here(&self) -> Found {
        let Subject { case, inputs, all, .. } = self.subject;
        let run = |vars: &[&Var<f64>]| case.run(vars);
        let run_f32 = |vars: &[&Var<f32>]| case.run_f32(vars);
        let double = |inputs: &[Tensor<f64>], before| outcome(&run, inputs, all, &|_| self.seeds.clone(), before);
        let single = || outcome(&run_f32, &self.inputs_f32, all, &|_| self.seeds_f32.clone(), None);
        let alone = |f: &dyn Fn() -> Outcome<f64>| parallel::with_threads(1, f);

        let (found, cuts) = regime::record(|| alone(&|| double(inputs, None)));
        if cuts.iter().all(|cut| cut.pieces < 2) {
            return Found { cuts, complaints: Vec::new() };
        }
        let mut complaints = Vec::new();
        let mut complain = |check, why| complaints.push((check, why));
        if let Some(why) = self.report(&found).failure() {
            complain("differences", why.to_string());
        }
        let off = distance(found.0.iter(), self.usual.0.iter());
        if off > 1e-10 {
            complain("values", format!("its values are off by {off:e}"));
        }
        let added = alone(&|| double(inputs, Some(&self.before)));
        let off = distance(added.1.iter().flatten(), self.sums(&found).iter());
        if off > 1e-11 {
            complain("accumulation", format!("gradients are off by {off:e} where others were before"));
        }
        let narrow = parallel::with_threads(1, single);
        let reference = alone(&|| double(&self.widened, None));
        let off = distance(narrow.0.iter(), reference.0.iter())
            .max(distance(narrow.1.iter().flatten(), reference.1.iter().flatten()));
        if off > SINGLE {
            complain("single", format!("f32 is off by {off:e}"));
        }
        for threads in THREADS {
            let again = parallel::with_threads(threads, || double(inputs, None));
            let again_f32 = parallel::with_threads(threads, single);
            for (why, of) in [(same(&found, &again), "f64"), (same(&narrow, &again_f32), "f32")] {
                if let Err(why) = why {
                    complain("threads", format!("{why} on {threads} threads in {of}"));
                }
            }
        }
        Found { cuts, complaints }
    }

    /// Gradients against the finite differences, which are known.
    fn report(&self, found: &Outcome<f64>) -> Report {
        let zero = |(i, g): (usize, &Option<Tensor<f64>>)| {
            self.subject.all[i].then(|| g.clone().unwrap_or_else(|| Tensor::zeros(*self.subject.inputs[i].shape())))
        };
        let gradients =
            Gradients { cotangents: self.seeds.clone(), inputs: found.1.iter().enumerate().map(zero).collect() };
        Report::new(&gradients, self.subject.measured(), &self.subject.options)
    }

    /// Expected gradients where there were others before: the sums of both.
    fn sums(&self, found: &Outcome<f64>) -> Vec<Tensor<f64>> {
        let tracked = (0..self.before.len()).filter(|&i| self.subject.all[i]);
        let sum = |i: usize| {
            let g = found.1[i].clone().unwrap_or_else(|| Tensor::zeros(*self.before[i].shape()));
            let sums: Vec<f64> = g.data().iter().zip(self.before[i].data()).map(|(g, b)| g + b).collect();
            Tensor::from_vec(*g.shape(), sums)
        };
        tracked.map(sum).collect()
    }
}

/// Statistics of one cut: how often it was made, the most pieces, and whether a last piece was seen that is shorter,
/// and one that is not.
#[derive(Clone, Copy, Debug, Default)]
pub struct Crossed {
    /// How many calls cut there.
    pub times: usize,
    /// The most pieces.
    pub most: usize,
    shorter: bool,
    whole: bool,
    by_length: bool,
}

impl Crossed {
    fn add(&mut self, cut: &Cut) {
        self.times += 1;
        self.most = self.most.max(cut.pieces);
        self.by_length |= cut.rest.is_some();
        if cut.pieces > 1 {
            self.shorter |= cut.rest == Some(true);
            self.whole |= cut.rest != Some(true);
        }
    }
}

/// The table of regimes: every cut that cases made, by who cut and where.
#[derive(Default)]
pub struct Regimes {
    /// By op, kernel path and place in the source.
    pub rows: BTreeMap<(&'static str, &'static str, String), Crossed>,
}

impl Regimes {
    /// Adds cuts.
    pub fn add(&mut self, cuts: &[Cut]) {
        for cut in cuts {
            self.rows.entry((cut.op, cut.algo, cut.place())).or_default().add(cut);
        }
    }

    /// The places of which no case of any op that cuts there crosses the boundary: with more than two pieces, a last
    /// piece that is shorter, and one that is not.
    pub fn gaps(&self) -> Vec<String> {
        let mut places: BTreeMap<(&str, &str), Crossed> = BTreeMap::new();
        for ((op, _, place), row) in &self.rows {
            let all = places.entry((owner(op, place), place)).or_default();
            all.most = all.most.max(row.most);
            all.shorter |= row.shorter;
            all.whole |= row.whole;
            all.by_length |= row.by_length;
        }
        let crossed = |c: &Crossed| c.most > 2 && (!c.by_length || (c.shorter && c.whole));
        let open = places.into_iter().filter(|(_, c)| !crossed(c));
        open.map(|((op, place), c)| {
            let Crossed { most, shorter, whole, .. } = c;
            format!("{op}: the cut at {place} has at most {most} pieces, a shorter last one: {shorter}, a whole one: {whole}")
        })
        .collect()
    }

    /// How many places cut.
    pub fn places(&self) -> usize {
        self.rows.keys().map(|(_, _, place)| place).collect::<std::collections::BTreeSet<_>>().len()
    }
}

/// Whose cut it is: an op's own, or one of code that several ops share, which any of them may cross for all.
fn owner<'a>(op: &'a str, place: &str) -> &'a str {
    let shared = ["tensor/", "ops/support/", "ops/reduce/axis_loops"].iter().any(|folder| place.starts_with(folder));
    let borrowed = op != "conv2d" && place.starts_with("ops/conv/conv2d/");
    if shared || borrowed { "(shared)" } else { op }
}
