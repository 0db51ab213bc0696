//! Ground truth in the forms that stereo benchmarks store it in, as depth in metres.

use std::path::{Path, PathBuf};

use image::DynamicImage;

use crate::depth::DepthMap;
use crate::formats::mat::read_mat;
use crate::formats::pfm::read_pfm;
use crate::formats::picture::decode;
use crate::{Error, Result};

/// Where the depth of a picture is stored, and how.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Truth {
    /// A 16-bit grey PNG of metres times 256, 0 for none.
    DepthPng(PathBuf),
    /// A 16-bit grey PNG of `steps` times disparity, plus `zero`, 0 for none; depth is `focal_baseline / disparity`.
    DisparityPng {
        path: PathBuf,
        steps: f64,
        zero: u16,
        /// Focal length in pixels times the baseline in metres.
        focal_baseline: f64,
    },
    /// A PFM map of disparity, infinite for none; depth is `focal_baseline / (disparity + offset)`.
    DisparityPfm { path: PathBuf, focal_baseline: f64, offset: f64 },
    /// Make3D's grid of laser points.
    LaserGrid(PathBuf),
}

impl Truth {
    pub(super) fn path(&self) -> &Path {
        match self {
            Truth::DepthPng(path) | Truth::LaserGrid(path) => path,
            Truth::DisparityPng { path, .. } | Truth::DisparityPfm { path, .. } => path,
        }
    }

    /// The depth, in metres.
    pub(super) fn read(&self) -> Result<DepthMap> {
        match self {
            Truth::DepthPng(path) => grey16(path, "depth (metres times 256, 0 for none)", |v| f64::from(v) / 256.0),
            Truth::DisparityPng { path, steps, zero, focal_baseline } => {
                let depth = |v| if v == 0 { 0.0 } else { focal_baseline * steps / (f64::from(v) - f64::from(*zero)) };
                grey16(path, &format!("disparity (pixels times {steps}, 0 for none)"), depth)
            }
            Truth::DisparityPfm { path, focal_baseline, offset } => {
                let map = read_pfm(path)?;
                let depth = |&d: &f32| known(focal_baseline / (f64::from(d) + offset));
                Ok(DepthMap { width: map.width, height: map.height, metres: map.values.iter().map(depth).collect() })
            }
            Truth::LaserGrid(path) => laser_grid(path),
        }
    }
}

/// A depth in metres; 0, which means unknown, for what is none.
fn known(metres: f64) -> f32 {
    if metres.is_finite() && metres > 0.0 { metres as f32 } else { 0.0 }
}

fn grey16(path: &Path, what: &str, depth: impl Fn(u16) -> f64) -> Result<DepthMap> {
    match decode(path)? {
        DynamicImage::ImageLuma16(image) => Ok(DepthMap {
            width: image.width() as usize,
            height: image.height() as usize,
            metres: image.as_raw().iter().map(|&v| known(depth(v))).collect(),
        }),
        other => {
            let message = format!("expected {what} as a 16-bit grey PNG, found {:?}", other.color());
            Err(Error::file(path, message))
        }
    }
}

/// Rows of the laser's grid that lie in the central 2:1 of the picture.
const LASER_ROWS: std::ops::Range<usize> = 17..38;

/// The fourth layer of `Position3DGrid`, 55 x 305 x 4, which is depth; its rows 17 to 37.
fn laser_grid(path: &Path) -> Result<DepthMap> {
    const NAME: &str = "Position3DGrid";
    let array = read_mat(path, NAME)?;
    let &[rows, columns, 4] = array.shape.as_slice() else {
        let message =
            format!("{NAME}: expected 55 x 305 x 4 numbers (depth is the fourth layer), found {:?}", array.shape);
        return Err(Error::file(path, message));
    };
    let layer = array.values.get(3 * rows * columns..).unwrap_or_default();
    if rows < LASER_ROWS.end || columns == 0 {
        return Err(Error::file(path, format!("{NAME}: expected 55 rows and 305 columns, found {rows} and {columns}")));
    }
    // Columns are stored one after another.
    let depth = |row: usize| layer.chunks_exact(rows).map(move |column| column.get(row).map_or(0.0, |&m| known(m)));
    Ok(DepthMap { width: columns, height: LASER_ROWS.len(), metres: LASER_ROWS.flat_map(depth).collect() })
}
