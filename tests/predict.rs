//! `parallax predict` from the outside: any picture in, maps of its size out, and nothing lost or overwritten.
#![cfg(feature = "cli")]

use std::fs;
use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use image::{DynamicImage, GenericImageView, ImageFormat, Rgb, RgbImage};
use parallax::eval::predictor::Predictor;
use parallax::monovit::Preset;
use parallax::networks::DepthNetwork;
use parallax::nn::Context;
use parallax::tensor::{Tensor, Var, parallel, pool};
use parallax::train::RunConfig;
use parallax::train::run::{load_weights, write_weights};

/// The size that the network of these tests was made for.
const HEIGHT: u32 = 64;
const WIDTH: u32 = 96;

/// Weights of the smallest size as they are drawn: what they predict is nonsense, but depends on the picture.
fn weights() -> &'static Path {
    static FILE: OnceLock<PathBuf> = OnceLock::new();
    FILE.get_or_init(|| {
        let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("predict/pico.safetensors");
        let usual = RunConfig::new(Preset::Pico, 1);
        let config = RunConfig { height: HEIGHT as usize, width: WIDTH as usize, ..usual };
        let (_, params) = DepthNetwork::new::<f32>(config.model(), 11);
        write_weights(&path, &params, &config.setup()).expect("weights");
        path
    })
}

fn run(weights: &Path, inputs: &[&Path], out: &Path, more: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_parallax"));
    command.arg("predict").arg("--weights").arg(weights).args(inputs).arg("--out").arg(out).args(more);
    command.output().expect("the program runs")
}

/// Predicts, and returns what `--json` printed.
#[track_caller]
fn predict(inputs: &[&Path], out: &Path, more: &[&str]) -> serde_json::Value {
    let output = run(weights(), inputs, out, &[&["--json"], more].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("one JSON object and nothing else")
}

/// Fails with `status`, and says all of `words` on standard error.
#[track_caller]
fn fails(output: &Output, status: i32, words: &[&str]) {
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(status), "{said}");
    for word in words {
        assert!(said.contains(word), "should say {word:?}: {said}");
    }
}

/// A picture in which every place looks different.
fn picture(width: u32, height: u32) -> RgbImage {
    RgbImage::from_fn(width, height, |x, y| {
        Rgb([(255 * x / width) as u8, (255 * y / height) as u8, if (x / 7 + y / 5) % 2 == 0 { 200 } else { 30 }])
    })
}

fn save(folder: &Path, name: &str, picture: impl Into<DynamicImage>) -> PathBuf {
    let path = folder.join(name);
    fs::create_dir_all(path.parent().expect("a folder")).expect("made");
    picture.into().save(&path).expect("saved");
    path
}

/// Height, width and values.
fn read_npy(path: &Path) -> (usize, usize, Vec<f32>) {
    let bytes = fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let length = usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let header = std::str::from_utf8(&bytes[10..10 + length]).expect("a header");
    let shape = header.split(['(', ')']).nth(1).expect("a shape");
    let sides: Vec<usize> = shape.split(", ").map(|n| n.parse().expect("a side")).collect();
    let values = bytes[10 + length..].as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    (sides[0], sides[1], values)
}

/// A point and its colour.
type Point = ([f32; 3], [u8; 3]);

/// The points of a cloud.
fn read_ply(path: &Path) -> Vec<Point> {
    let bytes = fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let end = bytes.windows(11).position(|w| w == b"end_header\n").expect("a header") + 11;
    let header = std::str::from_utf8(&bytes[..end]).expect("text");
    assert!(header.starts_with("ply\nformat binary_little_endian 1.0\n"), "{header}");
    let float = |b: &[u8]| f32::from_le_bytes(b.try_into().expect("four bytes"));
    let (points, rest) = bytes[end..].as_chunks::<15>();
    assert!(rest.is_empty() && header.contains(&format!("element vertex {}\n", points.len())), "{header}");
    points.iter().map(|p| ([float(&p[..4]), float(&p[4..8]), float(&p[8..12])], [p[12], p[13], p[14]])).collect()
}

#[test]
fn any_picture_gives_maps_of_its_own_size_that_agree() {
    let place = tempfile::tempdir().expect("a folder");
    let (inside, out) = (place.path().join("in"), place.path().join("out"));
    let plain = DynamicImage::from(picture(130, 50));
    save(&inside, "rgb.png", plain.clone());
    save(&inside, "deep.png", plain.to_rgb16());
    save(&inside, "alpha.png", plain.to_rgba8());
    save(&inside, "grey.png", plain.to_luma8());
    save(&inside, "photo.jpg", plain.clone());
    save(&inside, "web.webp", plain);
    save(&inside, "one.png", picture(1, 1));
    save(&inside, "tall.png", picture(3, 90));
    let summary = predict(&[&inside], &out, &["--npy", "--depth-png", "--ply", "--scale", "3"]);
    let done = summary["pictures"].as_array().expect("a list");
    assert_eq!(done.len(), 8);
    for name in ["rgb", "deep", "alpha", "grey", "photo", "web", "one", "tall"] {
        let (w, h) = match name {
            "one" => (1, 1),
            "tall" => (3, 90),
            _ => (130, 50),
        };
        let file = |ending: &str| out.join(format!("{name}{ending}"));
        let entry = done.iter().find(|d| d["outputs"]["inverse_depth"] == file(".npy").to_str().expect("UTF-8"));
        let entry = entry.unwrap_or_else(|| panic!("{name} is missing: {summary}"));
        assert_eq!((&entry["width"], &entry["height"]), (&w.into(), &h.into()), "{name}");
        assert_eq!(image::open(file("_disp.png")).expect("a picture").dimensions(), (w, h), "{name}");
        let (rows, columns, inverse) = read_npy(&file(".npy"));
        assert_eq!((rows, columns, inverse.len()), (h as usize, w as usize, (w * h) as usize), "{name}");
        let depth = image::open(file("_depth.png")).expect("a picture").into_luma16();
        assert_eq!(depth.dimensions(), (w, h), "{name}");
        let points = read_ply(&file(".ply"));
        for (i, &d) in inverse.iter().enumerate() {
            assert_eq!(depth.as_raw()[i], (256.0 / d).round() as u16, "{name}, pixel {i}");
            assert_eq!(points[i].0[2], 1.0 / d, "{name}, pixel {i}");
        }
        let mut depths: Vec<f32> = points.iter().map(|p| p.0[2]).collect();
        depths.sort_by(f32::total_cmp);
        let (stated, found) = (entry["median_depth"].as_f64().expect("a number"), depths[depths.len() / 2]);
        // Stated of the network's own map: of few pixels the median is another.
        assert!(w < 100 || (stated / f64::from(found) - 1.0).abs() < 0.02, "{name}: {stated} {found}");
    }
    let map = |name: &str| fs::read(out.join(format!("{name}.npy"))).expect("a map");
    for same in ["deep", "alpha", "web"] {
        assert!(map(same) == map("rgb"), "{same} is the same picture");
    }
    assert!(map("grey") != map("rgb") && map("photo") != map("rgb"), "the map does not depend on the picture");
}

/// A JPEG whose EXIF segment says how it was held.
fn jpeg(picture: &RgbImage, orientation: u8) -> Vec<u8> {
    let mut plain = Vec::new();
    let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut plain, 100);
    picture.write_with_encoder(encoder).expect("encoded");
    // Big-endian TIFF with one entry: orientation (0x112), a short, one of them.
    let mut exif = b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0".to_vec();
    exif.extend([orientation, 0, 0, 0, 0, 0, 0]);
    let mut bytes = b"\xff\xd8\xff\xe1".to_vec();
    bytes.extend((exif.len() as u16 + 2).to_be_bytes());
    bytes.extend(exif);
    bytes.extend(&plain[2..]);
    bytes
}

#[test]
fn all_eight_orientations_stand_upright() {
    let place = tempfile::tempdir().expect("a folder");
    let (inside, out) = (place.path().join("in"), place.path().join("out"));
    fs::create_dir(&inside).expect("made");
    let (w, h) = (32, 16);
    let corners = [[220, 40, 40], [40, 200, 40], [40, 40, 220], [230, 230, 60]];
    let upright = |x: u32, y: u32| corners[usize::from(x >= w / 2) + 2 * usize::from(y >= h / 2)];
    for orientation in 1..=8u8 {
        // What the stored row 0 and column 0 are of the picture, as the EXIF standard says it.
        let (bottom, right) = match orientation {
            1 | 5 => (false, false),
            2 | 6 => (false, true),
            3 | 7 => (true, true),
            _ => (true, false),
        };
        let stored = |row: u32, column: u32| {
            let (x, y) = if orientation <= 4 { (column, row) } else { (row, column) };
            upright(if right { w - 1 - x } else { x }, if bottom { h - 1 - y } else { y })
        };
        let (sw, sh) = if orientation <= 4 { (w, h) } else { (h, w) };
        let picture = RgbImage::from_fn(sw, sh, |x, y| Rgb(stored(y, x)));
        fs::write(inside.join(format!("{orientation}.jpg")), jpeg(&picture, orientation)).expect("written");
    }
    predict(&[&inside], &out, &["--ply"]);
    for orientation in 1..=8 {
        let map = image::open(out.join(format!("{orientation}_disp.png"))).expect("a map");
        assert_eq!(map.dimensions(), (w, h), "orientation {orientation}");
        let points = read_ply(&out.join(format!("{orientation}.ply")));
        for (x, y) in [(2, 2), (w - 3, 2), (2, h - 3), (w - 3, h - 3)] {
            let colour = points[(y * w + x) as usize].1;
            let near = colour.iter().zip(upright(x, y)).all(|(a, b)| a.abs_diff(b) < 12);
            assert!(near, "orientation {orientation}, pixel {x}, {y}: {colour:?}");
        }
    }
}

#[test]
fn what_is_broken_is_named_and_the_rest_is_done() {
    let place = tempfile::tempdir().expect("a folder");
    let (inside, out) = (place.path().join("in"), place.path().join("out"));
    save(&inside, "frame2.png", picture(20, 10));
    save(&inside, "frame10.png", picture(20, 10));
    let whole = fs::read(inside.join("frame2.png")).expect("a picture");
    fs::write(inside.join("frame3.png"), &whole[..whole.len() / 2]).expect("written");
    fs::write(inside.join("frame4.png"), "no picture").expect("written");
    let missing = place.path().join("missing.png");
    let output = run(weights(), &[&inside, &missing], &out, &["--json"]);
    fails(&output, 1, &["frame3.png", "frame4.png", "missing.png", "3 of 5 pictures"]);
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let names = |list: &str| -> Vec<String> {
        let list = summary[list].as_array().expect("a list");
        let name =
            |e: &serde_json::Value| Path::new(e["input"].as_str().expect("a path")).file_name().map(PathBuf::from);
        list.iter().filter_map(|e| Some(name(e)?.to_string_lossy().into_owned())).collect()
    };
    assert_eq!(names("pictures"), ["frame2.png", "frame10.png"]);
    assert_eq!(names("failed"), ["frame3.png", "frame4.png", "missing.png"]);
    let mut written: Vec<_> =
        fs::read_dir(out.join("in")).expect("results").map(|e| e.expect("one").file_name()).collect();
    written.sort();
    assert_eq!(written, ["frame10_disp.png", "frame2_disp.png"], "nothing half done, nothing else");
}

#[test]
fn a_picture_that_is_too_large_is_refused_at_once() {
    let place = tempfile::tempdir().expect("a folder");
    // A whole small picture whose header claims another size.
    let mut bytes = Cursor::new(Vec::new());
    picture(8, 8).write_to(&mut bytes, ImageFormat::WebP).expect("encoded");
    let mut bytes = bytes.into_inner();
    // Lossless WebP: after the signature (0x2f) 14 bits of width - 1 and 14 of height - 1.
    let at = bytes.iter().position(|&b| b == 0x2f).expect("a signature") + 1;
    let sizes = 15_999u32 | 15_999 << 14 | (u32::from(bytes[at + 3]) >> 4) << 28;
    bytes[at..at + 4].copy_from_slice(&sizes.to_le_bytes());
    let path = place.path().join("huge.webp");
    fs::write(&path, bytes).expect("written");
    let started = std::time::Instant::now();
    let output = run(weights(), &[&path], &place.path().join("out"), &[]);
    fails(&output, 1, &["huge.webp", "16000x16000", "100 megapixels"]);
    assert!(started.elapsed().as_secs() < 5, "{:?}", started.elapsed());
}

#[test]
fn pictures_of_one_name_keep_what_tells_them_apart() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = place.path();
    let (one, two) = (save(folder, "a/x.png", picture(8, 8)), save(folder, "b/x.png", picture(8, 12)));
    save(folder, "a/x.jpg", picture(12, 8));
    let size = |path: PathBuf| image::open(path).expect("a map").dimensions();
    let out = folder.join("files");
    predict(&[&one, &two, &one], &out, &[]);
    assert_eq!((size(out.join("a/x.png_disp.png")), size(out.join("b/x.png_disp.png"))), ((8, 8), (8, 12)));
    let out = folder.join("stems");
    predict(&[&folder.join("a")], &out, &[]);
    assert_eq!((size(out.join("x.jpg_disp.png")), size(out.join("x.png_disp.png"))), ((12, 8), (8, 8)));
    // Folders of one name, as KITTI's drives have them.
    let drives = ["drive_1/data", "drive_2/data"].map(|drive| folder.join(drive));
    drives.iter().for_each(|drive| drop(save(drive, "0000000000.png", picture(8, 8))));
    let out = folder.join("drives");
    predict(&[&drives[0], &drives[1]], &out, &[]);
    for drive in ["drive_1", "drive_2"] {
        assert!(out.join(drive).join("data/0000000000.png_disp.png").is_file(), "{drive}");
    }
}

#[test]
fn what_is_passed_over_is_named_and_what_is_there_can_be_left_alone() {
    let place = tempfile::tempdir().expect("a folder");
    let (folder, out) = (place.path().join("in"), place.path().join("out"));
    save(&folder, "a.png", picture(8, 8));
    for name in ["b.heic", "c.mp4", "no_ending"] {
        fs::write(folder.join(name), "something").expect("written");
    }
    let first = run(weights(), &[&folder], &out, &[]);
    let said = String::from_utf8_lossy(&first.stderr);
    for word in ["3 files", "b.heic", "c.mp4", "no_ending", "1 of 1 pictures done", "out"] {
        assert!(said.contains(word), "should say {word:?}: {said}");
    }
    fs::write(out.join("a_disp.png"), "mine").expect("written");
    let second = run(weights(), &[&folder], &out, &["--skip-existing"]);
    assert!(second.status.success() && String::from_utf8_lossy(&second.stderr).contains("1 were there already"));
    assert_eq!(fs::read(out.join("a_disp.png")).expect("there"), b"mine");
}

#[test]
fn a_picture_that_cannot_be_read_is_named_and_the_rest_of_the_folder_is_done() {
    let place = tempfile::tempdir().expect("a folder");
    let (folder, out) = (place.path().join("in"), place.path().join("out"));
    save(&folder, "a_good.png", picture(8, 8));
    save(&folder, "z_good.png", picture(8, 8));
    let bad =
        ["coarse_brightness.jpg", "coarse_brightness_scans.jpg", "fuzzed_465.jpg", "fuzzed_559.jpg", "trunc_60.jpg"];
    let pictures = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/pictures");
    for name in ["coarse_brightness.jpg", "coarse_brightness_scans.jpg", "fuzzed_465.jpg", "fuzzed_559.jpg"] {
        fs::copy(pictures.join(name), folder.join(name)).expect("copied");
    }
    let whole = fs::read(pictures.join("trunc_90.jpg")).expect("a fixture");
    fs::write(folder.join("trunc_60.jpg"), &whole[..2 * whole.len() / 3]).expect("written");
    fails(
        &run(weights(), &[&folder], &out, &[]),
        1,
        &[&bad[..], &["5 of 7 pictures", "2 of 7 pictures done"]].concat(),
    );
    assert!(out.join("a_good_disp.png").is_file() && out.join("z_good_disp.png").is_file());
    // A folder that was made for nothing goes.
    let alone = run(weights(), &[&folder.join("trunc_60.jpg")], &place.path().join("none"), &[]);
    fails(&alone, 1, &["trunc_60.jpg", "cut short"]);
    assert!(!place.path().join("none").exists());
}

#[test]
fn results_that_would_overwrite_something_are_refused_before_any_work() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = place.path();
    let out = folder.join("out");
    let no_weights = Path::new("/no/such/weights");
    // A picture that bears the name of another's result.
    let mine = save(folder, "c/y_disp.png", picture(8, 8));
    let before = fs::read(&mine).expect("there");
    let named = save(folder, "c/y.png", picture(8, 8));
    let c = folder.join("c");
    fails(&run(no_weights, &[&mine, &named], &c, &[]), 1, &["y_disp.png", "would be overwritten"]);
    fails(&run(no_weights, &[&c], &c, &[]), 1, &["another --out"]);
    assert_eq!(fs::read(&mine).expect("there"), before);
    fails(&run(no_weights, &[&named], &out, &[]), 1, &["/no/such/weights"]);
    assert!(!out.exists(), "nothing was made");
}

#[test]
fn folders_of_the_same_names_stand_side_by_side() {
    let place = tempfile::tempdir().expect("a folder");
    let (left, right, out) = (place.path().join("left"), place.path().join("right"), place.path().join("out"));
    save(&left, "deep/0.png", picture(12, 8));
    save(&right, "deep/0.png", picture(8, 12));
    predict(&[&left, &right], &out, &[]);
    let size = |name: &str| image::open(out.join(name)).expect("a map").dimensions();
    assert_eq!((size("left/deep/0_disp.png"), size("right/deep/0_disp.png")), ((12, 8), (8, 12)));
    predict(&[&left], &out, &[]);
    assert_eq!(size("deep/0_disp.png"), (12, 8));
}

#[test]
fn wrong_usage_is_named() {
    let place = tempfile::tempdir().expect("a folder");
    let path = save(place.path(), "a.png", picture(8, 8));
    let out = place.path().join("out");
    let go = |more: &[&str]| run(weights(), &[&path], &out, more);
    fails(&go(&["--scale", "2", "--stereo"]), 2, &["--scale", "--stereo"]);
    fails(&go(&["--camera-height", "1.65", "--stereo"]), 2, &["--camera-height", "--stereo"]);
    fails(&go(&["--camera-height", "1.65", "--scale", "1"]), 2, &["--camera-height", "--scale"]);
    fails(&go(&["--fov", "60", "--intrinsics", "1,1,1,1"]), 2, &["--fov", "--intrinsics"]);
    fails(&go(&["--scale", "0"]), 2, &["--scale", "above 0"]);
    fails(&go(&["--intrinsics", "1,2"]), 2, &["--intrinsics", "four numbers"]);
    fails(&go(&["--height", "100"]), 2, &["--height", "100", "multiple of 32"]);
    fails(&go(&["--width", "32"]), 2, &["--width", "32"]);
    assert!(!out.exists(), "nothing was made");
    fails(&run(weights(), &[&path], &path.join("inside"), &[]), 1, &["a.png"]);
}

#[test]
fn depth_is_scaled_clipped_and_refused_without_a_road() {
    let place = tempfile::tempdir().expect("a folder");
    let path = save(place.path(), "a.png", picture(24, 12));
    let out = |name: &str| place.path().join(name);
    let map = |name: &str| read_npy(&out(name).join("a.npy")).2;
    predict(&[&path], &out("plain"), &["--npy"]);
    predict(&[&path], &out("stereo"), &["--npy", "--stereo"]);
    let summary = predict(&[&path], &out("far"), &["--npy", "--depth-png", "--scale", "1e6"]);
    assert_eq!(summary["pictures"][0]["factor"], 1e6);
    for (a, b) in map("plain").iter().zip(map("stereo")) {
        assert!((a / b / 5.4 - 1.0).abs() < 1e-5, "{a} {b}");
    }
    let clipped = image::open(out("far").join("a_depth.png")).expect("a map").into_luma16();
    assert!(clipped.pixels().all(|p| p[0] == 65535), "the largest value");
    fails(&run(weights(), &[&path], &out("none"), &["--camera-height", "1.65"]), 1, &["a.png", "no road", "--scale"]);
}

#[test]
fn with_flip_a_mirrored_picture_gives_the_mirrored_map() {
    let place = tempfile::tempdir().expect("a folder");
    let plain = save(place.path(), "plain.png", picture(WIDTH, HEIGHT));
    let mirrored = save(place.path(), "mirrored.png", image::imageops::flip_horizontal(&picture(WIDTH, HEIGHT)));
    let difference = |out: &Path| {
        let (_, w, one) = read_npy(&out.join("plain.npy"));
        let (_, _, other) = read_npy(&out.join("mirrored.npy"));
        let back = other.chunks(w).flat_map(|row| row.iter().rev());
        one.iter().zip(back).map(|(a, b)| (a / b - 1.0).abs()).fold(0.0, f32::max)
    };
    let (with, without) = (place.path().join("with"), place.path().join("without"));
    predict(&[&plain, &mirrored], &with, &["--npy", "--flip"]);
    predict(&[&plain, &mirrored], &without, &["--npy"]);
    let (with, without) = (difference(&with), difference(&without));
    assert!(with < 1e-5 && without > 1e-3, "with: {with}, without: {without}");
}

#[test]
fn the_network_can_run_at_another_size() {
    let place = tempfile::tempdir().expect("a folder");
    let path = save(place.path(), "a.png", picture(40, 30));
    let (usual, larger) = (place.path().join("usual"), place.path().join("larger"));
    assert_eq!(predict(&[&path], &usual, &["--npy"])["width"], WIDTH);
    let summary = predict(&[&path], &larger, &["--npy", "--height", "96", "--width", "128"]);
    assert_eq!((&summary["height"], &summary["width"]), (&96.into(), &128.into()));
    let (one, other) = (read_npy(&usual.join("a.npy")), read_npy(&larger.join("a.npy")));
    assert_eq!((one.0, one.1), (other.0, other.1));
    assert!(one.2 != other.2, "the same map at another size");
}

#[test]
fn points_lie_where_the_camera_saw_them() {
    let place = tempfile::tempdir().expect("a folder");
    let path = save(place.path(), "a.png", picture(20, 10));
    let check = |more: &[&str], [fx, fy, cx, cy]: [f32; 4]| {
        let out = place.path().join("out");
        predict(&[&path], &out, &[&["--ply"], more].concat());
        let points = read_ply(&out.join("a.ply"));
        assert_eq!(points.len(), 200);
        for (i, ([x, y, z], colour)) in points.into_iter().enumerate() {
            let (u, v) = ((i % 20) as f32, (i / 20) as f32);
            assert!((fx * x / z + cx - u).abs() < 1e-3 && (fy * y / z + cy - v).abs() < 1e-3, "{more:?}, point {i}");
            assert_eq!(colour, picture(20, 10).get_pixel(u as u32, v as u32).0);
        }
    };
    check(&["--intrinsics", "30,25,9,6"], [30.0, 25.0, 9.0, 6.0]);
    check(&["--fov", "90"], [10.0, 10.0, 9.5, 4.5]);
    check(&[], [11.6, 11.6, 9.5, 4.5]);
}

#[test]
fn predicting_records_nothing_and_reuses_its_memory() {
    let (model, params, config) = load_weights(weights()).expect("weights");
    let input = Var::constant(Tensor::<f32>::zeros([1, HEIGHT as usize, WIDTH as usize, 3]));
    let outputs = model.disparities(&Context::inference(&params), &input);
    assert!(outputs.iter().all(|d| !d.is_tracked() && d.tape().is_none()));
    drop(outputs);
    let predictor = Predictor::new(&model, &params, &config);
    let fresh = || {
        let before = pool::fresh_buffers();
        predictor.inverse_depth(&picture(WIDTH, HEIGHT), true);
        pool::fresh_buffers() - before
    };
    // On one thread, so that no two kernels hold buffers at the same time by chance.
    let taken = parallel::with_threads(1, || [fresh(), fresh(), fresh()]);
    assert_eq!(taken[1..], [0, 0], "a later picture takes new memory: {taken:?}");
}
