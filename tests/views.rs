//! Views of a run that has left none.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use parallax::data::DataSource;
use parallax::monovit::Preset;
use parallax::street::{Street, StreetConfig};
use parallax::train::RunConfig;
use parallax::train::rotations::Rotations;
use parallax::train::run::{Ended, Run, RunData, is_running};
use parallax::train::views::{AT_END, AT_VALIDATION, Views, make_views};

fn street(seed: u64) -> Arc<dyn DataSource> {
    let config = StreetConfig { height: 64, width: 96, sequences: 1, frames: 6, seed, ..StreetConfig::default() };
    Arc::new(Street::render(&config, None))
}

fn views(folder: &Path, list: &str) -> Views {
    serde_json::from_slice(&fs::read(folder.join("views").join(list)).expect("a list")).expect("views")
}

#[test]
fn lost_views_are_made_from_the_weights_but_not_while_the_run_is_trained() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = place.path();
    let config = RunConfig { height: 64, width: 96, batch: 2, ..RunConfig::new(Preset::Pico, 2) };
    let config = RunConfig { rotations: Rotations::default(), ..config };
    let data = RunData { train: street(1), validation: street(2), test: Some(street(3)) };
    let mut run = Run::create(folder, config).expect("a run");
    assert!(matches!(run.train(&data, || false, |_| ()).expect("trained"), Ended::Finished(_)));
    let kinds = |list: &str| views(folder, list).groups.iter().map(|group| group.kind.clone()).collect::<Vec<_>>();
    let before = [kinds(AT_VALIDATION), kinds(AT_END)];
    fs::remove_dir_all(folder.join("views")).expect("removed");

    assert!(is_running(folder));
    let error = make_views(folder, &|_, _, _| ()).expect_err("in use").to_string();
    assert!(error.contains("another process is training this run"), "{error}");
    drop(run);
    assert!(!is_running(folder));

    // The data are those that the configuration names: the embedded street.
    make_views(folder, &|_, _, _| ()).expect("made");
    assert_eq!([kinds(AT_VALIDATION), kinds(AT_END)], before);
    let (last, end) = (views(folder, AT_VALIDATION), views(folder, AT_END));
    assert_eq!((last.step, end.step), (2, 2));
    assert!(last.time.is_empty() && end.path.len() == end.true_path.len() && end.path.len() > 1, "{end:?}");
    for view in last.groups.iter().chain(&end.groups).flat_map(|group| &group.views) {
        image::open(folder.join("views").join(&view.file)).expect("a picture");
    }

    for weights in ["best.safetensors", "last.safetensors"] {
        fs::remove_file(folder.join(weights)).expect("removed");
    }
    let error = make_views(folder, &|_, _, _| ()).expect_err("no weights").to_string();
    assert!(error.contains("neither last.safetensors nor best.safetensors"), "{error}");
}
