//! Folders of frames, KITTI odometry and Cityscapes from files that are written here.

use std::fs;

use super::*;
use crate::formats::depth_png::write_depth_png;

const PLAIN: Options = Options { cache_bytes: 1 << 20, ..PLAIN_DEFAULT };
const PLAIN_DEFAULT: Options = Options {
    neighbours: true,
    stereo: false,
    with_depth: false,
    camera: Camera::Fov { degrees: 60.0 },
    skip_bad_frames: false,
    cache_bytes: 0,
};

fn write(path: &Path, size: (u32, u32)) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    RgbImage::from_fn(size.0, size.1, |x, y| image::Rgb([x as u8, y as u8, 90])).save(path).unwrap();
}

fn folder(files: &[&str]) -> tempfile::TempDir {
    let root = tempfile::tempdir().unwrap();
    files.iter().for_each(|file| write(&root.path().join(file), (12, 8)));
    root
}

fn names(frames: &Frames) -> Vec<String> {
    (0..frames.len()).map(|sample| frames.name(sample)).collect()
}

fn open(root: &Path, list: Option<&str>, options: Options) -> Result<Frames> {
    let list = list.map(|text| {
        let path = root.join("list.txt");
        fs::write(&path, text).unwrap();
        path
    });
    Frames::open(root, list.as_deref(), [8, 12], options)
}

fn message(result: Result<Frames>) -> String {
    result.map(|frames| names(&frames)).unwrap_err().to_string()
}

#[test]
fn frames_come_in_natural_order_and_sequences_by_folder() {
    let root = folder(&["f10.png", "f9.png", "f8.png", "f11.jpg", "b/1.png", "b/2.png", "b/3.png", "c/deep/x.webp"]);
    let frames = open(root.path(), None, PLAIN).unwrap();
    assert_eq!(names(&frames), [". f9", ". f10", "b 2"]);
    assert_eq!(frames.place(0).sequence, frames.place(1).sequence);
    assert_ne!(frames.place(1).sequence, frames.place(2).sequence);
    assert_eq!(frames.image(0, -1).unwrap().dimensions(), (12, 8));
    assert!(frames.image(1, 2).unwrap_err().to_string().contains("f10.png"));
    let alone = Options { neighbours: false, ..PLAIN };
    assert_eq!(open(root.path(), None, alone).unwrap().len(), 8);
}

#[test]
fn every_sequence_has_its_own_camera() {
    let root = folder(&["a/1.png", "a/2.png", "a/3.png", "b/1.png", "b/2.png", "b/3.png"]);
    fs::write(root.path().join("camera.toml"), "fov = 90").unwrap();
    fs::write(root.path().join("b/camera.toml"), "width = 24\nheight = 16\nfx = 18\nfy = 18\ncx = 10\ncy = 7").unwrap();
    let frames = open(root.path(), None, Options { camera: Camera::Auto, ..PLAIN }).unwrap();
    assert_eq!(frames.cameras().len(), 2);
    assert!((frames.intrinsics(0).fx - 0.5).abs() < 1e-12);
    let expected = Intrinsics { fx: 0.75, fy: 18.0 / 16.0, cx: 10.0 / 24.0, cy: 7.0 / 16.0 };
    assert_eq!(frames.intrinsics(1), expected);
}

#[test]
fn depth_lies_beside_the_frames() {
    let root = folder(&["a/1.png", "a/2.png", "a/3.png", "a/4.png"]);
    let depth = DepthMap { width: 2, height: 1, metres: vec![4.0, 0.0] };
    fs::create_dir_all(root.path().join("a/depth")).unwrap();
    write_depth_png(root.path().join("a/depth/2.png"), &depth).unwrap();
    let frames = open(root.path(), None, PLAIN).unwrap();
    assert_eq!(names(&frames), ["a 2", "a 3"]);
    assert_eq!((frames.depth(0).unwrap(), frames.depth(1).unwrap()), (Some(depth), None));
    let measured = Options { neighbours: false, with_depth: true, ..PLAIN };
    let measured = open(root.path(), None, measured).unwrap();
    assert_eq!(names(&measured), ["a 2"]);
    assert_eq!(measured.left_out().without_depth, 3);
    assert!(measured.left_out().first_depth.as_ref().unwrap().ends_with("a/depth/1.png"));
}

#[test]
fn a_list_names_frames() {
    let root = folder(&["a/1.png", "a/2.png", "a/3.png", "a/4.png"]);
    let listed = open(root.path(), Some("\u{feff}a  3\r\n\r\na 2\t\r\n"), PLAIN).unwrap();
    assert_eq!(names(&listed), ["a 3", "a 2"]);
    for (list, line) in [("a 2\na 1", "line 2"), ("a 2 l", "line 1"), ("", "blank")] {
        let error = message(open(root.path(), Some(list), PLAIN));
        assert!(error.contains("list.txt") && error.contains(line), "{error}");
    }
}

#[test]
fn what_cannot_be_a_sequence_is_an_error_that_says_why() {
    let two = folder(&["1.png", "2.png"]);
    assert!(message(open(two.path(), None, PLAIN)).contains("three frames at least"));
    let mixed = folder(&["1.png", "2.png", "3.png"]);
    write(&mixed.path().join("2.png"), (10, 8));
    let error = message(open(mixed.path(), None, PLAIN));
    assert!(error.contains("2.png") && error.contains("10x8") && error.contains("12x8"), "{error}");
    let bad = folder(&["1.png", "2.png", "3.png", "4.png", "5.png", "6.png"]);
    fs::write(bad.path().join("2.png"), b"no picture").unwrap();
    assert!(message(open(bad.path(), None, PLAIN)).contains("2.png"));
    let skipping = open(bad.path(), None, Options { skip_bad_frames: true, ..PLAIN }).unwrap();
    assert_eq!((names(&skipping), skipping.unreadable().len()), (vec![". 4".into(), ". 5".into()], 1));
    assert!(message(open(&bad.path().join("nowhere"), None, PLAIN)).contains("nowhere"));
    let empty = tempfile::tempdir().unwrap();
    let error = message(open(empty.path(), None, PLAIN));
    assert!(error.contains("no PNG, JPEG or WebP") && error.contains("sequences/NN/image_2"), "{error}");
    let deep = folder(&["kitti/day/drive/image_02/data/1.png"]);
    let error = message(open(deep.path(), None, PLAIN));
    assert!(error.contains("image_02/data") && error.contains("holds the dates"), "{error}");
}

/// A picture of which every pixel has one colour.
fn plain(path: &Path, size: (u32, u32), colour: [u8; 3]) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    RgbImage::from_pixel(size.0, size.1, image::Rgb(colour)).save(path).unwrap();
}

const STEREO: Options = Options { stereo: true, ..AUTO };
const AUTO: Options = Options { camera: Camera::Auto, ..PLAIN };

/// Sequences 08 and 09 of KITTI odometry, four frames each, the right camera's last one missing in 09.
fn odometry() -> tempfile::TempDir {
    let root = tempfile::tempdir().unwrap();
    for sequence in ["08", "09"] {
        let folder = root.path().join("sequences").join(sequence);
        for (camera, red) in [(2, 20), (3, 90)] {
            let frames = if (sequence, camera) == ("09", 3) { 0..3 } else { 0..4 };
            for number in frames {
                plain(&folder.join(format!("image_{camera}/{number:06}.png")), (24, 16), [red + number as u8, 0, 0]);
            }
        }
        let lines = "P0: 12 0 11 0 0 13 7 0 0 0 1 0\nP1: 12 0 11 -6 0 13 7 0 0 0 1 0\n\
                     P2: 12 0 11 0.6 0 13 7 0 0 0 1 0\nP3: 12 0 11 -5.4 0 13 7 0 0 0 1 0\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n";
        fs::write(folder.join("calib.txt"), lines).unwrap();
    }
    root
}

#[test]
fn kitti_odometry_is_read_from_its_layout() {
    let root = odometry();
    let frames = open(root.path(), None, AUTO).unwrap();
    let all = ["08 1 l", "08 2 l", "08 1 r", "08 2 r", "09 1 l", "09 2 l", "09 1 r"];
    assert_eq!(names(&frames), all);
    assert_eq!(frames.intrinsics(0), Intrinsics { fx: 0.5, fy: 13.0 / 16.0, cx: 11.0 / 24.0, cy: 7.0 / 16.0 });
    // Both cameras are one recording.
    assert_eq!((frames.place(0), frames.recording(0)), (frames.place(2), "08".to_owned()));
    assert_ne!(frames.place(0).sequence, frames.place(4).sequence);
    assert_eq!(frames.image(6, 1).unwrap().get_pixel(0, 0).0[0], 92);
    assert_eq!(frames.other_camera_at(0), None);
    let pairs = open(root.path(), None, STEREO).unwrap();
    assert_eq!(names(&pairs), all);
    assert!((pairs.other_camera_at(0).unwrap() + 0.5).abs() < 1e-12 && pairs.other_camera_at(2).unwrap() > 0.0);
    assert_eq!(pairs.other_image(1).unwrap().get_pixel(0, 0).0[0], 92);
    assert!(pairs.cameras().iter().any(|line| line.contains("pairs 0.5000 m")), "{:?}", pairs.cameras());
    // A sequence, or the folder of all, may be the root.
    assert_eq!(open(&root.path().join("sequences"), None, AUTO).unwrap().len(), 7);
    assert_eq!(names(&open(&root.path().join("sequences/09"), None, AUTO).unwrap()), all[4..]);
}

#[test]
fn lists_of_kitti_odometry_are_as_published_ones_are() {
    let root = odometry();
    let listed = open(root.path(), Some("9 1 l\r\n8 000002\tr \nsequences/08 1 l\n"), AUTO).unwrap();
    assert_eq!(names(&listed), ["09 1 l", "08 2 r", "08 1 l"]);
    for (list, what) in
        [("9 1 left", "side l"), ("9 3 l", "such as `08 1 l`"), ("7 1 l", "line 1"), ("9 1", "2 fields")]
    {
        let error = message(open(root.path(), Some(list), AUTO));
        assert!(error.contains("list.txt") && error.contains(what), "{error}");
    }
}

#[test]
fn a_broken_calibration_of_kitti_odometry_is_named() {
    for (lines, what) in [
        ("P2: 12 0 11 0.6\n", "P2: expected 12 numbers, found 4"),
        ("P0: 12 0 11 0 0 13 7 0 0 0 1 0\n", "P2: expected 12 numbers, found no such line"),
        ("P2: 12 0 99 0 0 13 7 0 0 0 1 0\n", "outside the picture"),
        ("P2: 12 0 11 0 0 13 7 0 0 0 1 0\nP3: 12 0 11 9 0 13 7 0 0 0 1 0\n", "stands -0.75 m"),
    ] {
        let root = odometry();
        fs::write(root.path().join("sequences/09/calib.txt"), lines).unwrap();
        let error = message(open(root.path(), None, STEREO));
        assert!(error.contains("09/calib.txt") && error.contains(what), "{error}");
        // Whoever says the camera needs no calibration.
        assert_eq!(open(root.path(), None, PLAIN).unwrap().len(), 7);
    }
    let error = message(open(odometry().path(), None, Options { with_depth: true, ..PLAIN }));
    assert!(error.contains("KITTI odometry has none"), "{error}");
}

/// A snippet of four frames of Cityscapes and a lonely frame, 64x32, whose lower quarter is white.
fn cityscapes() -> tempfile::TempDir {
    let root = tempfile::tempdir().unwrap();
    for (side, red) in [("left", 40), ("right", 80)] {
        for number in [16, 17, 18, 19, 40] {
            let name = format!("{side}Img8bit_sequence/train/aachen/aachen_000003_{number:06}_{side}Img8bit.png");
            let path = root.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            let pixel = |_, y| image::Rgb(if y < 24 { [red + number as u8, 0, 0] } else { [255; 3] });
            RgbImage::from_fn(64, 32, pixel).save(path).unwrap();
        }
    }
    let camera = root.path().join("camera/train/aachen/aachen_000003_000019_camera.json");
    fs::create_dir_all(camera.parent().unwrap()).unwrap();
    let json = r#"{"extrinsic": {"baseline": 0.25, "pitch": 0.03}, "intrinsic": {"fx": 2048, "fy": 2304, "u0": 1000, "v0": 500}}"#;
    fs::write(camera, json).unwrap();
    root
}

#[test]
fn cityscapes_is_read_from_its_layout_without_the_bonnet() {
    let root = cityscapes();
    let camera = Camera::Auto;
    let frames = open(root.path(), None, AUTO).unwrap();
    let street = "train/aachen/aachen_000003";
    assert_eq!(names(&frames), ["17 l", "18 l", "17 r", "18 r"].map(|frame| format!("{street} {frame}")));
    // Of 768 of 1024 rows.
    assert_eq!(frames.intrinsics(0), Intrinsics { fx: 1.0, fy: 3.0, cx: 1000.0 / 2048.0, cy: 500.0 / 768.0 });
    assert!(frames.image(0, -1).unwrap().pixels().all(|pixel| pixel.0 == [56, 0, 0]));
    assert_eq!(frames.place(0), frames.place(2));
    let pairs = open(root.path(), Some(&format!("{street} 18 l\n")), STEREO).unwrap();
    assert_eq!((pairs.len(), pairs.other_camera_at(0)), (1, Some(-0.25)));
    assert_eq!(pairs.other_image(0).unwrap().get_pixel(3, 7).0, [98, 0, 0]);
    // Disparity of 2 pixels, and of none: (p - 1) / 256.
    let disparity =
        image::ImageBuffer::from_fn(64, 32, |x, y| image::Luma([if x == 1 { 0u16 } else { 513 } + y as u16 / 24]));
    let folder = root.path().join("disparity_sequence/train/aachen");
    fs::create_dir_all(&folder).unwrap();
    disparity.save(folder.join("aachen_000003_000018_disparity.png")).unwrap();
    let measured = open(root.path(), None, Options { neighbours: false, with_depth: true, camera, ..PLAIN }).unwrap();
    assert_eq!(names(&measured), [format!("{street} 18 l")]);
    let depth = measured.depth(0).unwrap().unwrap();
    assert_eq!((depth.width, depth.height), (64, 24));
    assert_eq!((depth.metres[0], depth.metres[1]), (256.0, 0.0));
}

#[test]
fn what_is_wrong_with_cityscapes_is_named() {
    let root = cityscapes();
    let camera = root.path().join("camera/train/aachen/aachen_000003_000019_camera.json");
    for (json, what) in [
        ("{", "line 1"),
        (r#"{"extrinsic": {"baseline": 0.2}}"#, "intrinsic"),
        (
            r#"{"extrinsic": {"baseline": 0.2}, "intrinsic": {"fx": 2048, "fy": 2304, "u0": 4000, "v0": 500}}"#,
            "outside the picture",
        ),
    ] {
        fs::write(&camera, json).unwrap();
        let error = message(open(root.path(), None, AUTO));
        assert!(error.contains("camera.json") && error.contains(what), "{error}");
    }
    fs::remove_file(&camera).unwrap();
    let error = message(open(root.path(), None, AUTO));
    assert!(error.contains("aachen_000003_000016_camera.json") && error.contains("--intrinsics"), "{error}");
    let odd = root.path().join("leftImg8bit_sequence/train/aachen/aachen.png");
    plain(&odd, (64, 32), [0; 3]);
    assert!(
        message(open(root.path(), None, AUTO)).contains("expected a name like aachen_000000_000019_leftImg8bit.png")
    );
}

#[test]
fn right_pictures_lie_where_patterns_say() {
    let camera = "width = 12\nheight = 8\nfx = 6\nfy = 6\ncx = 6\ncy = 4\nbaseline = 0.3\n";
    for (patterns, left, right, depth) in [
        ("", "a/{}.png", "a/right/{}.jpg", "a/depth/{}.png"),
        ("right = \"../r/{}_r\"\ndepth = \"../d/{}\"", "a/{}.png", "r/{}_r.png", "d/{}.png"),
        ("frames = \"left_{}\"\nright = \"right_{}\"", "a/left_{}.png", "a/right_{}.png", "a/depth/{}.png"),
    ] {
        let root = tempfile::tempdir().unwrap();
        for number in ["1", "2", "3"] {
            plain(&root.path().join(left.replace("{}", number)), (12, 8), [10, 0, 0]);
            plain(&root.path().join(right.replace("{}", number)), (12, 8), [200, 0, 0]);
        }
        let map = root.path().join(depth.replace("{}", "2"));
        fs::create_dir_all(map.parent().unwrap()).unwrap();
        write_depth_png(&map, &DepthMap { width: 1, height: 1, metres: vec![4.0] }).unwrap();
        fs::write(root.path().join("camera.toml"), format!("{camera}{patterns}")).unwrap();
        let pairs = open(root.path(), None, STEREO).unwrap();
        assert_eq!(pairs.len(), 1, "{patterns}: {:?}", names(&pairs));
        assert_eq!((pairs.other_camera_at(0), pairs.depth(0).unwrap().is_some()), (Some(-0.3), true), "{patterns}");
        assert!(pairs.other_image(0).unwrap().get_pixel(0, 0).0[0] > 190);
        // The right pictures are no sequence of their own.
        assert_eq!(open(root.path(), None, AUTO).unwrap().len(), 1, "{patterns}");
    }
}

#[test]
fn pairs_that_cannot_be_used_are_errors_that_say_why() {
    let root = folder(&["a/1.png", "a/2.png", "a/3.png"]);
    let stereo = Options { stereo: true, ..PLAIN };
    let error = message(open(root.path(), None, stereo));
    assert!(error.contains("right/NAME") && error.contains("--sources mono"), "{error}");
    write(&root.path().join("a/right/2.png"), (12, 8));
    let error = message(open(root.path(), None, stereo));
    assert!(error.contains("baseline = METRES"), "{error}");
    for (said, what) in [
        ("baseline = -1", "baseline = -1"),
        ("right = \"right\"", "right = \"right\""),
        ("frames = \"x{}\"", "frames = \"..\""),
        ("left = 3", "left"),
    ] {
        fs::write(root.path().join("camera.toml"), said).unwrap();
        let error = message(open(root.path(), None, stereo));
        assert!(error.contains(what), "{error}");
    }
    fs::write(root.path().join("camera.toml"), "baseline = 0.3").unwrap();
    write(&root.path().join("a/right/2.png"), (14, 8));
    assert!(message(open(root.path(), None, stereo)).contains("14x8"));
}
