//! Evaluation protocols of the literature, as data: one line of a table each, applied by
//! [`compare_image`](super::compare::compare_image).
//!
//! A protocol says which part of the ground truth the picture shows, which pixels of it count, how the prediction is
//! brought to the truth's size, between which depths predictions are cut, and which logarithm the column RMSE log has.

use std::fmt;
use std::ops::Range;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::{Error, Result};

/// Least depth that most protocols evaluate, in metres; predictions are clamped to the same range.
pub const MIN_DEPTH: f64 = 1e-3;
/// Greatest depth that most protocols evaluate, in metres.
pub const MAX_DEPTH: f64 = 80.0;

/// Evaluation protocol: which pixels are evaluated, against which ground truth. The numbers are in [`Protocol::rules`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Protocol {
    /// 0.001 < depth < 80 m, the whole image: for ground truth without holes.
    Dense,
    /// 0.001 < depth < 80 m within Garg's crop; the ground truth is the LiDAR's x, as in the Eigen tables.
    Eigen,
    /// The pixels of `eigen`; the ground truth is camera z.
    EigenCameraZ,
    /// Every pixel of the improved ground truth.
    Improved,
    /// The pixels of [`Eigen`](Protocol::Eigen); the ground truth is a scan that somebody else has projected:
    /// `proj_depth/velodyne/*.npz`.
    Projected,
    /// Make3D's C1 within the central crop of 2:1, as Monodepth2 and what follows it: up to 70 m, log10.
    #[serde(rename = "make3d")]
    Make3d,
    /// Every pixel of DrivingStereo's truth, the whole picture.
    #[serde(rename = "drivingstereo")]
    DrivingStereo,
    /// DrivingStereo's truth within Garg's crop: papers do not say whether they crop.
    #[serde(rename = "drivingstereo-garg")]
    DrivingStereoGarg,
    /// Every pixel of KITTI 2015's truth, the whole picture.
    #[serde(rename = "kitti2015")]
    Kitti2015,
    /// Every pixel of Middlebury's truth, the whole picture.
    Middlebury,
    /// 0.001 < depth < 80 m, rows 256 to 768 and columns 192 to 1856 of Cityscapes' 2048 x 1024.
    Cityscapes,
}

/// Part of the ground truth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Region {
    /// All of it.
    Whole,
    /// From and to in parts of the height, then of the width; truncated to whole pixels, end exclusive.
    Parts([f64; 4]),
    /// Pixels of a ground truth of one size.
    Pixels {
        /// The rows that the picture shows: the prediction is of these alone, over the whole width.
        shown: [usize; 2],
        /// Rows and columns that count, from and to (exclusive).
        counted: [usize; 4],
        /// Height and width of the whole ground truth. One that holds the shown rows alone is taken, too.
        of: [usize; 2],
    },
}

/// Garg's crop of KITTI's pictures (1603.04992): where the LiDAR sees.
const GARG: Region = Region::Parts([0.40810811, 0.99189189, 0.03594771, 0.96405229]);

/// How a map of inverse depth is brought to the size of the ground truth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Resize {
    /// Bilinear in inverse depth, pixel centres at halves.
    Bilinear,
    /// The value of pixel `floor(i from / to)`, as OpenCV's nearest neighbour.
    Nearest,
}

/// The logarithm in the column RMSE log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Logarithm {
    /// To the base e.
    Natural,
    /// To the base 10.
    Ten,
}

/// Rules of a protocol.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rules {
    /// The name that it is chosen by.
    pub name: &'static str,
    /// The pixels that count, in words.
    pub pixels: &'static str,
    /// Where pixels count.
    pub region: Region,
    /// Depths above this count, in metres.
    pub above: f64,
    /// Depths below this count, in metres.
    pub below: f64,
    /// Predictions are cut to this range, in metres, after scaling.
    pub clamp: [f64; 2],
    /// How predictions are resized.
    pub resize: Resize,
    /// The logarithm of RMSE log.
    pub logarithm: Logarithm,
}

/// The part that most have in common.
const USUAL: Rules = Rules {
    name: "dense",
    pixels: "0.001 to 80 m, the whole picture",
    region: Region::Whole,
    above: MIN_DEPTH,
    below: MAX_DEPTH,
    clamp: [MIN_DEPTH, MAX_DEPTH],
    resize: Resize::Bilinear,
    logarithm: Logarithm::Natural,
};
/// Every pixel whose depth is known, though predictions are cut at 80 m.
const KNOWN: Rules = Rules { above: 0.0, below: f64::INFINITY, ..USUAL };

/// Make3D's grid of laser depths: 55 rows of 305, of which the central 2:1 of the picture shows 21.
const MAKE3D: Region = Region::Pixels { shown: [17, 38], counted: [17, 38, 0, 305], of: [55, 305] };
/// Cityscapes without the lower quarter, which shows the bonnet.
const CITYSCAPES: Region = Region::Pixels { shown: [0, 768], counted: [256, 768, 192, 1856], of: [1024, 2048] };

/// All protocols and their rules.
#[rustfmt::skip]
const TABLE: [(Protocol, Rules); 11] = [
    (Protocol::Dense, USUAL),
    (Protocol::Eigen, Rules { name: "eigen", region: GARG,
        pixels: "0.001 to 80 m within Garg's crop, the LiDAR's x", ..USUAL }),
    (Protocol::EigenCameraZ, Rules { name: "eigen-camera-z", region: GARG,
        pixels: "0.001 to 80 m within Garg's crop, the camera's z", ..USUAL }),
    (Protocol::Improved, Rules { name: "improved", pixels: "every pixel of the improved ground truth", ..KNOWN }),
    (Protocol::Projected, Rules { name: "projected", region: GARG,
        pixels: "0.001 to 80 m within Garg's crop, scans projected beforehand", ..USUAL }),
    (Protocol::Make3d, Rules { name: "make3d", region: MAKE3D, above: 0.0, below: 70.0, clamp: [0.0, 70.0],
        resize: Resize::Nearest, logarithm: Logarithm::Ten,
        pixels: "up to 70 m (C1), rows 17 to 38 of 55, RMSE log to the base 10" }),
    (Protocol::DrivingStereo, Rules { name: "drivingstereo", pixels: "every pixel of the truth, no crop", ..KNOWN }),
    (Protocol::DrivingStereoGarg, Rules { name: "drivingstereo-garg", region: GARG,
        pixels: "every pixel of the truth within Garg's crop", ..KNOWN }),
    (Protocol::Kitti2015, Rules { name: "kitti2015", pixels: "every pixel of the truth, no crop", ..KNOWN }),
    (Protocol::Middlebury, Rules { name: "middlebury", pixels: "every pixel of the truth, no crop", ..KNOWN }),
    (Protocol::Cityscapes, Rules { name: "cityscapes", region: CITYSCAPES,
        pixels: "0.001 to 80 m, rows 256 to 768 and columns 192 to 1856", ..USUAL }),
];

impl Protocol {
    /// Every protocol, in the order of the table.
    pub fn all() -> impl Iterator<Item = Protocol> {
        TABLE.iter().map(|(protocol, _)| *protocol)
    }

    /// The rules of this protocol.
    pub fn rules(self) -> &'static Rules {
        let found = TABLE.iter().find(|(protocol, _)| *protocol == self);
        &found.expect("every protocol has its line in the table").1
    }

    /// The names of all, in words.
    fn names() -> String {
        let names: Vec<&str> = TABLE.iter().map(|(_, rules)| rules.name).collect();
        let (last, others) = names.split_last().expect("there are protocols");
        format!("{} or {last}", others.join(", "))
    }
}

impl Rules {
    /// Whether a depth of the ground truth, in metres, counts.
    pub fn keeps(&self, metres: f64) -> bool {
        metres > self.above && metres < self.below && metres.is_finite()
    }

    /// The rows and columns of a ground truth of `height x width` that the prediction is of, and those that count, end
    /// exclusive.
    ///
    /// # Errors
    /// If the protocol is for ground truth of another size.
    pub fn windows(&self, height: usize, width: usize) -> Result<Windows> {
        let whole = [0..height, 0..width];
        match self.region {
            Region::Whole => Ok(Windows { shown: whole.clone(), counted: whole }),
            Region::Parts([top, bottom, left, right]) => {
                let part = |size: usize, from: f64, to: f64| (from * size as f64) as usize..(to * size as f64) as usize;
                Ok(Windows { shown: whole, counted: [part(height, top, bottom), part(width, left, right)] })
            }
            Region::Pixels { shown: [first, last], counted: [top, bottom, left, right], of } => {
                // The rows above the shown ones may have been cut off already.
                let cut = match [height, width] {
                    size if size == of => 0,
                    size if size == [last - first, of[1]] => first,
                    _ => {
                        let message = format!(
                            "{} is for ground truth of {} or {} rows of {}, found {height} rows of {width}: choose \
                             another protocol",
                            self.name,
                            of[0],
                            last - first,
                            of[1]
                        );
                        return Err(Error::setting("protocol", message));
                    }
                };
                let shown = [first - cut..last - cut, 0..width];
                Ok(Windows { shown, counted: [top - cut..bottom - cut, left..right] })
            }
        }
    }
}

/// Rows and columns of a ground truth.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Windows {
    /// The part that the prediction covers.
    pub shown: [Range<usize>; 2],
    /// The pixels that count.
    pub counted: [Range<usize>; 2],
}

impl fmt::Display for Protocol {
    /// The name that it is chosen by.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.rules().name)
    }
}

impl FromStr for Protocol {
    type Err = Error;

    fn from_str(name: &str) -> Result<Protocol> {
        let found = TABLE.iter().find(|(_, rules)| rules.name == name).map(|(protocol, _)| *protocol);
        found.ok_or_else(|| Error::setting("protocol", format!("expected {}, found {name:?}", Protocol::names())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_protocol_is_called_what_it_is_chosen_by() {
        for protocol in Protocol::all() {
            let name = protocol.to_string();
            assert_eq!(name.parse::<Protocol>().unwrap(), protocol);
            assert_eq!(serde_json::to_value(protocol).unwrap(), *name);
        }
        let error = "kitti".parse::<Protocol>().unwrap_err().to_string();
        for name in ["dense", "eigen", "make3d", "middlebury or cityscapes"] {
            assert!(error.contains(name), "{error}");
        }
    }

    #[test]
    fn windows_are_the_published_ones() {
        let windows = |protocol: Protocol, height, width| protocol.rules().windows(height, width);
        for protocol in [Protocol::Eigen, Protocol::EigenCameraZ, Protocol::Projected] {
            let found = windows(protocol, 375, 1242).unwrap();
            assert_eq!((found.shown, found.counted), ([0..375, 0..1242], [153..371, 44..1197]));
        }
        let whole = windows(Protocol::Make3d, 55, 305).unwrap();
        assert_eq!((whole.shown, whole.counted), ([17..38, 0..305], [17..38, 0..305]));
        let cut = windows(Protocol::Make3d, 21, 305).unwrap();
        assert_eq!((cut.shown, cut.counted), ([0..21, 0..305], [0..21, 0..305]));
        let whole = windows(Protocol::Cityscapes, 1024, 2048).unwrap();
        assert_eq!((whole.shown, whole.counted), ([0..768, 0..2048], [256..768, 192..1856]));
        assert_eq!(windows(Protocol::Cityscapes, 768, 2048).unwrap().counted, [256..768, 192..1856]);
        let error = windows(Protocol::Make3d, 375, 1242).unwrap_err().to_string();
        for part in ["make3d", "55 or 21 rows of 305", "375 rows of 1242"] {
            assert!(error.contains(part), "{error}");
        }
    }

    #[test]
    fn the_kept_depths_are_the_published_ones() {
        let keeps = |protocol: Protocol, metres| protocol.rules().keeps(metres);
        assert!(keeps(Protocol::Dense, 79.9) && !keeps(Protocol::Dense, 80.0) && !keeps(Protocol::Dense, 1e-3));
        assert!(keeps(Protocol::Make3d, 69.9) && !keeps(Protocol::Make3d, 70.0) && keeps(Protocol::Make3d, 5e-4));
        for protocol in [Protocol::Improved, Protocol::DrivingStereo, Protocol::Kitti2015, Protocol::Middlebury] {
            assert!(keeps(protocol, 120.0) && !keeps(protocol, 0.0) && !keeps(protocol, f64::INFINITY), "{protocol}");
        }
        assert!(Protocol::all().all(|protocol| !keeps(protocol, f64::NAN)));
    }
}
