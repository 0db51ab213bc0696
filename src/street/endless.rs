//! Streets without end: sequences that nobody has seen yet are rendered while training goes on, and take the place of the
//! oldest.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use image::RgbImage;
use rayon::prelude::*;

use super::rendered::StreetConfig;
use super::sequence::{Sequence, usual_path};
use crate::camera::Intrinsics;
use crate::depth::DepthMap;

/// Epochs that a sequence is seen in: at two, rendering the next ones takes the time of a small part of a small network's
/// steps, and half of what is seen is new in each epoch.
pub const SHOWN: usize = 2;

/// Rendered sequences that go on forever. An epoch shows the `sequences` of the configuration from a first number on;
/// the next epoch starts a [`SHOWN`]th of them later. The sequence of a number is the same whenever it is rendered, so what
/// an epoch shows follows from the configuration alone.
///
/// A thread of its own renders what comes next, at the pace at which samples are used up. What is not there when it is
/// asked for is rendered at once.
pub struct Endless {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

struct Shared {
    config: StreetConfig,
    state: Mutex<State>,
    /// The thread that renders sleeps until there is something to do.
    wake: Condvar,
}

#[derive(Default)]
struct State {
    there: BTreeMap<usize, Arc<Sequence>>,
    /// The numbers to be rendered ahead of their use.
    wanted: Range<usize>,
    stop: bool,
}

impl Endless {
    /// Renders the sequences of the first epoch, on rayon's threads. `progress` gets the number of frames done and of all,
    /// from any thread.
    ///
    /// # Panics
    /// If the configuration has fewer than [`SHOWN`] sequences, fewer than three frames in each, or a second camera.
    pub fn render(config: &StreetConfig, progress: Option<&(dyn Fn(usize, usize) + Sync)>) -> Endless {
        assert!(config.sequences >= SHOWN && config.frames >= 3, "an endless street of sequences that hold samples");
        assert!(config.baseline == 0.0, "an endless street of one camera");
        let shared = Arc::new(Shared { config: config.clone(), state: Mutex::default(), wake: Condvar::new() });
        shared.fill(0..config.sequences, progress);
        let of_thread = shared.clone();
        let thread = std::thread::Builder::new().name("street".into()).spawn(move || of_thread.render_ahead());
        // Without a thread everything is rendered when it is asked for.
        Endless { shared, thread: thread.ok() }
    }

    /// Settings with which sequences are rendered; `sequences` are those of one epoch.
    pub fn config(&self) -> &StreetConfig {
        &self.shared.config
    }

    /// Samples of one epoch: frames that have both neighbours.
    pub fn samples(&self) -> usize {
        self.config().sequences * self.each()
    }

    /// The number of the sample that stands at an index in an epoch.
    pub(crate) fn of_epoch(&self, epoch: u64, index: usize) -> usize {
        self.shared.first_of(epoch) * self.each() + index
    }

    /// The sequence and the frame of a sample.
    pub(crate) fn locate(&self, sample: usize) -> (usize, usize) {
        (sample / self.each(), sample % self.each() + 1)
    }

    fn each(&self) -> usize {
        self.config().frames - 2
    }

    /// A frame of a sequence. Panics if it has no such frame.
    pub fn frame(&self, sequence: usize, frame: usize) -> Arc<RgbImage> {
        self.sequence(sequence).images[frame].clone()
    }

    /// The depth of a frame at the pixels' centres: camera z in metres, 0 for the sky. Panics if there is none such.
    pub fn frame_depth(&self, sequence: usize, frame: usize) -> DepthMap {
        self.sequence(sequence).depth(self.config(), frame)
    }

    /// The camera of a sequence.
    pub fn camera(&self, sequence: usize) -> Intrinsics {
        self.sequence(sequence).intrinsics
    }

    /// The sequence of a number.
    fn sequence(&self, number: usize) -> Arc<Sequence> {
        if let Some(sequence) = self.shared.state().there.get(&number) {
            return sequence.clone();
        }
        self.shared.film(number)
    }

    /// Prepares what the samples from a position of the endless order on need: the epoch's own sequences now, if any is
    /// missing, and those of the next one as many as will be there in time. What lies further back than the last epoch
    /// is forgotten.
    pub(crate) fn about_to_read(&self, position: u64) {
        let (samples, shared) = (self.samples() as u64, &self.shared);
        let (epoch, place) = (position / samples, position % samples);
        let (first, sequences, fresh) = (shared.first_of(epoch), self.config().sequences, shared.fresh());
        // One ahead of what has to be there by now, to spread the work over the epoch.
        let ahead = ((place + 1) * fresh as u64).div_ceil(samples) as usize;
        shared.fill(first..first + sequences, None);
        let mut state = shared.state();
        let oldest = first.saturating_sub(fresh);
        state.there = state.there.split_off(&oldest);
        state.wanted = first + sequences..first + sequences + ahead;
        drop(state);
        shared.wake.notify_one();
    }
}

impl Drop for Endless {
    fn drop(&mut self) {
        self.shared.state().stop = true;
        self.shared.wake.notify_one();
        if let Some(thread) = self.thread.take() {
            // If it panicked, that was said, and nothing is missing.
            let _ = thread.join();
        }
    }
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The sequences that an epoch shows for the first time.
    fn fresh(&self) -> usize {
        self.config.sequences / SHOWN
    }

    /// The first sequence of an epoch.
    fn first_of(&self, epoch: u64) -> usize {
        usize::try_from(epoch).unwrap_or(usize::MAX).saturating_mul(self.fresh())
    }

    fn film(&self, number: usize) -> Arc<Sequence> {
        let path = |number: usize, world: &_| usual_path(&self.config, number, world);
        Arc::new(Sequence::film(&self.config, number, &path, &|| ()))
    }

    /// Renders those of some sequences that are not there, on rayon's threads.
    fn fill(&self, numbers: Range<usize>, progress: Option<&(dyn Fn(usize, usize) + Sync)>) {
        let missing: Vec<usize> = {
            let state = self.state();
            numbers.filter(|number| !state.there.contains_key(number)).collect()
        };
        let (frames, done) = (self.config.frames, AtomicUsize::new(0));
        let all = missing.len() * frames;
        missing.into_par_iter().for_each(|number| {
            let sequence = self.film(number);
            self.state().there.insert(number, sequence);
            let done = frames + done.fetch_add(frames, Ordering::Relaxed);
            if let Some(progress) = progress {
                progress(done, all);
            }
        });
    }

    /// The thread's work: renders what is wanted and not there, one sequence after the other, and sleeps in between.
    fn render_ahead(&self) {
        // Threads of its own: in those of training it would stand in the way of a step's work.
        let Ok(pool) = rayon::ThreadPoolBuilder::new().num_threads(1).build() else { return };
        let mut state = self.state();
        while !state.stop {
            let next = state.wanted.clone().find(|number| !state.there.contains_key(number));
            state = match next {
                Some(number) => {
                    drop(state);
                    let sequence = pool.install(|| self.film(number));
                    let mut state = self.state();
                    state.there.insert(number, sequence);
                    state
                }
                None => self.wake.wait(state).unwrap_or_else(PoisonError::into_inner),
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use super::*;
    use crate::data::DataSource;
    use crate::data::batch::{Augment, batch_of_step};
    use crate::street::{Street, WorldKind};

    const CONFIG: StreetConfig = StreetConfig {
        height: 32,
        width: 64,
        sequences: 4,
        frames: 4,
        seed: 9,
        world: WorldKind::Street2,
        own_lenses: true,
        moving_cars: true,
        intrinsics: crate::camera::Intrinsics::KITTI,
        baseline: 0.0,
    };

    fn there(endless: &Endless) -> Vec<usize> {
        endless.shared.state().there.keys().copied().collect()
    }

    #[test]
    fn every_epoch_shows_half_of_the_last_one_and_as_many_new_ones() {
        let endless = Endless::render(&CONFIG, None);
        assert_eq!((endless.len(), there(&endless)), (8, vec![0, 1, 2, 3]));
        let sequences = |epoch: u64| -> Vec<usize> {
            (0..8).map(|index| endless.locate(endless.of_epoch(epoch, index)).0).collect()
        };
        assert_eq!(sequences(0), [0, 0, 1, 1, 2, 2, 3, 3]);
        assert_eq!(sequences(3), [6, 6, 7, 7, 8, 8, 9, 9]);
    }

    #[test]
    fn a_sequence_is_that_of_a_long_street_whenever_it_is_rendered() {
        let long = Street::render(&StreetConfig { sequences: 8, ..CONFIG }, None);
        let endless = Endless::render(&CONFIG, None);
        for sample in [15, 3, 12, 0] {
            assert_eq!(endless.image(sample, 1).unwrap(), long.image(sample, 1).unwrap(), "sample {sample}");
            assert_eq!(endless.depth(sample).unwrap(), long.depth(sample).unwrap());
            assert_eq!(endless.intrinsics(sample), long.intrinsics(sample));
            assert_eq!(endless.name(sample), long.name(sample));
        }
    }

    #[test]
    fn what_comes_next_is_rendered_ahead_and_the_past_forgotten() {
        let endless = Endless::render(&CONFIG, None);
        let wait_for = |expected: &[usize]| {
            let since = Instant::now();
            while there(&endless) != expected {
                assert!(since.elapsed() < Duration::from_secs(60), "{:?}, expected {expected:?}", there(&endless));
                std::thread::sleep(Duration::from_millis(2));
            }
        };
        endless.about_to_read(0);
        wait_for(&[0, 1, 2, 3, 4]);
        endless.about_to_read(7);
        wait_for(&[0, 1, 2, 3, 4, 5]);
        // The third epoch starts at 4; 2 and 3 were shown in the one before it.
        endless.about_to_read(16);
        wait_for(&[2, 3, 4, 5, 6, 7, 8]);
    }

    #[test]
    fn a_batch_is_the_same_in_a_run_that_starts_there() {
        let plain = Augment { flip: true, jitter: true, sensor: true };
        let (long, short) = (Endless::render(&CONFIG, None), Endless::render(&CONFIG, None));
        for step in 0..7 {
            batch_of_step(&long, plain, 3, 5, step).unwrap();
        }
        let [one, other] = [&long, &short].map(|endless| batch_of_step(endless, plain, 3, 5, 7).unwrap());
        assert!(one.target.same_bits(&other.target) && one.sources[1].same_bits(&other.sources[1]));
        assert_eq!(one.intrinsics, other.intrinsics);
        let early = batch_of_step(&short, plain, 3, 5, 0).unwrap();
        assert!(!early.target.same_bits(&one.target));
    }
}
