//! TensorBoard's event files of a run, read back and compared with its log.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::sync::Arc;

use parallax::data::DataSource;
use parallax::formats::tensorboard::{FILE_VERSION, What, Worth, read_events};
use parallax::monovit::Preset;
use parallax::street::{Street, StreetConfig};
use parallax::train::RunConfig;
use parallax::train::rotations::Rotations;
use parallax::train::run::{Ended, Event, Run, RunData};

fn street(seed: u64) -> Arc<dyn DataSource> {
    let config = StreetConfig { height: 64, width: 96, sequences: 1, frames: 6, seed, ..StreetConfig::default() };
    Arc::new(Street::render(&config, None))
}

/// What a folder of event files says, by tag and step, after the rule of every reader: a session that begins at a step
/// takes back what was said of it and later ones.
fn told(folder: &Path) -> BTreeMap<String, BTreeMap<i64, Vec<Worth>>> {
    let mut files: Vec<_> =
        fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("a file").path()).collect();
    files.sort();
    let mut found: BTreeMap<String, BTreeMap<i64, Vec<Worth>>> = BTreeMap::new();
    for path in files {
        let file = read_events(&path).expect("events");
        assert!(!file.torn, "{}", path.display());
        assert_eq!(file.events[0].what, Some(What::FileVersion(FILE_VERSION.into())));
        for event in file.events {
            match event.what {
                Some(What::SessionLog(_)) => {
                    found.values_mut().for_each(|steps| steps.retain(|step, _| *step < event.step))
                }
                Some(What::Summary(summary)) => {
                    for point in summary.points {
                        let values = found.entry(point.tag).or_default().entry(event.step).or_default();
                        values.extend(point.worth);
                    }
                }
                _ => {}
            }
        }
    }
    found
}

#[test]
fn a_run_that_was_killed_and_went_on_has_every_step_once_and_as_its_log_says() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = place.path().join("run");
    let data = RunData { train: street(1), validation: street(2), test: Some(street(3)) };
    let usual = RunConfig::new(Preset::Pico, 4);
    let config =
        RunConfig { height: 64, width: 96, batch: 2, log_every: 1, checkpoint_every: 2, tensorboard: true, ..usual };
    let config = RunConfig { rotations: Rotations::default(), ..config };

    // What a killed program leaves: the state of step 2, and events of step 3.
    let mut run = Run::create(&folder, config).expect("a run");
    let state = || fs::read(folder.join("checkpoints/state.safetensors")).expect("a state");
    let saved = std::cell::RefCell::new(Vec::new());
    let stopping = std::cell::Cell::new(false);
    let tell = |event: Event| {
        if matches!(event, Event::Validated(_)) {
            *saved.borrow_mut() = state();
        }
        stopping.set(matches!(event, Event::Step(r) if r.step == 3));
    };
    assert!(matches!(run.train(&data, || stopping.get(), tell).expect("trained"), Ended::Interrupted(3)));
    drop(run);
    fs::write(folder.join("checkpoints/state.safetensors"), saved.into_inner()).expect("put back");
    let ended = Run::resume(&folder).expect("resumed").train(&data, || false, |_| ()).expect("trained");
    let Ended::Finished(metrics) = ended else { panic!("not finished") };

    let events = folder.join("tensorboard");
    assert_eq!(fs::read_dir(&events).expect("a folder").count(), 2, "one file for each session");
    let found = told(&events);
    let value = |tag: &str, step: i64| match &found[tag][&step][..] {
        [Worth::Scalar(value)] => *value,
        other => panic!("{tag} of step {step}: {other:?}"),
    };
    let log = fs::read_to_string(folder.join("log.jsonl")).expect("a log");
    let lines: Vec<serde_json::Value> = log.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    let (mut steps, mut validations) = (Vec::new(), Vec::new());
    for line in &lines {
        let said = |name: &str| line.pointer(name).and_then(serde_json::Value::as_f64).expect("a number") as f32;
        if let Some(step) = line["step"].as_i64() {
            steps.push(step);
            for (tag, name) in [
                ("training/loss", "/loss"),
                ("health/disparity_spread", "/disparity_spread"),
                ("gradient_norms/pose", "/grad_norms/2"),
                ("learning_rates/encoder", "/learning_rates/0"),
            ] {
                assert_eq!(value(tag, step), said(name), "{tag} of step {step}");
            }
        }
        if let Some(step) = line["validated"].as_i64() {
            validations.push(step);
            assert_eq!(value("validation/photometric", step), said("/photometric"));
            assert_eq!(value("validation/abs_rel", step), said("/abs_rel"));
        }
    }
    assert_eq!((&steps[..], &validations[..]), (&[1, 2, 3, 4][..], &[2, 4][..]));
    assert!(found["training/loss"].keys().eq(&steps) && found["validation/warped"].keys().eq(&validations));
    assert_eq!(value("test/abs_rel", 4), metrics.after.expect("measured").abs_rel as f32);
    for (what, part) in
        [("weights", "encoder"), ("gradients", "encoder"), ("gradients", "decoder"), ("weights", "pose")]
    {
        for step in &validations {
            let tag = format!("{what}/{part}");
            let [Worth::Histogram(histogram)] = &found[&tag][step][..] else { panic!("{tag} of step {step}") };
            assert!(histogram.num > 1e3 && histogram.bucket.iter().sum::<f64>() == histogram.num, "{histogram:?}");
            assert!(histogram.min < 0.0 && histogram.max > 0.0 && histogram.sum_squares > 0.0, "{histogram:?}");
        }
    }
    let [Worth::Image(depth)] = &found["Depth and its error/error0-depth"][&4][..] else { panic!("no picture") };
    let picture = image::load_from_memory(&depth.encoded).expect("a picture");
    assert_eq!((depth.width, depth.height), (96, 64));
    assert_eq!((picture.width(), picture.height()), (96, 64));
}

#[test]
fn without_being_asked_for_there_are_no_events() {
    let place = tempfile::tempdir().expect("a folder");
    let config = RunConfig { height: 64, width: 96, batch: 2, steps: 1, ..RunConfig::new(Preset::Pico, 1) };
    let config = RunConfig { rotations: Rotations::default(), ..config };
    let data = RunData { train: street(1), validation: street(2), test: None };
    let ended = Run::create(place.path(), config).expect("a run").train(&data, || false, |_| ()).expect("trained");
    assert!(matches!(ended, Ended::Finished(_)));
    assert!(!place.path().join("tensorboard").exists());
}
