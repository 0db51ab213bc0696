//! The second camera of a stereo pair as one more source: the same instant, seen from a place that is known.

use serde::{Deserialize, Serialize};

/// Which frames a target is compared with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
pub enum Sources {
    /// Its neighbours in time (M). The motion is learnt along with the depth, both up to a common scale.
    #[default]
    Mono,
    /// The other camera's frame of the same instant (S). The motion is the baseline, and nothing of it is learnt.
    Stereo,
    /// Both (MS): the baseline gives neighbours and depth their scale.
    Both,
}

impl Sources {
    /// Whether the frames before and after the target are needed.
    pub fn in_time(self) -> bool {
        self != Sources::Stereo
    }

    /// Whether the other camera's frame is needed.
    pub fn other_camera(self) -> bool {
        self != Sources::Mono
    }
}

/// Unit of the distance between two cameras, and with it of the depth that is learnt.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
pub enum Baseline {
    /// Metres, as calibrated: predicted depth is in metres.
    #[default]
    Calibrated,
    /// The baseline is 0.1, whatever it measures, as published for KITTI (Monodepth2): predicted depth times 5.4 is in
    /// metres there, where the cameras stand 0.54 m apart.
    Published,
}

/// The published length of KITTI's baseline, in the units that depth is predicted in.
const PUBLISHED: f64 = 0.1;

impl Baseline {
    /// The x of the shift to the other camera in this unit, of one in metres.
    pub fn shift(self, metres: f64) -> f64 {
        match self {
            Baseline::Calibrated => metres,
            Baseline::Published => PUBLISHED.copysign(metres),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_published_baseline_keeps_the_side_alone() {
        assert_eq!(Baseline::Calibrated.shift(-0.532), -0.532);
        assert_eq!(Baseline::Published.shift(-0.532), -0.1);
        assert_eq!(Baseline::Published.shift(0.54), 0.1);
    }
}
