//! Data sets made here, and the real piece where it is named.

use std::fs;

use image::Rgb;

use super::*;
use crate::formats::depth_png::write_depth_png;
use crate::test_support::{fixture_bytes, kitti};

/// Writes a drive `day/drive` with frames `numbers` of both cameras, 24x16.
fn made_up(numbers: std::ops::Range<u32>) -> tempfile::TempDir {
    let root = tempfile::tempdir().unwrap();
    for (camera, blue) in [("image_02", 20), ("image_03", 90)] {
        let folder = root.path().join("day/drive").join(camera).join("data");
        fs::create_dir_all(&folder).unwrap();
        for number in numbers.clone() {
            let picture = RgbImage::from_pixel(24, 16, Rgb([number as u8 * 10, 200, blue]));
            picture.save(folder.join(format!("{number:010}.png"))).unwrap();
        }
    }
    root
}

fn split(root: &Path, text: &str) -> PathBuf {
    let path = root.join("split.txt");
    fs::write(&path, text).unwrap();
    path
}

fn names(kitti: &Kitti) -> Vec<String> {
    (0..kitti.len()).map(|i| kitti.name(i)).collect()
}

fn open(root: &Path, lines: Option<&str>, options: Options) -> Result<Kitti> {
    let split = lines.map(|lines| split(root, lines));
    Kitti::open(root, split.as_deref(), 8, 12, options)
}

fn message(result: Result<Kitti>) -> String {
    result.map(|kitti| names(&kitti)).unwrap_err().to_string()
}

const PUBLISHED: Options = Options { neighbours: true, cache_bytes: 1 << 20, ..TARGET_ONLY };

const TARGET_ONLY: Options = Options {
    neighbours: false,
    stereo: false,
    camera: Camera::KittiPublished,
    ground_truth: GroundTruth::Auto,
    skip_bad_frames: false,
    cache_bytes: 0,
};

#[test]
fn without_a_list_every_frame_with_both_neighbours_is_a_sample() {
    let root = made_up(3..7);
    let kitti = open(root.path(), None, PUBLISHED).unwrap();
    assert_eq!(names(&kitti), ["day/drive 4 l", "day/drive 5 l", "day/drive 4 r", "day/drive 5 r"]);
    assert_eq!(open(root.path(), None, TARGET_ONLY).unwrap().len(), 8);
    fs::remove_file(root.path().join("day/drive/image_02/data/0000000005.png")).unwrap();
    assert_eq!(names(&open(root.path(), None, PUBLISHED).unwrap()), ["day/drive 4 r", "day/drive 5 r"]);
    let stereo = open(root.path(), None, Options { stereo: true, ..PUBLISHED }).unwrap();
    assert_eq!(names(&stereo), ["day/drive 4 r"]);
}

#[test]
fn frames_come_at_the_size_asked_for_and_in_the_order_of_time() {
    let root = made_up(3..7);
    let kitti = open(root.path(), Some("day/drive 5 r\nday/drive 4 l\n"), PUBLISHED).unwrap();
    assert_eq!(names(&kitti), ["day/drive 5 r", "day/drive 4 l"]);
    for (offset, red) in [(-1, 40), (0, 50), (1, 60)] {
        let picture = kitti.image(0, offset).unwrap();
        assert_eq!(picture.dimensions(), (12, 8));
        assert!(picture.pixels().all(|p| p.0 == [red, 200, 90]));
    }
    assert_eq!(kitti.other_image(0).unwrap().get_pixel(0, 0).0, [50, 200, 20]);
    assert_eq!(kitti.intrinsics(0), Intrinsics::KITTI);
    assert_eq!(kitti.depth(0).unwrap(), None);
    assert!(kitti.path(1, 1).unwrap().ends_with("day/drive/image_02/data/0000000005.png"));
    // Frame 7 was never there, and nobody asked for it at opening.
    assert!(kitti.image(0, 2).unwrap_err().to_string().contains("0000000007.png"));
}

#[test]
fn the_cache_keeps_what_its_cap_allows() {
    let root = made_up(3..7);
    let frame = 12 * 8 * 3;
    let kitti = open(root.path(), None, Options { cache_bytes: 2 * frame + 1, ..PUBLISHED }).unwrap();
    for offset in [-1, 0, 1] {
        kitti.image(0, offset).unwrap();
    }
    assert_eq!(kitti.pictures.held(), (2, 2 * frame));
    assert!(Arc::ptr_eq(&kitti.image(0, 0).unwrap(), &kitti.image(1, -1).unwrap()));
    assert!(!Arc::ptr_eq(&kitti.image(0, 1).unwrap(), &kitti.image(0, 1).unwrap()));
}

#[test]
fn lines_that_point_nowhere_name_list_line_and_path() {
    let root = made_up(3..7);
    for (line, what) in [
        ("day/other 5 l", "day/other"),
        ("day/drive 9 l", "image_02/data/0000000009.png: the frame is missing"),
        ("day/drive 3 l", "image_02/data/0000000002.png: the frame before frame 3 is missing"),
        ("day/drive 6 r", "image_03/data/0000000007.png: the frame after frame 6 is missing"),
        ("day/drive 5", "found 2 fields"),
    ] {
        let error = message(open(root.path(), Some(&format!("day/drive 4 l\n\n{line}\n")), Options::default()));
        assert!(error.contains("split.txt: line 3: ") && error.contains(what), "{error}");
    }
    let first = made_up(0..3);
    let error = message(open(first.path(), Some("day/drive 0 l"), Options::default()));
    assert!(error.contains("split.txt: line 1: ") && error.contains("no previous frame"), "{error}");
    assert!(open(first.path(), Some("day/drive 0 l"), TARGET_ONLY).is_ok());
}

#[test]
fn what_cannot_be_used_is_found_at_opening() {
    let root = made_up(3..7);
    let neighbour = root.path().join("day/drive/image_02/data/0000000004.png");
    fs::write(&neighbour, b"not a picture").unwrap();
    for lines in [None, Some("day/drive 5 l\n")] {
        let error = message(open(root.path(), lines, Options::default()));
        assert!(error.contains("0000000004.png") && error.contains("could not decode"), "{error}");
    }
    for (root, what) in [(root.path().join("nowhere"), "nowhere"), (neighbour.clone(), "0000000004.png")] {
        assert!(message(Kitti::open(&root, None, 8, 12, Options::default())).contains(what));
    }
    let empty = tempfile::tempdir().unwrap();
    assert!(message(open(empty.path(), None, Options::default())).contains("no frames with both neighbours"));
    assert!(message(open(root.path(), Some("\n\n"), Options::default())).contains("no samples"));
    assert!(message(Kitti::open(root.path(), None, 0, 12, Options::default())).contains("height"));
    let lidar = Options { ground_truth: GroundTruth::Lidar(DepthAxis::CameraZ), ..TARGET_ONLY };
    assert!(message(open(root.path(), Some("day/drive 5 l"), lidar)).contains("calib_cam_to_cam.txt"));
    let calibrated = Options { camera: Camera::Calibrated, ..TARGET_ONLY };
    assert!(message(open(root.path(), Some("day/drive 5 l"), calibrated)).contains("calib_cam_to_cam.txt"));
    let improved = Options { ground_truth: GroundTruth::Improved, ..TARGET_ONLY };
    let error = message(open(root.path(), Some("day/drive 5 l"), improved));
    assert!(error.contains("line 1") && error.contains("proj_depth/groundtruth/image_02/0000000005.png"), "{error}");
}

#[test]
fn frames_that_cannot_be_read_are_left_out_if_they_may_be() {
    let root = made_up(3..9);
    fs::write(root.path().join("day/drive/image_02/data/0000000008.png"), b"not a picture").unwrap();
    let skipping = Options { skip_bad_frames: true, ..PUBLISHED };
    let list = "day/drive 4 l\nday/drive 7 l\nday/drive 7 r";
    for (lines, expected) in [(Some(list), 2), (None, 7)] {
        assert!(message(open(root.path(), lines, PUBLISHED)).contains("0000000008.png"));
        let kitti = open(root.path(), lines, skipping).unwrap();
        assert_eq!(kitti.len(), expected);
        let [(name, why)] = kitti.unreadable() else { panic!("{:?}", kitti.unreadable()) };
        assert!(name == "day/drive 7 l" && why.contains("0000000008.png") && why.contains("decode"), "{name}: {why}");
    }
    let error = message(open(root.path(), Some("day/drive 7 l"), skipping));
    assert!(error.contains("split.txt") && error.contains("0000000008.png"), "{error}");
    // What a list should not have named is an error all the same.
    assert!(
        message(open(root.path(), Some("day/drive 9 l"), skipping)).contains("0000000009.png: the frame is missing")
    );
}

#[test]
fn ground_truth_that_cannot_be_read_is_left_out_with_its_frame() {
    let root = made_up(3..9);
    let depth = DepthMap { width: 3, height: 2, metres: vec![1.0; 6] };
    let path = |frame: u32| root.path().join(format!("day/drive/proj_depth/groundtruth/image_02/{frame:010}.png"));
    for frame in [4, 5] {
        write_depth_png(path(frame), &depth).unwrap();
    }
    fs::write(path(6), b"no picture").unwrap();
    let improved = Options { ground_truth: GroundTruth::Improved, ..TARGET_ONLY };
    let skipping = Options { skip_bad_frames: true, ..improved };
    for lines in [Some("day/drive 4 l\nday/drive 5 l\nday/drive 6 l"), None] {
        assert!(message(open(root.path(), lines, improved)).contains("0000000006.png"));
        let kitti = open(root.path(), lines, skipping).unwrap();
        assert_eq!(names(&kitti), ["day/drive 4 l", "day/drive 5 l"]);
        let [(name, why)] = kitti.unreadable() else { panic!("{:?}", kitti.unreadable()) };
        assert!(name == "day/drive 6 l" && why.contains("0000000006.png"), "{name}: {why}");
    }
}

#[test]
fn a_picture_that_is_cut_is_an_error_with_its_path() {
    let root = made_up(3..7);
    let path = root.path().join("day/drive/image_02/data/0000000005.png");
    let picture =
        RgbImage::from_fn(24, 16, |x, y| Rgb([((x * 31) ^ (y * 17)) as u8, (x * y * 7) as u8, (x + 9 * y) as u8]));
    picture.save(&path).unwrap();
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let kitti = open(root.path(), Some("day/drive 5 l"), TARGET_ONLY).unwrap();
    let error = kitti.image(0, 0).unwrap_err().to_string();
    assert!(error.contains("0000000005.png") && error.contains("cut short"), "{error}");
}

#[test]
fn frames_without_the_depth_that_was_asked_for_are_counted_and_say_where_it_was_looked_for() {
    let root = made_up(3..7);
    let with = |ground_truth| Options { ground_truth, ..TARGET_ONLY };
    for (ground_truth, what, place) in [
        (GroundTruth::Improved, "the improved ground truth", "proj_depth/groundtruth/image_02/0000000003.png"),
        (GroundTruth::Lidar(DepthAxis::CameraZ), "the LiDAR scan", "velodyne_points/data/0000000003.bin"),
    ] {
        if ground_truth != GroundTruth::Improved {
            fs::write(root.path().join("day/calib_velo_to_cam.txt"), "R: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n").unwrap();
            let lines = "S_rect_02: 24 16\nS_rect_03: 24 16\nR_rect_00: 1 0 0 0 1 0 0 0 1\n\
                         P_rect_02: 12 0 11 0 0 12 7 0 0 0 1 0\nP_rect_03: 12 0 13 0 0 12 7 0 0 0 1 0\n";
            fs::write(root.path().join("day/calib_cam_to_cam.txt"), lines).unwrap();
        }
        let error = message(open(root.path(), None, with(ground_truth)));
        for part in ["8 frames lack it;", what, place] {
            assert!(error.contains(part), "{part}: {error}");
        }
        let error = message(open(root.path(), None, Options { neighbours: true, ..with(ground_truth) }));
        assert!(error.contains("4 frames lack it, and 4 more lack a neighbour"), "{error}");
    }
    // With pictures alone missing, depth is not what is missed.
    let error = message(open(made_up(3..5).path(), None, PUBLISHED));
    assert!(
        error.contains("with both neighbours") && error.contains("4 frames") && !error.contains("depth"),
        "{error}"
    );
    // Where some have it, the others are counted.
    let depth = DepthMap { width: 1, height: 1, metres: vec![2.0] };
    write_depth_png(root.path().join("day/drive/proj_depth/groundtruth/image_03/0000000005.png"), &depth).unwrap();
    let kitti = open(root.path(), None, with(GroundTruth::Improved)).unwrap();
    assert_eq!((kitti.len(), kitti.left_out().without_depth), (1, 7));
    let list = "day/drive 5 r\nday/drive 5 l\nday/drive 6 l";
    let error = message(open(root.path(), Some(list), with(GroundTruth::Improved)));
    assert!(error.contains("line 2") && error.contains("2 of the list's 3 frames lack it"), "{error}");
}

#[test]
fn frames_are_found_by_any_ending() {
    let root = made_up(3..7);
    let data = root.path().join("day/drive/image_02/data");
    for (number, ending) in [(3, "JPG"), (4, "jpeg"), (5, "webp"), (6, "PNG")] {
        let old = data.join(format!("{number:010}.png"));
        let picture = image::open(&old).unwrap();
        fs::remove_file(&old).unwrap();
        picture.save(data.join(format!("{number:010}.{ending}"))).unwrap();
    }
    let kitti = open(root.path(), None, TARGET_ONLY).unwrap();
    assert_eq!(kitti.len(), 8);
    for sample in 0..4 {
        let red = kitti.image(sample, 0).unwrap().get_pixel(0, 0)[0];
        assert!(red.abs_diff(10 * (sample as u8 + 3)) < 4, "{red} of frame {}", kitti.name(sample));
    }
    assert!(open(root.path(), Some("day/drive 4 l\n./day/drive 5 l"), PUBLISHED).is_ok());
}

#[test]
fn spellings_of_a_drive_are_one_drive() {
    let root = made_up(3..7);
    let kitti = open(root.path(), Some("day/drive 4 l\n./day//drive/ 4 l"), PUBLISHED).unwrap();
    assert_eq!(names(&kitti), ["day/drive 4 l", "day/drive 4 l"]);
    assert_eq!(kitti.drives.len(), 1);
}

#[test]
fn depth_files_are_found_by_camera() {
    let root = made_up(3..7);
    let depth = DepthMap { width: 3, height: 2, metres: vec![0.0, 1.5, 2.0, 80.0, 0.25, 10.0] };
    let path = root.path().join("day/drive/proj_depth/groundtruth/image_03/0000000005.png");
    write_depth_png(&path, &depth).unwrap();
    let kitti = open(root.path(), Some("day/drive 5 l\nday/drive 5 r"), TARGET_ONLY).unwrap();
    assert_eq!(kitti.depth(0).unwrap(), None);
    assert_eq!(kitti.depth(1).unwrap(), Some(depth));
    let improved = Options { ground_truth: GroundTruth::Improved, ..TARGET_ONLY };
    assert_eq!(names(&open(root.path(), None, improved).unwrap()), ["day/drive 5 r"]);
    let off = Options { ground_truth: GroundTruth::Off, ..TARGET_ONLY };
    assert_eq!(open(root.path(), Some("day/drive 5 r"), off).unwrap().depth(0).unwrap(), None);
}

#[test]
#[cfg_attr(not(kitti), ignore = "needs PARALLAX_KITTI, the folder of the real KITTI piece")]
fn lidar_projects_to_the_reference_depths() {
    let reference: serde_json::Value = serde_json::from_slice(&fixture_bytes("kitti_depth.json")).unwrap();
    let root = kitti();
    let lines = tempfile::tempdir().unwrap();
    let lines =
        split(lines.path(), "2011_09_26/2011_09_26_drive_0001_sync 5 l\n2011_09_26/2011_09_26_drive_0001_sync 5 r");
    for (axis, kind) in [(DepthAxis::CameraZ, "camera_z"), (DepthAxis::LidarX, "lidar_x")] {
        let options = Options { ground_truth: GroundTruth::Lidar(axis), ..TARGET_ONLY };
        let kitti = Kitti::open(&root, Some(&lines), 96, 320, options).unwrap();
        for (sample, camera) in [(0, "image_02"), (1, "image_03")] {
            let expected = &reference["maps"][format!("{camera}/{kind}")];
            let depth = kitti.depth(sample).unwrap().unwrap();
            assert_eq!((depth.height, depth.width), (375, 1242));
            let valid = depth.metres.iter().filter(|&&d| d > 0.0).count();
            assert_eq!(valid as u64, expected["valid"].as_u64().unwrap(), "{camera}/{kind}");
            let sum: f64 = depth.metres.iter().map(|&d| f64::from(d)).sum();
            assert!((sum / expected["sum"].as_f64().unwrap() - 1.0).abs() < 1e-7, "{camera}/{kind} {sum}");
            let samples = expected["samples"].as_array().unwrap();
            assert_eq!(samples.len(), 60);
            for s in samples {
                let (row, column) = (s[0].as_u64().unwrap() as usize, s[1].as_u64().unwrap() as usize);
                let found = f64::from(depth.metres[row * 1242 + column]);
                assert!((found / s[2].as_f64().unwrap() - 1.0).abs() < 1e-6, "{camera}/{kind} {row} {column} {found}");
            }
        }
    }
}

#[test]
#[cfg_attr(not(kitti), ignore = "needs PARALLAX_KITTI, the folder of the real KITTI piece")]
fn the_real_lists_open() {
    let root = kitti();
    let open = |list: &str, options| Kitti::open(&root, Some(&root.join("splits").join(list)), 96, 320, options);
    let train = open("train_files.txt", Options { camera: Camera::Calibrated, ..Options::default() }).unwrap();
    assert_eq!(train.len(), 54);
    let camera = train.intrinsics(0);
    assert!((camera.fx * 1242.0 - 721.5377).abs() < 1e-9 && (camera.cy * 375.0 - 172.854).abs() < 1e-9);
    assert!(train.image(0, -1).unwrap() != train.image(0, 0).unwrap());
    let improved = open("improved_files.txt", Options { ground_truth: GroundTruth::Improved, ..TARGET_ONLY }).unwrap();
    let scan =
        open("improved_files.txt", Options { ground_truth: GroundTruth::Lidar(DepthAxis::CameraZ), ..TARGET_ONLY });
    let scan = scan.unwrap();
    assert_eq!(
        open("lidar_files.txt", Options { ground_truth: GroundTruth::Lidar(DepthAxis::LidarX), ..TARGET_ONLY })
            .unwrap()
            .len(),
        7
    );
    // The improved ground truth is accumulated over frames and filtered; where both know a pixel or its neighbour,
    // most of the depths agree.
    let (improved, scan) = (improved.depth(0).unwrap().unwrap(), scan.depth(0).unwrap().unwrap());
    let both: Vec<f32> = improved
        .metres
        .iter()
        .zip(&scan.metres)
        .filter(|(a, b)| **a > 0.0 && **b > 0.0)
        .map(|(a, b)| (a / b - 1.0).abs())
        .collect();
    let close = both.iter().filter(|&&d| d < 0.05).count();
    assert!(both.len() > 5000 && close * 10 > both.len() * 8, "{close} of {}", both.len());
}

#[test]
#[cfg_attr(not(kitti), ignore = "needs PARALLAX_KITTI, the folder of the real KITTI piece")]
fn without_a_list_the_real_piece_gives_its_triplets() {
    let kitti = Kitti::open(&kitti(), None, 96, 320, Options::default()).unwrap();
    // 44 of the drive with 46 frames, twice 5 of the one with 7.
    assert_eq!(kitti.len(), 54);
    // By itself the depth is the scan's where there is one: frames 8, 16, 24, 32 and 40 of the long drive.
    let with_depth = (0..kitti.len()).filter(|&i| kitti.depth(i).unwrap().is_some()).count();
    assert_eq!(with_depth, 5);
}

#[test]
fn a_mirrored_picture_has_a_mirrored_camera_but_for_the_published_constants() {
    let root = made_up(3..7);
    let pixels = Camera::Pixels { fx: 12.0, fy: 12.0, cx: 6.0, cy: 7.0 };
    for (camera, cx) in [(pixels, 1.0 - 1.0 / 12.0 - 0.25), (Camera::KittiPublished, 0.5)] {
        let kitti = open(root.path(), Some("day/drive 5 r"), Options { camera, ..PUBLISHED }).unwrap();
        let whole = crate::data::Subset::new(Arc::new(kitti), vec![0]);
        let mirrored = whole.mirrored_intrinsics(0, 12);
        assert!((mirrored.cx - cx).abs() < 1e-12, "{mirrored:?}");
        assert_eq!(Intrinsics { cx: whole.intrinsics(0).cx, ..mirrored }, whole.intrinsics(0));
    }
}

#[test]
fn a_measured_camera_needs_no_lidar() {
    let root = made_up(3..7);
    let lines = "S_rect_02: 24 16\nS_rect_03: 24 16\nP_rect_02: 12 0 11 0 0 12 7 0 0 0 1 0\n\
                 P_rect_03: 12 0 13 0 0 12 7 0 0 0 1 0\n";
    fs::write(root.path().join("day/calib_cam_to_cam.txt"), lines).unwrap();
    let scan = root.path().join("day/drive/velodyne_points/data/0000000005.bin");
    fs::create_dir_all(scan.parent().unwrap()).unwrap();
    fs::write(&scan, [0; 32]).unwrap();
    let calibrated = Options { camera: Camera::Calibrated, ..TARGET_ONLY };
    let kitti = open(root.path(), Some("day/drive 5 r"), calibrated).unwrap();
    assert_eq!(kitti.intrinsics(0), Intrinsics { fx: 0.5, fy: 0.75, cx: 13.0 / 24.0, cy: 7.0 / 16.0 });
    // Without the LiDAR's calibration its scan is no depth, unless it is asked for: then it is an error.
    assert_eq!(kitti.depth(0).unwrap(), None);
    let lidar = Options { ground_truth: GroundTruth::Lidar(DepthAxis::CameraZ), ..TARGET_ONLY };
    assert!(message(open(root.path(), Some("day/drive 5 r"), lidar)).contains("calib_velo_to_cam.txt"));
}

/// The calibration of a day whose cameras stand `shifts` pixels beside the first one, with principal points `cx`.
fn pair_calibration(root: &Path, shifts: [f64; 2], cx: [f64; 2]) {
    let camera = |n: usize| {
        let (cx, shift) = (cx[n - 2], shifts[n - 2]);
        format!("S_rect_0{n}: 1242 375\nP_rect_0{n}: 721.5377 0 {cx} {shift} 0 721.5377 172.854 0 0 0 1 0\n")
    };
    fs::write(root.join("day/calib_cam_to_cam.txt"), camera(2) + &camera(3)).unwrap();
}

#[test]
fn pairs_stand_as_far_apart_as_the_calibration_says() {
    let root = made_up(3..7);
    let pairs = Options { stereo: true, ..TARGET_ONLY };
    let usual = open(root.path(), None, pairs).unwrap();
    assert_eq!(usual.other_camera_at(0), Some(-0.54), "nobody says otherwise");
    assert!(
        usual.cameras().iter().any(|c| c.contains("pairs 0.5400 m apart (KITTI's usual: ")),
        "{:?}",
        usual.cameras()
    );
    pair_calibration(root.path(), [44.85728, -339.5242], [609.5593; 2]);
    let kitti = open(root.path(), Some("day/drive 4 l\nday/drive 4 r\n"), pairs).unwrap();
    let expected = (44.85728 + 339.5242) / 721.5377;
    let found = [0, 1].map(|sample| kitti.other_camera_at(sample).unwrap());
    assert!((found[0] + expected).abs() < 1e-12 && (found[1] - expected).abs() < 1e-12, "{found:?}");
    assert!(kitti.cameras().iter().any(|c| c.contains("pairs 0.5327 m apart (") && c.contains("calib_cam_to_cam")));
    assert_eq!(open(root.path(), None, TARGET_ONLY).unwrap().other_camera_at(0), None, "nobody asked");

    for (shifts, cx, what) in [
        ([44.0, -339.0], [609.5593, 604.0], "P_rect_02 has 609.5593 where P_rect_03 has 604"),
        ([-339.0, 44.0], [609.5593; 2], "stands -0.53"),
        ([44.0, 44.0], [609.5593; 2], "stands 0 m to the right"),
    ] {
        pair_calibration(root.path(), shifts, cx);
        let error = message(open(root.path(), None, pairs));
        assert!(error.contains("calib_cam_to_cam.txt") && error.contains(what), "{error}");
    }
}
