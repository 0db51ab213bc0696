//! Training runs from the outside: resumed and uninterrupted runs agree, and bad input costs no time.
#![cfg(feature = "cli")]

use std::collections::BTreeSet;
use std::path::Path;
use std::process::{Command, Output};
use std::sync::Arc;

use parallax::camera::Intrinsics;
use parallax::data::DataSource;
use parallax::depth::DepthMap;
use parallax::formats::safetensors;
use parallax::monovit::Preset;
use parallax::monovit::loss::{Reprojection, Scales};
use parallax::street::{Street, StreetConfig};
use parallax::train::RunConfig;
use parallax::train::recipe::read_config;
use parallax::train::rotations::Rotations;
use parallax::train::run::{Ended, Event, Run, RunData, RunMetrics, load_weights};
use parallax::train::views::{AT_END, AT_VALIDATION, Views};

fn street(seed: u64) -> Arc<dyn DataSource> {
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
            fields.remove("trained");
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
    assert!(matches!(ended, Ended::Finished(_)));

    // Before the first step; before the first validation; on a step that is validated; and between two of them.
    let mut run = Run::create(&parts, config()).expect("a run");
    assert_eq!(interrupted(&mut run, &data, |e| matches!(e, Event::Rotations(1, _))), 0);
    drop(run);
    for at in [1, 2, 3, 4] {
        let mut run = Run::resume(&parts).expect("resumed");
        assert_eq!(interrupted(&mut run, &data, |e| matches!(e, Event::Step(r) if r.step == at)), at);
    }
    let ended = Run::resume(&parts).expect("resumed").train(&data, || false, |_| ()).expect("trained");
    let Ended::Finished(metrics) = ended else { panic!("not finished") };

    assert_eq!(log(&whole), log(&parts));
    assert_eq!(log(&whole).iter().filter(|line| line["validated"].is_u64()).count(), 3, "after steps 2, 4 and 5");
    // All but the time, to the last digit.
    let said = |folder: &Path| {
        let text = std::fs::read_to_string(folder.join("metrics.json")).expect("metrics");
        text.lines().filter(|line| !line.contains("\"seconds\"")).map(str::to_owned).collect::<Vec<_>>()
    };
    assert_eq!(said(&whole), said(&parts));
    let weights = |folder: &Path| std::fs::read(folder.join("best.safetensors")).expect("weights");
    assert!(weights(&whole) == weights(&parts), "the best weights differ");
    assert!(metrics.after.expect("measured").abs_rel > 0.0 && metrics.before != metrics.after, "{metrics:?}");
    for file in ["metrics.json", "config.toml", "images/00.png", "checkpoints/state.safetensors"] {
        assert!(parts.join(file).is_file(), "{file}");
    }
    // The views of the page: errors, warps, attention and times of the last validation, path and worst samples of the end.
    let views = |list: &str| -> Views {
        serde_json::from_slice(&std::fs::read(parts.join("views").join(list)).expect("a list")).expect("views")
    };
    let (last, end) = (views(AT_VALIDATION), views(AT_END));
    let kinds = |views: &Views| views.groups.iter().map(|group| group.kind.clone()).collect::<BTreeSet<_>>();
    let expected = ["Attention of query pixels", "Depth and its error", "Warped neighbours and auto-mask"];
    assert!(kinds(&last).iter().eq(expected), "{:?}", kinds(&last));
    assert!(kinds(&end).iter().eq(["Worst samples"]) && end.path.len() > 1 && end.metres, "{end:?}");
    assert!(end.true_path.len() == end.path.len() && end.path_error.is_some(), "{end:?}");
    // Streets are driven along: some metres a frame, and forward.
    assert!(end.true_path.windows(2).all(|pair| pair[1][1] > pair[0][1]), "{end:?}");
    assert!(
        last.step == 5 && last.time.iter().any(|(op, seconds)| op == "conv2d" && *seconds > 0.0),
        "{:?}",
        last.time
    );
    for view in last.groups.iter().chain(&end.groups).flat_map(|group| &group.views) {
        image::open(parts.join("views").join(&view.file)).expect("a picture");
    }
}

/// A street where nothing moves: every neighbour is the frame itself.
struct Still(Arc<dyn DataSource>);

impl DataSource for Still {
    fn len(&self) -> usize {
        self.0.len()
    }
    fn name(&self, sample: usize) -> String {
        format!("still frame {sample}")
    }
    fn image(&self, sample: usize, _: i32) -> parallax::Result<Arc<image::RgbImage>> {
        self.0.image(sample, 0)
    }
    fn intrinsics(&self, sample: usize) -> Intrinsics {
        self.0.intrinsics(sample)
    }
    fn depth(&self, sample: usize) -> parallax::Result<Option<DepthMap>> {
        self.0.depth(sample)
    }
}

#[test]
fn a_training_on_still_frames_is_told_so_once_and_its_folder_says_it() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = place.path().join("run");
    let still = || Arc::new(Still(street(1)));
    let data = RunData { train: still(), validation: still(), test: None };
    let config = RunConfig { steps: 14, checkpoint_every: 14, rotations: Rotations::default(), ..config() };
    let mut told = Vec::new();
    let mut tell = |event: &Event| {
        if let Event::Health(warning) = event {
            told.push((warning.step, warning.warning));
        }
        matches!(event, Event::Step(r) if r.step == 12)
    };
    // Interrupted after the warning has begun, and continued: it is not told again.
    let stopping = std::cell::Cell::new(false);
    let mut run = Run::create(&folder, config).expect("a run");
    let ended = run.train(&data, || stopping.get(), |event| stopping.set(stopping.get() || tell(&event)));
    assert!(matches!(ended.expect("trained"), Ended::Interrupted(12)));
    drop(run);
    let mut run = Run::resume(&folder).expect("resumed");
    run.train(&data, || false, |event| _ = tell(&event)).expect("trained");
    assert_eq!(told, [(10, "frames are static")]);
    let text = std::fs::read_to_string(folder.join("warnings.jsonl")).expect("warnings");
    let lines: Vec<serde_json::Value> = text.lines().map(|l| serde_json::from_str(l).expect("a line")).collect();
    assert!(lines.len() == 1 && lines[0]["warning"] == "frames are static" && lines[0]["begins"] == true, "{text}");
    assert!(log(&folder).iter().any(|l| l["unwarped"] == 0.0 && l["inside"].is_f64() && l["grad_norms"].is_array()));
}

/// A street of which only some frames have depth, and which may have lost a picture.
struct Patchy {
    street: Arc<dyn DataSource>,
    samples: usize,
    has_depth: fn(usize) -> bool,
    lost: Option<usize>,
}

impl DataSource for Patchy {
    fn len(&self) -> usize {
        self.samples
    }
    fn name(&self, sample: usize) -> String {
        format!("patchy frame {sample}")
    }
    fn image(&self, sample: usize, offset: i32) -> parallax::Result<Arc<image::RgbImage>> {
        if self.lost == Some(sample) {
            return Err(parallax::Error::file("lost.png", "cannot be decoded"));
        }
        self.street.image(sample, offset)
    }
    fn intrinsics(&self, sample: usize) -> Intrinsics {
        self.street.intrinsics(sample)
    }
    fn depth(&self, sample: usize) -> parallax::Result<Option<DepthMap>> {
        if (self.has_depth)(sample) { self.street.depth(sample) } else { Ok(None) }
    }
}

fn patchy(samples: usize, has_depth: fn(usize) -> bool) -> Arc<dyn DataSource> {
    Arc::new(Patchy { street: street(2), samples, has_depth, lost: None })
}

/// Trains to the end; the metrics and the warnings.
fn finished(folder: &Path, config: RunConfig, data: &RunData) -> (RunMetrics, Vec<String>) {
    let mut warnings = Vec::new();
    let tell = |event: Event| {
        if let Event::Warning(what) = event {
            warnings.push(what.to_owned());
        }
    };
    let ended = Run::create(folder, config).expect("a run").train(data, || false, tell).expect("trained");
    let Ended::Finished(metrics) = ended else { panic!("not finished") };
    (*metrics, warnings)
}

#[test]
fn frames_without_depth_are_passed_over_and_cost_no_training() {
    let place = tempfile::tempdir().expect("a folder");
    let (odd, none) = ((|i| i % 2 == 1) as fn(usize) -> bool, (|_| false) as fn(usize) -> bool);
    let mixed = RunData { train: patchy(6, odd), validation: patchy(6, odd), test: Some(patchy(6, odd)) };
    let (metrics, warnings) = finished(&place.path().join("mixed"), config(), &mixed);
    assert_eq!((metrics.images, warnings), (3, vec![]));
    assert!(metrics.mean_map.is_some(), "only the first training frame lacks depth");
    let lines = log(&place.path().join("mixed"));
    assert!(lines.iter().any(|l| l["abs_rel"].is_f64() && l["a1"].is_f64()), "validated where there is depth");

    let without = RunData { train: patchy(6, none), validation: patchy(6, none), test: Some(patchy(6, none)) };
    let (metrics, warnings) = finished(&place.path().join("without"), config(), &without);
    assert_eq!((metrics.images, metrics.before, metrics.after), (0, None, None));
    assert!(warnings.iter().any(|w| w.contains("ground-truth depth")), "{warnings:?}");
    assert!(place.path().join("without/metrics.json").is_file());
}

#[test]
fn a_run_without_validation_data_keeps_its_last_weights() {
    let place = tempfile::tempdir().expect("a folder");
    let data = RunData { validation: patchy(0, |_| true), ..data() };
    let (metrics, warnings) = finished(&place.path().join("run"), config(), &data);
    assert!(metrics.after.is_some());
    assert!(warnings.iter().any(|w| w.contains("no validation data")), "{warnings:?}");
    load_weights(&place.path().join("run")).expect("weights");
}

#[test]
fn a_frame_that_cannot_be_read_stops_the_run_with_its_name_and_keeps_what_was_learnt() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = place.path().join("run");
    // Thirty steps of two see each of six frames; the lost one comes in the first three.
    let broken = Arc::new(Patchy { street: street(1), samples: 6, has_depth: |_| true, lost: Some(4) });
    let config = RunConfig { rotations: Rotations::default(), seed: 3, ..config() };
    let broken = RunData { train: broken, ..data() };
    let mut run = Run::create(&folder, config).expect("a run");
    let error = run.train(&broken, || false, |_| ()).err().expect("stopped").to_string();
    assert!(error.contains("lost.png"), "{error}");
    let taken = run.steps();
    drop(run);
    let mut run = Run::resume(&folder).expect("resumed");
    assert_eq!(run.steps(), taken, "the steps before it are kept");
    assert!(matches!(run.train(&data(), || false, |_| ()), Ok(Ended::Finished(_))), "the frame is there again");
}

#[test]
fn a_frame_that_cannot_be_read_is_passed_over_if_it_may_be_and_is_named_at_the_end() {
    let place = tempfile::tempdir().expect("a folder");
    let broken = |lost| Arc::new(Patchy { street: street(1), samples: 6, has_depth: |_| false, lost: Some(lost) });
    let config = RunConfig { skip_bad_frames: true, ..config() };
    let broken = RunData { train: broken(4), validation: broken(0), ..data() };
    let (metrics, warnings) = finished(&place.path().join("run"), config, &broken);
    assert_eq!((metrics.steps, metrics.skipped), (5, 2), "{warnings:?}");
    let first = metrics.first_skipped.expect("named");
    assert!(first.contains("patchy frame") && first.contains("lost.png"), "{first}");
    assert!(log(&place.path().join("run")).iter().any(|line| line["photometric"].is_f64() && line["best"] == true));
}

#[test]
fn training_on_a_folder_with_a_broken_frame_goes_on_where_that_is_asked_for() {
    let place = tempfile::tempdir().expect("a folder");
    let path = |name: &str| place.path().join(name).to_str().expect("a path in UTF-8").to_owned();
    let size = ["--sequences", "1", "--frames", "14", "--height", "64", "--width", "96"];
    assert!(parallax(&[&["data", "street", "--out", &path("street")][..], &size].concat()).status.success());
    // Its header is whole, its pixels are not; training sees every sample.
    let frame = place.path().join("street/2011_09_26/2011_09_26_drive_0000_sync/image_02/data/0000000000.png");
    let bytes = std::fs::read(&frame).expect("a frame");
    std::fs::write(&frame, &bytes[..bytes.len() / 2]).expect("cut");
    let mut short = config();
    (short.steps, short.rotations.share, short.data) = (7, 0.0, path("street"));
    std::fs::write(path("config.toml"), toml::to_string(&short).expect("TOML")).expect("written");
    let (config, run) = (path("config.toml"), path("run"));
    fails(&["train", "--config", &config, "--out", &run], 1, &["0000000000.png", "cut short"]);
    let output = parallax(&["train", "--resume", &run, "--skip-bad-frames"]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let last = said.lines().last().expect("a last line");
    for word in ["done in", "1 samples were skipped", "2011_09_26_drive_0000_sync 1 l", "0000000000.png", "cut short"] {
        assert!(last.contains(word), "{word}: {last}");
    }
}

#[test]
fn a_frame_in_both_lists_is_refused_by_name_however_it_is_spelled() {
    let place = tempfile::tempdir().expect("a folder");
    let path = |name: &str| place.path().join(name).to_str().expect("a path in UTF-8").to_owned();
    let size = ["--sequences", "1", "--frames", "9", "--height", "64", "--width", "96"];
    assert!(parallax(&[&["data", "street", "--out", &path("street")][..], &size].concat()).status.success());
    let drive = "2011_09_26/2011_09_26_drive_0000_sync";
    let lines = |spelled: &str, frames: [u32; 4]| frames.map(|n| format!("{spelled} {n} l\n")).concat();
    std::fs::write(path("train.txt"), lines(drive, [1, 2, 3, 4])).expect("written");
    std::fs::write(path("val.txt"), lines(&format!("./{}", drive.replace('/', "//")), [4, 5, 6, 7])).expect("written");
    let size = ["--preset", "pico", "--height", "64", "--width", "96", "--batch", "2", "--steps", "1"];
    let data = ["--data", &path("street"), "--split", &path("train.txt"), "--val-split", &path("val.txt")];
    let run = path("run");
    let all = [&["train", "--out", &run][..], &data, &size].concat();
    fails(&all, 1, &["val.txt", &format!("{drive} 4 l is trained on, too")]);
}

#[test]
fn numbers_that_are_not_finite_are_neither_saved_nor_best() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = place.path().join("run");
    let mut wild = config();
    (wild.optim.rate, wild.optim.encoder_rate, wild.optim.pose_rate) = (1e38, 1e38, 1e38);
    (wild.checkpoint_every, wild.rotations) = (1, Rotations::default());
    wild.optim.schedule.warm_up = 0.0;
    let error = Run::create(&folder, wild).expect("a run").train(&data(), || false, |_| ()).err().expect("stopped");
    assert!(error.to_string().contains("step "), "{error}");
    for file in std::fs::read_dir(folder.join("checkpoints")).expect("a folder").flatten() {
        let Ok(state) = safetensors::read::<f32>(&file.path()) else { continue };
        assert!(state.tensors.values().all(|t| t.is_finite()), "{:?}", file.path());
    }
    assert!(log(&folder).iter().all(|line| line["best"] != true || line["photometric"].is_f64()));
}

#[test]
fn a_damaged_state_is_named_and_the_one_before_it_is_taken() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = place.path().join("run");
    finished(&folder, config(), &data());
    let state = folder.join("checkpoints/state.safetensors");
    let mut bytes = std::fs::read(&state).expect("a state");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x10;
    std::fs::write(&state, &bytes).expect("damaged");
    let mut told = Vec::new();
    let run = Run::resume_with(&folder, |_| Ok(()), |what| told.push(what.to_owned())).expect("resumed");
    assert_eq!(run.steps(), 4, "the checkpoint before the last");
    assert!(told.len() == 1 && told[0].contains("state.safetensors") && told[0].contains("damaged"), "{told:?}");
    drop(run);
    assert_eq!(Run::resume(&folder).expect("the whole one is still there").steps(), 4);
    std::fs::write(folder.join("checkpoints/previous.safetensors"), &bytes).expect("damaged, too");
    std::fs::rename(folder.join("checkpoints/previous.safetensors"), &state).expect("moved");
    let error = Run::resume(&folder).err().expect("refused").to_string();
    assert!(error.contains("state.safetensors") && error.contains("damaged"), "{error}");
}

#[test]
fn a_second_process_is_refused_while_the_first_has_the_run() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = place.path().join("run");
    let first = Run::create(&folder, config()).expect("a run");
    let error = Run::resume(&folder).err().expect("refused").to_string();
    assert!(error.contains("another process"), "{error}");
    drop(first);
    Run::resume(&folder).expect("the lock is gone with its holder");
}

#[test]
fn a_run_that_was_killed_before_its_first_state_can_be_begun_again() {
    let place = tempfile::tempdir().expect("a folder");
    std::fs::write(place.path().join("config.toml"), "half").expect("written");
    std::fs::write(place.path().join(".best.safetensors.1-0.tmp"), "half").expect("written");
    Run::create(place.path(), config()).expect("a run");
    let names = std::fs::read_dir(place.path()).expect("a folder").flatten().map(|e| e.file_name());
    assert!(names.into_iter().all(|name| !name.to_string_lossy().ends_with(".tmp")));
}

#[test]
fn an_interrupted_run_has_weights_and_a_finished_one_can_be_prolonged() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = place.path().join("run");
    let data = data();
    let mut run = Run::create(&folder, config()).expect("a run");
    load_weights(&folder).expect("weights before the first step");
    assert_eq!(interrupted(&mut run, &data, |e| matches!(e, Event::Step(r) if r.step == 1)), 1);
    drop(run);
    load_weights(&folder).expect("weights before the first validation");
    let mut run = Run::resume(&folder).expect("resumed");
    assert!(matches!(run.train(&data, || false, |_| ()), Ok(Ended::Finished(_))));
    drop(run);
    let prolong = |config: &mut RunConfig| {
        config.steps = 8;
        Ok(())
    };
    let mut run = Run::resume_with(&folder, prolong, |_| ()).expect("resumed");
    assert!(matches!(run.train(&data, || false, |_| ()), Ok(Ended::Finished(_))));
    assert_eq!(run.steps(), 8);
    assert_eq!(read_config(&folder.join("config.toml")).expect("written").steps, 8);
}

#[test]
fn what_a_resumed_run_cannot_take_is_refused_by_name() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = place.path().join("run");
    drop(Run::create(&folder, config()).expect("a run"));
    let run = folder.to_str().expect("a path in UTF-8");
    for flags in [
        &["--learning-rate", "0.1"][..],
        &["--batch", "3"],
        &["--seed", "9"],
        &["--height", "96"],
        &["--width", "96"],
        &["--epochs", "2"],
        &["--val-split", "list.txt"],
        &["--checkpoint-every", "7"],
        &["--log-every", "7"],
        &["--allow-partial"],
    ] {
        fails(&[&["train", "--resume", run][..], flags].concat(), 2, &[flags[0], "--resume"]);
    }
    fails(&["train", "--resume", run, "--no-auto-mask"], 2, &["ablation", "--resume"]);
    fails(&["train", "--resume", run, "--data", "/no/such/folder"], 1, &["/no/such/folder"]);
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
    assert_eq!(written.model().mpvit().map(|sizes| sizes.paths), Some([1; 4]));
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
    fails(&[&small[..], &["--batch", "5"]].concat(), 2, &["--batch", "5 samples", "holds 4"]);
    assert!(!Path::new(&out).exists(), "nothing was made");
    let split = path("split.txt");
    std::fs::write(&split, "2011_09_26/no_such_drive 3 l\n").expect("written");
    fails(&[&small[..], &["--split", &split]].concat(), 1, &["split.txt", "line 1", "no_such_drive"]);
}

#[test]
fn a_folder_that_holds_something_is_not_written_into() {
    let place = tempfile::tempdir().expect("a folder");
    std::fs::write(place.path().join("precious.txt"), "mine").expect("written");
    std::fs::write(place.path().join(".x.1-2.tmp"), "mine, too").expect("written");
    let error = Run::create(place.path(), config()).err().expect("refused").to_string();
    assert!(error.contains("not empty") && error.contains("--resume"), "{error}");
    assert_eq!(std::fs::read_dir(place.path()).expect("readable").count(), 2);
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

/// A folder of JPEG frames, a sequence in each folder, of a camera of its own and with depth maps for one of them.
#[test]
fn a_folder_of_frames_trains_and_is_measured() {
    let place = tempfile::tempdir().expect("a folder");
    let camera = Intrinsics { fx: 0.9, fy: 1.2, cx: 0.45, cy: 0.55 };
    let frames = 12;
    let config =
        StreetConfig { height: 72, width: 96, sequences: 2, frames, intrinsics: camera, ..StreetConfig::default() };
    let street = Street::render(&config, None);
    for (sequence, name) in ["first", "second"].into_iter().enumerate() {
        let folder = place.path().join("frames").join(name);
        std::fs::create_dir_all(folder.join("depth")).expect("a folder");
        for frame in 0..frames {
            street.frame(sequence, frame).save(folder.join(format!("f{frame}.jpg"))).expect("written");
            let depth = folder.join(format!("depth/f{frame}.png"));
            parallax::formats::depth_png::write_depth_png(depth, &street.frame_depth(sequence, frame))
                .expect("written");
        }
    }
    let data = place.path().join("frames");
    let (data_arg, out) = (data.to_str().expect("UTF-8"), place.path().join("run"));
    let size = ["--height", "64", "--width", "96", "--batch", "2", "--preset", "pico"];
    let train = |more: &[&str]| {
        let mut args = vec!["train", "--data", data_arg, "--steps", "3", "--out", out.to_str().expect("UTF-8")];
        args.extend(size.iter().chain(more));
        parallax(&args)
    };
    // Nothing says which camera it was.
    let refused = train(&[]);
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(!refused.status.success() && said.contains("camera.toml") && said.contains("first"), "{said}");
    let toml = "width = 192\nheight = 144\nfx = 172.8\nfy = 172.8\ncx = 86.4\ncy = 79.2\n";
    std::fs::write(data.join("camera.toml"), toml).expect("written");
    let sheet = place.path().join("sheet.png");
    let checked = parallax(&["data", "check", data_arg, "--sheet", sheet.to_str().expect("UTF-8")]);
    let said = String::from_utf8_lossy(&checked.stdout);
    assert!(checked.status.success() && said.contains("14 samples to train on, 2 to be set aside"), "{said}");
    assert!(said.contains("fx 0.9000") && !said.contains("look at this"), "{said}");
    assert!(said.contains("whether the camera fits") || said.contains("the camera fits"), "{said}");
    assert_eq!(parallax::formats::picture::read_picture(&sheet).expect("a picture").dimensions(), (8 * 320, 4 * 96));
    let bad = data.join("second/f3.jpg");
    let whole = std::fs::read(&bad).expect("a frame");
    std::fs::write(&bad, b"no picture").expect("written");
    let checked = parallax(&["data", "check", data_arg]);
    let said = String::from_utf8_lossy(&checked.stdout);
    assert_eq!(checked.status.code(), Some(1), "{said}");
    for words in
        ["cannot be read: f3.jpg", "to be mended: second: 1 pictures", "14 samples to train on, 1 to be set aside"]
    {
        assert!(said.contains(words), "{words}: {said}");
    }
    std::fs::write(&bad, whole).expect("written");
    fails(&["data", "check", bad.to_str().expect("UTF-8")], 1, &["f3.jpg", "ffmpeg"]);
    let prepared = data.join("frames-96x64.prepared");
    let made = parallax(&["data", "prepare", data_arg, "--height", "64", "--width", "96"]);
    let said = String::from_utf8_lossy(&made.stderr);
    assert!(made.status.success() && said.contains("24 frames of 96x64") && prepared.is_file(), "{said}");
    std::fs::copy(data.join("first/f2.jpg"), data.join("first/f12.jpg")).expect("copied");
    let stale = train(&[]);
    let said = String::from_utf8_lossy(&stale.stderr);
    assert!(stale.status.code() == Some(1) && said.contains("first/f12.jpg was added"), "{said}");
    std::fs::remove_file(data.join("first/f12.jpg")).expect("removed");

    let trained = train(&[]);
    let said = String::from_utf8_lossy(&trained.stderr);
    assert!(trained.status.success(), "{said}");
    assert!(said.contains("fx 0.9000, fy 1.2000, cx 0.4500, cy 0.5500") && said.contains("camera.toml"), "{said}");
    // Of ten samples of each drive the last is set aside, and two before it are given up.
    assert!(said.contains("on 14 samples"), "{said}");
    let metrics: RunMetrics =
        serde_json::from_slice(&std::fs::read(out.join("metrics.json")).expect("metrics")).expect("JSON");
    assert_eq!((metrics.images, metrics.after.is_some()), (1, true));
    let eval = parallax(&["eval", "--weights", out.to_str().expect("UTF-8"), "--data", data_arg, "--json"]);
    let said = String::from_utf8_lossy(&eval.stderr);
    assert!(eval.status.success(), "{said}");
    let measured: serde_json::Value = serde_json::from_slice(&eval.stdout).expect("JSON");
    assert_eq!(measured["images"], 24, "{measured}");
}
