//! `parallax eval` from the outside: what was measured is said with the numbers.
#![cfg(feature = "cli")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use parallax::data::DataSource;
use parallax::data::kitti::{Kitti, Options};
use parallax::formats::npy::write_npy_shaped;
use parallax::monovit::Preset;
use parallax::networks::DepthNetwork;
use parallax::train::RunConfig;
use parallax::train::run::write_weights;

/// A street of 64x96 with six frames, as files; weights for that size as they are drawn.
fn made() -> &'static (PathBuf, PathBuf) {
    static MADE: OnceLock<(PathBuf, PathBuf)> = OnceLock::new();
    MADE.get_or_init(|| {
        let place = Path::new(env!("CARGO_TARGET_TMPDIR")).join("eval");
        // What an earlier run left.
        let _ = std::fs::remove_dir_all(&place);
        let (street, weights) = (place.join("street"), place.join("pico.safetensors"));
        let size = ["--sequences", "1", "--frames", "6", "--height", "64", "--width", "96"];
        let output = parallax(&[&["data", "street", "--out", text(&street)][..], &size].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let config = RunConfig { height: 64, width: 96, ..RunConfig::new(Preset::Pico, 1) };
        let (_, params) = DepthNetwork::new::<f32>(config.model(), 11);
        write_weights(&weights, &params, &config.setup()).expect("weights");
        (street, weights)
    })
}

const DRIVE: &str = "2011_09_26/2011_09_26_drive_0000_sync";

fn parallax(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_parallax")).args(arguments).output().expect("the program runs")
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a path in UTF-8")
}

/// Standard output of what must succeed.
#[track_caller]
fn said(arguments: &[&str]) -> String {
    let output = parallax(arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("UTF-8")
}

/// Fails with `status`, and says all of `words`.
#[track_caller]
fn fails(arguments: &[&str], status: i32, words: &[&str]) {
    let output = parallax(arguments);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(status), "{said}");
    for word in words {
        assert!(said.contains(word), "should say {word:?}: {said}");
    }
}

/// A street of its own, of which only so many frames have depth; the others are named.
fn with_depth(place: &Path, frames: usize) -> PathBuf {
    let street = place.join("street");
    let size = ["--sequences", "1", "--frames", "6", "--height", "64", "--width", "96"];
    said(&[&["data", "street", "--out", text(&street)][..], &size].concat());
    for frame in frames..6 {
        let depth = format!("{DRIVE}/proj_depth/groundtruth/image_02/{frame:010}.png");
        std::fs::remove_file(street.join(depth)).expect("removed");
    }
    street
}

#[test]
fn what_was_measured_is_said_in_the_table_and_in_json() {
    let (_, weights) = made();
    let place = tempfile::tempdir().expect("a folder");
    let street = with_depth(place.path(), 4);
    let flags = ["eval", "--weights", text(weights), "--data", text(&street), "--scale", "2.5", "--flip"];
    let table = said(&flags);
    let missing = "proj_depth/groundtruth/image_02/0000000004.png";
    for line in [
        &format!("weights   {}, maps of 96x64, joined with the mirrored picture's", weights.display())[..],
        &format!("data      {}", street.display()),
        "protocol  dense: 0.001 to 80 m, the whole picture",
        "scaling   times 2.5",
        "images    4 of 6 frames",
        "skipped   2: no ground-truth depth (the first: ",
        missing,
        "Abs Rel",
    ] {
        assert!(table.contains(line), "{line}: {table}");
    }
    let json: serde_json::Value = serde_json::from_str(&said(&[&flags[..], &["--json"]].concat())).expect("JSON");
    assert_eq!((&json["weights"], &json["data"]), (&text(weights).into(), &text(&street).into()));
    assert_eq!((&json["protocol"], &json["scale"], &json["flip"]), (&"dense".into(), &"2.5".into(), &true.into()));
    assert_eq!((&json["frames"], &json["images"]), (&6.into(), &4.into()));
    assert_eq!((&json["height"], &json["width"]), (&64.into(), &96.into()));
    let [skipped] = &json["skipped"].as_array().expect("a list")[..] else { panic!("{json}") };
    assert_eq!((&skipped["why"], &skipped["frames"]), (&"no ground-truth depth".into(), &2.into()));
    assert!(skipped["first"].as_str().expect("a path").ends_with(missing));
    assert!(
        json["abs_rel"].as_f64().expect("a number") > 0.0 && json["per_image"].as_array().expect("a list").len() == 4
    );
}

#[test]
fn missing_depth_is_not_missing_frames() {
    let (_, weights) = made();
    let place = tempfile::tempdir().expect("a folder");
    let street = with_depth(place.path(), 0);
    let flags = ["eval", "--weights", text(weights), "--data", text(&street)];
    let path = "proj_depth/groundtruth/image_02/0000000000.png";
    fails(&flags, 1, &["no ground-truth depth: 6 frames lack it", path]);
    let split = place.path().join("list.txt");
    std::fs::write(&split, format!("{DRIVE} 2 l\n{DRIVE} 3 l\n")).expect("written");
    let words = ["list.txt", "line 1", "image_02/0000000002.png", "2 of the list's 2 frames lack it"];
    fails(&[&flags[..], &["--split", text(&split)]].concat(), 1, &words);
    let empty = place.path().join("empty");
    std::fs::create_dir(&empty).expect("made");
    fails(
        &["eval", "--weights", text(weights), "--data", text(&empty)],
        1,
        &["empty", "holds no PNG, JPEG or WebP pictures"],
    );
}

#[test]
fn the_truth_as_another_programs_disparities_is_perfect() {
    let (street, _) = made();
    let place = tempfile::tempdir().expect("a folder");
    let split = place.path().join("list.txt");
    std::fs::write(&split, format!("{DRIVE} 3 l\n{DRIVE} 1 l\n{DRIVE} 4 l\n")).expect("written");
    let data = Kitti::open(street, Some(&split), 64, 96, Options { neighbours: false, ..Options::default() });
    let data = data.expect("opened");
    let mut values = Vec::new();
    for sample in 0..3 {
        let depth = data.depth(sample).expect("read").expect("depth");
        // In a unit of its own.
        values.extend(depth.metres.iter().map(|&m| if m > 0.0 { 7.0 / m } else { 0.01 }));
    }
    let file = place.path().join("disps.npy");
    write_npy_shaped(&file, &values, &[3, 64, 96]).expect("written");
    let flags = ["eval", "--disparities", text(&file), "--data", text(street), "--split", text(&split)];
    let json: serde_json::Value = serde_json::from_str(&said(&[&flags[..], &["--json"]].concat())).expect("JSON");
    assert!(json["abs_rel"].as_f64().expect("a number") < 1e-5 && json["a1"] == 1.0, "{json}");
    assert!((json["ratio_median"].as_f64().expect("a number") - 7.0).abs() < 1e-3, "{json}");
    assert_eq!((&json["weights"], &json["disparities"]), (&serde_json::Value::Null, &text(&file).into()));
    assert!(said(&flags).contains("disps.npy, maps of 96x64"));
    // The order counts.
    std::fs::write(&split, format!("{DRIVE} 1 l\n{DRIVE} 3 l\n{DRIVE} 4 l\n")).expect("written");
    let json: serde_json::Value = serde_json::from_str(&said(&[&flags[..], &["--json"]].concat())).expect("JSON");
    assert!(json["abs_rel"].as_f64().expect("a number") > 1e-3, "{json}");

    std::fs::write(&split, format!("{DRIVE} 1 l\n")).expect("written");
    fails(&flags, 1, &["disps.npy", "has 3 maps", "[3, 64, 96]", "1 frames"]);
    write_npy_shaped(&file, &values, &[3 * 64, 96]).expect("written");
    fails(&flags, 1, &["disps.npy", "[frames, height, width]", "[192, 96]"]);
    write_npy_shaped(&file, &vec![-1.0; 64 * 96], &[1, 64, 96]).expect("written");
    fails(&flags, 1, &[&format!("{DRIVE} 1 l"), "row 0, column 0 is -1"]);
    fails(&[&flags[..], &["--flip"]].concat(), 2, &["--flip"]);
}

#[test]
fn protocols_and_scales_are_said_and_what_does_not_fit_is_refused() {
    let (street, weights) = made();
    let flags = ["eval", "--weights", text(weights), "--data", text(street)];
    let with = |more: &[&'static str]| [&flags[..], more].concat();
    let table = said(&with(&["--protocol", "kitti2015", "--scale", "stereo"]));
    for line in ["protocol  kitti2015: every pixel of the truth, no crop", "scaling   stereo: times 5.4", "RMSE log "] {
        assert!(table.contains(line), "{line}: {table}");
    }
    fails(&with(&["--protocol", "make3d"]), 2, &["--protocol: make3d is for ground truth of 55 or 21 rows of 305"]);
    fails(&with(&["--protocol", "kitti"]), 2, &["dense, eigen", "cityscapes", "\"kitti\""]);
    fails(&with(&["--scale", "camera-height=0"]), 2, &["camera-height=METRES"]);
    fails(&with(&["--protocol", "projected"]), 1, &["proj_depth/velodyne/image_02/0000000000.npz", "6 of 6 frames"]);
}

/// The exact depth of the street, in a unit of its own, has the scale of the camera's height: 1.65 m.
#[test]
fn the_cameras_height_gives_the_scale_without_ground_truth() {
    let place = tempfile::tempdir().expect("a folder");
    let street = place.path().join("street");
    let size = ["--sequences", "2", "--frames", "3", "--height", "96", "--width", "320"];
    said(&[&["data", "street", "--out", text(&street)][..], &size].concat());
    let data = Kitti::open(&street, None, 96, 320, Options { neighbours: false, ..Options::default() });
    let data = data.expect("opened");
    let mut values = Vec::new();
    for sample in 0..data.len() {
        let depth = data.depth(sample).expect("read").expect("depth");
        values.extend(depth.metres.iter().map(|&m| if m > 0.0 { 7.0 / m } else { 0.01 }));
    }
    let file = place.path().join("disps.npy");
    write_npy_shaped(&file, &values, &[6, 96, 320]).expect("written");
    let flags = ["eval", "--disparities", text(&file), "--data", text(&street), "--scale", "camera-height", "--json"];
    let json: serde_json::Value = serde_json::from_str(&said(&flags)).expect("JSON");
    assert_eq!((&json["scale"], &json["images"]), (&"camera-height=1.65".into(), &6.into()));
    assert!((json["ratio_median"].as_f64().expect("a number") / 7.0 - 1.0).abs() < 0.03, "{json}");
    // A wall shows no road: the image is counted and in none of the numbers.
    values[..96 * 320].fill(0.2);
    write_npy_shaped(&file, &values, &[6, 96, 320]).expect("written");
    let json: serde_json::Value = serde_json::from_str(&said(&flags)).expect("JSON");
    assert_eq!((&json["images"], json["without_scale"].as_array().expect("a list").len()), (&5.into(), 1));
    assert_eq!(json["skipped"][0]["why"], "no road to measure the camera's height over");
    values.fill(0.2);
    write_npy_shaped(&file, &values, &[6, 96, 320]).expect("written");
    fails(&flags, 1, &["6 frames show no road"]);
}

/// Weights as other draws have them.
fn other_weights(place: &Path) -> PathBuf {
    let path = place.join("other.safetensors");
    let config = RunConfig { height: 64, width: 96, ..RunConfig::new(Preset::Pico, 1) };
    let (_, params) = DepthNetwork::new::<f32>(config.model(), 12);
    write_weights(&path, &params, &config.setup()).expect("weights");
    path
}

#[test]
fn more_than_a_mean_is_written_and_weights_stand_beside_each_other() {
    let (_, weights) = made();
    let place = tempfile::tempdir().expect("a folder");
    let street = place.path().join("street");
    let size = ["--sequences", "2", "--frames", "4", "--height", "64", "--width", "96"];
    said(&[&["data", "street", "--out", text(&street)][..], &size].concat());
    let other = other_weights(place.path());
    let [csv, plot, sheets] = ["images.csv", "distance.svg", "sheets"].map(|name| place.path().join(name));
    let flags = ["eval", "--data", text(&street), "--weights", text(weights), text(&other), text(weights)];
    let more = ["--csv", text(&csv), "--plot", text(&plot), "--sheets", text(&sheets)];
    let json = said(&[&flags[..], &more, &["--json", "--bins", "0,10,30"]].concat());
    let json: serde_json::Value = serde_json::from_str(&json).expect("JSON");

    let number = |value: &serde_json::Value| value.as_f64().expect("a number");
    assert_eq!((&json["interval"]["unit"], &json["interval"]["units"]), (&"sequences".into(), &2.into()));
    assert!(number(&json["interval"]["low"]["abs_rel"]) <= number(&json["abs_rel"]));
    let pixels = |groups: &serde_json::Value| -> u64 {
        groups.as_array().expect("a list").iter().map(|group| group["pixels"].as_u64().expect("a count")).sum()
    };
    assert_eq!(pixels(&json["per_image"]), pixels(&json["distances"]));
    assert_eq!(pixels(&json["per_image"]), pixels(&json["regions"]));
    assert_eq!(json["sets"].as_array().expect("a list").len(), 2);
    let [b, same] = &json["others"].as_array().expect("a list")[..] else { panic!("{json}") };
    let by = number(&b["abs_rel"]) - number(&json["abs_rel"]);
    assert!(by != 0.0 && (number(&b["difference"]["abs_rel"]) - by).abs() < 1e-12);
    assert_eq!((&same["difference"]["abs_rel"], &same["difference"]["images"]), (&0.0.into(), &8.into()));

    let lines = std::fs::read_to_string(&csv).expect("a table");
    assert_eq!(lines.lines().count(), 1 + 3 * 8);
    let mean: f64 =
        lines.lines().skip(1).take(8).map(|l| l.split(',').nth(5).expect("abs_rel").parse::<f64>().expect("")).sum();
    assert!((mean / 8.0 - number(&json["abs_rel"])).abs() < 1e-12);
    let svg = std::fs::read_to_string(&plot).expect("a plot");
    assert_eq!((svg.matches("<polyline").count(), svg.contains("0 to 10 m")), (3, true));
    assert_eq!(std::fs::read_dir(&sheets).expect("a folder").count(), 8);

    let table = said(&[&flags[..5], &["--details"]].concat());
    for part in ["intervals 95 %, bootstrap of 1000 draws from 2 whole sequences", "bottom centre", "by sequence"] {
        assert!(table.contains(part), "{part}: {table}");
    }
    fails(&[&flags[..], &["--bins", "10,5"]].concat(), 2, &["--bins: expected metres from 0 up"]);
    let small = ["eval", "--data", text(&street), "--weights", text(weights), "--height", "64", "--bootstrap", "0"];
    assert!(!said(&[&small[..], &["--width", "64"]].concat()).contains("intervals"));
}

#[test]
fn a_folder_of_predictions_is_matched_by_name() {
    let (street, weights) = made();
    let place = tempfile::tempdir().expect("a folder");
    let split = place.path().join("list.txt");
    std::fs::write(&split, format!("{DRIVE} 3 l\n{DRIVE} 1 l\n")).expect("written");
    let depth = place.path().join("depth");
    let predict = ["predict", "--weights", text(weights), text(street), "--out", text(&depth), "--npy"];
    said(&predict);
    let flags = ["eval", "--data", text(street), "--split", text(&split), "--predictions", text(&depth), "--inverse"];
    // The same numbers as the network itself, whose maps have the truth's size.
    fails(&flags, 1, &["predictions of no frame", "--ignore-extra"]);
    let number = |flags: &[&str]| {
        let json: serde_json::Value = serde_json::from_str(&said(&[flags, &["--json"]].concat())).expect("JSON");
        json["abs_rel"].as_f64().expect("a number")
    };
    let found = number(&[&flags[..], &["--ignore-extra"]].concat());
    let own = number(&["eval", "--data", text(street), "--split", text(&split), "--weights", text(weights)]);
    assert!((found - own).abs() < 1e-6, "{found} {own}");
    std::fs::remove_file(depth.join(format!("{DRIVE}/image_02/data/0000000001.npy"))).expect("removed");
    let missing = [&flags[..], &["--ignore-extra"]].concat();
    fails(
        &missing,
        1,
        &["1 of 2 frames have no prediction", &format!("{DRIVE} 1 l"), "image_02/data/0000000001 or", ".npy or .pfm"],
    );
    fails(&["eval", "--predictions", text(&depth)], 2, &["--predictions", "data street"]);
}

#[test]
fn trajectories_are_compared() {
    let (street, _) = made();
    let place = tempfile::tempdir().expect("a folder");
    let truth = street.join(DRIVE).join("poses.txt");
    let [half, plot] = ["half.txt", "path.svg"].map(|name| place.path().join(name));
    // The same path in half the unit.
    let lines = std::fs::read_to_string(&truth).expect("poses");
    let halved = lines.lines().map(|line| {
        let numbers = line.split(' ').map(|n| n.parse::<f64>().expect("a number")).enumerate();
        let numbers = numbers.map(|(i, n)| if i % 4 == 3 { n / 2.0 } else { n }.to_string());
        numbers.collect::<Vec<_>>().join(" ") + "\n"
    });
    std::fs::write(&half, halved.collect::<String>()).expect("written");
    let flags = ["eval", "--poses", text(&truth), "--trajectory", text(&half), "--plot", text(&plot)];
    let json: serde_json::Value = serde_json::from_str(&said(&[&flags[..], &["--json"]].concat())).expect("JSON");
    let number = |value: &serde_json::Value| value.as_f64().expect("a number");
    assert!((number(&json["scale"]) - 2.0).abs() < 1e-9 && number(&json["ate"]) < 1e-9, "{json}");
    assert!(number(&json["five_frames"]["mean"]) < 1e-9 && json["segments"].is_null(), "{json}");
    assert!(std::fs::read_to_string(&plot).expect("a plot").contains("from above"));
    assert!(said(&flags).contains("segments     none"));
    std::fs::write(&half, lines.lines().take(3).map(|l| format!("{l}\n")).collect::<String>()).expect("written");
    fails(&flags, 2, &["--trajectory: 3 predicted poses, but 6 true ones"]);
    fails(&["eval", "--poses", text(&truth)], 2, &["--trajectory"]);
}
