//! Whether a camera fits its frames, told from the frames alone.
//!
//! Points are followed from frame to frame (`corners`, `track`). Whatever the scene, where it stands still the points of two
//! frames obey the epipolar constraint of a rotation and a direction of travel, if the camera is right (`epipolar`). The
//! camera is then changed: focal lengths, principal point (`profile`). Where another camera explains all pairs of frames
//! together better than chance would, the given one does not fit.
//!
//! How much can be told depends on the drive. Of a camera that moves without turning nothing can: the fundamental matrix of
//! a pure translation is the epipole's alone, whatever the focal lengths (Hartley and Zisserman, "Multiple View Geometry",
//! 2nd edition, section 9.3.1). A principal point that is off shows at turns of half a degree a frame, focal lengths at some
//! two degrees.

mod corners;
mod epipolar;
mod grey;
mod profile;
#[cfg(test)]
mod tests;
mod track;
mod vectors;
mod warp;

use rayon::prelude::*;
use serde::Serialize;

use self::epipolar::{Pair, Pinhole};
use self::profile::{Parameter, Solved};
use self::vectors::degrees;
use super::DataSource;
use crate::camera::Intrinsics;

pub use self::profile::Range;
pub(super) use self::warp::warped;

/// Pairs of frames whose points are followed, and how many of them are used: those that turn most.
const CANDIDATES: usize = 72;
const USED: usize = 32;
/// The fewest matches of a pair, and pairs, that say anything.
const LEAST_MATCHES: usize = 40;
const LEAST_PAIRS: usize = 8;
/// Residuals that count, in pixels, while the first motions are found.
const WIDE: f64 = 0.5;
/// Afterwards: so many times the median residual, but not less than so many pixels.
const MEDIANS: f64 = 4.5;
const LEAST_SCALE: f64 = 0.1;
/// The least turn from frame to frame, in degrees, at which anything is said of focal lengths, and of a principal point: below
/// it, what matching gets systematically wrong (scale, occlusion) is as large as what they would change. Found on streets
/// of other seeds than the tests'.
const FOCAL_TURN: f64 = 1.4;
const CENTRE_TURN: f64 = 0.25;
/// Factors of the focal lengths that are no fault, and those that are still told from the right one where it is said to
/// fit.
const FOCAL_FINE: [f64; 2] = [0.88, 1.14];
const FOCAL_KNOWN: [f64; 2] = [0.77, 1.3];
/// Trial offsets of the principal point, in shares of the width: across and down, and across.
const CENTRE_FINE: [f64; 2] = [0.04, 0.08];
const CENTRE_KNOWN: f64 = 0.1;
/// A direction of travel that is further from the camera's axis is worth a word, in degrees.
const ASKEW: f64 = 6.0;

/// The answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// No other camera explains the frames better, and focal lengths that are wrong by 30 %, or a principal point that is off
    /// by a tenth of the width to a side, would have shown.
    Fits,
    /// Another camera explains the frames better than chance would.
    DoesNotFit,
    /// The frames agree with this camera and with quite different ones: they turn too little, or show too little.
    CannotTell,
}

/// The verdict of the frames on a camera.
#[derive(Clone, Debug, Serialize)]
pub struct CameraFit {
    /// The name of the first sample that was taken with it.
    pub first: String,
    /// The camera, in units of the picture.
    pub intrinsics: Intrinsics,
    /// The answer.
    pub verdict: Verdict,
    /// Pairs of frames that were used.
    pub pairs: usize,
    /// Matches of a pair, the median.
    pub matches: usize,
    /// How far the camera turns from one frame to the next, the median of the pairs used, in degrees.
    pub turn: f64,
    /// How far the matches are off under the camera as it is, the median, in pixels of the pictures that were looked at.
    pub residual: f64,
    /// The factors of the focal lengths that the frames allow.
    pub focal: Option<Range>,
    /// How far the principal point may lie to the right and below, in shares of the width.
    pub centre: Option<[Range; 2]>,
    /// The direction of travel right of and below the camera's axis, the median, in degrees.
    pub travel: Option<[f64; 2]>,
}

/// The width at which pictures are looked at, if they have so many pixels, and where the networks see smaller ones.
const WIDTH: u32 = 640;

/// The height and width at which frames should be looked at that are `widest` pixels wide, where the networks see them at
/// `[height, width]`: larger than that as far as the files have more pixels, of the same aspect.
pub fn size(widest: Option<u32>, [height, width]: [usize; 2]) -> [usize; 2] {
    let wide = widest.unwrap_or(WIDTH).min(WIDTH) as usize;
    if wide <= width { [height, width] } else { [(height * wide).div_ceil(width), wide] }
}

/// The verdict of the frames on each camera of a data set. Frames that cannot be read are passed over
/// ([`check`](super::check::check) names them).
pub fn fit(data: &dyn DataSource) -> Vec<CameraFit> {
    let mut cameras: Vec<(Intrinsics, Vec<usize>)> = Vec::new();
    for sample in 0..data.len() {
        let own = data.intrinsics(sample);
        match cameras.iter_mut().find(|(camera, _)| *camera == own) {
            Some((_, samples)) => samples.push(sample),
            None => cameras.push((own, vec![sample])),
        }
    }
    cameras.into_iter().map(|(camera, samples)| fit_one(data, camera, &samples)).collect()
}

/// The verdict of some samples on their camera.
fn fit_one(data: &dyn DataSource, intrinsics: Intrinsics, samples: &[usize]) -> CameraFit {
    let mut fit = CameraFit {
        first: samples.first().map_or_else(String::new, |&sample| data.name(sample)),
        intrinsics,
        verdict: Verdict::CannotTell,
        pairs: 0,
        matches: 0,
        turn: 0.0,
        residual: 0.0,
        focal: None,
        centre: None,
        travel: None,
    };
    let Some((width, camera, mut pairs)) = solved(data, intrinsics, samples) else { return fit };
    let turns = |pair: &Solved| degrees(&pair.motion.rotation);
    pairs.sort_by(|a, b| turns(b).total_cmp(&turns(a)));
    pairs.truncate(USED);
    let residuals = |pair: &Solved| -> Vec<f64> {
        Pair::new(&pair.matches, camera).residuals(&pair.motion).map(f64::abs).collect()
    };
    fit.pairs = pairs.len();
    fit.matches = median(pairs.iter().map(|pair| pair.matches.0.len() as f64)) as usize;
    fit.turn = median(pairs.iter().map(turns));
    fit.residual = median(pairs.iter().flat_map(residuals));
    fit.travel = travel(&pairs);
    if pairs.len() < LEAST_PAIRS {
        return fit;
    }
    let scale = (MEDIANS * fit.residual).max(LEAST_SCALE);
    for pair in &mut pairs {
        pair.motion = Pair::new(&pair.matches, camera).refine(pair.motion, scale);
    }
    let along = |parameter| profile::profile(&pairs, camera, width, parameter, scale).range();
    let (focal, centre) = (along(Parameter::Focal), [0, 1].map(|axis| along(Parameter::Centre(axis))));
    fit.verdict = judge(fit.turn, focal, centre);
    (fit.focal, fit.centre) = (Some(focal), Some(centre));
    fit
}

/// The width of the pictures, the camera in their pixels, and pairs from all over the samples with their motions; nothing
/// if no picture can be read.
fn solved(data: &dyn DataSource, k: Intrinsics, samples: &[usize]) -> Option<(usize, Pinhole, Vec<Solved>)> {
    let (width, height) = samples.iter().find_map(|&sample| data.image(sample, 0).ok())?.dimensions();
    let (w, h) = (f64::from(width), f64::from(height));
    let camera = Pinhole { focal: [k.fx * w, k.fy * h], centre: [k.cx * w, k.cy * h] };
    let n = samples.len().min(CANDIDATES);
    let chosen: Vec<usize> = (0..n).map(|i| samples[i * samples.len() / n]).collect();
    let pair = |&sample: &usize| {
        let (from, to) = (data.image(sample, 0).ok()?, data.image(sample, 1).ok()?);
        let matches = track::matches(&from, &to);
        let motion = (matches.0.len() >= LEAST_MATCHES).then(|| Pair::new(&matches, camera).search(WIDE))?;
        Some(Solved { matches, motion })
    };
    Some((width as usize, camera, chosen.par_iter().filter_map(pair).collect()))
}

/// The median direction of travel right of and below the axis, in degrees, of pairs that travel along it rather than across.
fn travel(pairs: &[Solved]) -> Option<[f64; 2]> {
    let ahead: Vec<_> = pairs.iter().map(|pair| pair.motion.direction).filter(|d| d[2].abs() > 0.5).collect();
    let angle = |axis: usize| median(ahead.iter().map(|d| (d[axis] / d[2]).atan().to_degrees()));
    (2 * ahead.len() > pairs.len()).then(|| [angle(0), angle(1)])
}

fn judge(turn: f64, focal: Range, centre: [Range; 2]) -> Verdict {
    let apart = |range: Range, [low, high]: [f64; 2]| range.low > high || range.high < low;
    let within = |range: Range, [low, high]: [f64; 2]| range.low > low && range.high < high;
    let off = |axis: usize| apart(centre[axis], [-CENTRE_FINE[axis], CENTRE_FINE[axis]]);
    if (turn > FOCAL_TURN && apart(focal, FOCAL_FINE)) || (turn > CENTRE_TURN && (off(0) || off(1))) {
        Verdict::DoesNotFit
    } else if turn > FOCAL_TURN && within(focal, FOCAL_KNOWN) && within(centre[0], [-CENTRE_KNOWN, CENTRE_KNOWN]) {
        Verdict::Fits
    } else {
        Verdict::CannotTell
    }
}

impl CameraFit {
    /// The answer in a sentence, with its figures.
    pub fn in_words(&self) -> String {
        let CameraFit { pairs, turn, residual, .. } = self;
        let (Some(focal), Some([right, down])) = (self.focal, self.centre) else {
            return format!(
                "cannot tell whether the camera fits: {pairs} pairs of frames have {LEAST_MATCHES} points in common, \
                 {LEAST_PAIRS} are needed"
            );
        };
        let range = |range: Range| format!("{:.2} to {:.2}", range.low, range.high);
        let figures = format!(
            "{pairs} pairs of frames that turn by {turn:.1} degrees allow focal lengths of {} times the given ones, and a \
             principal point moved by {} of the width to the right and {} down; residual {residual:.2} pixels",
            range(focal),
            range(right),
            range(down)
        );
        match self.verdict {
            Verdict::Fits => format!("the camera fits: {figures}"),
            Verdict::DoesNotFit => format!(
                "the camera does not fit: {figures}; check the calibration, and that the pictures were not cropped \
                 after it"
            ),
            Verdict::CannotTell => format!(
                "cannot tell whether the camera fits (too little turning, or too few points): {figures}{}",
                self.askew()
            ),
        }
    }

    /// Whether the direction of travel lies far from the camera's axis.
    pub fn is_askew(&self) -> bool {
        self.travel.is_some_and(|[right, down]| right.hypot(down) > ASKEW)
    }

    /// A word on such a direction.
    fn askew(&self) -> String {
        match self.travel {
            Some([right, down]) if self.is_askew() => format!(
                ". It travels {right:.0} degrees right of its axis and {down:.0} below: true of a camera that is mounted \
                 so; otherwise the principal point is wrong"
            ),
            _ => String::new(),
        }
    }
}

/// The median; 0 of nothing.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}
