//! The numeric side: finite differences, one movement of the inputs after the other.

use std::collections::BTreeMap;

use super::options::{Options, Stencil};
use crate::random::{Random, Stream};
use crate::tensor::{Tensor, Var};

/// The quotients along one movement of the inputs, met with the cotangents.
#[derive(Clone, Copy, Debug)]
pub struct Quotient {
    /// From both sides, as the stencil says.
    pub central: f64,
    /// (f(x) - f(x - h)) / h.
    pub left: f64,
    /// (f(x + h) - f(x)) / h.
    pub right: f64,
    /// The least value that a derivative can have if each output takes either of its one-sided ones.
    pub low: f64,
    /// The greatest.
    pub high: f64,
}

impl Quotient {
    /// Whether the one-sided quotients disagree, beside a gradient of the given size.
    ///
    /// A smooth function's differ by its curvature times the step; at a kink they differ by the jump of the slope.
    pub fn is_kink(&self, scale: f64) -> bool {
        let scale = scale.max(self.left.abs()).max(self.right.abs());
        let apart = |a: f64, b: f64| (a - b).abs() > 1e-2 * scale;
        apart(self.left, self.right) || apart(self.low, self.high)
    }
}

/// How one input was moved, and what came of it.
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

/// The whole numeric side.
#[derive(Clone, Debug)]
pub struct Measured {
    /// For every input that is differentiated.
    pub inputs: Vec<Option<Differences>>,
    /// The ties among their kinks, where they have a derivative together.
    pub ties: Vec<Tie>,
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
    let evaluate = |inputs: &[Tensor<f64>]| -> Vec<Tensor<f64>> {
        let constants: Vec<_> = inputs.iter().cloned().map(Var::constant).collect();
        f(&constants).into_iter().map(Var::into_value).collect()
    };
    let centre = evaluate(inputs);
    let fits = |(y, c): (&Tensor<f64>, &Option<Tensor<f64>>)| c.as_ref().is_none_or(|c| c.shape() == y.shape());
    if centre.len() != cotangents.len() || !centre.iter().zip(cotangents).all(fits) {
        return Err("the outputs have other shapes when nothing is tracked".into());
    }
    let prober = Prober { evaluate, inputs, centre, cotangents, options };
    let mut found = vec![None; inputs.len()];
    for &i in tracked {
        let n = inputs[i].len();
        let directions = options.directions.filter(|&count| count < n).map(|count| {
            let mut random = Random::of(options.seed, Stream::InputDirections(i as u64));
            let mut draw = |_| (0..n).map(|_| random.normal() / (n as f64).sqrt()).collect::<Vec<f64>>();
            (0..count).map(&mut draw).collect::<Vec<_>>()
        });
        let quotients = match &directions {
            None => (0..n).map(|k| prober.probe(&[(i, k, 1.0)])).collect(),
            Some(all) => {
                let movement = |d: &Vec<f64>| d.iter().enumerate().map(|(k, &d)| (i, k, d)).collect::<Vec<_>>();
                all.iter().map(|d| prober.probe(&movement(d))).collect()
            }
        };
        found[i] = Some(Differences { directions, quotients });
    }
    let ties = ties(&prober, &found);
    Ok(Measured { inputs: found, ties })
}

/// Moves inputs and looks at what the outputs do.
struct Prober<'a, F> {
    evaluate: F,
    inputs: &'a [Tensor<f64>],
    centre: Vec<Tensor<f64>>,
    cotangents: &'a [Option<Tensor<f64>>],
    options: &'a Options,
}

impl<F: Fn(&[Tensor<f64>]) -> Vec<Tensor<f64>>> Prober<'_, F> {
    /// The step along a movement: (input, element, how far) of each element that moves.
    fn step(&self, movement: &[(usize, usize, f64)]) -> f64 {
        let largest = movement.iter().map(|&(i, k, _)| self.inputs[i].data()[k].abs());
        let largest = largest.filter(|x| x.is_finite()).fold(1.0, f64::max);
        let mut h = self.options.step * largest;
        if let [(i, k, _)] = *movement {
            // The step that is really taken, after rounding.
            let x = self.inputs[i].data()[k];
            h = if x.is_finite() { (x + h) - x } else { h };
        }
        h
    }

    /// The outputs after a movement by `h`.
    fn at(&self, movement: &[(usize, usize, f64)], h: f64) -> Vec<Tensor<f64>> {
        let mut moved = self.inputs.to_vec();
        movement.iter().for_each(|&(i, k, far)| moved[i].data_mut()[k] += h * far);
        (self.evaluate)(&moved)
    }

    /// The quotient along a movement.
    fn probe(&self, movement: &[(usize, usize, f64)]) -> Quotient {
        let h = self.step(movement);
        let at = |h: f64| self.at(movement, h);
        let (above, below) = (at(h), at(-h));
        let mut q = Quotient { central: 0.0, left: 0.0, right: 0.0, low: 0.0, high: 0.0 };
        for_each_number(self.cotangents, [&above, &self.centre, &below], |c, [above, centre, below]| {
            let (right, left) = (c * change(above, centre) / h, c * change(centre, below) / h);
            q.central += c * change(above, below) / (2.0 * h);
            q.right += right;
            q.left += left;
            q.low += right.min(left);
            q.high += right.max(left);
        });
        if self.options.stencil == Stencil::FivePoint {
            let (far_above, far_below) = (at(2.0 * h), at(-2.0 * h));
            let mut far = 0.0;
            for_each_number(self.cotangents, [&far_above, &self.centre, &far_below], |c, [above, _, below]| {
                far += c * change(above, below) / (4.0 * h);
            });
            q.central += (q.central - far) / 3.0;
        }
        q
    }

    /// Between what the derivative of one member of a tie must lie.
    fn bounds(&self, member: (usize, usize), together: &[(usize, usize, f64)]) -> [f64; 2] {
        let alone = [(member.0, member.1, 1.0)];
        let (h, common) = (self.step(&alone), self.step(together));
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
fn ties<F: Fn(&[Tensor<f64>]) -> Vec<Tensor<f64>>>(prober: &Prober<F>, found: &[Option<Differences>]) -> Vec<Tie> {
    let mut groups: BTreeMap<u64, Vec<(usize, usize)>> = BTreeMap::new();
    let mut scale = 0.0;
    for (i, differences) in found.iter().enumerate() {
        let Some(differences) = differences.as_ref().filter(|d| d.directions.is_none()) else { continue };
        scale = differences.scale().max(scale);
        for (k, q) in differences.quotients.iter().enumerate() {
            if q.is_kink(differences.scale()) {
                // 0 and -0 are equal.
                groups.entry((prober.inputs[i].data()[k] + 0.0).to_bits()).or_default().push((i, k));
            }
        }
    }
    let groups = groups.into_values().filter(|members| members.len() > 1);
    groups
        .filter_map(|members| {
            let movement: Vec<_> = members.iter().map(|&(i, k)| (i, k, 1.0)).collect();
            let quotient = prober.probe(&movement);
            if quotient.is_kink(scale) {
                return None;
            }
            let bounds = members.iter().map(|&member| prober.bounds(member, &movement)).collect();
            Some(Tie { members, quotient, bounds })
        })
        .collect()
}
