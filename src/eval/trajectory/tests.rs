//! Hand-made trajectories whose errors are known.

use super::*;

/// A camera that drives `metres` forward a frame and turns right by `turn` radians.
fn drive(frames: usize, metres: f64, turn: f64) -> Vec<Pose> {
    let (s, c) = (turn.sin(), turn.cos());
    let step = Pose([[c, 0.0, s, 0.0], [0.0, 1.0, 0.0, 0.0], [-s, 0.0, c, metres]]);
    let mut all = vec![Pose::IDENTITY];
    for i in 1..frames {
        all.push(all[i - 1].after(&step));
    }
    all
}

fn close(a: f64, b: f64) {
    assert!((a - b).abs() <= 1e-9 * b.abs().max(1.0), "{a} {b}");
}

#[test]
fn transforms_compose_and_invert() {
    let path = drive(5, 1.5, 0.3);
    let there_and_back = path[4].after(&path[4].inverse());
    there_and_back.0.as_flattened().iter().zip(Pose::IDENTITY.0.as_flattened()).for_each(|(a, b)| close(*a, *b));
    close(path[4].angle(), 1.2);
    // A point ahead of frame 0 is nearer to frame 1 of a straight drive.
    let step = relative(&drive(2, 1.5, 0.0));
    assert_eq!((step.len(), step[0].position()), (1, [0.0, 0.0, -1.5]));
}

#[test]
fn the_sum_is_under_the_root_and_the_number_of_points_outside() {
    // Four steps of truth along z; the prediction leaves by 0.1 to the side at its last step.
    let step = |x: f64, z: f64| Pose([[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, z]]);
    let truth = vec![step(0.0, 1.0); 4];
    let mut predicted = vec![step(0.0, 0.5); 3];
    predicted.push(step(0.1, 0.5));
    // By hand: g z = 0, 1, 2, 3, 4; p z = 0, .5, 1, 1.5, 2, p x = .1 at the last.
    // s = (0.5 + 2 + 4.5 + 8) / (0.25 + 1 + 2.25 + 4 + 0.01) = 15 / 7.51.
    let s = 15.0 / 7.51;
    let sum = (1..=4).map(|i| (s * 0.5 * f64::from(i) - f64::from(i)).powi(2)).sum::<f64>() + (s * 0.1f64).powi(2);
    let whole = sum.sqrt() / 5.0;
    let found = five_frame_error(&truth, &predicted);
    assert_eq!(found.count, 4);
    // The last snippets: 4, 3 and 2 points, each with the step to the side at its end.
    let shorter = |n: i32| {
        let n = f64::from(n);
        let steps: Vec<f64> = (1..=n as i32).map(f64::from).collect();
        let dot: f64 = steps.iter().map(|i| 0.5 * i * i).sum();
        let s = dot / (steps.iter().map(|i| 0.25 * i * i).sum::<f64>() + 0.01);
        (steps.iter().map(|i| (s * 0.5 * i - i).powi(2)).sum::<f64>() + (0.1 * s).powi(2)).sqrt() / (n + 1.0)
    };
    let all = [whole, shorter(3), shorter(2), shorter(1)];
    let mean = all.iter().sum::<f64>() / 4.0;
    close(found.mean, mean);
    close(found.std, (all.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / 4.0).sqrt());
}

#[test]
fn a_turned_scaled_and_moved_trajectory_has_no_error() {
    let truth = drive(400, 1.0, 0.01);
    let elsewhere = Similarity {
        rotation: crate::ops::depth::rotation::rotation([0.1, 2.0, -0.4]),
        translation: [3.0, 1.0, -2.0],
        scale: 0.04,
    };
    let predicted: Vec<Pose> = truth.iter().map(|pose| elsewhere.of_pose(pose)).collect();
    let found = compare_trajectories(&truth, &predicted).unwrap();
    close(found.scale, 25.0);
    assert!(found.ate < 1e-9 && found.five_frames.mean < 1e-9, "{found:?}");
    let segments = found.segments.unwrap();
    assert!(segments.translation_percent < 1e-5 && segments.degrees_per_100_m < 1e-5, "{segments:?}");
}

#[test]
fn a_drift_has_kittis_errors() {
    // On a straight road of 300 m the prediction turns by 0.02 degrees a metre: 2 degrees in 100 m.
    let truth = drive(301, 1.0, 0.0);
    let turn = 0.02f64.to_radians();
    let found = segment_errors(&truth, &drive(301, 1.0, turn)).unwrap();
    // Segments end at the first frame beyond their length: 101 and 201 steps; there are 20 of 100 m and 10 of 200 m.
    let (hundred, two) = ((0..=190).step_by(10).count(), (0..=90).step_by(10).count());
    assert_eq!(found.count, hundred + two);
    let share = (hundred as f64 * 101.0 / 100.0 + two as f64 * 201.0 / 200.0) / (hundred + two) as f64;
    assert!((found.degrees_per_100_m - 2.0 * share).abs() < 1e-6, "{found:?}");
    // The end of an arc of n steps against n steps straight on, seen from the end of the arc: the distance of both ends.
    let end = |n: usize| {
        let (mut x, mut z) = (0.0, 0.0);
        for i in 0..n {
            x += (turn * i as f64).sin();
            z += (turn * i as f64).cos();
        }
        (x * x + (z - n as f64) * (z - n as f64)).sqrt()
    };
    let translation = (hundred as f64 * end(101) / 100.0 + two as f64 * end(201) / 200.0) / (hundred + two) as f64;
    assert!((found.translation_percent - 100.0 * translation).abs() < 1e-6, "{found:?}");
    assert_eq!(segment_errors(&drive(90, 1.0, 0.0), &drive(90, 1.0, turn)), None);
}

#[test]
fn files_of_poses_read_back_and_bad_lines_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("09.txt");
    let poses = drive(7, 0.9, 0.2);
    write_poses(&path, &poses).unwrap();
    assert_eq!(read_poses(&path).unwrap(), poses);
    let good = "1 0 0 0 0 1 0 0 0 0 1 0\n";
    for (bad, what) in [
        ("1 0 0 0 0 1 0 0 0 0 1", "twelve numbers"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 5", "twelve numbers"),
        ("1 0 0 nan 0 1 0 0 0 0 1 0", "twelve numbers"),
        ("2 0 0 0 0 1 0 0 0 0 1 0", "no rotation"),
    ] {
        std::fs::write(&path, format!("{good}{bad}\n")).unwrap();
        let error = read_poses(&path).unwrap_err().to_string();
        assert!(error.contains("09.txt: line 2") && error.contains(what), "{error}");
    }
    std::fs::write(&path, good).unwrap();
    assert!(read_poses(&path).unwrap_err().to_string().contains("two poses at least, found 1"));
}

#[test]
fn trajectories_of_other_lengths_are_refused() {
    let error = compare_trajectories(&drive(5, 1.0, 0.0), &drive(4, 1.0, 0.0)).unwrap_err().to_string();
    assert!(error.contains("4 predicted poses, but 5 true ones"), "{error}");
}
