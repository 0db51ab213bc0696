//! Every protocol against a second implementation, written out pixel by pixel from the published rules.

use super::*;
use crate::random::{Random, Stream};

/// A published rule, as a reader of the papers would write it.
struct Published {
    protocol: Protocol,
    /// Rows and columns of the ground truth.
    truth: (usize, usize),
    /// Whether a pixel counts, by where it is and how deep.
    counts: fn(row: usize, column: usize, metres: f64) -> bool,
    /// The first row of the truth that the prediction is of, and how many rows it is of.
    shown: (usize, usize),
    nearest: bool,
    cut: (f64, f64),
    ten: bool,
}

/// Garg's crop of 375 x 1242, as numbers: rows 153 to 370, columns 44 to 1196.
fn garg(row: usize, column: usize) -> bool {
    (153..=370).contains(&row) && (44..=1196).contains(&column)
}

fn published() -> Vec<Published> {
    let usual = |protocol, truth: (usize, usize), counts| Published {
        protocol,
        truth,
        counts,
        shown: (0, truth.0),
        nearest: false,
        cut: (0.001, 80.0),
        ten: false,
    };
    let known = |_: usize, _: usize, z: f64| z > 0.0;
    let cityscapes =
        |r: usize, c: usize, z: f64| (256..768).contains(&r) && (192..1856).contains(&c) && z > 0.001 && z < 80.0;
    vec![
        usual(Protocol::Dense, (40, 70), |_, _, z| z > 0.001 && z < 80.0),
        usual(Protocol::Eigen, (375, 1242), |r, c, z| garg(r, c) && z > 0.001 && z < 80.0),
        usual(Protocol::EigenCameraZ, (375, 1242), |r, c, z| garg(r, c) && z > 0.001 && z < 80.0),
        usual(Protocol::Projected, (375, 1242), |r, c, z| garg(r, c) && z > 0.001 && z < 80.0),
        usual(Protocol::Improved, (40, 70), known),
        usual(Protocol::DrivingStereo, (40, 88), known),
        usual(Protocol::DrivingStereoGarg, (375, 1242), |r, c, z| garg(r, c) && z > 0.0),
        usual(Protocol::Kitti2015, (37, 124), known),
        usual(Protocol::Middlebury, (50, 60), known),
        Published {
            shown: (17, 21),
            nearest: true,
            cut: (0.0, 70.0),
            ten: true,
            ..usual(Protocol::Make3d, (55, 305), |r, _, z| (17..38).contains(&r) && z > 0.0 && z < 70.0)
        },
        Published { shown: (0, 768), ..usual(Protocol::Cityscapes, (1024, 2048), cityscapes) },
    ]
}

/// Inverse depth where the centre of a pixel of the truth falls in the prediction.
fn at(map: &[f32], (h, w): (usize, usize), (row, column): (usize, usize), to: (usize, usize), nearest: bool) -> f64 {
    let pixel = |y: f64, x: f64| {
        let (y, x) = (y.clamp(0.0, h as f64 - 1.0) as usize, x.clamp(0.0, w as f64 - 1.0) as usize);
        f64::from(map[y * w + x])
    };
    let (sy, sx) = (h as f64 / to.0 as f64, w as f64 / to.1 as f64);
    if nearest {
        return pixel((row as f64 * sy).floor(), (column as f64 * sx).floor());
    }
    let (y, x) = ((row as f64 + 0.5) * sy - 0.5, (column as f64 + 0.5) * sx - 0.5);
    let (y, x) = (y.clamp(0.0, h as f64 - 1.0), x.clamp(0.0, w as f64 - 1.0));
    let (fy, fx) = (y - y.floor(), x - x.floor());
    let mut sum = 0.0;
    for (dy, wy) in [(0.0, 1.0 - fy), (1.0, fy)] {
        for (dx, wx) in [(0.0, 1.0 - fx), (1.0, fx)] {
            sum += wy * wx * pixel(y.floor() + dy, x.floor() + dx);
        }
    }
    sum
}

/// The seven metrics by the published rules; the factor of the median scaling.
fn by_the_rules(
    p: &Published,
    map: &[f32],
    size: (usize, usize),
    truth: &DepthMap,
    scale: Option<f64>,
) -> ([f64; 7], f64) {
    let (mut gs, mut ps) = (Vec::new(), Vec::new());
    for row in 0..truth.height {
        for column in 0..truth.width {
            let g = f64::from(truth.metres[row * truth.width + column]);
            if (p.counts)(row, column, g) {
                let inverse = at(map, size, (row - p.shown.0, column), (p.shown.1, truth.width), p.nearest);
                gs.push(g);
                ps.push(1.0 / inverse);
            }
        }
    }
    let middle = |values: &[f64]| {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let n = sorted.len();
        if n % 2 == 1 { sorted[n / 2] } else { (sorted[n / 2 - 1] + sorted[n / 2]) / 2.0 }
    };
    let factor = scale.unwrap_or_else(|| middle(&gs) / middle(&ps));
    let ps: Vec<f64> = ps.iter().map(|p_| (p_ * factor).max(p.cut.0).min(p.cut.1)).collect();
    let mean = |f: &dyn Fn(f64, f64) -> f64| gs.iter().zip(&ps).map(|(g, p)| f(*g, *p)).sum::<f64>() / gs.len() as f64;
    let log = |x: f64| if p.ten { x.log10() } else { x.ln() };
    let within = |t: f64| mean(&|g, p| if (g / p).max(p / g) < t { 1.0 } else { 0.0 });
    let metrics = [
        mean(&|g, p| (g - p).abs() / g),
        mean(&|g, p| (g - p).powi(2) / g),
        mean(&|g, p| (g - p).powi(2)).sqrt(),
        mean(&|g, p| (log(g) - log(p)).powi(2)).sqrt(),
        within(1.25),
        within(1.25f64.powi(2)),
        within(1.25f64.powi(3)),
    ];
    (metrics, factor)
}

/// Depths from 0.3 to 150 m, a third of them unknown; a prediction that is off by a factor and noise.
fn made((height, width): (usize, usize), size: (usize, usize), seed: u64) -> (Vec<f32>, DepthMap) {
    let mut random = Random::of(seed, Stream::Only);
    let metres = (0..height * width).map(|i| match random.below(3) {
        0 => 0.0,
        _ => (0.3 * 500f64.powf(random.unit() * 0.5 + 0.5 * ((i / width) as f64 / height as f64))) as f32,
    });
    let metres = metres.collect();
    let map = (0..size.0 * size.1).map(|_| (0.02 + 0.4 * random.unit()) as f32).collect();
    (map, DepthMap { width, height, metres })
}

#[test]
fn every_protocol_equals_a_second_implementation_of_its_rules() {
    let all = published();
    assert_eq!(all.len(), Protocol::all().count());
    for (seed, p) in all.iter().enumerate() {
        let size = (24, 80);
        let (map, truth) = made(p.truth, size, seed as u64);
        for scale in [Scale::Median, Scale::Factor(3.5), Scale::Stereo] {
            let given = match scale {
                Scale::Median => None,
                Scale::Stereo => Some(5.4),
                Scale::Factor(f) | Scale::CameraHeight(f) => Some(f),
            };
            let (expected, factor) = by_the_rules(p, &map, size, &truth, given);
            let found = evaluate_image(&map, size, &truth, p.protocol, scale).unwrap();
            for (k, (a, b)) in found.metrics.unwrap().to_array().into_iter().zip(expected).enumerate() {
                assert!((a - b).abs() <= 1e-9 * b.abs().max(1e-3), "{} {scale}, metric {k}: {a} {b}", p.protocol);
            }
            match found.ratio {
                Some(ratio) => assert!((ratio / factor - 1.0).abs() < 1e-12, "{}: {ratio} {factor}", p.protocol),
                None => assert!(given.is_some(), "{}", p.protocol),
            }
        }
    }
}

#[test]
fn truth_that_is_cropped_already_gives_the_same_numbers() {
    let (map, whole) = made((55, 305), (32, 64), 3);
    let cut = DepthMap { height: 21, metres: whole.metres[17 * 305..38 * 305].to_vec(), ..whole.clone() };
    let [a, b] =
        [&whole, &cut].map(|truth| evaluate_image(&map, (32, 64), truth, Protocol::Make3d, Scale::Median).unwrap());
    assert_eq!(a, b);
    let other = DepthMap { height: 61, metres: whole.metres.clone(), width: 275 };
    let error = evaluate_image(&map, (32, 64), &other, Protocol::Make3d, Scale::Median).unwrap_err().to_string();
    assert!(error.contains("61 rows of 275"), "{error}");
}

#[test]
fn pairs_say_where_they_are() {
    let truth = DepthMap { width: 3, height: 2, metres: vec![0.0, 4.0, 0.0, 90.0, 0.0, 8.0] };
    let found = compare_image(&[0.5], (1, 1), &truth, Protocol::Dense, Scale::Factor(3.0)).unwrap();
    let pair = |row, column, truth| Pair { row, column, truth, prediction: 6.0 };
    assert_eq!(found.pairs, [pair(0, 1, 4.0), pair(1, 2, 8.0)]);
    let error = compare_image(&[0.5], (1, 1), &truth, Protocol::Dense, Scale::CameraHeight(1.0)).unwrap_err();
    assert!(error.to_string().contains("intrinsics"), "{error}");
}
