//! Starts from networks that were trained to classify pictures (ImageNet), as the paper's are.

use std::path::Path;

use super::{Need, Sources};
use crate::error::{Error, Result};
use crate::formats::StoredTensor;
use crate::monovit::{Config, Preset};
use crate::nn::{Named, Params, Report};

/// The first convolution of the pose encoder.
const FIRST: &str = "pose_encoder.encoder.conv1.weight";

/// Starts the depth encoder from an MPViT (or from the encoder of a MonoViT); a classification head is passed over.
///
/// # Errors
/// As [`Sources::open`] and [`Sources::fill`]; if it is an MPViT of another size, unless `allow_partial`.
pub fn start_encoder(params: &mut Params<f32>, preset: Preset, path: &Path, allow_partial: bool) -> Result<Report> {
    start(params, preset, path, "encoder", allow_partial)
}

/// Starts the pose encoder from a ResNet-18 in torchvision's names (or from a pose encoder).
///
/// A first convolution for one picture is repeated for the second one and halved, so that two equal pictures give what
/// one gave (Monodepth2, section 4).
///
/// # Errors
/// As [`start_encoder`].
pub fn start_pose_encoder(
    params: &mut Params<f32>,
    preset: Preset,
    path: &Path,
    allow_partial: bool,
) -> Result<Report> {
    start(params, preset, path, "pose_encoder", allow_partial)
}

fn start(
    params: &mut Params<f32>,
    preset: Preset,
    path: &Path,
    network: &'static str,
    allow_partial: bool,
) -> Result<Report> {
    let mut sources = Sources::open(&[path.to_owned()])?;
    let prefix = format!("{network}.");
    if !sources.tensors.iter().any(|t| t.name.starts_with(&prefix)) {
        let what =
            if network == "encoder" { "an MPViT (stem., mhca_stages.)" } else { "a ResNet-18 (conv1., layer1.)" };
        return Err(Error::file(path, format!("holds no tensors of {what}")));
    }
    for tensor in &mut sources.tensors {
        if tensor.name == FIRST {
            for_two_pictures(tensor, &preset.config());
        }
    }
    if !allow_partial {
        sources.only(network).expect(preset)?;
    }
    sources.fill(params, Need::Only(network), allow_partial)
}

/// `[w, 3, 7, 7]` over one picture to `[w, 6, 7, 7]` over two.
fn for_two_pictures(first: &mut Named, config: &Config) {
    let &[out, 3, height, width] = first.tensor.shape() else { return };
    // Anything else is refused by its shape or kind of number later on.
    if out != config.pose_width {
        return;
    }
    let Some(numbers) = first.tensor.to_f64() else { return };
    let of_one = 3 * height * width;
    if of_one == 0 {
        return;
    }
    let both: Vec<f64> =
        numbers.chunks(of_one).flat_map(|filter| filter.iter().chain(filter)).map(|x| x / 2.0).collect();
    first.tensor = StoredTensor::of_f64(&[out, 6, height, width], &both);
}
