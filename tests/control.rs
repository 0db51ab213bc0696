//! Flags that steer a long training: gradients of several batches, frozen parameters, states that are kept, an early end.
#![cfg(feature = "cli")]

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

use parallax::data::DataSource;
use parallax::data::batch::{Augment, batch_of_step};
use parallax::formats::safetensors;
use parallax::monovit::Preset;
use parallax::networks::DepthNetwork;
use parallax::street::{Street, StreetConfig};
use parallax::train::recipe::{RateDecay, RateSchedule};
use parallax::train::rotations::Rotations;
use parallax::train::run::{Ended, Event, Run, RunData};
use parallax::train::{RunConfig, Trainer};

fn street(seed: u64) -> Arc<dyn DataSource> {
    let config = StreetConfig { height: 64, width: 96, sequences: 1, frames: 8, seed, ..StreetConfig::default() };
    Arc::new(Street::render(&config, None))
}

fn data() -> RunData {
    RunData { train: street(1), validation: street(2), test: None }
}

/// A training of five steps without rotations.
fn config() -> RunConfig {
    let usual = RunConfig::new(Preset::Pico, 5);
    let rotations = Rotations::default();
    RunConfig { height: 64, width: 96, batch: 2, log_every: 1, checkpoint_every: 5, rotations, ..usual }
}

/// Trains to the end; the steps that were taken.
fn finish(run: &mut Run, data: &RunData) -> u64 {
    let ended = run.train(data, || false, |_| ()).expect("trained");
    let Ended::Finished(metrics) = ended else { panic!("not finished") };
    metrics.steps
}

/// A parameter's name, and numbers.
type Named = (String, Vec<f32>);

/// The optimiser's first moments after one step, a tenth of the gradients.
fn moments(place: &Path, batches: &[[usize; 2]], freeze: &str) -> Vec<Named> {
    let mut config = config();
    (config.loss.tie_break, config.auto_mask_delay) = (0.0, 0.0);
    let (model, params) = DepthNetwork::new(config.model(), 0);
    let mut trainer = Trainer::of(model, params, config.plan());
    trainer.freeze(&[freeze.to_owned()]).expect("there are such");
    let (plain, street) = (Augment { flip: false, jitter: false, sensor: false }, street(1));
    let batch =
        |[size, step]: [usize; 2]| batch_of_step(street.as_ref(), plain, size, 0, step as u64).expect("a batch");
    let batches: Vec<_> = batches.iter().copied().map(batch).collect();
    trainer.step_of(&batches).expect("a step");
    let path = place.join("state.safetensors");
    trainer.save(&path, Default::default()).expect("written");
    let all = safetensors::read::<f32>(&path).expect("read").tensors;
    let first = all.into_iter().filter(|(name, _)| name.starts_with("first_moment/"));
    let mut first: Vec<_> = first.map(|(name, tensor)| (name, tensor.data().to_vec())).collect();
    first.sort_by(|a, b| a.0.cmp(&b.0));
    first
}

/// The greatest difference of gradients, relative to the greatest gradient of the parameter.
fn difference(a: &[Named], b: &[Named]) -> f32 {
    assert!(a.len() == b.len() && a.len() > 50);
    let of = |((name, a), (other, b)): (&Named, &Named)| {
        assert_eq!(name, other);
        let largest = a.iter().fold(1e-6f32, |m, x| m.max(x.abs()));
        a.iter().zip(b).fold(0f32, |m, (x, y)| m.max((x - y).abs() / largest))
    };
    a.iter().zip(b).map(of).fold(0.0, f32::max)
}

#[test]
fn two_batches_in_a_step_are_one_of_twice_the_size_but_for_the_statistics_of_batches() {
    let place = tempfile::tempdir().expect("a folder");
    let moments = |batches: &[[usize; 2]], freeze| moments(place.path(), batches, freeze);
    let (whole, parts) = (moments(&[[4, 0]], "*.running_*"), moments(&[[2, 0], [2, 1]], "*.running_*"));
    let found = difference(&whole, &parts);
    assert!(found < 2e-5, "f32, sums in another order: {found}");
    // The first batch alone is something else, and so are normalisations by each batch's own statistics.
    assert!(difference(&whole, &moments(&[[2, 0]], "*.running_*")) > 1e-2);
    let own = "encoder.stem.0.conv.weight";
    assert!(difference(&moments(&[[4, 0]], own), &moments(&[[2, 0], [2, 1]], own)) > 1e-3);
}

#[test]
fn a_resumed_run_accumulates_the_batches_that_it_would_have_seen() {
    let place = tempfile::tempdir().expect("a folder");
    let (whole, parts) = (place.path().join("whole"), place.path().join("parts"));
    let config = RunConfig { accumulate: 2, steps: 3, ..config() };
    let data = data();
    finish(&mut Run::create(&whole, config.clone()).expect("a run"), &data);
    let mut run = Run::create(&parts, config).expect("a run");
    let stopping = std::cell::Cell::new(false);
    let tell = |event: Event| stopping.set(stopping.get() || matches!(event, Event::Step(r) if r.step == 1));
    assert!(matches!(run.train(&data, || stopping.get(), tell).expect("trained"), Ended::Interrupted(1)));
    drop(run);
    finish(&mut Run::resume(&parts).expect("resumed"), &data);
    let weights = |folder: &Path| std::fs::read(folder.join("last.safetensors")).expect("weights");
    assert!(weights(&whole) == weights(&parts));
}

#[test]
fn frozen_parameters_and_statistics_keep_their_bits_and_others_do_not() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = place.path().join("run");
    let rotations = Rotations { share: 0.5, keep: 0.5, ..Rotations::default() };
    let freeze = ["encoder.*", "pose_encoder.*"].map(str::to_owned).to_vec();
    let config = RunConfig { rotations, freeze, steps: 4, checkpoint_every: 4, ..config() };
    let (_, start) = DepthNetwork::new(config.model(), config.seed);
    finish(&mut Run::create(&folder, config).expect("a run"), &data());
    let last = safetensors::read::<f32>(&folder.join("last.safetensors")).expect("weights").tensors;
    let (mut kept, mut moved) = (0, 0);
    for (name, before) in start.export() {
        let same = before.same_bits(&last[&name]);
        if name.starts_with("encoder.") || name.starts_with("pose_encoder.") {
            assert!(same, "{name} moved");
            kept += 1;
        } else {
            moved += usize::from(!same);
        }
    }
    assert!(kept > 100 && moved > 20, "{kept} kept, {moved} moved");
}

#[test]
fn pose_networks_that_learn_first_leave_depth_alone_meanwhile() {
    let config = RunConfig { steps: 4, pose_first: 0.5, ..config() };
    let (model, start) = DepthNetwork::new(config.model(), 0);
    let mut trainer = Trainer::of(model, start.clone(), config.plan());
    let street = street(1);
    let mut step = |i: u64| {
        let batch = batch_of_step(street.as_ref(), config.augment, 2, 0, i).expect("a batch");
        let report = trainer.step(&batch).expect("a step");
        let moved = |prefix: &str| {
            let pairs = start.iter().zip(trainer.params.iter());
            pairs.filter(|((_, a), (_, b))| a.name().starts_with(prefix) && !a.value.same_bits(&b.value)).count()
        };
        (["encoder.", "depth.", "pose"].map(moved), report.grad_norms)
    };
    for i in 0..2 {
        let (moved, norms) = step(i);
        assert!(moved[0] == 0 && moved[1] == 0 && moved[2] > 20, "{moved:?}");
        assert!(norms[0] == 0.0 && norms[1] == 0.0 && norms[2] > 0.0, "{norms:?}");
    }
    let (moved, norms) = step(2);
    assert!(moved.iter().all(|&n| n > 20) && norms.iter().all(|&n| n > 0.0), "{moved:?} {norms:?}");
}

/// The names of the states of a run.
fn states(folder: &Path) -> Vec<String> {
    let files = std::fs::read_dir(folder.join("checkpoints")).expect("states").flatten();
    let mut names: Vec<String> = files.map(|f| f.file_name().to_string_lossy().into_owned()).collect();
    names.retain(|name| name.ends_with(".safetensors"));
    names.sort();
    names
}

#[test]
fn as_many_states_are_kept_as_are_asked_for() {
    let place = tempfile::tempdir().expect("a folder");
    let run = |keep: usize| -> PathBuf {
        let folder = place.path().join(keep.to_string());
        let config = RunConfig { keep, checkpoint_every: 1, ..config() };
        finish(&mut Run::create(&folder, config).expect("a run"), &data());
        assert!(folder.join("best.safetensors").is_file() && folder.join("last.safetensors").is_file());
        folder
    };
    assert_eq!(states(&run(1)), ["state.safetensors"]);
    let four = run(4);
    let expected = ["previous", "state", "step-00000002", "step-00000003", "step-00000004", "step-00000005"];
    assert_eq!(states(&four), expected.map(|name| format!("{name}.safetensors")));
    // To go on from an older one: in the place of the newest.
    let checkpoints = four.join("checkpoints");
    std::fs::copy(checkpoints.join("step-00000003.safetensors"), checkpoints.join("state.safetensors"))
        .expect("copied");
    let fewer = |c: &mut RunConfig| {
        c.keep = 2;
        Ok(())
    };
    let mut run = Run::resume_with(&four, fewer, |_| ()).expect("resumed");
    assert_eq!(run.steps(), 3);
    finish(&mut run, &data());
    assert_eq!(states(&four), ["previous.safetensors", "state.safetensors"]);
}

#[test]
fn a_run_ends_early_if_that_is_asked_for_and_can_be_taken_up_again() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = place.path().join("run");
    let mut config = RunConfig { checkpoint_every: 1, patience: Some(2), steps: 6, ..config() };
    // Nothing is learnt, so that no validation is better than the first.
    (config.optim.encoder_rate, config.optim.rate, config.optim.pose_rate) = (0.0, 0.0, 0.0);
    config.freeze = vec!["*.running_*".into()];
    let data = data();
    assert_eq!(finish(&mut Run::create(&folder, config).expect("a run"), &data), 3, "the best, and two more");
    assert_eq!(finish(&mut Run::resume(&folder).expect("resumed"), &data), 3, "nothing has changed");
    let longer = |c: &mut RunConfig| {
        c.patience = None;
        Ok(())
    };
    assert_eq!(finish(&mut Run::resume_with(&folder, longer, |_| ()).expect("resumed"), &data), 6);
}

#[test]
fn an_epoch_is_a_pass_over_the_samples_in_whole_steps() {
    let mut config = RunConfig { batch: 2, accumulate: 2, epochs: Some(4), ..config() };
    config.optim.schedule = RateSchedule { warm_up: 0.0, decay: RateDecay::Epochs { factor: 0.5 } };
    config.set_epoch(9);
    assert_eq!((config.epoch, config.steps), (Some(3), 12));
    let schedule = config.plan().schedule;
    assert_eq!([1, 3, 4, 6, 7, 12].map(|step| schedule.factor(step)), [1.0, 1.0, 0.5, 0.5, 0.25, 0.125]);
}

/// Fails with `status`, and says all of `words`.
#[track_caller]
fn fails(arguments: &[&str], status: i32, words: &[&str]) {
    let output = Command::new(env!("CARGO_BIN_EXE_parallax")).args(arguments).output().expect("the program runs");
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(status), "{arguments:?}: {said}");
    words.iter().for_each(|word| assert!(said.contains(word), "{arguments:?} should say {word:?}: {said}"));
}

#[test]
fn flags_that_cannot_be_used_are_refused_before_any_time_is_spent() {
    let place = tempfile::tempdir().expect("a folder");
    let out = place.path().join("run");
    let out = out.to_str().expect("a path in UTF-8");
    fails(&["train", "--keep", "0", "--out", out], 2, &["--keep", "at least 1"]);
    fails(&["train", "--accumulate", "0", "--out", out], 2, &["--accumulate", "at least 1"]);
    fails(&["train", "--patience", "0", "--out", out], 2, &["--patience", "at least 1"]);
    fails(&["train", "--pose-rate=-1", "--out", out], 2, &["--pose-rate", "-1"]);
    fails(&["train", "--schedule", "linear", "--out", out], 2, &["linear", "cosine", "exponential"]);
    fails(&["train", "--freeze", "encodre.*", "--out", out], 2, &["encodre.*", "encoder.stem.*", "pose.net.*"]);
    assert!(!Path::new(out).exists(), "nothing was made");
    let run = place.path().join("a run");
    drop(Run::create(&run, config()).expect("a run"));
    let run = run.to_str().expect("a path in UTF-8");
    for flags in [["--accumulate", "2"], ["--schedule", "constant"], ["--freeze", "encoder.*"], ["--pose-rate", "1"]] {
        fails(&[&["train", "--resume", run][..], &flags].concat(), 2, &[flags[0], "--resume"]);
    }
}

/// The configuration that `train --print-config` prints.
fn printed(arguments: &[&str]) -> toml::Table {
    let output =
        Command::new(env!("CARGO_BIN_EXE_parallax")).args(["train", "--print-config"]).args(arguments).output();
    let output = output.expect("the program runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    toml::from_str(&String::from_utf8_lossy(&output.stdout)).expect("TOML")
}

#[test]
fn flags_win_over_the_file_and_that_over_the_recipe_and_that_over_the_preset() {
    let place = tempfile::tempdir().expect("a folder");
    let file = place.path().join("part.toml");
    std::fs::write(&file, "batch = 6\naccumulate = 2\n[optim]\nrate = 3e-4\n").expect("written");
    let file = file.to_str().expect("a path in UTF-8");
    let found = printed(&["--recipe", "monovit", "--config", file, "--accumulate", "3", "--schedule", "constant"]);
    let number = |name: &str| found[name].as_integer().expect("a number");
    assert_eq!((number("batch"), number("accumulate"), number("height"), number("epochs")), (6, 3, 192, 20));
    let rates = ["encoder_rate", "rate"].map(|rate| found["optim"][rate].as_float().expect("a rate"));
    assert_eq!(rates, [5e-5, 3e-4]);
    assert_eq!(found["optim"]["schedule"]["decay"]["kind"].as_str(), Some("constant"));
    assert_eq!(number("checkpoint_every"), RunConfig::usual().checkpoint_every as i64);
    assert!(!printed(&["--recipe", "monodepth2", "--steps", "9"]).contains_key("epochs"));
    fails(&["train", "--recipe", "monodepth", "--print-config"], 2, &["--recipe", "monodepth", "monovit, monodepth2"]);
    fails(&["train", "--recipe", "monovit", "--resume", "run"], 2, &["--resume"]);
}
