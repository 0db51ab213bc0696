//! The unit of a prediction's depth: a given factor, the camera's height over the road, or metres that the weights know.

use parallax::camera::Intrinsics;
use parallax::data::inputs::Input;
use parallax::eval::camera_height::find_ground;
use parallax::eval::metrics::STEREO_SCALE;
use parallax::networks::Setup;
use parallax::weights::{Metres, Origin};
use parallax::{Error, Result};

use super::Args;
use crate::cli::weights::WeightsArgs;

/// How depths get their unit.
pub struct Scaling<'a> {
    args: &'a Args,
    origin: Option<&'a Origin>,
}

impl<'a> Scaling<'a> {
    /// As the flags say, or else the weights.
    pub fn new(args: &'a Args, origin: Option<&'a Origin>) -> Self {
        Scaling { args, origin }
    }

    /// How depths become metres by what the weights know, if that decides. It was measured at the network's own size, and
    /// holds at no other.
    fn known(&self) -> Option<Metres> {
        let told = self.args.scale.is_some() || self.args.stereo || self.args.camera_height.is_some();
        self.origin.filter(|_| !told && !self.args.weights.resized()).map(|origin| origin.metres)
    }

    /// The unit of depth, as JSON says it.
    pub fn unit(&self) -> &'static str {
        let metric = self.args.stereo || self.args.camera_height.is_some() || self.known().is_some();
        if metric { "metres" } else { "relative" }
    }

    /// Says which network predicts, what it was trained on, and in which unit, where the weights know that.
    pub fn tell(&self, weights: &WeightsArgs, setup: &Setup, numbers: usize) {
        let Some(origin) = self.origin else { return };
        let (networks, millions) = (setup.architecture().name(), numbers as f64 / 1e6);
        let (height, width) = (setup.height, setup.width);
        let trained = origin.in_words();
        note!("weights {}: {networks}, {millions:.1} million parameters, trained on {trained}", weights.name());
        match self.known() {
            Some(metres) => {
                let whose = if self.args.fov.is_some() || self.args.intrinsics.is_some() {
                    "the given view across"
                } else {
                    "each picture's view across"
                };
                note!(
                    "pictures are seen at {width}x{height}; depth is in metres for a camera {} m above the road and {whose} \
                     (--camera-height, --fov)",
                    metres.camera_height
                );
            }
            None if self.args.weights.resized() => note!(
                "pictures are seen at {width}x{height}, which these weights were not trained for: depth has no unit, and may be \
                 far worse"
            ),
            None => note!("pictures are seen at {width}x{height}"),
        }
    }

    /// Factor on all depths of pictures of this camera, where pictures have no factor of their own.
    pub fn factor_of_all(&self, camera: Intrinsics) -> f64 {
        match self.known() {
            Some(metres) => metres.factor_for(camera),
            None if self.args.stereo => STEREO_SCALE,
            None => self.args.scale.unwrap_or(1.0),
        }
    }

    /// Factor on a picture's depths; `map` is its inverse depth as predicted.
    ///
    /// # Errors
    /// If the camera's height decides, and no road is seen.
    pub fn factor(&self, input: &Input, map: &[f32], size: (usize, usize), camera: Intrinsics) -> Result<f64> {
        let Some(metres) = self.args.camera_height else { return Ok(self.factor_of_all(camera)) };
        let ground = find_ground(map, size, camera).ok_or_else(|| {
            let message = "no road was found to measure the camera's height over: give --scale instead, or the \
                           camera's --intrinsics or --fov if it is not KITTI's";
            Error::file(&input.path, message)
        })?;
        Ok(metres / ground.camera_height)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(clap::Parser)]
    struct Command {
        #[command(flatten)]
        args: Args,
    }

    fn args(more: &[&str]) -> Args {
        let all = ["predict", "--weights", "w", "a.png", "--out", "o"].iter().chain(more);
        <Command as clap::Parser>::try_parse_from(all).map(|command| command.args).unwrap()
    }

    fn camera(args: &Args, width: f64, height: f64) -> Intrinsics {
        args.lens("a.png".as_ref(), [width, height], None).unwrap().intrinsics
    }

    #[test]
    fn every_flag_of_the_scale_gives_its_factor() {
        let input = Input { path: "a.png".into(), name: "a".into() };
        let size = (24, 80);
        // A road: inverse depth grows with the row below the horizon. Its camera hangs half a unit above it.
        let road: Vec<f32> =
            (0..24 * 80).map(|i| (((i / 80) as f64 - 11.5) / (80.0 * 0.58) / 0.5).max(0.01) as f32).collect();
        let factor = |more: &[&str]| {
            let args = args(more);
            Scaling::new(&args, None).factor(&input, &road, size, camera(&args, 80.0, 24.0))
        };
        assert_eq!(factor(&[]).unwrap(), 1.0);
        assert_eq!(factor(&["--scale", "2.5"]).unwrap(), 2.5);
        assert_eq!(factor(&["--stereo"]).unwrap(), 5.4);
        let found = factor(&["--camera-height", "1.65"]).unwrap();
        assert!((found / 3.3 - 1.0).abs() < 0.01, "{found}");
        // With a longer lens the same rows lie nearer to the horizon: the camera hangs lower.
        let longer = factor(&["--camera-height", "1.65", "--intrinsics", "92.8,92.8,39.5,11.5"]).unwrap();
        assert!((longer / 6.6 - 1.0).abs() < 0.02, "{longer}");
        let nowhere = args(&["--camera-height", "1.65"]);
        let error = Scaling::new(&nowhere, None)
            .factor(&input, &vec![0.1; 24 * 80], size, camera(&nowhere, 80.0, 24.0))
            .unwrap_err();
        assert!(error.to_string().contains("a.png: no road"), "{error}");
    }

    #[test]
    fn weights_that_know_the_metre_use_it_unless_told_otherwise() {
        let metres =
            Metres { factor: 16.0, camera: Intrinsics::KITTI, camera_height: 1.65, by_width: 0.25, by_height: 0.75 };
        let text = || "words".to_owned();
        let origin =
            Origin { world: text(), steps: 1, recipe: text(), version: text(), simd: text(), licence: text(), metres };
        let factor = |more: &[&str], size: (f64, f64)| {
            let args = args(more);
            let scaling = Scaling::new(&args, Some(&origin));
            (scaling.factor_of_all(camera(&args, size.0, size.1)), scaling.unit())
        };
        let near = |(found, unit): (f64, &str), expected: f64| {
            assert!((found / expected - 1.0).abs() < 5e-3 && unit == "metres", "{found} {unit}, expected {expected}");
        };
        near(factor(&[], (1242.0, 375.0)), 16.0);
        // The same lens in pictures twice as high: the height is half as many focal lengths.
        near(factor(&[], (1242.0, 750.0)), 16.0 * 0.5f64.powf(0.75));
        // A lens twice as long, along both sides.
        near(factor(&["--intrinsics", "1440.7,1440.7,621,187.5"], (1242.0, 375.0)), 32.0);
        near(factor(&["--fov", "90"], (1242.0, 375.0)), 16.0 * 0.5 / 0.58);
        assert_eq!(factor(&["--scale", "2"], (1242.0, 375.0)), (2.0, "relative"));
        assert_eq!(factor(&["--stereo"], (1242.0, 375.0)), (5.4, "metres"));
        assert_eq!(factor(&["--height", "192"], (1242.0, 375.0)), (1.0, "relative"));
    }

    #[test]
    fn the_camera_is_kittis_unless_given() {
        let close = |a: Intrinsics, b: Intrinsics, by: f64| {
            let pairs = [(a.fx, b.fx), (a.fy, b.fy), (a.cx, b.cx), (a.cy, b.cy)];
            assert!(pairs.iter().all(|(a, b)| (a / b - 1.0).abs() < by), "{a:?} {b:?}");
        };
        // The published constants are those of KITTI's pictures, up to half a pixel.
        close(camera(&args(&[]), 1242.0, 375.0), Intrinsics::KITTI, 4e-3);
        close(camera(&args(&["--fov", "81.5"]), 640.0, 480.0), camera(&args(&[]), 640.0, 480.0), 1e-3);
        let given = camera(&args(&["--intrinsics", "700,710,600,170"]), 1000.0, 500.0);
        close(given, Intrinsics { fx: 0.7, fy: 1.42, cx: 0.6, cy: 0.34 }, 1e-12);
    }
}
