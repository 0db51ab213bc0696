//! How the residuals of many pairs change when a camera is changed: a profile along one parameter.
//!
//! For every value of the parameter each pair gets its own best motion, so that what a profile shows is the camera's alone.

use rayon::prelude::*;
use serde::Serialize;

use super::epipolar::{Motion, Pair, Pinhole};
use super::track::Matches;

/// Standard errors by which the cost may exceed the least at values that are still allowed, and by how many more, over the
/// number of pairs: errors of few pairs are not well known.
const ERRORS: f64 = 3.0;
const FEW: f64 = 12.0;

/// A way in which a camera may be wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Parameter {
    /// Both focal lengths, times a factor.
    Focal,
    /// The principal point, moved along an axis (0 right, 1 down) by a share of the picture's width (of square pixels,
    /// whatever the picture was resized to).
    Centre(usize),
}

impl Parameter {
    /// The values that are tried, in order; the middle one leaves the camera as it is.
    pub(super) fn values(self) -> Vec<f64> {
        match self {
            Parameter::Focal => (-12..=12).map(|k| (0.045 * f64::from(k)).exp()).collect(),
            Parameter::Centre(_) => (-10..=10).map(|k| 0.02 * f64::from(k)).collect(),
        }
    }

    /// The camera with a value, for pictures of so many pixels across.
    pub(super) fn apply(self, camera: Pinhole, value: f64, width: usize) -> Pinhole {
        let mut changed = camera;
        match self {
            Parameter::Focal => changed.focal = camera.focal.map(|f| f * value),
            Parameter::Centre(axis) => {
                changed.centre[axis] += value * width as f64 * camera.focal[axis] / camera.focal[0]
            }
        }
        changed
    }
}

/// The costs of each pair at each value: `costs[value][pair]`, sums of losses in squared pixels.
pub(super) struct Profile {
    pub(super) values: Vec<f64>,
    pub(super) costs: Vec<Vec<f64>>,
}

/// The values of a parameter that pairs allow.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Range {
    /// The value that explains all pairs best.
    pub best: f64,
    /// The smallest value that explains them nearly as well; an end of what was tried if there is no smaller bound.
    pub low: f64,
    /// The largest such value.
    pub high: f64,
}

impl Profile {
    /// The values that pairs allow: those at which the costs of the pairs together exceed the least by no more than chance
    /// explains, some standard errors of the sum of the pairs' differences. What all matches of a pair share (noise, a
    /// car that moves) is one draw of chance in it, not hundreds.
    pub(super) fn range(&self) -> Range {
        let sum = |costs: &Vec<f64>| costs.iter().sum::<f64>();
        let by_sum = |a: &usize, b: &usize| sum(&self.costs[*a]).total_cmp(&sum(&self.costs[*b]));
        let best = (0..self.values.len()).min_by(by_sum).unwrap_or(0);
        let n = self.costs.first().map_or(0, Vec::len) as f64;
        let errors = ERRORS + FEW / n.max(1.0);
        let allowed = |value: usize| {
            let more: Vec<f64> = self.costs[value].iter().zip(&self.costs[best]).map(|(a, b)| a - b).collect();
            let mean = more.iter().sum::<f64>() / n;
            let variance = more.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
            mean * n <= errors * (variance * n).sqrt()
        };
        let mut values = (0..self.values.len()).filter(|&value| value == best || allowed(value));
        let low = values.next().unwrap_or(best);
        let high = values.next_back().unwrap_or(low);
        Range { best: self.values[best], low: self.values[low], high: self.values[high] }
    }
}

/// The matches of a pair, and its best motion under the camera as it is.
pub(super) struct Solved {
    pub(super) matches: Matches,
    pub(super) motion: Motion,
}

/// The profile of a camera along a parameter. Residuals beyond some `scale` pixels do not count.
pub(super) fn profile(pairs: &[Solved], camera: Pinhole, width: usize, along: Parameter, scale: f64) -> Profile {
    let values = along.values();
    let of_pair = |pair: &Solved| {
        let mut costs = vec![0.0; values.len()];
        let middle = values.len() / 2;
        // From the middle outwards, each search from what its neighbour found.
        for outward in [(0..=middle).rev().collect::<Vec<_>>(), (middle..values.len()).collect()] {
            let mut motion = pair.motion;
            for value in outward {
                let at = Pair::new(&pair.matches, along.apply(camera, values[value], width));
                motion = at.refine(motion, scale);
                costs[value] = at.cost(&motion, scale);
            }
        }
        costs
    };
    let by_pair: Vec<Vec<f64>> = pairs.par_iter().map(of_pair).collect();
    let costs = (0..values.len()).map(|value| by_pair.iter().map(|costs| costs[value]).collect()).collect();
    Profile { values, costs }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// Costs of pairs that are least at `best`, each pair's own curve off by chance.
    fn noisy(best: f64, noise: f64) -> Profile {
        let mut random = Random::new(3, 0);
        let own: Vec<f64> = (0..25).map(|_| best + noise * random.normal()).collect();
        let values = Parameter::Focal.values();
        let cost = |value: f64| own.iter().map(|own| 4.0 + (value - own).powi(2)).collect();
        let costs = values.iter().map(|&value| cost(value)).collect();
        Profile { values, costs }
    }

    #[test]
    fn the_range_holds_the_truth_and_is_as_wide_as_the_noise() {
        let close = noisy(1.2, 0.05).range();
        assert!((close.best - 1.2).abs() < 0.04 && close.low > 1.1 && close.high < 1.3, "{close:?}");
        let wide = noisy(1.2, 0.6).range();
        assert!(wide.low < 1.2 && wide.high > 1.2 && wide.high - wide.low > 0.4, "{wide:?}");
        // A curve that is flat allows everything.
        let values = Parameter::Centre(0).values();
        let costs = vec![vec![1.0; 9]; values.len()];
        let flat = Profile { values, costs }.range();
        assert!((flat.low + 0.2).abs() < 1e-12 && (flat.high - 0.2).abs() < 1e-12, "{flat:?}");
    }

    #[test]
    fn parameters_change_a_camera_by_what_they_say() {
        let camera = Pinhole { focal: [300.0, 150.0], centre: [160.0, 40.0] };
        for parameter in [Parameter::Focal, Parameter::Centre(0), Parameter::Centre(1)] {
            let values = parameter.values();
            assert_eq!(parameter.apply(camera, values[values.len() / 2], 320), camera);
        }
        assert_eq!(Parameter::Focal.apply(camera, 2.0, 320).focal, [600.0, 300.0]);
        assert_eq!(Parameter::Centre(0).apply(camera, 0.1, 320).centre, [192.0, 40.0]);
        // Rows were squeezed to half: so is the move.
        assert_eq!(Parameter::Centre(1).apply(camera, 0.1, 320).centre, [160.0, 56.0]);
    }
}
