//! The switches of the paper's ablation study, as flags.

use parallax::Result;
use parallax::monovit::Ablation;
use parallax::monovit::loss::{LossConfig, Reprojection, Scales};
use parallax::networks::{Architecture, Config};

/// What is taken away from the networks.
#[derive(clap::Args, Clone)]
#[command(next_help_heading = "Ablations of the networks")]
pub struct Networks {
    /// Largest number of transformer paths in a stage: 2, 1 or 0 [default: the preset's].
    #[arg(long, value_name = "N")]
    transformer_paths: Option<usize>,
    /// Leave out the CNN path beside the transformer paths.
    #[arg(long)]
    no_cnn_path: bool,
    /// Leave out the decoder's channel attention.
    #[arg(long)]
    no_decoder_attention: bool,
    /// Largest DropPath probability [default: the preset's].
    #[arg(long, value_name = "PROBABILITY")]
    drop_path: Option<f64>,
}

impl Networks {
    /// Whether any flag is given.
    pub fn any(&self) -> bool {
        let numbers = self.transformer_paths.is_some() || self.drop_path.is_some();
        numbers || self.no_cnn_path || self.no_decoder_attention
    }

    /// Takes away what the flags say.
    pub fn apply(&self, ablation: &mut Ablation) {
        ablation.transformer_paths = self.transformer_paths.or(ablation.transformer_paths);
        ablation.cnn_path &= !self.no_cnn_path;
        ablation.decoder_attention &= !self.no_decoder_attention;
        ablation.drop_path = self.drop_path.or(ablation.drop_path);
    }

    /// What is left of named networks.
    pub fn config(&self, architecture: Architecture) -> Result<Config> {
        let mut ablation = Ablation::default();
        self.apply(&mut ablation);
        architecture.config(&ablation)
    }
}

/// What is changed in the loss.
#[derive(clap::Args, Clone)]
#[command(next_help_heading = "Ablations of the loss")]
pub struct Loss {
    /// Switch auto-masking off: keep the pixels that an unwarped neighbour explains better.
    #[arg(long)]
    no_auto_mask: bool,
    /// How a pixel's errors over its source frames are combined [default: minimum].
    #[arg(long)]
    reprojection: Option<Reprojection>,
    /// Resolution at which the loss of the smaller disparities is computed [default: full].
    #[arg(long)]
    scales: Option<Scales>,
    /// Share of SSIM in the photometric error, 0 to 1 [default: 0.85].
    #[arg(long, value_name = "SHARE")]
    ssim: Option<f64>,
}

impl Loss {
    /// Whether any flag is given.
    pub fn any(&self) -> bool {
        self.no_auto_mask || self.reprojection.is_some() || self.scales.is_some() || self.ssim.is_some()
    }

    /// Changes what the flags say.
    pub fn apply(&self, loss: &mut LossConfig) {
        loss.auto_mask &= !self.no_auto_mask;
        loss.reprojection = self.reprojection.unwrap_or(loss.reprojection);
        loss.scales = self.scales.unwrap_or(loss.scales);
        loss.ssim = self.ssim.unwrap_or(loss.ssim);
    }
}
