//! The weights inside the program: that they are whole and know something, and that every command takes them.
//! Nothing here depends on which weights they are.
#![cfg(all(feature = "cli", feature = "shipped-weights"))]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use parallax::camera::Intrinsics;
use parallax::data::DataSource;
use parallax::eval::evaluate::{Evaluation, evaluate, evaluate_mean_map};
use parallax::eval::mean_map::MeanMap;
use parallax::eval::metrics::{Protocol, Scale};
use parallax::eval::predictor::Predictor;
use parallax::formats::npy;
use parallax::monovit::Preset;
use parallax::networks::DepthNetwork;
use parallax::street::{Street, StreetConfig};
use parallax::train::RunConfig;
use parallax::train::run::write_weights;
use parallax::weights::{MOST_BYTES, Need, SHIPPED, Weights, load};

fn shipped() -> Weights {
    load(&[SHIPPED.into()], Need::All, false).expect("weights inside the program")
}

fn street(weights: &Weights, seed: u64, intrinsics: Intrinsics) -> Street {
    let (height, width) = (weights.setup.height, weights.setup.width);
    let config = StreetConfig { height, width, sequences: 2, frames: 3, seed, intrinsics, ..StreetConfig::default() };
    Street::render(&config, None)
}

#[test]
fn the_file_is_whole_and_says_where_it_comes_from() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/shipped.safetensors");
    assert!(fs::metadata(&path).expect("the file").len() as usize <= MOST_BYTES + 100_000);
    let Weights { params, report, origin, setup, .. } = shipped();
    assert!(report.absent.is_empty() && report.problem().is_none(), "{report}");
    assert_eq!(report.matched.len(), params.len());
    assert!(params.iter().all(|(_, p)| p.value.is_finite()));
    let origin = origin.expect("the file says where it comes from");
    origin.check().expect("every field");
    let recipe: RunConfig = toml::from_str(&origin.recipe).expect("a configuration");
    recipe.check().expect("one that can be used");
    assert_eq!((recipe.preset, recipe.height, recipe.width), (setup.preset, setup.height, setup.width));
    assert!(origin.steps > 0 && origin.metres.camera_height == 1.65, "{origin:?}");
}

#[test]
fn its_maps_of_rendered_streets_are_far_better_than_the_mean_depth_map_and_in_metres() {
    let weights = shipped();
    let predictor = Predictor::new(&weights.model, &weights.params, &weights.setup);
    let metres = weights.origin.as_ref().expect("an origin").metres;
    let known = MeanMap::of_dataset(&street(&weights, 7_000_000, Intrinsics::KITTI)).expect("a map");
    // The street's own camera, and a telephone's.
    let telephone = Intrinsics { fx: 0.755, fy: 0.755 * 16.0 / 9.0, cx: 0.5, cy: 0.5 };
    for (camera, share) in [(Intrinsics::KITTI, 0.7), (telephone, 0.85)] {
        let street = street(&weights, 7_100_000, camera);
        let samples: Vec<usize> = (0..street.len()).collect();
        let how = Evaluation { protocol: Protocol::Dense, scale: Scale::Median, flip: false };
        let found = evaluate(&predictor, &street, &samples, how, |_| ()).expect("measured");
        let baseline = evaluate_mean_map(&known, &street, &samples, how).expect("measured");
        assert!(
            found.metrics.abs_rel < share * baseline.metrics.abs_rel,
            "{camera:?}: {:?}, the mean depth map {:?}",
            found.metrics,
            baseline.metrics
        );
        let off = metres.factor_for(camera) / found.ratio_median.expect("a factor");
        assert!((off - 1.0).abs() < 0.25, "{camera:?}: metres are off by {off}");
    }
}

/// A folder to work in, with a picture of a street.
fn place() -> (tempfile::TempDir, PathBuf) {
    let place = tempfile::tempdir().expect("a folder");
    let config = StreetConfig { height: 120, width: 400, sequences: 1, frames: 3, ..StreetConfig::default() };
    let photo = place.path().join("photo.jpg");
    Street::render(&config, None).frame(0, 1).save(&photo).expect("saved");
    (place, photo)
}

fn parallax(place: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_parallax")).current_dir(place).args(arguments).output().expect("the program runs")
}

/// Standard output and error of what must succeed.
#[track_caller]
fn said(place: &Path, arguments: &[&str]) -> [String; 2] {
    let output = parallax(place, arguments);
    let [out, err] = [output.stdout, output.stderr].map(|said| String::from_utf8(said).expect("UTF-8"));
    assert!(output.status.success(), "{err}");
    [out, err]
}

#[test]
fn a_picture_alone_gives_a_map_in_metres() {
    let (place, _) = place();
    let [out, err] = said(place.path(), &["predict", "photo.jpg", "--json", "--npy"]);
    let origin = shipped().origin.expect("an origin");
    for word in ["weights shipped", &origin.world, "in metres", "1.65 m", "in depth"] {
        assert!(err.contains(word), "{word}: {err}");
    }
    let json: serde_json::Value = serde_json::from_str(&out).expect("JSON");
    assert_eq!((&json["weights"], &json["unit"]), (&SHIPPED.into(), &"metres".into()));
    assert_eq!(json["trained_on"], origin.in_words());
    assert!(place.path().join("depth/photo_disp.png").is_file());
    let near = |json: &serde_json::Value| json["pictures"][0]["factor"].as_f64().expect("a factor");
    let expected = origin.metres.factor_for(Intrinsics { fx: 0.58, fy: 0.58 * 400.0 / 120.0, ..Intrinsics::KITTI });
    assert!((near(&json) / expected - 1.0).abs() < 1e-9, "{json}");
    // A street's depth in metres: near the ground in front, far up the road.
    let map = npy::read(&place.path().join("depth/photo.npy")).expect("a map").to_f32().expect("numbers");
    let depth = |x: usize, y: usize| 1.0 / map[y * 400 + x];
    assert!((2.0..12.0).contains(&depth(200, 117)) && depth(200, 60) > 15.0, "{} {}", depth(200, 117), depth(200, 60));

    let [other, _] = said(place.path(), &["predict", "photo.jpg", "--json", "--fov", "40", "--out", "long"]);
    assert!(near(&serde_json::from_str(&other).expect("JSON")) > 1.5 * near(&json), "a longer lens sees further");
    let [resized, err] = said(place.path(), &["predict", "photo.jpg", "--json", "--width", "256", "--out", "other"]);
    let resized: serde_json::Value = serde_json::from_str(&resized).expect("JSON");
    assert_eq!((&resized["unit"], near(&resized)), (&"relative".into(), 1.0));
    assert!(err.contains("no unit"), "{err}");
}

#[test]
fn every_command_takes_them_and_a_folder_of_that_name_is_told_apart() {
    let (place, _) = place();
    let street = ["data", "street", "--out", "drive", "--sequences", "1", "--frames", "3"];
    said(place.path(), &street);
    let [out, _] = said(place.path(), &["eval", "--data", "drive", "--bootstrap", "0"]);
    assert!(out.contains("weights   shipped"), "{out}");
    said(place.path(), &["attention", "photo.jpg", "--at", "200,60", "--out", "look"]);
    assert!(place.path().join("look/photo_attention.png").is_file());
    let [config, _] = said(place.path(), &["train", "--init", "shipped", "--print-config"]);
    assert!(config.contains("init = [\"shipped\"]"), "{config}");
    said(place.path(), &["convert", "shipped", "copy.safetensors"]);
    said(place.path(), &["convert", "shipped", "other.safetensors", "--width", "256"]);
    for (copy, unit) in [("copy.safetensors", "metres"), ("other.safetensors", "relative")] {
        let [json, _] = said(place.path(), &["predict", "photo.jpg", "--weights", copy, "--json"]);
        assert!(json.contains(&format!("\"unit\":\"{unit}\"")), "{copy}: {json}");
    }

    fs::create_dir(place.path().join("shipped")).expect("made");
    let [_, err] = said(place.path(), &["predict", "photo.jpg"]);
    assert!(err.contains("./shipped"), "{err}");
    let output = parallax(place.path(), &["predict", "photo.jpg", "--weights", "./shipped"]);
    assert!(String::from_utf8_lossy(&output.stderr).contains("holds no weights"));
}

/// A run's folder as a training leaves it, with weights as they are drawn.
fn run_of(place: &Path, preset: Preset) -> PathBuf {
    let run = place.join(preset.name());
    fs::create_dir(&run).expect("made");
    let config = RunConfig { height: 64, width: 96, ..RunConfig::new(preset, 7) };
    let (_, params) = DepthNetwork::new::<f32>(config.model(), 3);
    write_weights(&run.join("best.safetensors"), &params, &config.setup()).expect("written");
    fs::write(run.join("config.toml"), toml::to_string(&config).expect("TOML")).expect("written");
    run
}

#[test]
fn a_run_becomes_a_file_to_ship() {
    let (place, _) = place();
    let run = run_of(place.path(), Preset::Pico);
    let run = run.to_str().expect("UTF-8");
    let ship = ["convert", run, "new.safetensors", "--ship", "--streets", "1", "--world", "nothing at all"];
    let [out, _] = said(place.path(), &[&ship[..], &["--json"]].concat());
    let json: serde_json::Value = serde_json::from_str(&out).expect("JSON");
    let [mean, largest] = ["rounding_mean", "rounding_largest"].map(|name| json[name].as_f64().expect("a number"));
    assert!(0.0 < mean && mean < largest && largest < 0.1, "{json}");
    let new = place.path().join("new.safetensors");
    let Weights { params, origin, setup, .. } = load(std::slice::from_ref(&new), Need::All, false).expect("read");
    let origin = origin.expect("an origin");
    assert_eq!((origin.in_words().as_str(), setup.width), ("nothing at all, 7 steps", 96));
    let mut exact = load(&[run.into()], Need::All, false).expect("read");
    exact.round_to_bf16();
    assert!(params.iter().zip(exact.params.iter()).all(|((_, a), (_, b))| a.value.data() == b.value.data()));
    assert!(fs::metadata(&new).expect("a file").len() < 3 * params.count("") as u64);
    let [_, err] = said(place.path(), &["predict", "photo.jpg", "--weights", "new.safetensors"]);
    assert!(err.contains("nothing at all"), "{err}");

    for (arguments, words) in [
        (&ship[..], &["new.safetensors", "--force"][..]),
        (&["convert", "photo.jpg", "b.safetensors", "--ship"], &["photo.jpg", "config.toml"]),
        (&["convert", run, "b.npz", "--ship"], &["b.npz", ".safetensors"]),
        (&["convert", run, run, "b.safetensors", "--ship"], &["--ship", "one run"]),
        (&["convert", run, "b.safetensors", "--world", "x"], &["--ship"]),
    ] {
        let output = parallax(place.path(), arguments);
        let err = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && words.iter().all(|word| err.contains(word)), "{arguments:?}: {err}");
    }
}

#[test]
fn a_network_that_is_too_large_is_not_shipped() {
    let (model, params) = DepthNetwork::new::<f32>(Preset::Tiny.config(), 0);
    let shipped = shipped();
    let mut report = shipped.report;
    report.matched = params.iter().map(|(_, p)| p.name().to_owned()).collect();
    let setup = parallax::networks::Setup::of(Preset::Tiny);
    let large = Weights { model, params, setup, report, origin: None };
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("large.safetensors");
    let error = parallax::weights::ship(&large, &shipped.origin.expect("an origin"), &path).unwrap_err().to_string();
    assert!(error.contains("tiny") && error.contains("MB") && !path.exists(), "{error}");
}
