//! The numeric side: finite differences, one movement of the inputs after the other.
//!
//! No single step suits every function: a long one sees the curvature, a short one sees rounding. So every movement is
//! made with two steps, whose extrapolation says how far it is to be believed, and where that is not enough, with a whole
//! ladder of them. The same ladder tells a kink from a bend: the gap between the one-sided quotients of a smooth function
//! shrinks with the step, that of a kink stays.

use std::collections::BTreeMap;

use super::function::{Function, OfVars};
use super::options::{Options, Stencil};
use crate::random::{Random, Stream};
use crate::tensor::{Tensor, Var};

/// Difference quotients of `<cotangents, f>` along one direction: central, one-sided, and how far they may be off.
#[derive(Clone, Copy, Debug)]
pub struct Quotient {
    /// From both sides, extrapolated to a step of zero.
    pub central: f64,
    /// How far `central` may be off: what the last extrapolation changed, and rounding.
    pub error: f64,
    /// (f(x) - f(x - h)) / h.
    pub left: f64,
    /// (f(x + h) - f(x)) / h.
    pub right: f64,
    /// The least value that a derivative can have if each output takes either of its one-sided ones.
    pub low: f64,
    /// The greatest.
    pub high: f64,
    /// The error that rounding is good for: some of the best that differences can do where outputs are of this size.
    pub rounding: f64,
    /// Whether the gap between the sides stays however short the step.
    pub kink: bool,
    /// Whether an output moved at all.
    pub moves: bool,
}

impl Quotient {
    /// Whether the one-sided quotients disagree however short the step.
    pub fn is_kink(&self) -> bool {
        self.kink
    }
}

/// The quotients of one step.
#[derive(Clone, Copy, Debug, Default)]
struct Step {
    h: f64,
    central: f64,
    left: f64,
    right: f64,
    low: f64,
    high: f64,
    /// What rounding alone may do to a quotient.
    noise: f64,
    /// The sum of the outputs' sizes, met with the cotangents.
    outputs: f64,
    moves: bool,
}

impl Step {
    /// How far the one-sided quotients are apart, output by output.
    fn gap(&self) -> f64 {
        self.high - self.low
    }

    fn size(&self) -> f64 {
        self.left.abs().max(self.right.abs())
    }

    fn is_finite(&self) -> bool {
        [self.central, self.low, self.high].iter().all(|x| x.is_finite())
    }
}

/// The polynomial in h^2 through the central quotients of some steps, at h = 0; and how far the last step moved it.
fn extrapolate(steps: &[Step]) -> [f64; 2] {
    let mut row: Vec<f64> = steps.iter().map(|s| s.central).collect();
    let n = row.len();
    let mut before = [f64::NAN; 2];
    for order in 1..n {
        if order == n - 1 {
            before = [row[0], row[1]];
        }
        for k in 0..n - order {
            let ratio = (steps[k].h / steps[k + order].h).powi(2);
            row[k] = row[k + 1] + (row[k + 1] - row[k]) / (ratio - 1.0);
        }
    }
    // Of the two extrapolations that the last one joins, that of the shorter steps.
    let short = (row[0] - before[1]).abs();
    [row[0], if n > 2 { short.max(1e-2 * (row[0] - before[0]).abs()) } else { short }]
}

/// Difference quotients of one input, element by element or along random directions.
#[derive(Clone, Debug)]
pub struct Differences {
    /// The directions: element `k` alone is direction `k`, without.
    pub directions: Option<Vec<Vec<f64>>>,
    /// The quotient along each.
    pub quotients: Vec<Quotient>,
}

impl Differences {
    /// The derivatives along the same directions that a gradient promises.
    pub(super) fn along(&self, gradient: &[f64]) -> Vec<f64> {
        match &self.directions {
            None => gradient.to_vec(),
            Some(all) => all.iter().map(|d| d.iter().zip(gradient).map(|(d, g)| d * g).sum()).collect(),
        }
    }

    /// The largest quotient.
    fn scale(&self) -> f64 {
        self.quotients.iter().fold(0.0, |m, q| m.max(q.central.abs()))
    }
}

/// Elements of equal value, each on a kink by itself, that were moved together.
///
/// Where several numbers tie, none of them has a derivative, but all of them together do: a maximum of three equal
/// numbers rises as fast as they all do. So their gradients have a sum that can be checked.
#[derive(Clone, Debug)]
pub struct Tie {
    /// (input, element) of each.
    pub members: Vec<(usize, usize)>,
    /// The quotient along their common movement.
    pub quotient: Quotient,
    /// Between what each member's own derivative must lie: every output takes its one-sided ones or the common one.
    pub bounds: Vec<[f64; 2]>,
}

/// Finite differences of all inputs, and what they tell of kinks and ties.
#[derive(Clone, Debug)]
pub struct Measured {
    /// For every input that is differentiated.
    pub inputs: Vec<Option<Differences>>,
    /// The ties among their kinks, where they have a derivative together.
    pub ties: Vec<Tie>,
    /// For every input that is differentiated, whether the function depends on it, here or nearby.
    pub moves: Vec<bool>,
}

/// The difference quotients of `f`, met with `cotangents` (one an output; `None` for outputs that are not
/// differentiated), for every input in `tracked`.
///
/// # Errors
/// If the outputs have other shapes than the cotangents.
pub fn differences(
    f: impl Fn(&[Var<f64>]) -> Vec<Var<f64>>,
    inputs: &[Tensor<f64>],
    tracked: &[usize],
    cotangents: &[Option<Tensor<f64>>],
    options: &Options,
) -> Result<Measured, String> {
    measure(&OfVars::new(f, tracked), inputs, tracked, cotangents, options)
}

/// [`differences()`] of any function.
pub(super) fn measure(
    f: &dyn Function,
    inputs: &[Tensor<f64>],
    tracked: &[usize],
    cotangents: &[Option<Tensor<f64>>],
    options: &Options,
) -> Result<Measured, String> {
    let centre = f.values(inputs);
    let fits = |(y, c): (&Tensor<f64>, &Option<Tensor<f64>>)| c.as_ref().is_none_or(|c| c.shape() == y.shape());
    if centre.len() != cotangents.len() || !centre.iter().zip(cotangents).all(fits) {
        return Err("the outputs have other shapes when nothing is tracked".into());
    }
    let prober = Prober::new(f, inputs, centre, cotangents, options);
    let mut found = vec![None; inputs.len()];
    for &i in tracked {
        let n = inputs[i].len();
        let directions = options.directions.filter(|&count| count < n).map(|count| {
            let mut random = Random::of(options.seed, Stream::InputDirections(i as u64));
            let mut draw = |_| (0..n).map(|_| random.normal() / (n as f64).sqrt()).collect::<Vec<f64>>();
            (0..count).map(&mut draw).collect::<Vec<_>>()
        });
        let movements: Vec<Movement> = match &directions {
            None => (0..n).map(|k| vec![(i, k, 1.0)]).collect(),
            Some(all) => all.iter().map(|d| d.iter().enumerate().map(|(k, &d)| (i, k, d)).collect()).collect(),
        };
        let mut quotients: Vec<_> = movements.iter().map(|movement| prober.probe(movement)).collect();
        // What is enough for an element depends on the largest, which is known only now.
        let scale = quotients.iter().fold(0.0, |m: f64, (q, _)| m.max(q.central.abs()));
        for ((q, doubtful), movement) in quotients.iter_mut().zip(&movements) {
            if *doubtful || !q.error.is_finite() || q.error > 0.1 * options.tolerance.allowed(q.central, scale) {
                *q = prober.climb(movement, scale);
            }
        }
        let quotients: Vec<Quotient> = quotients.into_iter().map(|(q, _)| q).collect();
        found[i] = Some(Differences { directions, quotients });
    }
    let moves = (0..inputs.len()).map(|i| {
        let seen = |d: &Differences| d.quotients.iter().any(|q| q.moves);
        found[i].as_ref().is_some_and(|d| seen(d) || prober.moves_nearby(i, tracked))
    });
    let moves = moves.collect();
    let ties = ties(&prober, &found);
    Ok(Measured { inputs: found, ties, moves })
}

/// What moves together: (input, element, how far) of each.
type Movement = Vec<(usize, usize, f64)>;

/// Moves inputs and looks at what the outputs do.
struct Prober<'a> {
    f: &'a dyn Function,
    inputs: &'a [Tensor<f64>],
    centre: Vec<Tensor<f64>>,
    cotangents: &'a [Option<Tensor<f64>>],
    options: &'a Options,
    epsilon: f64,
    /// The sum of the outputs' sizes, met with the cotangents.
    size: f64,
    /// What two runs may differ by, met with the cotangents.
    jitter: f64,
}

impl<'a> Prober<'a> {
    fn new(
        f: &'a dyn Function,
        inputs: &'a [Tensor<f64>],
        centre: Vec<Tensor<f64>>,
        cotangents: &'a [Option<Tensor<f64>>],
        options: &'a Options,
    ) -> Self {
        let (mut size, mut jitter) = (0.0, 0.0);
        for_each_number(cotangents, [&centre], |c, [y]| {
            size += if y.is_finite() { (c * y).abs() } else { 0.0 };
            jitter += c.abs() * options.nondeterminism;
        });
        Prober { f, inputs, centre, cotangents, options, epsilon: f.epsilon(), size, jitter }
    }

    /// The largest and the least size of the numbers that move, beside how far they do.
    fn sizes(&self, movement: &[(usize, usize, f64)]) -> [f64; 2] {
        let sizes = movement.iter().map(|&(i, k, _)| self.inputs[i].data()[k].abs()).filter(|x| x.is_finite());
        sizes.fold([1.0, 1.0], |[large, small], x| [large.max(x), if x > 0.0 { small.min(x) } else { small }])
    }

    /// The outputs after a movement by `h`.
    fn at(&self, movement: &[(usize, usize, f64)], h: f64) -> Vec<Tensor<f64>> {
        let mut moved = self.inputs.to_vec();
        movement.iter().for_each(|&(i, k, far)| moved[i].data_mut()[k] += h * far);
        self.f.values(&moved)
    }

    /// The quotients of a step.
    fn step(&self, movement: &[(usize, usize, f64)], h: f64) -> Step {
        let (mut up, mut down) = (h, h);
        if let [(i, k, far)] = *movement {
            // The steps that are really taken, after rounding.
            let x = self.inputs[i].data()[k];
            let real = |h: f64| (self.f.round(x + h * far) - x) / far;
            if x.is_finite() && real(h) > 0.0 && real(-h) < 0.0 {
                (up, down) = (real(h), -real(-h));
            }
        }
        let (above, below) = (self.at(movement, up), self.at(movement, -down));
        let mut s = Step { h, ..Step::default() };
        let mut size = 0.0;
        for_each_number(self.cotangents, [&above, &self.centre, &below], |c, [above, centre, below]| {
            let (right, left) = (c * change(above, centre) / up, c * change(centre, below) / down);
            s.central += c * change(above, below) / (up + down);
            s.right += right;
            s.left += left;
            s.low += right.min(left);
            s.high += right.max(left);
            s.moves |= above != centre || below != centre;
            let largest = above.abs().max(centre.abs()).max(below.abs());
            size += if largest.is_finite() { (c * largest).abs() } else { 0.0 };
        });
        // The inputs are rounded as well, where several move; and so is what the outputs are computed from.
        let moved = if movement.len() > 1 { self.sizes(movement)[0] * s.size() } else { 0.0 };
        s.outputs = size;
        s.noise = (self.epsilon * (size + moved) + self.jitter) / h;
        s
    }

    /// The step that the options ask for.
    fn usual(&self, movement: &[(usize, usize, f64)]) -> f64 {
        self.options.step * self.sizes(movement)[0]
    }

    /// The quotient along a movement, by two or three steps; and whether it may be a kink.
    fn probe(&self, movement: &[(usize, usize, f64)]) -> (Quotient, bool) {
        let h = self.usual(movement);
        let factors: &[f64] = match self.options.stencil {
            Stencil::Central => &[1.0, 0.5],
            Stencil::FivePoint => &[2.0, 1.0, 0.5],
        };
        let steps: Vec<Step> = factors.iter().map(|factor| self.step(movement, factor * h)).collect();
        let [before, last] = [steps[steps.len() - 2], steps[steps.len() - 1]];
        let [central, error] = extrapolate(&steps);
        let doubtful =
            !steps.iter().all(Step::is_finite) || last.gap() > 0.6 * before.gap() && last.gap() > 10.0 * last.noise;
        (self.quotient(&last, central, error + 2.0 * last.noise, movement), doubtful)
    }

    /// The error that rounding is good for, where outputs are of a size.
    fn rounding(&self, size: f64, movement: &[(usize, usize, f64)]) -> f64 {
        250.0 * self.epsilon.powf(2.0 / 3.0) * size / self.sizes(movement)[0]
    }

    fn quotient(&self, s: &Step, central: f64, error: f64, movement: &[(usize, usize, f64)]) -> Quotient {
        let rounding = self.rounding(self.size, movement);
        let Step { left, right, low, high, moves, .. } = *s;
        Quotient { central, error, left, right, low, high, rounding, kink: false, moves }
    }

    /// The quotient along a movement, by steps of all lengths; `scale` is the largest of the same input.
    fn climb(&self, movement: &[(usize, usize, f64)], scale: f64) -> Quotient {
        let [large, small] = self.sizes(movement);
        let longest = (0.5 * self.epsilon.powf(0.2)).max(self.options.step) * large;
        let shortest = (self.epsilon.powf(0.6) * large).min(1e-5 * small);
        let mut steps = Vec::new();
        let mut h = longest;
        while h > shortest && h > self.epsilon.powf(0.55) * small && steps.len() < MOST_STEPS {
            let step = self.step(movement, h);
            steps.push(step);
            h /= 4.0;
        }
        let steps: Vec<Step> = steps.into_iter().filter(Step::is_finite).collect();
        // The window of neighbouring steps whose extrapolation moves least.
        let windows = (2..=4).flat_map(|n| steps.windows(n));
        let extrapolated = windows.map(|w| {
            let last = &w[w.len() - 1];
            let [central, error] = extrapolate(w);
            (central, error + 2.0 * last.noise, last)
        });
        let mut all: Vec<_> = extrapolated.collect();
        all.sort_by(|a, b| a.1.total_cmp(&b.1));
        let Some(&(central, error, last)) = all.first() else {
            // Beyond one of the sides there is nothing, however short the step.
            let s = self.step(movement, self.usual(movement));
            return self.quotient(&s, s.central, f64::INFINITY, movement);
        };
        // The best of many is better than it is by chance: the runners-up say by how much.
        let error = all.iter().take(3).fold(error, |m, other| m.max((other.0 - central).abs()));
        let mut q = self.quotient(last, central, error, movement);
        // Where outputs vanish here, what rounds is their size along the way.
        let size = steps.iter().fold(self.size, |m, s| m.max(s.outputs));
        q.rounding = self.rounding(size, movement);
        if let Some(at) = self.kink(&steps, scale) {
            q = self.quotient(at, at.central, at.noise, movement);
            q.kink = true;
        }
        q.moves = steps.iter().any(|s| s.moves);
        q
    }

    /// A step whose one-sided quotients are those of a kink, if there is one: their gap stays over the shortest steps
    /// that rounding leaves to be believed.
    fn kink<'s>(&self, steps: &'s [Step], scale: f64) -> Option<&'s Step> {
        let believed = (30.0 * self.epsilon.powf(2.0 / 3.0)).max(1e-6);
        let size = |s: &Step| scale.max(s.size());
        let clear = |s: &&Step| s.noise <= believed * size(s);
        let clear: Vec<&Step> = steps.iter().filter(clear).collect();
        let last = &clear[clear.len().saturating_sub(3)..];
        let stays = last.windows(2).all(|w| {
            let ratio = w[1].gap() / w[0].gap();
            (0.65..=2.5).contains(&ratio)
        });
        let at = *last.last()?;
        let is_gap = at.gap() > 20.0 * at.noise && at.gap() > 100.0 * believed * size(at);
        (last.len() > 1 && stays && is_gap).then_some(at)
    }

    /// Whether an input matters in the neighbourhood, though nothing moves with it here: behind weights of zero, say.
    fn moves_nearby(&self, input: usize, tracked: &[usize]) -> bool {
        let mut random = Random::of(self.options.seed, Stream::InputDirections(NEARBY));
        (0..3).any(|_| {
            let mut nearby = self.inputs.to_vec();
            for &i in tracked {
                nearby[i].data_mut().iter_mut().for_each(|x| *x += 1e-2 * random.normal() * x.abs().max(1.0));
            }
            let here = self.f.values(&nearby);
            nearby[input] = self.inputs[input].clone();
            let there = self.f.values(&nearby);
            let mut moves = false;
            let same_shapes = here.iter().zip(&there).all(|(a, b)| a.shape() == b.shape());
            if same_shapes && here.iter().zip(&self.centre).all(|(a, b)| a.shape() == b.shape()) {
                for_each_number(self.cotangents, [&here, &there], |_, [a, b]| moves |= a != b && (a - b).is_finite());
            }
            moves
        })
    }

    /// Between what the derivative of one member of a tie must lie.
    fn bounds(&self, member: (usize, usize), together: &[(usize, usize, f64)]) -> [f64; 2] {
        let alone = [(member.0, member.1, 1.0)];
        let (h, common) = (self.usual(&alone), self.usual(together));
        let (above, below) = (self.at(&alone, h), self.at(&alone, -h));
        let (all_above, all_below) = (self.at(together, common), self.at(together, -common));
        let (mut low, mut high) = (0.0, 0.0);
        let outputs = [&above, &self.centre, &below, &all_above, &all_below];
        for_each_number(
            self.cotangents,
            outputs.map(Vec::as_slice),
            |c, [above, centre, below, all_above, all_below]| {
                let slopes = [
                    change(above, centre) / h,
                    change(centre, below) / h,
                    change(all_above, all_below) / (2.0 * common),
                ];
                let slopes = slopes.map(|slope| c * slope);
                low += slopes.into_iter().fold(f64::INFINITY, f64::min);
                high += slopes.into_iter().fold(f64::NEG_INFINITY, f64::max);
            },
        );
        [low, high]
    }
}

/// Steps of a ladder.
const MOST_STEPS: usize = 24;
/// The stream of the neighbourhood's directions: no input has this number.
const NEARBY: u64 = (1 << 32) - 1;

/// a - b; an infinity that does not move has no slope of its own, and must not become NaN.
fn change(a: f64, b: f64) -> f64 {
    if a == b { 0.0 } else { a - b }
}

/// Calls `f` with every cotangent that is not zero, and the number that it belongs to in each of several outputs.
fn for_each_number<const N: usize>(
    cotangents: &[Option<Tensor<f64>>],
    outputs: [&[Tensor<f64>]; N],
    mut f: impl FnMut(f64, [f64; N]),
) {
    for (o, c) in cotangents.iter().enumerate() {
        let Some(c) = c else { continue };
        for (k, &c) in c.data().iter().enumerate() {
            // One-hot cotangents are mostly zeros.
            if c != 0.0 {
                f(c, outputs.map(|y| y[o].data()[k]));
            }
        }
    }
}

/// Moves elements of equal value that stand on kinks together, and keeps the groups that have a derivative so.
fn ties(prober: &Prober, found: &[Option<Differences>]) -> Vec<Tie> {
    let mut groups: BTreeMap<u64, Vec<(usize, usize)>> = BTreeMap::new();
    let mut scale = 0.0;
    for (i, differences) in found.iter().enumerate() {
        let Some(differences) = differences.as_ref().filter(|d| d.directions.is_none()) else { continue };
        scale = differences.scale().max(scale);
        for (k, q) in differences.quotients.iter().enumerate() {
            if q.is_kink() {
                // 0 and -0 are equal.
                groups.entry((prober.inputs[i].data()[k] + 0.0).to_bits()).or_default().push((i, k));
            }
        }
    }
    let groups = groups.into_values().filter(|members| members.len() > 1);
    groups
        .filter_map(|members| {
            let movement: Movement = members.iter().map(|&(i, k)| (i, k, 1.0)).collect();
            let quotient = prober.climb(&movement, scale);
            if quotient.is_kink() {
                return None;
            }
            let bounds = members.iter().map(|&member| prober.bounds(member, &movement)).collect();
            Some(Tie { members, quotient, bounds })
        })
        .collect()
}
