//! Camera trajectories: poses, KITTI's files of them, and how far a predicted one is from the true one.
//!
//! A pose `[R | C]` maps points of a frame's camera to the first frame's (metres; x right, y down, z forward), as a line of
//! KITTI odometry's `poses/NN.txt`.

use std::path::Path;

use super::alignment::Similarity;
use super::statistics::standard_deviation;
use crate::formats::atomic::write_bytes_atomically;
use crate::formats::bounded::read_text;
use crate::{Error, Result};

/// Poses of a million frames take fewer bytes.
const MAX_POSES: u64 = 512 << 20;
/// How many frames a snippet of the five-frame error has.
const SNIPPET: usize = 5;
/// The lengths of KITTI's segments, in metres.
const LENGTHS: [f64; 8] = [100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0];
/// Segments begin at every tenth frame.
const STEP: usize = 10;

/// Rigid transform, the rows of `[R | t]`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose(pub [[f64; 4]; 3]);

impl Pose {
    /// No motion.
    pub const IDENTITY: Pose = Pose([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);

    /// The transform that does `other` first, then this.
    pub fn after(&self, other: &Pose) -> Pose {
        let (a, b) = (&self.0, &other.0);
        Pose(std::array::from_fn(|i| {
            std::array::from_fn(|j| {
                let product: f64 = (0..3).map(|k| a[i][k] * b[k][j]).sum();
                product + if j == 3 { a[i][3] } else { 0.0 }
            })
        }))
    }

    /// The transform back: `[R^T | -R^T t]`.
    pub fn inverse(&self) -> Pose {
        let a = &self.0;
        Pose(std::array::from_fn(|i| {
            std::array::from_fn(|j| if j < 3 { a[j][i] } else { -(0..3).map(|k| a[k][i] * a[k][3]).sum::<f64>() })
        }))
    }

    /// The last column.
    pub fn position(&self) -> [f64; 3] {
        self.0.map(|row| row[3])
    }

    /// The angle of the rotation, in radians.
    pub fn angle(&self) -> f64 {
        let trace = self.0[0][0] + self.0[1][1] + self.0[2][2];
        (0.5 * (trace - 1.0)).clamp(-1.0, 1.0).acos()
    }
}

/// Reads poses in KITTI's form: twelve numbers a line, the rows of `[R | C]`.
///
/// # Errors
/// Names the line that is something else, or whose left part is no rotation (to 1 %).
pub fn read_poses(path: &Path) -> Result<Vec<Pose>> {
    let text = read_text(path, MAX_POSES, "a file of poses")?;
    let mut poses = Vec::new();
    for (i, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let numbers: Vec<f64> =
            line.split_whitespace().map_while(|n| n.parse().ok().filter(|x: &f64| x.is_finite())).collect();
        let rows: Option<[f64; 12]> = numbers.try_into().ok().filter(|_| line.split_whitespace().count() == 12);
        let Some(n) = rows else {
            let message =
                format!("line {}: expected twelve numbers, the rows of [R | C], found {:?}", i + 1, line.trim());
            return Err(Error::file(path, message));
        };
        let pose = Pose(std::array::from_fn(|r| std::array::from_fn(|c| n[4 * r + c])));
        let r = &pose.0;
        let product = |a: usize, b: usize| (0..3).map(|k| r[a][k] * r[b][k]).sum::<f64>();
        let off =
            (0..9).map(|k| (product(k / 3, k % 3) - f64::from(u8::from(k / 3 == k % 3))).abs()).fold(0.0, f64::max);
        if off > 0.01 {
            let message =
                format!("line {}: the 3x3 part of the pose is no rotation (its rows are off by {off:.3})", i + 1);
            return Err(Error::file(path, message));
        }
        poses.push(pose);
    }
    if poses.len() < 2 {
        return Err(Error::file(path, format!("expected two poses at least, found {}", poses.len())));
    }
    Ok(poses)
}

/// Writes poses in KITTI's form; they read back exactly.
///
/// # Errors
/// If the file cannot be written.
pub fn write_poses(path: &Path, poses: &[Pose]) -> Result<()> {
    let line = |pose: &Pose| pose.0.as_flattened().iter().map(f64::to_string).collect::<Vec<_>>().join(" ") + "\n";
    write_bytes_atomically(path, poses.iter().map(line).collect::<String>().as_bytes())
}

/// The mean of some errors and their deviation.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Spread {
    /// The mean.
    pub mean: f64,
    /// The standard deviation, of the whole population.
    pub std: f64,
    /// How many.
    pub count: usize,
}

/// How far a trajectory is from the true one.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct TrajectoryErrors {
    /// How many frames were compared.
    pub frames: usize,
    /// The five-frame error, in metres: see [`five_frame_error`].
    pub five_frames: Spread,
    /// The scale of the alignment of the whole trajectory.
    pub scale: f64,
    /// Root of the mean squared distance of positions after the alignment, in metres.
    pub ate: f64,
    /// KITTI's segment errors, after the alignment; `None` on a path shorter than 100 m.
    pub segments: Option<Segments>,
}

/// Compares a predicted trajectory with the true one, frame by frame.
///
/// # Errors
/// If they differ in their number of frames, or the predicted one does not move.
pub fn compare_trajectories(truth: &[Pose], predicted: &[Pose]) -> Result<TrajectoryErrors> {
    if truth.len() != predicted.len() {
        let message = format!(
            "{} predicted poses, but {} true ones: expected one for each frame of the same sequence",
            predicted.len(),
            truth.len()
        );
        return Err(Error::setting("trajectory", message));
    }
    let positions = |poses: &[Pose]| poses.iter().map(Pose::position).collect::<Vec<_>>();
    let alignment = Similarity::between(&positions(predicted), &positions(truth))?;
    let aligned: Vec<Pose> = predicted.iter().map(|pose| alignment.of_pose(pose)).collect();
    let squares = truth.iter().zip(&aligned).map(|(a, b)| distance(a.position(), b.position()).powi(2));
    Ok(TrajectoryErrors {
        frames: truth.len(),
        five_frames: five_frame_error(&relative(truth), &relative(predicted)),
        scale: alignment.scale,
        ate: (squares.sum::<f64>() / truth.len() as f64).sqrt(),
        segments: segment_errors(truth, &aligned),
    })
}

/// The transforms of points of each frame into the next one, as the pose network gives them for (t, t + 1).
pub fn relative(poses: &[Pose]) -> Vec<Pose> {
    poses.windows(2).map(|pair| pair[1].inverse().after(&pair[0])).collect()
}

/// The five-frame error of Zhou et al. (CVPR 2017) as Monodepth2 (1806.01260) and what follows it report it: for every frame
/// four relative transforms (points of t to t + 1) are chained as they are into five positions; the predicted ones are
/// scaled by `s = sum(g . p) / sum(p . p)`; the error is `sqrt(sum |s p - g|^2) / n`: the sum under the root, the number of
/// points outside it. The last snippets have fewer than five.
pub fn five_frame_error(truth: &[Pose], predicted: &[Pose]) -> Spread {
    let positions = |steps: &[Pose]| {
        let mut at = Pose::IDENTITY;
        let mut all = vec![at.position()];
        for step in steps {
            at = at.after(step);
            all.push(at.position());
        }
        all
    };
    let count = truth.len().min(predicted.len());
    let error = |start: usize| {
        let end = (start + SNIPPET - 1).min(count);
        let (g, p) = (positions(&truth[start..end]), positions(&predicted[start..end]));
        let dot = |a: &[[f64; 3]], b: &[[f64; 3]]| {
            a.as_flattened().iter().zip(b.as_flattened()).map(|(a, b)| a * b).sum::<f64>()
        };
        let length = dot(&p, &p);
        // A prediction that stands still cannot be scaled.
        let scale = if length > 0.0 { dot(&g, &p) / length } else { 0.0 };
        let square = g.as_flattened().iter().zip(p.as_flattened()).map(|(g, p)| (scale * p - g).powi(2)).sum::<f64>();
        square.sqrt() / g.len() as f64
    };
    let errors: Vec<f64> = (0..count).map(error).collect();
    let mean = errors.iter().sum::<f64>() / count.max(1) as f64;
    Spread { mean, std: standard_deviation(errors.iter().copied()), count }
}

/// KITTI's errors over segments of 100, 200, .., 800 m.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Segments {
    /// Translation error in per cent of the length.
    pub translation_percent: f64,
    /// Rotation error in degrees per 100 m.
    pub degrees_per_100_m: f64,
    /// How many segments there were.
    pub count: usize,
}

/// Errors over segments that begin at every tenth frame and end at the first frame that is so far along the true path
/// (Geiger et al., CVPR 2012): the motion from first to last, predicted against true. `None` on a shorter path.
pub fn segment_errors(truth: &[Pose], predicted: &[Pose]) -> Option<Segments> {
    let mut along = vec![0.0];
    for pair in truth.windows(2) {
        along.push(along[along.len() - 1] + distance(pair[0].position(), pair[1].position()));
    }
    let (mut translation, mut rotation, mut count) = (0.0, 0.0, 0usize);
    for first in (0..truth.len().min(predicted.len())).step_by(STEP) {
        for length in LENGTHS {
            let Some(last) = (first..predicted.len().min(along.len())).find(|&i| along[i] > along[first] + length)
            else {
                continue;
            };
            let motion = |poses: &[Pose]| poses[first].inverse().after(&poses[last]);
            let error = motion(predicted).inverse().after(&motion(truth));
            translation += distance(error.position(), [0.0; 3]) / length;
            rotation += error.angle() / length;
            count += 1;
        }
    }
    (count > 0).then(|| Segments {
        translation_percent: 100.0 * translation / count as f64,
        degrees_per_100_m: 100.0 * (rotation / count as f64).to_degrees(),
        count,
    })
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests;
