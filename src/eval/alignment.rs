//! The similarity that lays one set of points over another: Umeyama, PAMI 1991.

use faer::Mat;

use super::trajectory::Pose;
use crate::{Error, Result};

/// A similarity, seven degrees of freedom: `y = scale R x + t`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// Rotation, row-major.
    pub rotation: [[f64; 3]; 3],
    /// Translation.
    pub translation: [f64; 3],
    /// Scale, above 0.
    pub scale: f64,
}

impl Similarity {
    /// The similarity of `from` that has the least squared distance from `to`, point by point (equations 40 to 43 of the
    /// paper). Where points lie on a line the turn about it is any.
    ///
    /// # Errors
    /// If there are fewer than two points, or either set is a single place.
    pub fn between(from: &[[f64; 3]], to: &[[f64; 3]]) -> Result<Similarity> {
        let count = from.len().min(to.len());
        let n = count as f64;
        let mean = |points: &[[f64; 3]]| -> [f64; 3] {
            std::array::from_fn(|k| points.iter().take(count).map(|p| p[k]).sum::<f64>() / n)
        };
        let (x, y) = (mean(from), mean(to));
        let pairs = || from.iter().zip(to);
        let covariance = |i: usize, j: usize| pairs().map(|(a, b)| (b[i] - y[i]) * (a[j] - x[j])).sum::<f64>() / n;
        let variance = (0..3).map(|k| pairs().map(|(a, _)| (a[k] - x[k]).powi(2)).sum::<f64>() / n).sum::<f64>();
        let still = || Error::Failed("a trajectory that stays in one place cannot be laid over another".into());
        let svd = Mat::<f64>::from_fn(3, 3, covariance).svd().map_err(|_| still())?;
        let (u, s, v) = (svd.U(), svd.S().column_vector(), svd.V());
        if count < 2 || variance <= 0.0 || !variance.is_finite() || s[0] <= 0.0 {
            return Err(still());
        }
        // The rotation nearest to the covariance, not a reflection.
        let sign = if determinant(|i, j| u[(i, j)]) * determinant(|i, j| v[(i, j)]) < 0.0 { -1.0 } else { 1.0 };
        let signs = [1.0, 1.0, sign];
        let rotation: [[f64; 3]; 3] =
            std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| u[(i, k)] * signs[k] * v[(j, k)]).sum()));
        let scale = (0..3).map(|k| s[k] * signs[k]).sum::<f64>() / variance;
        let turned = turn(&rotation, x);
        Ok(Similarity { rotation, scale, translation: std::array::from_fn(|k| y[k] - scale * turned[k]) })
    }

    /// Where a point comes to lie.
    pub fn of_point(&self, point: [f64; 3]) -> [f64; 3] {
        let turned = turn(&self.rotation, point);
        std::array::from_fn(|k| self.scale * turned[k] + self.translation[k])
    }

    /// A camera's pose in the other trajectory's frame: turned, its position scaled too.
    pub fn of_pose(&self, pose: &Pose) -> Pose {
        let position = self.of_point(pose.position());
        Pose(std::array::from_fn(|i| {
            std::array::from_fn(|j| {
                if j == 3 { position[i] } else { (0..3).map(|k| self.rotation[i][k] * pose.0[k][j]).sum() }
            })
        }))
    }
}

fn turn(r: &[[f64; 3]; 3], x: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| (0..3).map(|k| r[i][k] * x[k]).sum())
}

fn determinant(m: impl Fn(usize, usize) -> f64) -> f64 {
    (0..3).map(|j| m(0, j) * (m(1, (j + 1) % 3) * m(2, (j + 2) % 3) - m(1, (j + 2) % 3) * m(2, (j + 1) % 3))).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::depth::rotation::rotation as rotation_matrix;
    use crate::random::{Random, Stream};

    #[test]
    fn a_known_similarity_is_found() {
        let mut random = Random::of(1, Stream::Only);
        let mut point = |flat: f64| [random.normal(), flat * random.normal(), random.normal()];
        // In space, and on a plane.
        for flat in [1.0, 0.0] {
            let from: Vec<[f64; 3]> = (0..20).map(|_| point(flat)).collect();
            let known =
                Similarity { rotation: rotation_matrix([0.3, -1.9, 0.8]), translation: [5.0, -2.0, 0.5], scale: 37.0 };
            let to: Vec<[f64; 3]> = from.iter().map(|p| known.of_point(*p)).collect();
            let found = Similarity::between(&from, &to).unwrap();
            let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-9, "{found:?}");
            close(found.scale, 37.0);
            found.translation.iter().zip(known.translation).for_each(|(a, b)| close(*a, b));
            found.rotation.as_flattened().iter().zip(known.rotation.as_flattened()).for_each(|(a, b)| close(*a, *b));
        }
    }

    #[test]
    fn a_mirrored_set_is_turned_and_never_mirrored() {
        let from = [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0], [0.5, 0.25, -1.0]];
        let found = Similarity::between(&from, &from.map(|[x, y, z]| [-x, y, z])).unwrap();
        assert!((determinant(|i, j| found.rotation[i][j]) - 1.0).abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn what_stands_still_cannot_be_aligned() {
        let moving = [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]];
        for (from, to) in [(&[[1.0; 3]; 2][..], &moving[..]), (&moving, &[[1.0; 3]; 2]), (&moving[..1], &moving[..1])] {
            assert!(Similarity::between(from, to).unwrap_err().to_string().contains("stays in one place"));
        }
    }
}
