//! Random numbers whose stream is fixed for good: ChaCha8, and our own map from integers to floats.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// A generator for one sequence. The map from words to floats is written out here, so that no library's change of
/// its distributions can change a street.
pub(crate) struct Draw(ChaCha8Rng);

impl Draw {
    /// The generator of `sequence` under `seed`: the key is the two numbers, little-endian, then `purpose`.
    pub(crate) fn new(seed: u64, sequence: u64, purpose: u64) -> Self {
        let mut key = [0; 32];
        key[..8].copy_from_slice(&seed.to_le_bytes());
        key[8..16].copy_from_slice(&sequence.to_le_bytes());
        key[16..24].copy_from_slice(&purpose.to_le_bytes());
        Draw(ChaCha8Rng::from_seed(key))
    }

    /// 32 random bits.
    pub(crate) fn bits(&mut self) -> u32 {
        self.0.next_u32()
    }

    /// Uniform in `[0, 1)`: the upper 24 bits of a word over 2^24.
    pub(crate) fn unit(&mut self) -> f64 {
        (self.bits() >> 8) as f64 / (1u32 << 24) as f64
    }

    /// Uniform in `[low, high)`.
    pub(crate) fn range(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// True with a probability.
    pub(crate) fn chance(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }

    /// One of `choices`.
    pub(crate) fn pick<C: Copy>(&mut self, choices: &[C]) -> C {
        choices[(self.unit() * choices.len() as f64) as usize]
    }

    /// Normal with mean zero: the sum of twelve uniforms less six, which needs no transcendental function.
    pub(crate) fn normal(&mut self, deviation: f64) -> f64 {
        let sum: f64 = (0..12).map(|_| self.unit()).sum();
        deviation * (sum - 6.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_are_those_of_the_distributions() {
        let mut draw = Draw::new(1, 2, 3);
        let n = 20_000;
        let normal: Vec<f64> = (0..n).map(|_| draw.normal(2.0)).collect();
        let mean = normal.iter().sum::<f64>() / n as f64;
        let variance = normal.iter().map(|x| x * x).sum::<f64>() / n as f64;
        assert!(mean.abs() < 0.05 && (variance - 4.0).abs() < 0.2, "{mean} {variance}");
        let uniform: Vec<f64> = (0..n).map(|_| draw.range(3.0, 5.0)).collect();
        assert!(uniform.iter().all(|x| (3.0..5.0).contains(x)));
        assert!((uniform.iter().sum::<f64>() / n as f64 - 4.0).abs() < 0.02);
    }

    #[test]
    fn streams_differ_by_seed_sequence_and_purpose() {
        let first = |seed, sequence, purpose| Draw::new(seed, sequence, purpose).bits();
        let all = [first(0, 0, 0), first(1, 0, 0), first(0, 1, 0), first(0, 0, 1)];
        for i in 0..4 {
            for j in 0..i {
                assert_ne!(all[i], all[j]);
            }
        }
    }
}
