//! On streets, whose camera is known: plain drives, and paths that turn.

use super::*;
use crate::street::{self, Draw, Pose, Street, StreetConfig};

/// A street seen through a camera that is said to be another one.
struct Claimed<'a>(&'a Street, Intrinsics);

impl DataSource for Claimed<'_> {
    fn len(&self) -> usize {
        self.0.len()
    }
    fn name(&self, sample: usize) -> String {
        self.0.name(sample)
    }
    fn image(&self, sample: usize, offset: i32) -> crate::Result<std::sync::Arc<image::RgbImage>> {
        self.0.image(sample, offset)
    }
    fn intrinsics(&self, _: usize) -> Intrinsics {
        self.1
    }
    fn depth(&self, _: usize) -> crate::Result<Option<crate::depth::DepthMap>> {
        Ok(None)
    }
}

/// The verdict on a street's camera with other focal lengths (a factor) and another principal point (shares of the size).
fn claimed(street: &Street, factor: f64, moved: [f64; 2]) -> CameraFit {
    let k = street.config().intrinsics;
    let k = Intrinsics { fx: k.fx * factor, fy: k.fy * factor, cx: k.cx + moved[0], cy: k.cy + moved[1] };
    let fits = fit(&Claimed(street, k));
    assert_eq!(fits.len(), 1);
    fits.into_iter().next().unwrap()
}

fn winding(seed: u64, frames: usize, rate: f64, speed: f64) -> Vec<Pose> {
    street::winding(&mut Draw::new(seed, 0, 0), frames, 0.0, rate, speed)
}

fn config(seed: u64, height: usize, width: usize, sequences: usize, frames: usize) -> StreetConfig {
    StreetConfig { seed, height, width, sequences, frames, ..StreetConfig::default() }
}

/// Some of the drives; all of them if `PARALLAX_DRIVES=all` asks for it, which takes minutes.
fn some<T>(drives: impl IntoIterator<Item = T>, few: usize) -> (Vec<T>, bool) {
    let all = std::env::var("PARALLAX_DRIVES").is_ok_and(|which| which == "all");
    (drives.into_iter().take(if all { usize::MAX } else { few }).collect(), all)
}

#[test]
fn a_wrong_camera_is_found_where_the_drive_turns_and_the_right_one_fits() {
    for (seed, rate, speed) in some([(31, 2.0, 0.6), (32, 2.5, 0.9)], 1).0 {
        let paths = [winding(seed, 18, rate, speed), winding(seed + 40, 18, rate, speed)];
        let street = Street::render_along(&config(seed, 192, 640, 0, 0), &paths, None);
        let right = claimed(&street, 1.0, [0.0, 0.0]);
        assert_eq!(right.verdict, Verdict::Fits, "{}", right.in_words());
        assert!((right.turn - rate).abs() < 0.1, "{}", right.in_words());
        for factor in [0.7, 1.3] {
            let wrong = claimed(&street, factor, [0.0, 0.0]);
            assert_eq!(wrong.verdict, Verdict::DoesNotFit, "{factor}: {}", wrong.in_words());
            let focal = wrong.focal.unwrap();
            assert!((focal.best * factor - 1.0).abs() < 0.15, "{factor}: {}", wrong.in_words());
        }
    }
}

#[test]
fn a_principal_point_off_by_a_tenth_is_found_on_plain_drives() {
    let mut found = 0;
    let (seeds, all) = some(51..54, 1);
    for seed in seeds {
        let street = Street::render(&config(seed, 192, 640, 2, 18), None);
        for moved in [-0.1, 0.1] {
            let wrong = claimed(&street, 1.0, [moved, 0.0]);
            if wrong.verdict == Verdict::DoesNotFit {
                let [right, _] = wrong.centre.unwrap();
                assert!((right.best + moved).abs() < 0.05, "{seed} {moved}: {}", wrong.in_words());
                found += 1;
            }
            // Where the drive turns too little to be sure, the direction of travel is off: atan(0.1 / 0.58) = 9.8 degrees.
            let said = wrong.verdict == Verdict::DoesNotFit || wrong.in_words().contains("of its axis");
            assert!(said, "{seed} {moved}: {}", wrong.in_words());
            assert!((wrong.travel.unwrap()[0].abs() - 9.8).abs() < 1.5, "{seed} {moved}: {:?}", wrong.travel);
        }
        // Too little turning for focal lengths: nothing is claimed.
        let wrong = claimed(&street, 1.3, [0.0, 0.0]);
        assert_eq!(wrong.verdict, Verdict::CannotTell, "{seed}: {}", wrong.in_words());
    }
    assert!(!all || found >= 2, "{found} of 6");
}

#[test]
fn the_right_camera_is_never_accused() {
    let cameras = [
        Intrinsics::KITTI,
        Intrinsics { fx: 0.8, fy: 2.6, cx: 0.5, cy: 0.5 },
        Intrinsics { fx: 0.5, fy: 1.6, cx: 0.53, cy: 0.46 },
        Intrinsics { fx: 0.7, fy: 1.1, cx: 0.47, cy: 0.55 },
    ];
    let mut told = 0;
    let (seeds, all) = some(0..20u64, 4);
    for seed in seeds {
        let (height, width) = [(96, 320), (128, 416), (192, 320)][seed as usize % 3];
        let intrinsics = cameras[seed as usize % 4];
        let moving_cars = seed % 5 == 0;
        let base = StreetConfig { intrinsics, moving_cars, ..config(700 + seed, height, width, 1, 26) };
        let street = match seed % 2 {
            0 => Street::render(&base, None),
            // Slow and fast, turning little and much.
            _ => {
                let rate = [0.5, 1.0, 2.0, 3.0][seed as usize / 2 % 4];
                let speed = [0.15, 0.5, 1.0][seed as usize / 2 % 3];
                Street::render_along(&base, &[winding(seed, 26, rate, speed)], None)
            }
        };
        let right = claimed(&street, 1.0, [0.0, 0.0]);
        assert_ne!(right.verdict, Verdict::DoesNotFit, "seed {seed}: {}", right.in_words());
        told += usize::from(right.verdict == Verdict::Fits);
    }
    assert!(!all || told >= 2, "{told} of 20 are said to fit");
}

#[test]
fn little_to_see_is_no_answer() {
    // Two pairs, and pictures without a corner.
    let street = Street::render(&config(1, 96, 320, 1, 4), None);
    let fit = claimed(&street, 1.0, [0.0, 0.0]);
    assert_eq!((fit.verdict, fit.focal), (Verdict::CannotTell, None));
    assert!(fit.in_words().contains("2 pairs"), "{}", fit.in_words());
    let tiny = Street::render(&config(1, 8, 16, 1, 12), None);
    assert_eq!(claimed(&tiny, 1.0, [0.0, 0.0]).pairs, 0);
}

#[test]
fn a_camera_that_looks_past_its_way_is_asked_about() {
    // It looks 10 degrees to the left of the way it moves, straight on: nothing can be told of its principal point.
    let path = (0..14).map(|i| Pose::new([0.0, 0.0, 0.7 * f64::from(i)], -10f64.to_radians(), 0.0)).collect();
    let street = Street::render_along(&config(5, 96, 320, 0, 0), &[path], None);
    let fit = claimed(&street, 1.0, [0.0, 0.0]);
    assert_eq!(fit.verdict, Verdict::CannotTell, "{}", fit.in_words());
    assert!((fit.travel.unwrap()[0] - 10.0).abs() < 0.5, "{:?}", fit.travel);
    assert!(fit.in_words().contains("10 degrees right of its axis"), "{}", fit.in_words());
}
