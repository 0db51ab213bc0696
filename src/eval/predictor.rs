//! Depth of single pictures, by networks with weights.

use std::path::Path;

pub use super::evaluate::{Evaluation, evaluate, evaluate_mean_map, evaluate_predictions};
use super::flip::{flip_post_process, mirror};
use crate::data::augment::flip;
use crate::data::batch::to_tensor;
use crate::data::resize::lanczos;
use crate::depth::{Disparity, InverseDepth};
use crate::error::{Error, Result};
use crate::networks::{DepthNetwork, Setup};
use crate::nn::{Folded, Params};
use crate::tensor::{Precision, profile};
use crate::weights::{self, Need, Weights};
use image::RgbImage;

/// Depth of single pictures, by the networks with weights in evaluation mode.
///
/// ```no_run
/// use parallax::eval::predictor::Predictor;
/// use parallax::formats::picture::read_picture;
///
/// let predictor = Predictor::load("runs/1")?;
/// let prediction = predictor.depth_of(&read_picture("street.jpg".as_ref())?)?;
/// println!("{:?}: {:?}", prediction.inverse_depth.unit, prediction.inverse_depth.depth().values[0]);
/// # Ok::<(), parallax::Error>(())
/// ```
pub struct Predictor {
    model: DepthNetwork,
    params: Folded<f32>,
    setup: Setup,
}

/// The depth of a picture.
#[derive(Clone, Debug)]
pub struct Prediction {
    /// Sigmoid disparity at the size of the networks' pictures.
    pub disparity: Disparity,
    /// Inverse depth at the picture's own size, in its unit.
    pub inverse_depth: InverseDepth,
}

impl Predictor {
    /// The networks with these weights; `setup` gives the size of their pictures and the range of depths.
    pub fn new(model: &DepthNetwork, params: &Params<f32>, setup: &Setup) -> Self {
        Predictor { model: model.clone(), params: Folded::new(params), setup: *setup }
    }

    /// This predictor with products of convolutions and linear layers in other numbers. In bf16 depths move by some 0.05 % on
    /// average, and by 0.2 % in one pixel of a hundred (`PERFORMANCE.md`).
    ///
    /// # Errors
    /// If this machine has not the instruction: see [`Precision::is_available`].
    pub fn with_precision(mut self, precision: Precision) -> Result<Self> {
        if !precision.is_available() {
            let message = format!("{precision:?} needs a processor with AVX-512 BF16 (which PARALLAX_SIMD may forbid)");
            return Err(Error::setting("precision", message));
        }
        self.params = self.params.with_precision(precision);
        Ok(self)
    }

    /// Reads weights: a run's folder, or any file or folder that [`weights::load`] takes; `"shipped"`
    /// ([`weights::SHIPPED`]) means those inside the program.
    ///
    /// # Errors
    /// As [`weights::load`].
    pub fn load(path: impl AsRef<Path>) -> Result<Self> {
        let Weights { model, params, setup, .. } = weights::load(&[path.as_ref().to_owned()], Need::Depth, false)?;
        Ok(Self::new(&model, &params, &setup))
    }

    /// The networks, the size of their pictures and the range of their depths.
    pub fn setup(&self) -> &Setup {
        &self.setup
    }

    /// The depth of a picture of any size, which the networks see at theirs (resized, whatever its aspect). Depths are
    /// relative: from one camera alone they have no unit.
    ///
    /// # Errors
    /// If the picture is empty, or what the networks say is not finite, as with broken weights.
    pub fn depth_of(&self, picture: &RgbImage) -> Result<Prediction> {
        let (width, height) = picture.dimensions();
        if width == 0 || height == 0 {
            return Err(Error::Failed("an empty picture has no depth".into()));
        }
        let seen = lanczos(picture, self.setup.width as u32, self.setup.height as u32);
        let disparity = self.disparity(&seen);
        let inverse_depth = disparity.inverse_depth(self.setup.min_depth, self.setup.max_depth);
        if !inverse_depth.is_whole() {
            return Err(Error::Failed(self.why_not_finite(&seen)));
        }
        let inverse_depth = inverse_depth.resized(height as usize, width as usize, 1.0);
        Ok(Prediction { disparity, inverse_depth })
    }

    /// Sigmoid disparity of a picture whose sides are multiples of 32.
    pub fn disparity(&self, image: &RgbImage) -> Disparity {
        self.disparities(&[image]).swap_remove(0)
    }

    /// Why the depth of a picture whose sides are multiples of 32 is no depth: the op that first made a number that is not
    /// finite.
    pub fn why_not_finite(&self, image: &RgbImage) -> String {
        let culprit = profile::first_not_finite(|| self.disparity(image));
        let culprit = culprit.unwrap_or_else(|| "a disparity is beyond its range".into());
        format!("the networks' depth is not finite: the weights are broken; {culprit}")
    }

    fn disparities(&self, images: &[&RgbImage]) -> Vec<Disparity> {
        let (width, height) = (images[0].width() as usize, images[0].height() as usize);
        let all = self.model.predict(&self.params, &to_tensor(images)).swap_remove(0);
        let each = all.data().chunks_exact(width * height);
        each.map(|values| Disparity { width, height, values: values.to_vec() }).collect()
    }

    /// Inverse depth of a picture whose sides are multiples of 32; `flipped_too` joins it with that of the mirrored
    /// picture ([`flip_post_process`]).
    pub fn inverse_depth(&self, image: &RgbImage, flipped_too: bool) -> InverseDepth {
        let inverse = |d: &Disparity| d.inverse_depth(self.setup.min_depth, self.setup.max_depth);
        if !flipped_too {
            return inverse(&self.disparity(image));
        }
        let both = self.disparities(&[image, &flip(image)]);
        let (plain, mirrored) = (inverse(&both[0]), inverse(&both[1]));
        let mirrored = mirror(&mirrored.values, plain.width);
        InverseDepth { values: flip_post_process(&plain.values, &mirrored, plain.width), ..plain }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monovit::Preset;
    use crate::tensor::Tensor;

    #[test]
    fn weights_that_overflow_are_named_by_the_op_that_did() {
        let setup = Setup { height: 64, width: 96, ..Setup::of(Preset::Pico) };
        let (model, mut params) = DepthNetwork::new::<f32>(setup.model(), 0);
        let picture = RgbImage::from_fn(96, 64, |x, y| image::Rgb([x as u8, y as u8, 90]));
        assert!(Predictor::new(&model, &params, &setup).depth_of(&picture).is_ok());
        let (id, huge) = params
            .iter()
            .find(|(_, p)| p.name() == "encoder.stem.1.conv.weight")
            .map(|(id, p)| (id, Tensor::full(*p.value.shape(), 3e38)))
            .expect("a weight");
        params.set(id, huge);
        let error = Predictor::new(&model, &params, &setup).depth_of(&picture).unwrap_err().to_string();
        assert!(error.contains("the first op that made such a number is conv2d ["), "{error}");
    }
}
