//! What a run starts from: random weights, and over them what files hold.

use std::path::PathBuf;

use super::recipe::RunConfig;
use crate::error::Result;
use crate::monovit::Ablation;
use crate::networks::DepthNetwork;
use crate::nn::{Params, Report};
use crate::weights::{Need, Sources, start_encoder, start_pose_encoder};

/// The weights before the first step.
pub struct Start {
    /// The networks.
    pub model: DepthNetwork,
    /// Their parameters.
    pub params: Params<f32>,
    /// For every flag's files, what was taken from them.
    pub reports: Vec<(Vec<PathBuf>, Report)>,
    /// Whether the pose networks know motion already: both came from files.
    pub knows_motion: bool,
}

impl Start {
    /// Draws weights from the seed, and reads `init`, `init_encoder` and `init_pose` over them.
    ///
    /// # Errors
    /// If a file cannot be read or does not fit the configuration's networks.
    pub fn of(config: &RunConfig) -> Result<Self> {
        let (model, mut params) = DepthNetwork::new(config.model(), config.seed);
        if let Some(disparity) = config.initial_disparity {
            start_at(&model, &mut params, disparity);
        }
        let (architecture, partial) = (config.architecture(), config.allow_partial);
        let mut reports = Vec::new();
        let mut knows_motion = false;
        if !config.init.is_empty() {
            let sources = Sources::open(&config.init)?;
            if !partial && config.ablation == Ablation::default() {
                sources.expect(architecture)?;
            }
            let report = sources.fill(&mut params, Need::All, partial)?;
            knows_motion = ["pose_encoder.", "pose."].iter().all(|p| report.matched.iter().any(|n| n.starts_with(p)));
            reports.push((config.init.clone(), report));
        }
        if let Some(path) = &config.init_encoder {
            reports.push((vec![path.clone()], start_encoder(&mut params, architecture, path, partial)?));
        }
        if let Some(path) = &config.init_pose {
            reports.push((vec![path.clone()], start_pose_encoder(&mut params, architecture, path, partial)?));
        }
        Ok(Start { model, params, reports, knows_motion })
    }
}

/// Sets the biases of the disparity heads so that an input of zeros gives this disparity.
fn start_at(model: &DepthNetwork, params: &mut Params<f32>, disparity: f64) {
    let logit = (disparity / (1.0 - disparity)).ln() as f32;
    for head in model.head_biases() {
        params.value_mut(head).data_mut().fill(logit);
    }
}
