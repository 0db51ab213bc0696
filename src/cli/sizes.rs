//! The flags that say what is run: shared by the commands that need no data.

use parallax::Result;
use parallax::monovit::Ablation;
use parallax::networks::Architecture;
use parallax::networks::setup::check_size;
use parallax::tensor::Precision;

use super::architecture::ArchitectureArgs;

#[derive(clap::Args, Clone)]
pub struct Sizes {
    #[command(flatten)]
    pub networks: ArchitectureArgs,
    /// Height of the pictures, a multiple of 32.
    #[arg(long, value_name = "PIXELS", default_value_t = 96)]
    pub height: usize,
    /// Width of the pictures, a multiple of 32.
    #[arg(long, value_name = "PIXELS", default_value_t = 320)]
    pub width: usize,
    /// Batch size, in pictures or triplets.
    #[arg(long, value_name = "N", default_value_t = 4)]
    pub batch: usize,
    /// Compute transformer layers again in the backward pass of a step: less memory, more time.
    #[arg(long)]
    pub recompute: bool,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
}

impl Sizes {
    /// The networks that are asked for.
    ///
    /// # Errors
    /// If flags contradict one another.
    pub fn architecture(&self) -> Result<Architecture> {
        self.networks.get()
    }

    /// Whether the networks can be run at these sizes.
    pub fn check(&self) -> Result<()> {
        check_size("--height", self.height)?;
        check_size("--width", self.width)?;
        if self.batch == 0 {
            return Err(parallax::Error::setting("--batch", "at least 1"));
        }
        self.architecture()?.config(&Ablation::default()).map(drop)
    }
}

/// Numbers in which products of convolutions and linear layers are taken, in inference.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Numbers {
    /// f32.
    F32,
    /// bf16, summed in f32: where the processor has AVX-512 BF16.
    Bf16,
}

impl Numbers {
    /// The library's word for it.
    ///
    /// # Errors
    /// If this machine has no instruction for it.
    pub fn checked(self) -> Result<Precision> {
        let precision = match self {
            Numbers::F32 => Precision::F32,
            Numbers::Bf16 => Precision::Bf16,
        };
        if !precision.is_available() {
            let message = "this processor has no AVX-512 BF16 (or PARALLAX_SIMD forbids it): take f32";
            return Err(parallax::Error::setting("--precision", message));
        }
        Ok(precision)
    }
}
