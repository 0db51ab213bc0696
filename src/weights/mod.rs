//! Weights from elsewhere, and back: the published files (`.pth`), safetensors, `.npz`.
//!
//! ```no_run
//! use parallax::weights::{Need, load};
//!
//! // A folder with encoder.pth and depth.pth, one file with all, or a run of this program.
//! let weights = load(&["mono_640x192".into()], Need::Depth, false)?;
//! println!("{} at {} x {}", weights.setup.architecture().name(), weights.setup.width, weights.setup.height);
//! println!("{}", weights.report);
//! # Ok::<(), parallax::Error>(())
//! ```
//!
//! [`Sources`] opens the files and finds out what each tensor is (`names.rs`) and which networks, of which size, they
//! belong to (`sizes.rs`). Loading is strict: every tensor of a network that is there, and no other, each finite, and the same
//! under all its names. [`start_encoder`] and [`start_pose_encoder`] take networks that were trained on ImageNet.
//! [`save`] writes any of these forms. The path [`SHIPPED`] stands for the weights inside the program.

mod imagenet;
mod names;
mod save;
mod shipped;
mod sizes;
mod sources;

pub use imagenet::{start_encoder, start_pose_encoder};
pub use names::NETWORKS;
pub use save::{Form, outputs, save};
pub use shipped::{MOST_BYTES, Metres, Origin, SHIPPED, ship};
pub use sources::{Need, Sources};

use std::path::PathBuf;

use crate::error::Result;
use crate::monovit::Ablation;
use crate::networks::{Architecture, DepthNetwork, Setup};
use crate::nn::{Params, Report};
use crate::tensor::bf16_bits;

/// A model with weights from files.
pub struct Weights {
    /// The networks.
    pub model: DepthNetwork,
    /// Their parameters. Those that were not loaded are as a new model's.
    pub params: Params<f32>,
    /// The size of the networks and of their pictures, the range of depths.
    pub setup: Setup,
    /// What was loaded and what was not.
    pub report: Report,
    /// Where they come from, if their file says so.
    pub origin: Option<Origin>,
}

impl Weights {
    /// Rounds every number to bfloat16, as the file of shipped weights holds it.
    pub fn round_to_bf16(&mut self) {
        let ids: Vec<_> = self.params.iter().map(|(id, _)| id).collect();
        for id in ids {
            let value = self.params.value_mut(id);
            *value = value.map(|x| f32::from_bits(u32::from(bf16_bits(x)) << 16));
        }
    }
}

/// Loads weights from files and folders; see [`Sources::open`] for which.
///
/// # Errors
/// As [`Sources::open`], [`Sources::setup`] and [`Sources::fill`]; if the tensors are of another size than the
/// configuration beside them, unless `allow_partial`.
pub fn load(paths: &[PathBuf], need: Need, allow_partial: bool) -> Result<Weights> {
    load_from(&Sources::open(paths)?, need, allow_partial)
}

/// [`load`], from sources that are open.
///
/// # Errors
/// As [`load`].
pub fn load_from(sources: &Sources, need: Need, allow_partial: bool) -> Result<Weights> {
    let setup = sources.setup(need)?;
    // Of a network that parts are taken away from, tensor by tensor will do.
    if !allow_partial && setup.ablation == Ablation::default() {
        sources.expect(setup.architecture())?;
    }
    let (model, mut params) = DepthNetwork::new(setup.model(), 0);
    let report = sources.fill(&mut params, need, allow_partial)?;
    Ok(Weights { model, params, setup, report, origin: sources.origin().cloned() })
}

/// The setup that some files of weights, of all four networks, say or have by their size.
///
/// # Errors
/// As [`Sources::open`] and [`Sources::setup`].
pub fn setup_of(paths: &[PathBuf]) -> Result<Setup> {
    Sources::open(paths)?.setup(Need::All)
}

/// The networks that some files are weights of.
///
/// # Errors
/// As [`Sources::open`] and [`Sources::architecture`].
pub fn architecture_of(paths: &[PathBuf]) -> Result<Architecture> {
    Sources::open(paths)?.architecture(Need::All)
}
