//! How well the matches of two pictures agree with a camera: the motion that explains them best, and what is left.
//!
//! A point at the ray p of the first picture lies at a ray q of the second with q . (t x R p) = 0, for the camera's rotation
//! R and its direction of travel t. The residual is Sampson's: the distance in pixels, to first order, by which both points
//! would have to be moved (Hartley and Zisserman, "Multiple View Geometry", 2nd edition, section 11.4.3).

use super::track::Matches;
use super::vectors::{
    Matrix, Vector, apply, apply_transposed, cross, dot, exponential, product, solve, tangents, unit,
};

/// A pinhole camera in pixels: focal lengths and principal point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pinhole {
    pub(super) focal: [f64; 2],
    pub(super) centre: [f64; 2],
}

impl Pinhole {
    /// The ray through a pixel, of depth 1.
    pub(super) fn ray(&self, [x, y]: [f64; 2]) -> Vector {
        [(x - self.centre[0]) / self.focal[0], (y - self.centre[1]) / self.focal[1], 1.0]
    }
}

/// A rotation, and a direction of travel of length 1 (whether forwards or backwards is not known).
#[derive(Clone, Copy, Debug)]
pub(super) struct Motion {
    pub(super) rotation: Matrix,
    pub(super) direction: Vector,
}

/// Geman and McClure's loss of a residual: its square where it is small, at most `scale` squared.
fn loss(residual: f64, scale: f64) -> f64 {
    let squared = residual * residual;
    squared / (1.0 + squared / (scale * scale))
}

/// The directions of travel that a search begins with.
const DIRECTIONS: [Vector; 5] = [[0.0, 0.0, 1.0], [0.7, 0.0, 0.7], [-0.7, 0.0, 0.7], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
/// Scales of the loss while a search narrows, in pixels.
const NARROWING: [f64; 4] = [30.0, 8.0, 3.0, 1.0];
/// Steps of Gauss and Newton at one scale.
const STEPS: usize = 20;

/// The matches of a pair under a camera.
pub(super) struct Pair<'a> {
    matches: &'a Matches,
    rays: Vec<[Vector; 2]>,
    camera: Pinhole,
}

impl<'a> Pair<'a> {
    pub(super) fn new(matches: &'a Matches, camera: Pinhole) -> Self {
        let rays = matches.0.iter().map(|pair| pair.map(|point| camera.ray(point))).collect();
        Pair { matches, rays, camera }
    }

    /// The residual of a match, and its derivatives by a rotation after the motion's and by two turns of the direction
    /// along `sideways`. Sampson's denominator counts as constant.
    fn residual(&self, [p, q]: &[Vector; 2], motion: &Motion, sideways: &[Vector; 2]) -> (f64, [f64; 5]) {
        let turned = apply(&motion.rotation, *p);
        let t = motion.direction;
        let (normal, across) = (cross(t, turned), cross(*q, t));
        let back = apply_transposed(&motion.rotation, across);
        let [fx, fy] = self.camera.focal;
        let squared = |n: Vector| (n[0] / fx).powi(2) + (n[1] / fy).powi(2);
        let length = (squared(normal) + squared(back)).sqrt().max(1e-12);
        let by_rotation = cross(turned, across);
        let by_direction = cross(turned, *q);
        let slope = [
            by_rotation[0],
            by_rotation[1],
            by_rotation[2],
            dot(sideways[0], by_direction),
            dot(sideways[1], by_direction),
        ];
        (dot(*q, normal) / length, slope.map(|x| x / length))
    }

    /// The sum of the losses of all matches.
    pub(super) fn cost(&self, motion: &Motion, scale: f64) -> f64 {
        self.residuals(motion).map(|r| loss(r, scale)).sum()
    }

    /// The residuals of all matches, in pixels.
    pub(super) fn residuals(&self, motion: &Motion) -> impl Iterator<Item = f64> {
        let sideways = tangents(motion.direction);
        self.rays.iter().map(move |rays| self.residual(rays, motion, &sideways).0)
    }

    /// The best motion from none known: the rotation that the median displacement would be, several directions of travel,
    /// and a loss that begins wide. Residuals beyond some `scale` pixels do not count in the end.
    pub(super) fn search(&self, scale: f64) -> Motion {
        let moved = |axis: usize| {
            let mut all: Vec<f64> = self.matches.0.iter().map(|[from, to]| to[axis] - from[axis]).collect();
            all.sort_by(f64::total_cmp);
            all.get(all.len() / 2).copied().unwrap_or(0.0) / self.camera.focal[axis]
        };
        let rotation = exponential([-moved(1), moved(0), 0.0]);
        let mut best: Option<(f64, Motion)> = None;
        for direction in DIRECTIONS {
            let mut motion = Motion { rotation, direction: unit(direction) };
            for wide in NARROWING {
                motion = self.refine(motion, wide.max(scale));
            }
            motion = self.refine(motion, scale);
            let cost = self.cost(&motion, scale);
            if best.is_none_or(|(least, _)| cost < least) {
                best = Some((cost, motion));
            }
        }
        best.map_or(Motion { rotation, direction: [0.0, 0.0, 1.0] }, |(_, motion)| motion)
    }

    /// The best motion near one: least squares, each match weighted by the slope of its loss, damped (Levenberg and
    /// Marquardt).
    pub(super) fn refine(&self, mut motion: Motion, scale: f64) -> Motion {
        let mut cost = self.cost(&motion, scale);
        let mut damping = 1e-4;
        for _ in 0..STEPS {
            let sideways = tangents(motion.direction);
            let (normal, gradient) = self.equations(&motion, &sideways, scale);
            let mut damped = normal;
            for (k, row) in damped.iter_mut().enumerate() {
                row[k] += damping * normal[k][k] + 1e-12;
            }
            let Some(step) = solve(damped, gradient.map(|g| -g)) else { break };
            let next = moved(&motion, &sideways, step);
            let better = self.cost(&next, scale);
            if better < cost {
                let gain = cost - better;
                (motion, cost) = (next, better);
                damping = (damping / 5.0).max(1e-9);
                if gain < 1e-7 * cost {
                    break;
                }
            } else {
                damping *= 10.0;
                if damping > 1e4 {
                    break;
                }
            }
        }
        motion
    }

    /// The weighted normal equations.
    fn equations(&self, motion: &Motion, sideways: &[Vector; 2], scale: f64) -> ([[f64; 5]; 5], [f64; 5]) {
        let (mut normal, mut gradient) = ([[0f64; 5]; 5], [0f64; 5]);
        for rays in &self.rays {
            let (r, slope) = self.residual(rays, motion, sideways);
            let weight = (1.0 + r * r / (scale * scale)).powi(-2);
            for i in 0..5 {
                gradient[i] += weight * slope[i] * r;
                for j in 0..5 {
                    normal[i][j] += weight * slope[i] * slope[j];
                }
            }
        }
        (normal, gradient)
    }
}

/// A motion after a small step: a rotation vector, and two turns of the direction.
fn moved(motion: &Motion, sideways: &[Vector; 2], step: [f64; 5]) -> Motion {
    let [a, b, c, d, e] = step;
    let turn = exponential([a, b, c]);
    let direction = std::array::from_fn(|k| motion.direction[k] + d * sideways[0][k] + e * sideways[1][k]);
    Motion { rotation: product(&turn, &motion.rotation), direction: unit(direction) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::camera_fit::vectors::degrees;
    use crate::random::Random;

    const CAMERA: Pinhole = Pinhole { focal: [370.0, 365.0], centre: [318.0, 97.0] };

    /// Points in front of a camera that turns by `rotation` and moves by `moved` (points are mapped by R p + t), as it sees
    /// them before and after; every sixth match is wrong.
    fn scene(rotation: &Matrix, moved: Vector) -> Matches {
        let mut random = Random::new(5, 0);
        let project = |p: Vector| [0, 1].map(|k| CAMERA.focal[k] * p[k] / p[2] + CAMERA.centre[k]);
        let pair = |i: usize| {
            let point = [random.uniform(-8.0, 8.0), random.uniform(-2.0, 1.6), random.uniform(5.0, 40.0)];
            let seen = apply(rotation, point);
            let mut to = project(std::array::from_fn(|k| seen[k] + moved[k]));
            if i.is_multiple_of(6) {
                to = [to[0] + random.uniform(-20.0, 20.0), to[1] + random.uniform(-20.0, 20.0)];
            }
            [project(point), to]
        };
        Matches((0..300).map(pair).collect())
    }

    #[test]
    fn the_motion_is_found_among_wrong_matches() {
        for (turn, moved) in [
            ([0.0, 0.04, 0.003], [0.05, 0.0, -0.8]),
            ([0.002, -0.06, 0.0], [-0.6, 0.01, -0.3]),
            ([0.03, 0.0, 0.0], [0.0, 0.5, 0.0]),
        ] {
            let rotation = exponential(turn);
            let matches = scene(&rotation, moved);
            let found = Pair::new(&matches, CAMERA).search(0.5);
            let rest = product(&found.rotation, &std::array::from_fn(|i| std::array::from_fn(|j| rotation[j][i])));
            // Wrong matches that happen to lie near their lines pull a little.
            assert!(degrees(&rest) < 0.01, "{turn:?}: {}", degrees(&rest));
            assert!((dot(found.direction, unit(moved)).abs() - 1.0).abs() < 1e-5, "{moved:?}: {found:?}");
        }
    }

    #[test]
    fn the_residual_is_a_distance_in_pixels() {
        let rotation = exponential([0.0, 0.03, 0.0]);
        let moved = [0.9, 0.0, 0.0];
        let mut matches = scene(&rotation, moved);
        matches.0.truncate(6);
        matches.0.remove(0);
        let pair = Pair::new(&matches, CAMERA);
        let motion = Motion { rotation, direction: unit(moved) };
        assert!(pair.residuals(&motion).all(|r| r.abs() < 1e-9));
        // Epipolar lines are nearly level: a point that is 1 pixel too low in one picture is half a pixel off in both.
        matches.0.iter_mut().for_each(|[_, to]| to[1] += 1.0);
        let pair = Pair::new(&matches, CAMERA);
        for r in pair.residuals(&motion) {
            assert!((r.abs() - 0.5f64.sqrt()).abs() < 0.03, "{r}");
        }
    }

    #[test]
    fn derivatives_are_those_of_small_steps() {
        let motion = Motion { rotation: exponential([0.01, 0.03, 0.0]), direction: unit([0.3, 0.1, -0.9]) };
        let matches = scene(&exponential([0.012, 0.033, 0.001]), [0.3, 0.05, -0.9]);
        let pair = Pair::new(&matches, CAMERA);
        let sideways = tangents(motion.direction);
        // A match that nearly agrees: there the denominator's change counts for nothing.
        for rays in pair.rays.iter().skip(1).take(4) {
            let (_, slope) = pair.residual(rays, &motion, &sideways);
            for (k, &slope) in slope.iter().enumerate() {
                let at = |h: f64| {
                    let step = std::array::from_fn(|i| if i == k { h } else { 0.0 });
                    pair.residual(rays, &self::moved(&motion, &sideways, step), &sideways).0
                };
                let difference = (at(1e-6) - at(-1e-6)) / 2e-6;
                assert!((difference - slope).abs() < 0.1 * slope.abs() + 6.0, "{k}: {difference} {}", slope);
            }
        }
    }
}
