//! Intervals against what is known in closed form, and against every draw that there is.

use super::*;

fn metrics(values: &[f64]) -> Vec<Metrics> {
    values.iter().map(|&v| Metrics::from_array(std::array::from_fn(|k| v * (k + 1) as f64))).collect()
}

/// The percentile of the means of every possible draw of `n` of `n` values, by enumeration.
fn exact(values: &[f64], part: f64) -> f64 {
    let n = values.len();
    let mut means: Vec<f64> = (0..n.pow(n as u32))
        .map(|mut draw| {
            let mut sum = 0.0;
            for _ in 0..n {
                sum += values[draw % n];
                draw /= n;
            }
            sum / n as f64
        })
        .collect();
    means.sort_unstable_by(f64::total_cmp);
    means[((means.len() - 1) as f64 * part).round() as usize]
}

#[test]
fn intervals_of_images_approach_those_of_all_possible_draws() {
    let values = [0.1, 0.4, 0.15, 0.9, 0.3];
    let bootstrap = Bootstrap::new(&[0; 5], 20_000, 3);
    assert_eq!((bootstrap.unit(), bootstrap.units()), (Unit::Images, 5));
    let found = bootstrap.intervals(&metrics(&values)).unwrap();
    for k in 0..7 {
        for (end, part) in [(found.low, 0.025), (found.high, 0.975)] {
            let (a, b) = (end.to_array()[k], (k + 1) as f64 * exact(&values, part));
            assert!((a - b).abs() < 0.03 * (k + 1) as f64, "{k}: {a} {b}");
        }
    }
    assert_eq!(bootstrap.intervals(&metrics(&values)), Some(found), "the same seed draws the same");
    // The ends of many draws of five values are the exact ones for any seed; those of a few differ.
    let few = |seed| Bootstrap::new(&[0; 5], 20, seed).intervals(&metrics(&values));
    assert_ne!(few(3), few(4));
}

#[test]
fn intervals_have_the_width_of_the_normal_law() {
    let mut random = Random::of(5, Stream::Only);
    let values: Vec<f64> = (0..400).map(|_| 1.0 + 0.2 * random.normal()).collect();
    let found = Bootstrap::new(&[0; 400], 2000, 0).intervals(&metrics(&values)).unwrap();
    let half = (found.high.abs_rel - found.low.abs_rel) / 2.0;
    // 1.96 standard errors of the mean: 0.2 / sqrt 400.
    assert!((half / (1.96 * 0.01) - 1.0).abs() < 0.15, "{half}");
}

#[test]
fn sequences_are_drawn_whole() {
    // Two sequences, alike within: a mean is one of a, (2 a + b) / 3 by images, b.
    let (a, b) = (0.2, 0.8);
    let bootstrap = Bootstrap::new(&[4, 4, 9], 4000, 1);
    assert_eq!((bootstrap.unit(), bootstrap.units()), (Unit::Sequences, 2));
    let found = bootstrap.intervals(&metrics(&[a, a, b])).unwrap();
    assert!((found.low.abs_rel - a).abs() < 1e-12 && (found.high.abs_rel - b).abs() < 1e-12, "{found:?}");
}

#[test]
fn differences_are_paired() {
    // Images differ widely, the second weights are better by 0.01 in every one: of that there is no doubt.
    let a = [0.1, 0.9, 0.3, 0.5, 0.2];
    let b = a.map(|x| x - 0.01);
    let found = Bootstrap::new(&[0; 5], 500, 0).of_differences(&metrics(&a), &metrics(&b)).unwrap();
    assert!((found.low.abs_rel + 0.01).abs() < 1e-12 && (found.high.abs_rel + 0.01).abs() < 1e-12, "{found:?}");
    assert_eq!(Bootstrap::new(&[0; 5], 500, 0).of_differences(&metrics(&a), &metrics(&b[..4])), None);
}

#[test]
fn where_nothing_can_be_known_there_is_no_interval() {
    assert_eq!(Bootstrap::new(&[0], 100, 0).intervals(&metrics(&[0.1])), None);
    assert_eq!(Bootstrap::new(&[], 100, 0).intervals(&[]), None);
    assert_eq!(Bootstrap::new(&[0, 0], 0, 0).intervals(&metrics(&[0.1, 0.2])), None);
    assert_eq!(Bootstrap::new(&[0, 0], 100, 0).intervals(&metrics(&[0.1])), None);
}
