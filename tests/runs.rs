//! Training runs from the outside: resumed and uninterrupted runs agree, and bad input costs no time.
#![cfg(feature = "cli")]

use std::path::Path;
use std::process::{Command, Output};
use std::sync::Arc;

use parallax::data::Dataset;
use parallax::monovit::Preset;
use parallax::monovit::loss::{Reprojection, Scales};
use parallax::street::{Street, StreetConfig};
use parallax::train::RunConfig;
use parallax::train::recipe::read_config;
use parallax::train::rotations::Rotations;
use parallax::train::run::{Ended, Event, Run, RunData, load_weights};

fn street(seed: u64) -> Arc<dyn Dataset> {
    let config = StreetConfig { height: 64, width: 96, sequences: 1, frames: 8, seed, ..StreetConfig::default() };
    Arc::new(Street::render(&config, None))
}

fn data() -> RunData {
    RunData { train: street(1), validation: street(2), test: Some(street(3)) }
}

fn config() -> RunConfig {
    let mut usual = RunConfig::new(Preset::Pico, 5);
    usual.rotations = Rotations { share: 0.4, keep: 0.4, ..Rotations::default() };
    RunConfig { height: 64, width: 96, batch: 2, log_every: 1, checkpoint_every: 2, ..usual }
}

/// The log without the times.
fn log(folder: &Path) -> Vec<serde_json::Value> {
    let text = std::fs::read_to_string(folder.join("log.jsonl")).expect("a log");
    let lines = text.lines().map(|l| serde_json::from_str::<serde_json::Value>(l).expect("a line of JSON"));
    lines
        .map(|mut line| {
            let fields = line.as_object_mut().expect("an object");
            fields.remove("seconds");
            fields.remove("data_seconds");
            line
        })
        .collect()
}

/// Trains in `folder` and is interrupted when `stop` says so of an event.
fn interrupted(run: &mut Run, data: &RunData, stop: impl Fn(&Event) -> bool) -> u64 {
    let stopping = std::cell::Cell::new(false);
    let tell = |event: Event| stopping.set(stopping.get() || stop(&event));
    match run.train(data, || stopping.get(), tell).expect("trained") {
        Ended::Interrupted(step) => step,
        Ended::Finished(_) => panic!("not interrupted"),
    }
}

#[test]
fn a_resumed_run_ends_like_one_that_never_stopped() {
    let place = tempfile::tempdir().expect("a folder");
    let (whole, parts) = (place.path().join("whole"), place.path().join("parts"));
    let data = data();

    let ended = Run::create(&whole, config()).expect("a run").train(&data, || false, |_| ()).expect("trained");
    assert!(matches!(ended, Ended::Finished(Some(_))));

    // Before the first step; before the first validation; and between two of them.
    let mut run = Run::create(&parts, config()).expect("a run");
    assert_eq!(interrupted(&mut run, &data, |e| matches!(e, Event::Rotations(1, _))), 0);
    for at in [1, 3] {
        let mut run = Run::resume(&parts).expect("resumed");
        assert_eq!(interrupted(&mut run, &data, |e| matches!(e, Event::Step(r) if r.step == at)), at);
    }
    let ended = Run::resume(&parts).expect("resumed").train(&data, || false, |_| ()).expect("trained");
    let Ended::Finished(Some(metrics)) = ended else { panic!("not finished") };

    assert_eq!(log(&whole), log(&parts));
    let weights = |folder: &Path| std::fs::read(folder.join("best.safetensors")).expect("weights");
    assert!(weights(&whole) == weights(&parts), "the best weights differ");
    assert!(metrics.after.abs_rel > 0.0 && metrics.before != metrics.after, "{metrics:?}");
    for file in ["metrics.json", "config.toml", "images/00.png", "checkpoints/state.safetensors"] {
        assert!(parts.join(file).is_file(), "{file}");
    }
}

fn parallax(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_parallax")).args(arguments).output().expect("the program runs")
}

/// Fails with `status`, and says all of `words` on standard error.
#[track_caller]
fn fails(arguments: &[&str], status: i32, words: &[&str]) {
    let output = parallax(arguments);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(status), "{arguments:?}: {said}");
    for word in words {
        assert!(said.contains(word), "{arguments:?} should say {word:?}: {said}");
    }
}

#[test]
fn wrong_settings_are_named_before_any_time_is_spent() {
    let place = tempfile::tempdir().expect("a folder");
    let out = place.path().join("run");
    let out = out.to_str().expect("a path in UTF-8");
    fails(&["train", "--height", "100", "--out", out], 2, &["--height", "100", "multiple of 32", "96"]);
    fails(&["train", "--steps", "0", "--out", out], 2, &["--steps"]);
    fails(&["train", "--stepz", "1"], 2, &["--stepz"]);
    fails(&["train", "--data", "/no/such/folder", "--out", out], 1, &["/no/such/folder"]);
    fails(&["train", "--resume", "/no/such/run"], 1, &["/no/such/run"]);
    fails(&["gradcheck", "--op", "nonsense"], 2, &["--op", "conv2d"]);
    assert!(!Path::new(out).exists(), "nothing was made");
}

/// What a run of an earlier version wrote, without the settings that came later.
#[test]
fn a_configuration_from_before_the_ablations_still_loads() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("config.toml");
    let text = toml::to_string(&config()).expect("TOML");
    let later = ["[ablation]", "cnn_path", "decoder_attention", "reprojection", "scales"];
    let old: String =
        text.lines().filter(|l| !later.iter().any(|x| l.starts_with(x))).flat_map(|l| [l, "\n"]).collect();
    assert_eq!(text.lines().count(), old.lines().count() + later.len());
    std::fs::write(&path, &old).expect("written");
    assert_eq!(read_config(&path).expect("read"), config());
    let broken = text.replace("cnn_path = true", "cnn_path = false\ntransformer_paths = 0");
    std::fs::write(&path, broken).expect("written");
    let path = path.to_str().expect("a path in UTF-8");
    fails(&["train", "--config", path, "--out", &format!("{path}.run")], 1, &["cnn_path", "neither"]);
}

#[test]
fn flags_of_ablations_win_over_the_configuration_and_are_written_into_the_run() {
    let place = tempfile::tempdir().expect("a folder");
    let path = |name: &str| place.path().join(name).to_str().expect("a path in UTF-8").to_owned();
    let street = path("street");
    let size = ["--sequences", "1", "--frames", "14", "--height", "64", "--width", "96"];
    assert!(parallax(&[&["data", "street", "--out", &street][..], &size].concat()).status.success());
    let mut shorter = config();
    (shorter.steps, shorter.rotations.share, shorter.data) = (1, 0.0, street);
    std::fs::write(path("config.toml"), toml::to_string(&shorter).expect("TOML")).expect("written");
    let (config, run) = (path("config.toml"), path("run"));
    let networks = ["--transformer-paths", "1", "--no-decoder-attention", "--drop-path", "0.5"];
    let loss = ["--no-auto-mask", "--reprojection", "average", "--scales", "own", "--ssim", "0"];
    let output = parallax(&[&["train", "--config", &config, "--out", &run][..], &networks, &loss].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let written = read_config(&place.path().join("run/config.toml")).expect("read");
    assert_eq!(written.model().paths, [1; 4]);
    assert_eq!((written.ablation.decoder_attention, written.ablation.drop_path), (false, Some(0.5)));
    assert_eq!((written.loss.reprojection, written.loss.scales), (Reprojection::Average, Scales::Own));
    assert_eq!((written.loss.auto_mask, written.loss.ssim), (false, 0.0));
    // The weights remember what they were made for.
    let (model, ..) = load_weights(&place.path().join("run")).expect("weights");
    assert_eq!(model.config, written.model());
    fails(&["train", "--ssim", "2", "--out", &path("no")], 2, &["--ssim", "2"]);
    fails(&["train", "--transformer-paths", "7", "--out", &path("no")], 2, &["--transformer-paths", "7"]);
    fails(&["info", "--transformer-paths", "0", "--no-cnn-path"], 2, &["cnn_path", "neither"]);
}

#[test]
fn an_output_folder_that_cannot_be_is_refused_before_the_street_is_rendered() {
    let place = tempfile::tempdir().expect("a folder");
    let file = place.path().join("a_file");
    std::fs::write(&file, "mine").expect("written");
    let inside = file.join("run");
    let started = std::time::Instant::now();
    fails(&["train", "--out", inside.to_str().expect("a path in UTF-8")], 1, &["a_file"]);
    assert!(started.elapsed().as_secs() < 2, "something was rendered first");
    assert_eq!(std::fs::read(&file).expect("there"), b"mine");
}

#[test]
fn a_batch_larger_than_the_data_is_refused() {
    let place = tempfile::tempdir().expect("a folder");
    let path = |name: &str| place.path().join(name).to_str().expect("a path in UTF-8").to_owned();
    let (street, out) = (path("street"), path("run"));
    let size = ["--sequences", "1", "--frames", "6", "--height", "64", "--width", "96"];
    let made = parallax(&[&["data", "street", "--out", &street][..], &size].concat());
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let small = ["train", "--data", &street, "--preset", "pico", "--height", "64", "--width", "96", "--out", &out];
    fails(&[&small[..], &["--batch", "5"]].concat(), 1, &["--batch", "5 samples", "holds 4"]);
    assert!(!Path::new(&out).exists(), "nothing was made");
    let split = path("split.txt");
    std::fs::write(&split, "2011_09_26/no_such_drive 3 l\n").expect("written");
    fails(&[&small[..], &["--split", &split]].concat(), 1, &["split.txt", "line 1", "no_such_drive"]);
}

#[test]
fn a_folder_that_holds_something_is_not_written_into() {
    let place = tempfile::tempdir().expect("a folder");
    std::fs::write(place.path().join("precious.txt"), "mine").expect("written");
    let error = Run::create(place.path(), config()).err().expect("refused").to_string();
    assert!(error.contains("not empty") && error.contains("--resume"), "{error}");
    assert_eq!(std::fs::read_dir(place.path()).expect("readable").count(), 1);
}

#[test]
fn weights_that_are_not_weights_are_refused_by_name() {
    let place = tempfile::tempdir().expect("a folder");
    let file = place.path().join("weights.safetensors");
    std::fs::write(&file, b"this is no checkpoint").expect("written");
    let file = file.to_str().expect("a path in UTF-8");
    fails(&["eval", "--weights", file], 1, &["weights.safetensors", "not a safetensors file"]);
}

#[test]
fn info_counts_the_published_parameters() {
    let output = parallax(&["info", "--preset", "small", "--height", "64", "--width", "96", "--batch", "1", "--json"]);
    let info: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON and nothing else");
    assert_eq!(info["parameters"]["encoder"], 22_603_400);
    assert_eq!(info["parameters"]["depth"], 5_266_708);
}
