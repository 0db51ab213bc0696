//! Every case of every op with all pieces of work made small: the second chunk, the third tile, the last block that is
//! shorter are compared with finite differences like the first ones. In f64 and f32, on 1, 2, 3 and 8 threads.
//!
//! The sizes are a switch of the whole process (`tensor::regime`), hence one test in a process of its own.

use std::collections::BTreeMap;

use parallax::gradcheck::{Gradients, Report, cotangents, differences, draw, options_of};
use parallax::ops::registry::{self, AnyCase};
use parallax::tensor::regime::{self, Cut};
use parallax::tensor::{Float, Tape, Tensor, Var, parallel};

const SEED: u64 = 1;
/// The largest size of a piece, in the unit of whoever cuts: elements, rows, blocks.
const SIZES: [usize; 5] = [1, 2, 3, 5, 8];
const THREADS: [usize; 3] = [2, 3, 8];
/// Largest error of an f32 output or gradient, of the largest number in it.
const SINGLE: f64 = 1e-4;

/// Whose cut it is: an op's own, or one of code that several ops share, which any of them may cross for all.
fn owner(op: &'static str, place: &str) -> &'static str {
    let shared = ["tensor/", "ops/support/", "ops/reduce/axis_loops"].iter().any(|folder| place.starts_with(folder));
    let borrowed = op != "conv2d" && place.starts_with("ops/conv/conv2d/");
    if shared || borrowed { "(shared)" } else { op }
}

/// Outputs, and the gradients of the tracked inputs.
type Outcome<T> = (Vec<Tensor<T>>, Vec<Option<Tensor<T>>>);

/// How an op runs in an element type.
type Run<'a, T> = &'a dyn Fn(&[&Var<T>]) -> Vec<Var<T>>;

/// Runs an op forward and backward; `before` is what each leaf's gradient already holds.
fn outcome<T: Float>(
    run: Run<T>,
    inputs: &[Tensor<T>],
    tracked: &[bool],
    seeds: &[Option<Tensor<T>>],
    before: Option<&[Tensor<T>]>,
) -> Outcome<T> {
    let tape = Tape::new();
    let leaf = |(x, &on): (&Tensor<T>, &bool)| if on { tape.leaf(x.clone()) } else { Var::constant(x.clone()) };
    let vars: Vec<Var<T>> = inputs.iter().zip(tracked).map(leaf).collect();
    let outputs = run(&vars.iter().collect::<Vec<_>>());
    let mut all: Vec<_> = outputs.iter().zip(seeds).filter_map(|(y, c)| Some((y, c.clone()?))).collect();
    if let Some(before) = before {
        all.extend(vars.iter().zip(before).zip(tracked).filter(|(_, on)| **on).map(|((x, c), _)| (x, c.clone())));
    }
    let mut gradients = tape.backward(&all);
    let gradients = vars.iter().map(|x| gradients.take(x)).collect();
    (outputs.into_iter().map(Var::into_value).collect(), gradients)
}

fn cast(x: &Tensor<f64>) -> Tensor<f32> {
    Tensor::from_vec(*x.shape(), x.data().iter().map(|&x| x as f32).collect())
}

/// Whether two outcomes have the same bits.
fn same<T: Float>(a: &Outcome<T>, b: &Outcome<T>) -> bool {
    let outputs = a.0.iter().zip(&b.0).all(|(x, y)| x.same_bits(y));
    outputs
        && a.1.iter().zip(&b.1).all(|(x, y)| match (x, y) {
            (Some(x), Some(y)) => x.same_bits(y),
            (x, y) => x.is_none() == y.is_none(),
        })
}

/// The largest difference of two lists of tensors, of the largest number in each tensor; infinite where one is finite and
/// the other is not.
fn distance<'a, T: Float, U: Float>(
    found: impl Iterator<Item = &'a Tensor<T>>,
    expected: impl Iterator<Item = &'a Tensor<U>>,
) -> f64 {
    let mut worst = 0.0_f64;
    for (x, y) in found.zip(expected) {
        let scale = y.data().iter().map(|y| y.f64().abs()).filter(|y| y.is_finite()).fold(1e-30, f64::max);
        for (x, y) in x.data().iter().zip(y.data()) {
            let (x, y) = (x.f64(), y.f64());
            worst = worst.max(match (x.is_finite(), y.is_finite()) {
                (true, true) => (x - y).abs() / scale,
                (false, false) => 0.0,
                _ => f64::INFINITY,
            });
        }
    }
    worst
}

/// What is known of one cut of one op: the most pieces, and whether a last piece was seen that is shorter, and one that
/// is not.
#[derive(Default)]
struct Crossed {
    cases: usize,
    most: usize,
    shorter: bool,
    whole: bool,
    by_length: bool,
}

impl Crossed {
    fn add(&mut self, cut: &Cut) {
        self.cases += 1;
        self.most = self.most.max(cut.pieces);
        self.by_length |= cut.rest.is_some();
        if cut.pieces > 1 {
            self.shorter |= cut.rest == Some(true);
            self.whole |= cut.rest != Some(true);
        }
    }
}

struct Suite {
    table: BTreeMap<(&'static str, String), Crossed>,
    failures: Vec<String>,
    runs: usize,
    /// The cuts that were made.
    #[cfg(mutants)]
    cuts: Vec<Cut>,
    /// A bug that is planted while kernels run with small pieces.
    #[cfg(mutants)]
    planted: Option<(&'static str, u32, regime::mutants::Bug)>,
}

impl Suite {
    fn new() -> Self {
        Suite {
            table: BTreeMap::new(),
            failures: Vec::new(),
            runs: 0,
            #[cfg(mutants)]
            cuts: Vec::new(),
            #[cfg(mutants)]
            planted: None,
        }
    }
}

impl Suite {
    fn case(&mut self, case: &dyn AnyCase) {
        let name = format!("{} [{}] \"{}\"", case.op(), case.algo(), case.name());
        let options = options_of(case, SEED);
        let tracked: Vec<bool> = (0..case.inputs().len()).map(|i| !options.constant.contains(&i)).collect();
        let inputs = draw(case, SEED);
        let run = |vars: &[&Var<f64>]| case.run(vars);
        let run_f32 = |vars: &[&Var<f32>]| case.run_f32(vars);
        let constants: Vec<Var<f64>> = inputs.iter().cloned().map(Var::constant).collect();
        let leaves: Vec<Var<f64>> = {
            let tape = Tape::new();
            constants
                .iter()
                .zip(&tracked)
                .map(|(x, &on)| if on { tape.leaf(x.value().clone()) } else { x.clone() })
                .collect()
        };
        let seeds = cotangents(&run(&leaves.iter().collect::<Vec<_>>()), SEED);
        let usual = outcome(&run, &inputs, &tracked, &seeds, None);
        let numbers: Vec<usize> = (0..inputs.len()).filter(|&i| tracked[i]).collect();
        let by_slices = |vars: &[Var<f64>]| run(&vars.iter().collect::<Vec<_>>());
        let measured =
            differences(by_slices, &inputs, &numbers, &seeds, &options).unwrap_or_else(|why| panic!("{name}: {why}"));
        // The same numbers in both types.
        let inputs_f32: Vec<Tensor<f32>> = inputs.iter().map(cast).collect();
        let widened: Vec<Tensor<f64>> = inputs_f32
            .iter()
            .map(|x| Tensor::from_vec(*x.shape(), x.data().iter().map(|x| f64::from(*x)).collect()))
            .collect();
        let seeds_f32: Vec<_> = seeds.iter().map(|s| s.as_ref().map(cast)).collect();
        let before: Vec<Tensor<f64>> = inputs
            .iter()
            .map(|x| {
                Tensor::build(*x.shape(), |out| {
                    out.iter_mut().enumerate().for_each(|(i, o)| *o = 0.25 + (i % 7) as f64)
                })
            })
            .collect();
        #[cfg(mutants)]
        regime::mutants::plant(self.planted);
        for size in SIZES {
            regime::shrink(size);
            self.runs += 1;
            let (found, cuts) =
                parallel::with_threads(1, || regime::record(|| outcome(&run, &inputs, &tracked, &seeds, None)));
            #[cfg(mutants)]
            self.cuts.extend(&cuts);
            for cut in &cuts {
                let file = cut.place.file().rsplit_once("src/").map_or(cut.place.file(), |(_, file)| file);
                let place = format!("{file}:{}", cut.place.line());
                self.table.entry((owner(case.op(), &place), place)).or_default().add(cut);
            }
            let mut fail = |why: String| self.failures.push(format!("{name}, pieces of {size}: {why}"));
            // The gradients, by the differences of the usual sizes; the values, by the usual ones.
            let filled = |(i, g): (usize, &Option<Tensor<f64>>)| {
                tracked[i].then(|| g.clone().unwrap_or_else(|| Tensor::zeros(*inputs[i].shape())))
            };
            let gradients =
                Gradients { cotangents: seeds.clone(), inputs: found.1.iter().enumerate().map(filled).collect() };
            if let Some(why) = Report::new(&gradients, &measured, &options).failure() {
                fail(why.to_string());
            }
            let off = distance(found.0.iter(), usual.0.iter());
            if off > 1e-10 {
                fail(format!("its values are off by {off:e}"));
            }
            // What is there already is added to.
            let added = parallel::with_threads(1, || outcome(&run, &inputs, &tracked, &seeds, Some(&before)));
            let expected: Vec<Tensor<f64>> = (0..inputs.len())
                .filter(|&i| tracked[i])
                .map(|i| {
                    let g = found.1[i].clone().unwrap_or_else(|| Tensor::zeros(*inputs[i].shape()));
                    let sums = g.data().iter().zip(before[i].data()).map(|(g, b)| g + b).collect();
                    Tensor::from_vec(*g.shape(), sums)
                })
                .collect();
            let off = distance(added.1.iter().flatten(), expected.iter());
            if off > 1e-11 {
                fail(format!("gradients are off by {off:e} where others were before"));
            }
            // f32, and every number of threads.
            let single = parallel::with_threads(1, || outcome(&run_f32, &inputs_f32, &tracked, &seeds_f32, None));
            let reference = parallel::with_threads(1, || outcome(&run, &widened, &tracked, &seeds, None));
            let off = distance(single.0.iter(), reference.0.iter())
                .max(distance(single.1.iter().flatten(), reference.1.iter().flatten()));
            if off > SINGLE {
                fail(format!("f32 is off by {off:e}"));
            }
            for threads in THREADS {
                let of_many = parallel::with_threads(threads, || outcome(&run, &inputs, &tracked, &seeds, None));
                if !same(&of_many, &found) {
                    fail(format!("{threads} threads give other bits"));
                }
                let of_many =
                    parallel::with_threads(threads, || outcome(&run_f32, &inputs_f32, &tracked, &seeds_f32, None));
                if !same(&of_many, &single) {
                    fail(format!("{threads} threads give other bits in f32"));
                }
            }
            regime::shrink(0);
            #[cfg(mutants)]
            if !self.failures.is_empty() {
                break;
            }
        }
        #[cfg(mutants)]
        regime::mutants::plant(None);
    }
}

/// The sizes are a switch of the whole process: tests take turns.
static TURN: std::sync::Mutex<()> = std::sync::Mutex::new(());

#[test]
fn every_piece_of_work_is_checked() {
    let _turn = TURN.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    let mut suite = Suite::new();
    for entry in registry::all() {
        for case in entry.cases() {
            suite.case(case.as_ref());
        }
    }
    let Suite { table, mut failures, runs, .. } = suite;
    for ((op, place), crossed) in &table {
        let Crossed { cases, most, shorter, whole, by_length } = crossed;
        println!("{op:24} {place:40} {cases:5} times, at most {most:5} pieces");
        let enough = *most > 2 && (!by_length || (*shorter && *whole));
        if !enough {
            failures.push(format!(
                "{op}: the cut at {place} has at most {most} pieces, a shorter last one: {shorter}, a whole one: {whole}"
            ));
        }
    }
    println!("{} cuts, {runs} cases with small pieces", table.len());
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
}

/// Bugs planted in the kernels themselves, at every cut of every op: each has to be noticed by the checks of an op that
/// makes the cut. `RUSTFLAGS="--cfg mutants" cargo test --test cuts planted -- --nocapture`
#[cfg(mutants)]
#[test]
fn planted_bugs_are_noticed() {
    use parallax::tensor::pool;
    use parallax::tensor::regime::mutants::{Bug, plant};

    let _turn = TURN.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    let entries = registry::all();
    // Which ops make which cuts.
    let mut places: BTreeMap<(&'static str, u32), Vec<usize>> = BTreeMap::new();
    for (k, entry) in entries.iter().enumerate() {
        for case in entry.cases() {
            let mut suite = Suite::new();
            suite.case(case.as_ref());
            for cut in suite.cuts {
                let file = cut.place.file().rsplit_once("src/").map_or(cut.place.file(), |(_, file)| file);
                let ops = places.entry((file, cut.place.line())).or_default();
                if !ops.contains(&k) {
                    ops.push(k);
                }
            }
        }
    }
    // What a piece that is not computed leaves behind must not be the right numbers of the time before.
    pool::set_poison(true);
    let (mut planted, mut survivors) = (0, Vec::new());
    for (&(file, line), ops) in &places {
        for &k in ops {
            for bug in Bug::ALL {
                planted += 1;
                let mut suite = Suite { planted: Some((file, line, bug)), ..Suite::new() };
                let mut noticed = false;
                for case in entries[k].cases() {
                    suite.case(case.as_ref());
                    if !suite.failures.is_empty() {
                        noticed = true;
                        break;
                    }
                }
                if !noticed {
                    survivors.push(format!("{}: {bug:?} at {file}:{line}", entries[k].name));
                }
            }
        }
    }
    plant(None);
    pool::set_poison(false);
    println!("{planted} bugs planted at {} cuts, {} not noticed", places.len(), survivors.len());
    assert!(survivors.is_empty(), "{}", survivors.join("\n"));
}
