//! The weights that lie inside the program, and what a file of weights says of its training.
//!
//! `assets/shipped.safetensors` is compiled in with the feature `shipped-weights`, which is on by default. It holds all
//! four networks in bfloat16, half the bytes of f32, and an [`Origin`] in its metadata. `parallax convert RUN FILE --ship`
//! makes it.

use std::collections::HashMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::Weights;
use super::save::tensors;
use crate::camera::Intrinsics;
use crate::error::{Error, Result};
use crate::formats::TensorFile;
use crate::formats::safetensors::{self, Numbers};

/// Name of the weights inside the program wherever weights are named. A file or folder of that name is
/// `./shipped`.
pub const SHIPPED: &str = "shipped";

/// The largest file that [`ship`] writes, in bytes: it becomes a part of the program.
pub const MOST_BYTES: usize = 6_000_000;

/// The key of an [`Origin`] in the metadata of a file of weights.
const KEY: &str = "parallax_origin";

/// Where weights come from, and how their depths become metres.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Origin {
    /// Name of the world that they were trained on.
    pub world: String,
    /// The steps of the training.
    pub steps: u64,
    /// The training's configuration as TOML; of paths only the last part.
    pub recipe: String,
    /// The version of the program that trained them.
    pub version: String,
    /// The SIMD level that it ran on ([`simd::level`](crate::tensor::simd::level)): other levels round otherwise.
    pub simd: String,
    /// Under which licence the weights are given away.
    pub licence: String,
    /// Depth in metres, for pictures of other cameras too.
    pub metres: Metres,
}

/// How the depths of a network that learnt from one moving camera become metres.
///
/// Such depths have one unknown factor. A network that always saw the road from the same height knows it by the road, so
/// the factor is the same for all pictures of its camera. Another lens changes it: seen by a lens twice as long, a thing
/// looks as it would at half the distance. Along the width and along the height of a picture that is stretched to the
/// network's size, the lens differs by different ratios, and how much each of them counts is the network's own affair. So
/// it is measured: a picture of focal lengths `fx` (over its width) and `fy` (over its height) has depths times
///
/// ```text
/// factor * (fx / camera.fx)^by_width * (fy / camera.fy)^by_height
/// ```
///
/// Pure geometry says `by_width + by_height = 1`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Metres {
    /// Metres in the network's unit of depth, for pictures of `camera`.
    pub factor: f64,
    /// The camera that the factor belongs to, in units of the picture's size.
    pub camera: Intrinsics,
    /// The camera's height over the road, in metres. Depths of a camera at another height are off by the ratio of the heights.
    pub camera_height: f64,
    /// The exponent of the ratio of focal lengths over the width.
    pub by_width: f64,
    /// The exponent of the ratio of focal lengths over the height.
    pub by_height: f64,
}

impl Metres {
    /// Factor that makes depths of a picture of this camera metres.
    pub fn factor_for(&self, camera: Intrinsics) -> f64 {
        let wide = (camera.fx / self.camera.fx).powf(self.by_width);
        let high = (camera.fy / self.camera.fy).powf(self.by_height);
        self.factor * wide * high
    }
}

impl Origin {
    /// Origin of the weights: the world, and for how long they were trained.
    pub fn in_words(&self) -> String {
        format!("{}, {} steps", self.world, self.steps)
    }

    /// Checks every field.
    ///
    /// # Errors
    /// Names the field that is empty or cannot be used.
    pub fn check(&self) -> Result<()> {
        let texts = [
            ("world", &self.world),
            ("recipe", &self.recipe),
            ("version", &self.version),
            ("simd", &self.simd),
            ("licence", &self.licence),
        ];
        if let Some((field, _)) = texts.iter().find(|(_, text)| text.trim().is_empty()) {
            return Err(Error::setting(*field, "is empty"));
        }
        let Metres { factor, camera, camera_height, by_width, by_height } = self.metres;
        let numbers = [
            ("metres.factor", factor),
            ("metres.camera.fx", camera.fx),
            ("metres.camera.fy", camera.fy),
            ("metres.camera_height", camera_height),
        ];
        if let Some((field, number)) = numbers.iter().find(|(_, x)| !(x.is_finite() && *x > 0.0)) {
            return Err(Error::setting(*field, format!("{number} is not a number above 0")));
        }
        // By geometry they lie between 0 and 1. A network may be odd, but hardly that odd.
        for (field, exponent) in [("metres.by_width", by_width), ("metres.by_height", by_height)] {
            if !(-2.0..=2.0).contains(&exponent) {
                return Err(Error::setting(field, format!("{exponent} is not a number from -2 to 2")));
            }
        }
        Ok(())
    }

    /// The metadata of a file of weights that come from there.
    pub(super) fn metadata(&self) -> Result<HashMap<String, String>> {
        let text = serde_json::to_string(self).map_err(|e| Error::Failed(format!("the origin as JSON: {e}")))?;
        Ok(HashMap::from([(KEY.into(), text)]))
    }

    /// The metadata of a file of weights, if it has any.
    ///
    /// # Errors
    /// If it says something that cannot be read or used.
    pub(super) fn from_metadata(metadata: &HashMap<String, String>) -> Result<Option<Self>> {
        let Some(text) = metadata.get(KEY) else { return Ok(None) };
        let origin: Origin = serde_json::from_str(text).map_err(|e| Error::setting(KEY, e.to_string()))?;
        origin.check()?;
        Ok(Some(origin))
    }
}

/// The file inside the program.
///
/// # Errors
/// If there is none: the program was built without the feature.
pub(super) fn open() -> Result<TensorFile> {
    safetensors::open_bytes(bytes()?, Path::new("the shipped weights"))
}

/// The bytes of the file inside the program.
#[cfg(feature = "shipped-weights")]
fn bytes() -> Result<&'static [u8]> {
    Ok(include_bytes!("../../assets/shipped.safetensors"))
}

/// The bytes of the file inside the program.
#[cfg(not(feature = "shipped-weights"))]
fn bytes() -> Result<&'static [u8]> {
    let message = "there are no weights inside this program: it was built without the feature `shipped-weights`. Name some \
                   (a run's folder, or a file), or build it with `--features shipped-weights`";
    Err(Error::Failed(message.into()))
}

/// Writes weights of all four networks as the file that is compiled in: numbers in bfloat16, `origin` in the metadata.
///
/// # Errors
/// If `origin` is not complete, a network is missing, the file would be larger than [`MOST_BYTES`], or it cannot be
/// written.
pub fn ship(weights: &Weights, origin: &Origin, path: &Path) -> Result<()> {
    origin.check()?;
    if let Some(missing) = weights.report.absent.first() {
        return Err(Error::Failed(format!("the network {missing} is missing: all four are shipped")));
    }
    let tensors = tensors(weights);
    let bytes: usize = tensors.values().map(|tensor| 2 * tensor.len()).sum();
    if bytes > MOST_BYTES {
        let message = format!(
            "{} has {:.1} MB of numbers in bfloat16: at most {:.1} are shipped (nano fits)",
            weights.setup.architecture().name(),
            bytes as f64 / 1e6,
            MOST_BYTES as f64 / 1e6
        );
        return Err(Error::Failed(message));
    }
    let mut metadata = weights.setup.metadata()?;
    metadata.extend(origin.metadata()?);
    safetensors::write_in(path, &tensors, metadata, Numbers::Bf16)
}

#[cfg(all(test, not(feature = "shipped-weights")))]
mod tests {
    use super::*;

    #[test]
    fn without_the_feature_the_error_says_what_to_do() {
        let error = open().unwrap_err().to_string();
        assert!(error.contains("--features shipped-weights") && error.contains("run's folder"), "{error}");
    }
}
