//! Starts from networks that were trained to classify pictures (ImageNet), as the papers' are.

use std::path::Path;

use super::sizes::{Family, Sizes};
use super::{Need, Sources};
use crate::error::{Error, Result};
use crate::formats::StoredTensor;
use crate::monovit::Ablation;
use crate::networks::{Architecture, Config};
use crate::nn::{Named, Params, Report};

/// The first convolution of the pose encoder.
const FIRST: &str = "pose_encoder.encoder.conv1.weight";

/// Starts the depth encoder of an architecture from weights of its kind: an MPViT, or a ResNet in torchvision's names (or the
/// encoder of trained weights). A classification head is passed over.
///
/// # Errors
/// As [`Sources::open`] and [`Sources::fill`]; if it is another encoder, or of another size, unless `allow_partial`.
pub fn start_encoder(
    params: &mut Params<f32>,
    architecture: impl Into<Architecture>,
    path: &Path,
    allow_partial: bool,
) -> Result<Report> {
    let architecture = architecture.into();
    let sources = Sources::open(&[path.to_owned()])?;
    let own = sources.only("encoder");
    let config = architecture.config(&Ablation::default())?;
    let (wanted, found) = (Family::of(&config.encoder), Sizes::of(&own.tensors).family());
    if found != Some(wanted) {
        let found = found.map_or(String::new(), |family| format!(", but those of {}", family.described()));
        return Err(Error::file(path, format!("holds no tensors of {}{found}", wanted.described())));
    }
    if !allow_partial {
        own.expect(architecture)?;
    }
    sources.fill(params, Need::Only("encoder"), allow_partial)
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
    architecture: impl Into<Architecture>,
    path: &Path,
    allow_partial: bool,
) -> Result<Report> {
    let architecture = architecture.into();
    let config = architecture.config(&Ablation::default())?;
    let mut sources = Sources::open(&[path.to_owned()])?;
    if !sources.networks().contains(&"pose_encoder") {
        // A ResNet for one picture, which a depth encoder may be as well.
        for tensor in &mut sources.tensors {
            if tensor.name.starts_with("encoder.encoder.") {
                tensor.name.insert_str(0, "pose_");
            }
        }
    }
    if !sources.networks().contains(&"pose_encoder") {
        return Err(Error::file(path, "holds no tensors of a ResNet-18 (conv1., layer1.)"));
    }
    for tensor in &mut sources.tensors {
        if tensor.name == FIRST {
            for_two_pictures(tensor, &config);
        }
    }
    if !allow_partial {
        sources.only("pose_encoder").expect(architecture)?;
    }
    sources.fill(params, Need::Only("pose_encoder"), allow_partial)
}

/// `[w, 3, 7, 7]` over one picture to `[w, 6, 7, 7]` over two.
fn for_two_pictures(first: &mut Named, config: &Config) {
    let &[out, 3, height, width] = first.tensor.shape() else { return };
    // Anything else is refused by its shape or kind of number later on.
    if out != config.pose.width {
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
