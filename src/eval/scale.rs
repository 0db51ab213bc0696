//! How predictions get their scale before they are evaluated.

use std::fmt;
use std::str::FromStr;

use crate::{Error, Result};

/// The scale of a network trained on stereo pairs whose baseline was called 0.1: KITTI's is 0.54 m.
pub const STEREO_SCALE: f64 = 5.4;

/// The height of KITTI's cameras over the road, in metres (Geiger et al., IJRR 2013).
pub const KITTI_CAMERA_HEIGHT: f64 = 1.65;

/// Scaling of predictions before they are evaluated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Scale {
    /// Times median(ground truth) / median(prediction), for every image on its own, over the pixels that count.
    Median,
    /// Times [`STEREO_SCALE`].
    Stereo,
    /// Times what makes the camera hang so many metres over the predicted road, for every image on its own
    /// ([`find_ground`](super::camera_height::find_ground)): no ground truth is used.
    CameraHeight(f64),
    /// Times this factor.
    Factor(f64),
}

impl Scale {
    /// The scaling in words.
    pub fn in_words(self) -> String {
        match self {
            Scale::Median => "each image by the ratio of the medians".to_owned(),
            Scale::Stereo => format!("stereo: times {STEREO_SCALE}"),
            Scale::CameraHeight(metres) => format!("each image by the camera's height over its road, {metres} m"),
            Scale::Factor(factor) => format!("times {factor}"),
        }
    }
}

impl fmt::Display for Scale {
    /// As it is chosen.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Scale::Median => f.write_str("median"),
            Scale::Stereo => f.write_str("stereo"),
            Scale::CameraHeight(metres) => write!(f, "camera-height={metres}"),
            Scale::Factor(factor) => write!(f, "{factor}"),
        }
    }
}

impl FromStr for Scale {
    type Err = Error;

    fn from_str(name: &str) -> Result<Scale> {
        let positive = |text: &str| text.parse::<f64>().ok().filter(|x| *x > 0.0 && x.is_finite());
        let found = match name.split_once('=') {
            Some(("camera-height", metres)) => positive(metres).map(Scale::CameraHeight),
            Some(_) => None,
            None => match name {
                "median" => Some(Scale::Median),
                "stereo" => Some(Scale::Stereo),
                "camera-height" => Some(Scale::CameraHeight(KITTI_CAMERA_HEIGHT)),
                number => positive(number).map(Scale::Factor),
            },
        };
        found.ok_or_else(|| {
            let message = format!(
                "expected median, stereo or a number above 0, or camera-height or camera-height=METRES; found {name:?}"
            );
            Error::setting("scale", message)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_are_called_what_they_are_chosen_by() {
        for name in ["median", "stereo", "5.4", "camera-height=1.2"] {
            assert_eq!(name.parse::<Scale>().unwrap().to_string(), name);
        }
        assert_eq!("camera-height".parse::<Scale>().unwrap(), Scale::CameraHeight(1.65));
        for bad in ["0", "-1", "nan", "inf", "mean", "camera-height=", "camera-height=0", "median=2"] {
            let error = bad.parse::<Scale>().unwrap_err().to_string();
            assert!(error.contains("median, stereo or a number") && error.contains(bad), "{error}");
        }
    }
}
