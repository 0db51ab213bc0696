//! Flags that say which frames a target is compared with.

use parallax::data::stereo::{Baseline, Sources};
use parallax::train::RunConfig;

/// Neighbours in time, a second camera, or both.
#[derive(clap::Args)]
pub struct StereoArgs {
    /// Sources that a frame is compared with: its neighbours in time (mono), the same instant as the other camera saw it (stereo),
    /// or both [default: mono].
    #[arg(long, value_name = "WHICH")]
    sources: Option<Sources>,
    /// Unit of the distance between the two cameras, and of the depth that is learnt: metres (calibrated), or the
    /// published 0.1 for KITTI's 0.54 m (published) [default: calibrated].
    #[arg(long, value_name = "UNIT")]
    baseline: Option<Baseline>,
}

impl StereoArgs {
    /// Whether any is given.
    pub fn any(&self) -> bool {
        self.sources.is_some() || self.baseline.is_some()
    }

    /// Puts what is given into a configuration.
    pub fn apply(&self, config: &mut RunConfig) {
        config.sources = self.sources.unwrap_or(config.sources);
        config.baseline = self.baseline.unwrap_or(config.baseline);
    }
}
