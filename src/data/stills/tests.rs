//! Data sets in their own layouts, written by the tests.

use std::fs;

use image::{ImageBuffer, Luma, Rgb};

use super::*;
use crate::formats::mat::write;

const LENS: Camera = Camera::Fov { degrees: 90.0 };

fn put(path: &Path, bytes: impl AsRef<[u8]>) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, bytes).unwrap();
}

fn picture(path: &Path, width: u32, height: u32) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    RgbImage::from_fn(width, height, |_, y| Rgb([y as u8; 3])).save(path).unwrap();
}

fn map(path: &Path, width: u32, values: &[u16]) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let map = ImageBuffer::<Luma<u16>, _>::from_raw(width, values.len() as u32 / width, values.to_vec()).unwrap();
    map.save(path).unwrap();
}

fn open(root: &Path, list: Option<&Path>, camera: Camera) -> Result<Stills> {
    Stills::open(Layout::of(root)?.expect("a layout that is known"), root, list, [8, 12], camera)
}

fn message(result: Result<Stills>) -> String {
    result.map(|stills| stills.len()).unwrap_err().to_string()
}

fn depth(stills: &Stills, sample: usize) -> Vec<f32> {
    stills.depth(sample).unwrap().unwrap().metres
}

/// Two cameras of f 10 in pictures of 12 x 8, half a metre apart.
fn calibration(left: &str, right: &str) -> String {
    let camera =
        |name: &str, last: f64| format!("S_rect_{name}: 12 8\nP_rect_{name}: 10 0 5 {last} 0 10 4 0 0 0 1 0\n");
    camera(left, 1.0) + &camera(right, -4.0)
}

#[test]
fn kitti_2015() {
    let root = tempfile::tempdir().unwrap();
    let training = root.path().join("training");
    for frame in ["000000_10", "000001_10", "000000_11", "000002_10"] {
        picture(&training.join(format!("image_2/{frame}.png")), 12, 8);
    }
    picture(&training.join("image_3/000000_10.png"), 12, 8);
    map(&training.join("disp_occ_0/000000_10.png"), 3, &[0, 256, 640]);
    map(&training.join("disp_occ_0/000001_10.png"), 3, &[0, 256, 512]);
    put(&training.join("calib_cam_to_cam/000000.txt"), calibration("02", "03"));
    let stills = open(root.path(), None, Camera::Auto).unwrap();
    assert_eq!((stills.layout(), stills.len(), stills.left_out().without_depth), (Layout::Kitti2015, 2, 1));
    // f B = 10 * 0.5.
    assert_eq!(depth(&stills, 0), [0.0, 5.0, 2.0]);
    assert_eq!(stills.intrinsics(0).fx, 10.0 / 12.0);
    assert_eq!(stills.right(0).unwrap(), (training.join("image_3/000000_10.png").as_path(), 0.5));
    // The constants: 721.5377 * 0.5327.
    assert!((depth(&stills, 1)[1] - 384.363).abs() < 1e-3 && stills.right(1).is_none());
    assert_eq!(stills.image(0, 0).unwrap().dimensions(), (12, 8));
    assert!(stills.image(0, 1).unwrap_err().to_string().contains("single pictures"));
    let list = root.path().join("list.txt");
    put(&list, "\u{feff}training\t000001_10  \r\n\r\n");
    assert_eq!(open(root.path(), Some(&list), LENS).unwrap().name(0), "training 000001_10");
    put(&list, "training 000009_10\n");
    let error = message(open(root.path(), Some(&list), LENS));
    assert!(error.contains("line 1") && error.contains("training 000000_10"), "{error}");
}

#[test]
fn a_calibration_is_checked_and_8_bit_truth_is_refused() {
    let root = tempfile::tempdir().unwrap();
    let training = root.path().join("training");
    picture(&training.join("image_2/000000_10.png"), 12, 8);
    picture(&training.join("disp_occ_0/000000_10.png"), 12, 8);
    let file = training.join("calib_cam_to_cam/000000.txt");
    for (text, why) in [
        ("S_rect_02: 12 8\n".to_owned(), "P_rect_02: expected 12 numbers, found no such line"),
        (calibration("02", "03") + "S_rect_02: 12 8\n", "S_rect_02: stands there twice"),
        (calibration("03", "02"), "smaller in the right"),
    ] {
        put(&file, text);
        let error = message(open(root.path(), None, Camera::Auto));
        assert!(error.contains("000000.txt") && error.contains(why), "{error}");
    }
    put(&file, calibration("02", "03"));
    let error = open(root.path(), None, Camera::Auto).unwrap().depth(0).unwrap_err().to_string();
    assert!(error.contains("disp_occ_0") && error.contains("16-bit grey"), "{error}");
}

#[test]
fn make3d_is_cropped_to_its_centre() {
    let root = tempfile::tempdir().unwrap();
    // 12 x 16: the central 2:1 are the rows 5 to 10.
    picture(&root.path().join("Test134/img-a.jpg"), 12, 16);
    let file = root.path().join("Gridlaserdata/depth_sph_corr-a.mat");
    // Depth is 100 * row + column + 1 in the fourth layer, -1 in the others.
    let mut values = vec![-1.0; 55 * 3 * 3];
    values.extend((0..3).flat_map(|column| (0..55).map(move |row| f64::from(100 * row + column + 1))));
    put(&file, write::file(&[write::compressed(&write::doubles("Position3DGrid", &[55, 3, 4], &values))]));
    let stills = open(root.path(), None, LENS).unwrap();
    let truth = stills.depth(0).unwrap().unwrap();
    assert_eq!((stills.layout(), truth.width, truth.height), (Layout::Make3d, 3, 21));
    assert_eq!((&truth.metres[..4], truth.metres[62]), (&[1701.0, 1702.0, 1703.0, 1801.0][..], 3703.0));
    // The rows 5 to 10, stretched to 8: brightness is the number of the row.
    let seen = stills.image(0, 0).unwrap();
    let mean: f64 = seen.pixels().map(|p| f64::from(p.0[0])).sum::<f64>() / 96.0;
    assert!((mean - 7.5).abs() < 0.6, "{mean}");
    let k = stills.intrinsics(0);
    // f 6 pixels; the centre 7.5 of 16 rows is 2.5 of the 6 that are left.
    assert!((k.fx - 0.5).abs() < 1e-12 && (k.fy - 1.0).abs() < 1e-12 && (k.cy - 2.5 / 6.0).abs() < 1e-12, "{k:?}");
    assert!(message(open(root.path(), None, Camera::Auto)).contains("--fov"));
    put(&file, write::file(&[write::doubles("Position3DGrid", &[55, 3], &[1.0; 165])]));
    let error = open(root.path(), None, LENS).unwrap().depth(0).unwrap_err().to_string();
    assert!(error.contains("depth_sph_corr-a.mat") && error.contains("55 x 305 x 4"), "{error}");
}

#[test]
fn driving_stereo_in_both_sizes_and_both_kinds_of_map() {
    let root = tempfile::tempdir().unwrap();
    let frame = "2018-07-16-15-18-53_2018-07-16-15-19-00-123";
    let place = |folder: &str, ending: &str| root.path().join(format!("{folder}/{frame}.{ending}"));
    picture(&place("foggy/left-image-full-size", "png"), 24, 16);
    map(&place("foggy/depth-map-full-size", "png"), 2, &[0, 512]);
    picture(&place("foggy/right-image-full-size", "png"), 24, 16);
    picture(&place("sunny/left-image-half-size", "jpg"), 12, 8);
    map(&place("sunny/disparity-map-half-size", "png"), 2, &[0, 640]);
    picture(&place("rainy/left-image-full-size", "jpg"), 24, 16);
    map(&place("rainy/disparity-map-full-size", "png"), 2, &[0, 640]);
    put(&root.path().join("half-image-calib/2018-07-16.txt"), calibration("101", "103"));
    let stills = open(root.path(), None, Camera::Auto).unwrap();
    let names: Vec<String> = (0..stills.len()).map(|sample| stills.name(sample)).collect();
    assert_eq!(names, ["foggy", "rainy", "sunny"].map(|weather| format!("{weather} {frame}")));
    assert_eq!(depth(&stills, 0), [0.0, 2.0]);
    assert_eq!(stills.right(0).unwrap().1, 0.5);
    // f is 20 at full size and 10 at half; disparities are 640 / 128 and 640 / 256.
    assert_eq!((depth(&stills, 1), depth(&stills, 2)), (vec![0.0, 2.0], vec![0.0, 2.0]));
    assert_eq!(open(&root.path().join("foggy"), None, LENS).unwrap().name(0), format!(". {frame}"));
}

#[test]
fn middlebury() {
    let root = tempfile::tempdir().unwrap();
    let scene = root.path().join("Adirondack");
    picture(&scene.join("im0.png"), 2, 2);
    picture(&scene.join("im1.png"), 2, 2);
    let values = [f32::INFINITY, 10.0, 30.0, 40.0];
    let bytes = values.iter().flat_map(|v| v.to_le_bytes());
    put(&scene.join("disp0.pfm"), "Pf\n2 2\n-1\n".bytes().chain(bytes).collect::<Vec<u8>>());
    let calib = "cam0=[400 0 1; 0 400 0.5; 0 0 1]\ncam1=[400 0 11; 0 400 0.5; 0 0 1]\ndoffs=10\nbaseline=200\n";
    put(&scene.join("calib.txt"), calib);
    let stills = open(root.path(), None, Camera::Auto).unwrap();
    // 0.2 m * 400 over 40, 50, none, 20: rows come from the bottom.
    assert_eq!(depth(&stills, 0), [2.0, 1.6, 0.0, 4.0]);
    assert_eq!((stills.name(0), stills.right(0).unwrap().1), ("Adirondack im0".to_owned(), 0.2));
    assert_eq!((stills.intrinsics(0).fx, stills.intrinsics(0).cy), (200.0, 0.25));
    for (text, why) in [
        (format!("{calib}doffs=3\n"), "doffs: stands there twice"),
        (calib.replace("baseline=200\n", ""), "baseline: expected millimetres"),
        (calib.replace("baseline=200", "baseline=-2"), "above 0"),
        (calib.replace("; 0 0 1]\nd", "]\nd").replace("; 0 0 1]\ncam1", "]\ncam1"), "cam0: expected"),
    ] {
        put(&scene.join("calib.txt"), text);
        let error = message(open(root.path(), None, Camera::Auto));
        assert!(error.contains("calib.txt") && error.contains(why), "{error}");
    }
}

#[test]
fn training_on_single_pictures_is_refused_and_truth_that_is_not_there_is_named() {
    let root = tempfile::tempdir().unwrap();
    picture(&root.path().join("training/image_2/000000_10.png"), 12, 8);
    fs::create_dir_all(root.path().join("training/disp_occ_0")).unwrap();
    let error = message(open(root.path(), None, LENS));
    assert!(error.contains("none of its 1 pictures") && error.contains("disp_occ_0/000000_10.png"), "{error}");
    let opening = crate::data::Opening { camera: LENS, ..crate::data::Opening::of([8, 12]) };
    let error = crate::data::open_folder(root.path(), opening).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("KITTI 2015") && error.contains("eval"), "{error}");
    assert_eq!(Layout::of(tempfile::tempdir().unwrap().path()).unwrap(), None);
}
