//! Against the reference values, and the cases that they do not have.

use safetensors::SafeTensors;
use serde_json::Value;

use super::*;
use crate::depth::{DepthMap, resize_bilinear};
use crate::test_support::{f32s, fixture_bytes};

struct Case {
    inverse_depth: Vec<Vec<f32>>,
    size: (usize, usize),
    ground_truth: Vec<DepthMap>,
}

fn case() -> Case {
    let bytes = fixture_bytes("evaluation.safetensors");
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let (disp, shape) = f32s(&file, "disp");
    let size = (shape[1], shape[2]);
    let (gt, shape) = f32s(&file, "gt");
    let (height, width) = (shape[1], shape[2]);
    let depth = |m: &[f32]| DepthMap { width, height, metres: m.to_vec() };
    Case {
        inverse_depth: disp.chunks_exact(size.0 * size.1).map(<[f32]>::to_vec).collect(),
        size,
        ground_truth: gt.chunks_exact(height * width).map(depth).collect(),
    }
}

fn report(case: &Case, protocol: Protocol, scale: Scale) -> Report {
    let images = case.inverse_depth.iter().zip(&case.ground_truth).enumerate().map(|(i, (map, truth))| {
        (format!("image {i}"), evaluate_image(map, case.size, truth, protocol, scale).unwrap())
    });
    Report::new(images.collect::<Vec<_>>()).unwrap()
}

fn close(found: f64, expected: &Value, what: &str) {
    let expected = expected.as_f64().unwrap();
    assert!((found - expected).abs() <= 1e-6 * expected.abs(), "{what}: {found}, expected {expected}");
}

fn check(report: &Report, expected: &Value, what: &str) {
    assert_eq!(report.images, 3);
    assert!(report.without_pixels.is_empty());
    for (k, found) in report.metrics.to_array().into_iter().enumerate() {
        close(found, &expected["mean"][k], &format!("{what} mean {k}"));
        for (i, image) in report.per_image.iter().enumerate() {
            close(image.metrics.to_array()[k], &expected["per_image"][i][k], &format!("{what} image {i} metric {k}"));
        }
    }
    if expected["ratio_median"].is_null() {
        assert_eq!((report.ratio_median, report.ratio_std), (None, None), "{what}");
    } else {
        close(report.ratio_median.unwrap(), &expected["ratio_median"], what);
        close(report.ratio_std.unwrap(), &expected["ratio_std"], what);
    }
}

#[test]
fn equals_the_reference_under_every_protocol_and_scaling() {
    let case = case();
    let mut expected: Value = serde_json::from_slice(&fixture_bytes("evaluation.json")).unwrap();
    let dense: Value = serde_json::from_slice(&fixture_bytes("evaluation_dense.json")).unwrap();
    expected.as_object_mut().unwrap().extend(dense.as_object().unwrap().clone());
    for (name, protocol, scale) in [
        ("eigen/median", Protocol::Eigen, Scale::Median),
        ("eigen/stereo", Protocol::Eigen, Scale::Stereo),
        ("eigen/median", Protocol::EigenCameraZ, Scale::Median),
        ("eigen/stereo", Protocol::EigenCameraZ, Scale::Factor(5.4)),
        ("improved/median", Protocol::Improved, Scale::Median),
        ("improved/stereo", Protocol::Improved, Scale::Stereo),
        ("dense/median", Protocol::Dense, Scale::Median),
        ("dense/stereo", Protocol::Dense, Scale::Stereo),
        ("dense/3.25", Protocol::Dense, Scale::Factor(3.25)),
    ] {
        check(&report(&case, protocol, scale), &expected[name], name);
    }
}

#[test]
fn protocols_differ_in_their_pixels() {
    let case = case();
    let pixels = |protocol| {
        let report = report(&case, protocol, Scale::Median);
        report.per_image.iter().map(|image| image.pixels).sum::<usize>()
    };
    assert!(pixels(Protocol::Eigen) < pixels(Protocol::Dense));
    assert!(pixels(Protocol::Dense) < pixels(Protocol::Improved));
}

#[test]
fn flip_post_processing_equals_the_reference() {
    let bytes = fixture_bytes("evaluation.safetensors");
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let [left, right, out] = ["left", "right", "out"].map(|n| f32s(&file, &format!("flip_post/{n}")).0);
    let found = flip_post_process(&left, &right, 80);
    for (i, (a, b)) in found.iter().zip(&out).enumerate() {
        assert!((a - b).abs() <= 1e-6 * b.abs(), "{i}: {a} {b}");
    }
    assert_eq!(found[0], right[0]);
    assert_eq!(found[79], left[79]);
    assert_eq!(flip_post_process(&[2.0], &[4.0], 1).len(), 1);
    assert_eq!(mirror(&[1.0, 2.0, 3.0, 4.0], 2), [2.0, 1.0, 4.0, 3.0]);
}

#[test]
fn metrics_by_hand() {
    let metrics = Metrics::of(&[(10.0, 12.0), (20.0, 10.0)]).unwrap();
    assert!((metrics.abs_rel - (0.2 + 0.5) / 2.0).abs() < 1e-15);
    assert!((metrics.sq_rel - (0.4 + 5.0) / 2.0).abs() < 1e-15);
    assert!((metrics.rmse - 52f64.sqrt()).abs() < 1e-12);
    let log = ((1.2f64.ln().powi(2) + 2f64.ln().powi(2)) / 2.0).sqrt();
    assert!((metrics.rmse_log - log).abs() < 1e-15);
    assert_eq!((metrics.a1, metrics.a2, metrics.a3), (0.5, 0.5, 0.5));
    assert_eq!(Metrics::of(&[]), None);
}

#[test]
fn a_prediction_is_cut_to_eighty_metres() {
    let truth = DepthMap { width: 2, height: 1, metres: vec![40.0, 79.0] };
    let image = evaluate_image(&[0.001, 0.001], (1, 2), &truth, Protocol::Dense, Scale::Factor(1.0)).unwrap();
    assert!((image.metrics.unwrap().rmse - ((40f64.powi(2) + 1.0) / 2.0).sqrt()).abs() < 1e-9);
}

#[test]
fn images_without_a_pixel_are_named_and_do_not_count() {
    let truth = |metres: f32| DepthMap { width: 2, height: 2, metres: vec![metres; 4] };
    let image = |metres| evaluate_image(&[0.125; 4], (2, 2), &truth(metres), Protocol::Dense, Scale::Median).unwrap();
    assert_eq!(image(0.0), ImageMetrics { pixels: 0, ratio: None, metrics: None });
    assert_eq!(image(90.0).metrics, None);
    let images = [("a".to_owned(), image(0.0)), ("b".to_owned(), image(16.0)), ("c".to_owned(), image(f32::NAN))];
    let report = Report::new(images.clone()).unwrap();
    assert_eq!((report.images, report.without_pixels.as_slice()), (1, ["a".to_owned(), "c".to_owned()].as_slice()));
    assert_eq!((report.ratio_median, report.ratio_std), (Some(2.0), Some(0.0)));
    assert!(report.metrics.abs_rel < 1e-6);
    let error = Report::new(images.into_iter().take(1)).unwrap_err().to_string();
    assert!(error.contains("of 1 images none"), "{error}");
}

#[test]
fn json_has_the_documented_names() {
    let case = case();
    let json = serde_json::to_value(report(&case, Protocol::Eigen, Scale::Stereo)).unwrap();
    for name in ["images", "abs_rel", "sq_rel", "rmse", "rmse_log", "a1", "a2", "a3", "per_image"] {
        assert!(!json[name].is_null(), "{name}");
    }
    let object = json.as_object().unwrap();
    assert!(object["ratio_median"].is_null() && object["ratio_std"].is_null());
    assert!(json["per_image"][2]["a3"].is_f64() && json["per_image"][2]["name"] == "image 2");
    let back: Report = serde_json::from_value(json).unwrap();
    assert_eq!(back, report(&case, Protocol::Eigen, Scale::Stereo));
}

#[test]
fn what_cannot_be_compared_is_an_error() {
    let truth = DepthMap { width: 2, height: 2, metres: vec![5.0; 4] };
    let message = |map: &[f32], size, truth: &DepthMap| {
        evaluate_image(map, size, truth, Protocol::Dense, Scale::Median).unwrap_err().to_string()
    };
    for bad in [f32::NAN, 0.0, -1.0, f32::INFINITY] {
        let error = message(&[0.1, 0.1, 0.1, bad], (2, 2), &truth);
        assert!(error.contains("row 1, column 1"), "{error}");
    }
    assert!(message(&[0.1; 3], (2, 2), &truth).contains("prediction has 3 values"));
    assert!(message(&[], (0, 2), &truth).contains("prediction has 0 values"));
    let short = DepthMap { metres: vec![5.0; 3], ..truth };
    assert!(message(&[0.1; 4], (2, 2), &short).contains("ground truth has 3 values"));
}

#[test]
fn resizing_interpolates_between_centres() {
    assert_eq!(resize_bilinear(&[0.0, 4.0], (1, 2), (1, 4)), [0.0, 1.0, 3.0, 4.0]);
    assert_eq!(resize_bilinear(&[0.0, 1.0, 2.0, 3.0], (4, 1), (2, 1)), [0.5, 2.5]);
    assert_eq!(resize_bilinear(&[5.0], (1, 1), (2, 2)), [5.0; 4]);
}

#[test]
fn the_mean_map_averages_inverse_depth() {
    let map = |metres: [f32; 2]| Ok(DepthMap { width: 2, height: 1, metres: metres.to_vec() });
    let mean = MeanMap::of([map([2.0, 0.0]), map([4.0, 10.0])]).unwrap();
    assert_eq!(mean.size, (1, 2));
    assert!((mean.inverse_depth[0] - 0.375).abs() < 1e-7);
    assert!((mean.inverse_depth[1] - 0.055).abs() < 1e-7);
    let near = MeanMap::of([map([0.001, 200.0])]).unwrap();
    assert_eq!(near.inverse_depth, [10.0, 0.01]);
    let wide = Ok(DepthMap { width: 4, height: 2, metres: vec![5.0; 8] });
    let mean = MeanMap::of([map([5.0, 5.0]), wide]).unwrap();
    assert!(mean.size == (1, 2) && mean.inverse_depth.iter().all(|d| (d - 0.2).abs() < 1e-7));
    assert!(MeanMap::of([]).is_err());
    assert!(
        MeanMap::of([map([1.0, 1.0]), Err(Error::Failed("gone".into()))]).unwrap_err().to_string().contains("gone")
    );
    // It is a prediction like any other.
    let truth = DepthMap { width: 2, height: 1, metres: vec![5.0, 5.0] };
    let image = evaluate_image(&mean.inverse_depth, mean.size, &truth, Protocol::Dense, Scale::Median).unwrap();
    assert!(image.metrics.unwrap().abs_rel < 1e-6);
}
