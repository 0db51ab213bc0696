//! `parallax attention` from the outside.
#![cfg(feature = "cli")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use parallax::monovit::{Ablation, Preset};
use parallax::networks::DepthNetwork;
use parallax::train::RunConfig;
use parallax::train::run::write_weights;

fn parallax(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_parallax")).args(arguments).output().expect("the program runs")
}

/// A folder with weights of a small network, as they start, and a picture of another size than it sees.
struct Place {
    folder: tempfile::TempDir,
}

impl Place {
    fn new(ablation: Ablation) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let config = RunConfig { height: 64, width: 96, ablation, ..RunConfig::new(Preset::Pico, 10) };
        let (_, params) = DepthNetwork::new(config.model(), 1);
        write_weights(&folder.path().join("weights.safetensors"), &params, &config.setup()).expect("written");
        let picture = image::RgbImage::from_fn(130, 70, |x, y| image::Rgb([x as u8, 2 * y as u8, (x * y % 251) as u8]));
        picture.save(folder.path().join("street.png")).expect("written");
        Place { folder }
    }

    fn path(&self, name: &str) -> String {
        self.folder.path().join(name).to_str().expect("a path in UTF-8").to_owned()
    }

    fn run(&self, at: &str, more: &[&str]) -> Output {
        let [weights, picture, out] = ["weights.safetensors", "street.png", "out"].map(|n| self.path(n));
        let usual = ["attention", "--weights", &weights, &picture, "--at", at, "--out", &out];
        parallax(&[&usual[..], more].concat())
    }

    #[track_caller]
    fn written(&self, at: &str, more: &[&str]) -> serde_json::Value {
        let output = self.run(at, &[&["--json"], more].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice(&output.stdout).expect("one JSON object and nothing else")
    }
}

fn size(path: &Path) -> (u32, u32) {
    image::image_dimensions(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

#[test]
fn every_layer_and_head_has_a_picture_and_a_line_of_json() {
    let place = Place::new(Ablation::default());
    let written = place.written("100,69", &["--heads"]);
    assert_eq!(written["at"], serde_json::json!([100, 69]));
    // (100.5, 69.5) of 130x70, in 96x64.
    assert_eq!(written["seen_at"], serde_json::json!([74, 63]));
    assert_eq!(written["seen_size"], serde_json::json!([96, 64]));
    assert!((0.0..1.0).contains(&written["disparity"].as_f64().expect("a number")));
    let maps = written["maps"].as_array().expect("a list");
    // Layers 1, 1, 2, 1 on paths 2, 3, 3, 3; each the mean and eight heads.
    assert_eq!(maps.len(), (2 + 3 + 6 + 3) * 9);
    for map in maps {
        let file = PathBuf::from(map["file"].as_str().expect("a path"));
        assert_eq!(size(&file), (130, 70), "{}", file.display());
        let stage = map["stage"].as_u64().expect("a number");
        assert_eq!(map["size"], serde_json::json!([96 >> stage, 64 >> stage]));
        assert_eq!(map["token"], serde_json::json!([74 >> stage, 63 >> stage]));
        assert!(map["smallest"].as_f64() <= map["largest"].as_f64());
    }
    assert!(maps.iter().any(|m| m["name"] == "encoder.mhca_stages.2.mhca_blks.1.MHCA_layers.1"));
    let files = std::fs::read_dir(place.path("out")).expect("a folder").count();
    assert_eq!(files, maps.len() + 2, "the maps, the sheet and the saliency");
    let sheet = size(&PathBuf::from(written["sheet"].as_str().expect("a path")));
    assert!(sheet.0 > 1000 && sheet.1 > 600, "{sheet:?}");
    assert_eq!(size(&PathBuf::from(written["saliency"].as_str().expect("a path"))), (130, 70));
}

#[test]
fn the_mean_is_the_mean_of_the_heads_and_another_pixel_sees_something_else() {
    let place = Place::new(Ablation::default());
    let written = place.written("10,10", &["--heads"]);
    let maps = written["maps"].as_array().expect("a list");
    for group in maps.chunks(9) {
        let sum = |map: &serde_json::Value| map["sum"].as_f64().expect("a number");
        let heads: f64 = group[1..].iter().map(sum).sum();
        assert!((sum(&group[0]) - heads / 8.0).abs() < 1e-4, "{} {heads}", sum(&group[0]));
    }
    let sheet = |written: &serde_json::Value| std::fs::read(written["sheet"].as_str().expect("a path")).expect("there");
    let first = sheet(&written);
    assert!(first == sheet(&place.written("10,10", &[])), "the same twice");
    assert!(first != sheet(&place.written("120,60", &[])), "another pixel");
}

#[test]
fn networks_without_transformer_paths_show_what_is_left() {
    let place = Place::new(Ablation { transformer_paths: Some(0), ..Ablation::default() });
    let written = place.written("0,0", &[]);
    assert_eq!(written["maps"].as_array().map(Vec::len), Some(0));
    assert!(size(&PathBuf::from(written["sheet"].as_str().expect("a path"))).1 > 400);
    let said = place.run("0,0", &[]);
    assert!(String::from_utf8_lossy(&said.stdout).contains("no transformer paths"));
}

/// Fails with `status`, and says all of `words` on standard error.
#[track_caller]
fn fails(output: Output, status: i32, words: &[&str]) {
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(status), "{said}");
    for word in words {
        assert!(said.contains(word), "should say {word:?}: {said}");
    }
}

#[test]
fn what_cannot_be_is_named_before_anything_is_computed() {
    let place = Place::new(Ablation::default());
    fails(place.run("130,10", &[]), 2, &["--at", "130,10", "130x70", "0 to 129", "0 to 69"]);
    fails(place.run("10", &[]), 2, &["--at", "320,96"]);
    fails(place.run("-1,5", &[]), 2, &["--at"]);
    assert!(!Path::new(&place.path("out")).exists(), "nothing was made");

    let [weights, picture, out] = ["weights.safetensors", "street.png", "out"].map(|n| place.path(n));
    let with = |weights: &str, picture: &str, out: &str| {
        parallax(&["attention", "--weights", weights, picture, "--at", "1,1", "--out", out])
    };
    fails(with(&weights, &place.path("none.png"), &out), 1, &["none.png"]);
    std::fs::write(place.path("text.png"), "no picture").expect("written");
    fails(with(&weights, &place.path("text.png"), &out), 1, &["text.png"]);
    fails(with(&weights, &picture, &format!("{picture}/inside")), 1, &["street.png"]);
    fails(with(&place.path("none.safetensors"), &picture, &out), 1, &["none.safetensors"]);
}
