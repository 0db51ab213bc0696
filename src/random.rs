//! Random numbers whose stream is fixed for good: ChaCha8, and our own maps from its bits to numbers.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use serde::{Deserialize, Serialize};

/// A seeded generator. The same seed and stream give the same numbers on every machine, in every version.
#[derive(Clone, Debug)]
pub struct Random {
    seed: u64,
    stream: u64,
    chacha: ChaCha8Rng,
}

/// Everything in this crate that is drawn at random, and its stream of a seed's numbers: the whole table. The numbers are
/// fixed for good, because runs that were stopped are continued by them.
///
/// What is drawn in every step or epoch has 2^40 streams in a row, one each, so that it can be drawn without what came
/// before. (Streets draw under keys of their own, see `street`.)
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stream {
    /// Something that needs no stream of its own: a test, an example, a benchmark.
    Only,
    /// Inputs of a gradient-check case that are the same for any seed.
    FixedInputs,
    /// The directions of the Taylor test.
    TaylorDirections,
    /// The cotangents of a gradient check.
    Cotangents,
    /// The directions in which one input of a gradient check is moved.
    InputDirections(u64),
    /// The weights that a network starts with.
    Weights,
    /// The inputs of a gradient-check case.
    CaseInputs,
    /// The order of the samples in an epoch.
    Order(u64),
    /// Mirroring and colour jitter of a step's batch.
    Augmentation(u64),
    /// The photometric changes of a step's batch.
    Photometric(u64),
    /// The pool of numbers that ties of the auto-mask are broken with.
    TiePool,
    /// Which of them a step takes.
    Ties(u64),
    /// Dropout in a training step.
    Dropout(u64),
    /// Dropout while rotations are learnt.
    RotationDropout,
    /// The rotations of a step of their pretraining.
    Rotations(u64),
    /// The rotations that go on beside a training step.
    KeptRotations(u64),
    /// The images that a bootstrap interval is made of.
    Bootstrap,
}

impl Stream {
    /// The stream's number.
    pub fn number(self) -> u64 {
        let each = |family: u64, step: u64| (family << 40).wrapping_add(step);
        match self {
            Stream::Only => 0,
            Stream::FixedInputs => 8,
            Stream::TaylorDirections => 0x7A7,
            Stream::Cotangents => 0xC07,
            Stream::InputDirections(input) => 0xD12 + input,
            Stream::Weights => 0x1417,
            Stream::CaseInputs => 0xCA5E,
            Stream::Bootstrap => 0xB007,
            Stream::Order(epoch) => each(1, epoch),
            Stream::Augmentation(step) => each(2, step),
            Stream::TiePool => each(3, 0) - 1,
            Stream::Ties(step) => each(3, step),
            Stream::Dropout(step) => each(4, step),
            Stream::RotationDropout => each(5, 0) - 1,
            Stream::Rotations(step) => each(5, step),
            Stream::KeptRotations(step) => each(6, step),
            Stream::Photometric(step) => each(7, step),
        }
    }
}

/// Where a [`Random`] stands, to go on from there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RandomState {
    /// The seed.
    pub seed: u64,
    /// The stream.
    pub stream: u64,
    /// How many 32-bit words were drawn.
    pub position: u64,
}

impl Random {
    /// A generator for `seed`; different streams of one seed are independent.
    pub fn new(seed: u64, stream: u64) -> Self {
        let mut chacha = ChaCha8Rng::seed_from_u64(seed);
        chacha.set_stream(stream);
        Random { seed, stream, chacha }
    }

    /// A generator for `seed` and one of this crate's streams.
    pub fn of(seed: u64, stream: Stream) -> Self {
        Random::new(seed, stream.number())
    }

    /// Where it stands.
    pub fn state(&self) -> RandomState {
        RandomState { seed: self.seed, stream: self.stream, position: self.chacha.get_word_pos() as u64 }
    }

    /// A generator that stands there.
    pub fn from_state(state: RandomState) -> Self {
        let mut random = Random::new(state.seed, state.stream);
        random.chacha.set_word_pos(state.position as u128);
        random
    }

    /// The generator itself, for code that draws from it directly.
    pub fn chacha(&mut self) -> &mut ChaCha8Rng {
        &mut self.chacha
    }

    /// 64 random bits.
    pub fn bits(&mut self) -> u64 {
        self.chacha.next_u64()
    }

    /// Uniform in [0, 1), a multiple of 2^-53.
    pub fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Uniform in [low, high).
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// A whole number below `n` (0 for 0).
    pub fn below(&mut self, n: usize) -> usize {
        ((self.bits() as u128 * n as u128) >> 64) as usize
    }

    /// True with probability 1/2.
    pub fn coin(&mut self) -> bool {
        self.bits() >> 63 == 1
    }

    /// Standard normal (Box-Muller, the cosine half).
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.unit()).cos()
    }

    /// One of some items.
    ///
    /// # Panics
    /// If there is none.
    pub fn pick<T: Copy>(&mut self, items: &[T]) -> T {
        items[self.below(items.len())]
    }

    /// A whole number from `low` to `high`, half of the time one of the two: combinations of extremes are where loops
    /// go wrong.
    pub fn extreme(&mut self, low: usize, high: usize) -> usize {
        match self.below(4) {
            0 => low,
            1 => high,
            _ => low + self.below(high - low + 1),
        }
    }

    /// Puts a slice in random order (Fisher-Yates).
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for i in (1..items.len()).rev() {
            items.swap(i, self.below(i + 1));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_are_all_different() {
        let last = (1 << 40) - 2;
        let mut all = vec![Stream::Only, Stream::FixedInputs, Stream::TaylorDirections, Stream::Cotangents];
        all.extend([Stream::Weights, Stream::CaseInputs, Stream::TiePool, Stream::RotationDropout]);
        all.push(Stream::Bootstrap);
        all.extend([0, 1, 200].map(Stream::InputDirections));
        for family in [Stream::Order, Stream::Augmentation, Stream::Ties] {
            all.extend([0, 1, last].map(family));
        }
        for family in [Stream::Dropout, Stream::Rotations, Stream::KeptRotations] {
            all.extend([0, 1, last].map(family));
        }
        let mut numbers: Vec<u64> = all.iter().map(|s| s.number()).collect();
        numbers.sort_unstable();
        numbers.dedup();
        assert_eq!(numbers.len(), all.len());
    }

    #[test]
    fn the_stream_is_fixed() {
        let mut r = Random::new(7, 0);
        let first: Vec<u64> = (0..3).map(|_| r.below(1000) as u64).collect();
        assert_eq!(first, FIRST_OF_SEED_7);
    }

    #[test]
    fn a_saved_state_goes_on_where_it_stood() {
        let mut r = Random::new(1, 2);
        for _ in 0..5 {
            r.normal();
        }
        let mut again = Random::from_state(r.state());
        assert_eq!(r.bits(), again.bits());
    }

    #[test]
    fn normal_numbers_have_mean_0_and_variance_1() {
        let mut r = Random::new(3, 0);
        let xs: Vec<f64> = (0..20_000).map(|_| r.normal()).collect();
        let mean = xs.iter().sum::<f64>() / 2e4;
        let variance = xs.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 2e4;
        assert!(mean.abs() < 0.02 && (variance - 1.0).abs() < 0.03, "{mean} {variance}");
    }

    const FIRST_OF_SEED_7: [u64; 3] = [157, 167, 704];
}
