//! The frames of a sample, and its depth.

use std::sync::Arc;

use image::RgbImage;

use crate::data::DataSource;
use crate::data::augment::flip;
use crate::data::stereo::Sources;
use crate::error::{Error, Result};

/// The frames of a sample.
pub(super) struct Frames {
    pub(super) target: Arc<RgbImage>,
    /// The previous and the next one.
    pub(super) neighbours: Option<[Arc<RgbImage>; 2]>,
    /// The other camera's, and the x of the shift to it in metres.
    pub(super) other: Option<(Arc<RgbImage>, f64)>,
}

impl Frames {
    pub(super) fn read(data: &dyn DataSource, sample: usize, sources: Sources) -> Result<Frames> {
        let neighbours = || Ok::<_, Error>([data.image(sample, -1)?, data.image(sample, 1)?]);
        let neighbours = sources.in_time().then(neighbours).transpose()?;
        let other = match sources.other_camera() {
            true => {
                let image = data.other_image(sample)?;
                let unknown =
                    || Error::setting("sources", format!("{}: its second camera stands nowhere", data.name(sample)));
                Some((image, data.other_camera_at(sample).ok_or_else(unknown)?))
            }
            false => None,
        };
        Ok(Frames { target: data.image(sample, 0)?, neighbours, other })
    }

    /// As in a mirror: what stood to the right stands to the left.
    pub(super) fn mirrored(self) -> Frames {
        let flip = |image: Arc<RgbImage>| Arc::new(flip(&image));
        Frames {
            target: flip(self.target),
            neighbours: self.neighbours.map(|both| both.map(flip)),
            other: self.other.map(|(image, shift)| (flip(image), -shift)),
        }
    }
}
/// The depth of a sample's target at `[h, w]` pixels, the nearest ones of the ground truth: metres, 0 for unknown, infinite
/// for the sky; unknown everywhere if there is none.
///
/// # Errors
/// If it cannot be read.
pub(super) fn depth_of(data: &dyn DataSource, sample: usize, [h, w]: [usize; 2], mirrored: bool) -> Result<Vec<f32>> {
    let Some(map) = data.depth(sample)? else { return Ok(vec![0.0; h * w]) };
    let sky = if data.zero_depth_is_sky() { f32::INFINITY } else { 0.0 };
    let pixel = |y: usize, x: usize| {
        let x = if mirrored { w - 1 - x } else { x };
        let nearest = |at: usize, of: usize, size: usize| ((2 * at + 1) * size / (2 * of)).min(size - 1);
        let metres = map.metres[nearest(y, h, map.height) * map.width + nearest(x, w, map.width)];
        if metres > 0.0 { metres } else { sky }
    };
    Ok((0..h).flat_map(|y| (0..w).map(move |x| (y, x))).map(|(y, x)| pixel(y, x)).collect())
}
