//! The baseline that knows nothing but the mean depth map.

use super::compare::check_map;
use super::protocol::MIN_DEPTH;
use crate::data::DataSource;
use crate::depth::{DepthMap, resize_bilinear};
use crate::{Error, Result};

/// Baseline predictor: the mean of the inverse depth maps of the training frames, whatever the picture.
#[derive(Clone, Debug, PartialEq)]
pub struct MeanMap {
    /// Rows and columns: the first ground truth's.
    pub size: (usize, usize),
    /// Row-major inverse depths (1/m) within the range of the networks, [0.01, 10].
    pub inverse_depth: Vec<f32>,
}

/// The range of the networks' inverse depth: depth from 0.1 to 100.
const FARTHEST: f64 = 0.01;
const NEAREST: f64 = 10.0;

impl MeanMap {
    /// The mean over ground-truth maps of 1/depth where depth is known and 0.01 (100 m) elsewhere. Maps of another
    /// size than the first one's are resized to it.
    ///
    /// # Errors
    /// If there is no map, a map is empty, or reading one failed.
    pub fn of(maps: impl IntoIterator<Item = Result<DepthMap>>) -> Result<MeanMap> {
        let (mut size, mut sum, mut count) = ((0, 0), Vec::new(), 0u32);
        for map in maps {
            let map = map?;
            let own = (map.height, map.width);
            check_map("ground truth", map.metres.len(), own)?;
            let known = |metres: f32| metres > 0.0 && metres.is_finite();
            let inverse = |&m: &f32| {
                if known(m) { 1.0 / m.max(MIN_DEPTH as f32) } else { FARTHEST as f32 }
            };
            let inverse: Vec<f32> = map.metres.iter().map(inverse).collect();
            if count == 0 {
                size = own;
                sum = vec![0.0; inverse.len()];
            }
            let at_size = resize_bilinear(&inverse, own, size);
            sum.iter_mut().zip(at_size).for_each(|(s, v): (&mut f64, f64)| *s += v);
            count += 1;
        }
        if count == 0 {
            return Err(Error::Failed("no mean depth map: no frame has ground-truth depth".to_owned()));
        }
        let mean = |s: &f64| (s / f64::from(count)).clamp(FARTHEST, NEAREST) as f32;
        Ok(MeanMap { size, inverse_depth: sum.iter().map(mean).collect() })
    }

    /// [`MeanMap::of`] the target frames of a data set (the one that a network is trained on).
    pub fn of_dataset(data: &dyn DataSource) -> Result<MeanMap> {
        MeanMap::of((0..data.len()).filter_map(|sample| data.depth(sample).transpose()))
    }
}
