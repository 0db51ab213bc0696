//! How numbers are spread, in buckets whose width grows with their distance from 0.

use std::sync::OnceLock;

use prost::Message;

/// The least bound above 0, and the factor from one bound to the next: TensorFlow's own, so that histograms of both
/// programs lie over each other.
const LEAST: f64 = 1e-12;
const GROWTH: f64 = 1.1;
/// Numbers beyond this fall into the outermost buckets.
const GREATEST: f64 = 1e20;

/// Counts of numbers by size.
#[derive(Clone, PartialEq, Message)]
pub struct Histogram {
    /// The least of them.
    #[prost(double, tag = "1")]
    pub min: f64,
    /// The greatest.
    #[prost(double, tag = "2")]
    pub max: f64,
    /// How many.
    #[prost(double, tag = "3")]
    pub num: f64,
    /// Their sum.
    #[prost(double, tag = "4")]
    pub sum: f64,
    /// The sum of their squares.
    #[prost(double, tag = "5")]
    pub sum_squares: f64,
    /// The upper bound of each bucket, rising.
    #[prost(double, repeated, tag = "6")]
    pub bucket_limit: Vec<f64>,
    /// How many numbers lie in each.
    #[prost(double, repeated, tag = "7")]
    pub bucket: Vec<f64>,
}

impl Histogram {
    /// Counts the finite ones of some numbers; `None` if there is none.
    pub fn of<'a>(numbers: impl IntoIterator<Item = &'a f32>) -> Option<Self> {
        let bounds = bounds();
        let mut counts = vec![0u64; bounds.len()];
        let [mut min, mut max] = [f64::INFINITY, f64::NEG_INFINITY];
        let (mut num, mut sum, mut squares) = (0u64, 0.0, 0.0);
        for number in numbers.into_iter().map(|&x| f64::from(x)).filter(|x| x.is_finite()) {
            counts[bucket(number)] += 1;
            (min, max) = (min.min(number), max.max(number));
            (num, sum, squares) = (num + 1, sum + number, squares + number * number);
        }
        let first = counts.iter().position(|&n| n > 0)?;
        let last = counts.iter().rposition(|&n| n > 0)?;
        // A bucket without numbers before the first gives it a lower bound; one after the last is not needed.
        let (mut limits, mut bucket) = (Vec::new(), Vec::new());
        for i in first.saturating_sub(1)..=last {
            // Neighbours without numbers become one.
            if counts[i] == 0 && bucket.last() == Some(&0.0) {
                limits.pop();
                bucket.pop();
            }
            limits.push(bounds[i]);
            bucket.push(counts[i] as f64);
        }
        Some(Histogram { min, max, num: num as f64, sum, sum_squares: squares, bucket_limit: limits, bucket })
    }
}

/// The upper bounds of all buckets, rising: negative ones, 0, positive ones, and one for all that is greater.
fn bounds() -> &'static [f64] {
    static BOUNDS: OnceLock<Vec<f64>> = OnceLock::new();
    BOUNDS.get_or_init(|| {
        let positive: Vec<f64> =
            std::iter::successors(Some(LEAST), |x| Some(x * GROWTH)).take_while(|x| *x < GREATEST).collect();
        let negative = positive.iter().rev().map(|x| -x);
        negative.chain([0.0]).chain(positive.iter().copied()).chain([f64::MAX]).collect()
    })
}

/// The bucket of a finite number: the first whose bound is greater.
fn bucket(number: f64) -> usize {
    bounds().partition_point(|bound| *bound <= number).min(bounds().len() - 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_is_counted_in_the_bucket_that_holds_it() {
        let numbers = [-3.0, -1e-20, 0.0, 0.0, 0.5, 0.51, 7e30, f32::NAN, f32::INFINITY];
        let found = Histogram::of(&numbers).unwrap();
        assert_eq!((found.num, found.min, found.max), (7.0, -3.0, f64::from(7e30f32)));
        assert_eq!(found.bucket.iter().sum::<f64>(), 7.0);
        assert!(found.bucket_limit.windows(2).all(|pair| pair[0] < pair[1]), "{found:?}");
        for &number in numbers.iter().filter(|x| x.is_finite()) {
            let number = f64::from(number);
            let i = found.bucket_limit.iter().position(|limit| number < *limit).unwrap();
            assert!(found.bucket[i] > 0.0, "{number} in {found:?}");
            // A bucket that holds a number is no wider than the growth says, but for what lies around 0.
            let below = if i > 0 { found.bucket_limit[i - 1] } else { f64::NEG_INFINITY };
            assert!(
                below <= number
                    && (number.abs() < 1e-11 || number > 1e19 || found.bucket_limit[i] - below < 0.11 * number.abs())
            );
        }
        assert!((found.sum_squares - numbers[..7].iter().map(|x| f64::from(*x).powi(2)).sum::<f64>()).abs() < 1e50);
    }

    #[test]
    fn of_nothing_there_is_none() {
        assert_eq!(Histogram::of(&[]), None);
        assert_eq!(Histogram::of(&[f32::NAN]), None);
        assert_eq!(Histogram::of(&[0.0]).unwrap().bucket.iter().sum::<f64>(), 1.0);
    }
}
