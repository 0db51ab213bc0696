//! Regimes of size: where a kernel stops doing everything in one piece.
//!
//! Chunks, tiles, blocks and partial sums have sizes that suit caches, far above those of inputs that finite differences
//! can afford. What begins behind such a boundary (the second chunk, the last one that is shorter) would be compared with
//! nothing. So every size at which kernels cut their work is asked for here ([`size`]), where a gradient check can make
//! it small ([`shrink`]), and every cut is noted with its place in the source for whoever listens ([`record`]): the suite
//! sees which cuts its cases crossed, and refuses those that none did.

use std::cell::{Cell, RefCell};
use std::ops::Range;
use std::panic::Location;

thread_local! {
    /// The largest size of a piece of work that this thread asked for; none if `usize::MAX`.
    static LARGEST: Cell<usize> = const { Cell::new(usize::MAX) };
}

/// The size at which a kernel cuts its work, in its own unit: `usual`, unless a check has made it smaller.
#[inline(always)]
pub fn size(usual: usize) -> usize {
    usual.min(largest())
}

/// The largest size of a piece on this thread.
#[inline(always)]
pub(super) fn largest() -> usize {
    LARGEST.get()
}

/// Runs `f` with pieces of work of at most `largest` units: what this thread computes, and what it hands over to others.
/// For checks alone: sums are added in another order then, and so have other last bits.
pub fn shrink<R>(largest: usize, f: impl FnOnce() -> R) -> R {
    struct Restore(usize);
    impl Drop for Restore {
        fn drop(&mut self) {
            LARGEST.set(self.0);
        }
    }
    let _restore = Restore(LARGEST.replace(largest.max(1)));
    f()
}

/// One cut that a kernel made: whose kernel, its place in the source, and how many pieces there were.
#[derive(Clone, Copy, Debug)]
pub struct Cut {
    /// The op, forward or backward; empty outside of one.
    pub op: &'static str,
    /// Its kernel path.
    pub algo: &'static str,
    /// The call that cut.
    pub location: &'static Location<'static>,
    /// Number of pieces.
    pub pieces: usize,
    /// Whether the last piece was shorter than the others, where that is known.
    pub rest: Option<bool>,
    /// Elementary operations of all pieces together, as the kernel declares them; 0 for a loop inside a thread.
    pub work: usize,
    /// Whether it was made inside a piece of another one.
    pub nested: bool,
}

impl Cut {
    /// File, below `src`, and line.
    pub fn place(&self) -> String {
        let file = self.location.file();
        format!("{}:{}", file.rsplit_once("src/").map_or(file, |(_, file)| file), self.location.line())
    }
}

thread_local! {
    static CUTS: RefCell<Option<Vec<Cut>>> = const { RefCell::new(None) };
    /// The op that runs on this thread, and its kernel path.
    static RUNNING: Cell<(&'static str, &'static str)> = const { Cell::new(("", "")) };
}

/// The op that is about to run, if anybody wants to know whose cuts are made.
pub(crate) fn label(what: impl FnOnce() -> (&'static str, &'static str)) -> Option<(&'static str, &'static str)> {
    CUTS.with_borrow(Option::is_some).then(what)
}

/// Runs an op, whose cuts bear its label.
pub(crate) fn of_op<R>(label: Option<(&'static str, &'static str)>, run: impl FnOnce() -> R) -> R {
    let Some(label) = label else { return run() };
    let before = RUNNING.replace(label);
    let result = run();
    RUNNING.set(before);
    result
}

/// Runs `f`, and returns the cuts that kernels made meanwhile on this thread: all of them, if kernels run on one
/// ([`with_threads`](super::parallel::with_threads)).
pub fn record<R>(f: impl FnOnce() -> R) -> (R, Vec<Cut>) {
    let before = CUTS.replace(Some(Vec::new()));
    let result = f();
    (result, CUTS.replace(before).unwrap_or_default())
}

/// Notes a cut.
pub(crate) fn note(location: &'static Location<'static>, pieces: usize, rest: Option<bool>, work: usize) {
    CUTS.with_borrow_mut(|cuts| {
        if let Some(cuts) = cuts {
            let (op, algo) = RUNNING.get();
            cuts.push(Cut { op, algo, location, pieces, rest, work, nested: DEPTH.get() > 0 });
        }
    });
}

thread_local! {
    /// How many cuts this thread is inside of.
    static DEPTH: Cell<usize> = const { Cell::new(0) };
}

/// Runs the pieces of a cut on this thread: the cuts that they make are nested.
pub(super) fn inside<R>(f: impl FnOnce() -> R) -> R {
    struct Leave;
    impl Drop for Leave {
        fn drop(&mut self) {
            DEPTH.set(DEPTH.get() - 1);
        }
    }
    DEPTH.set(DEPTH.get() + 1);
    let _leave = Leave;
    f()
}

/// A bug planted at one cut, to see whether the checks notice: only in builds with `--cfg mutants`.
#[cfg(mutants)]
pub mod mutants {
    use std::cell::Cell;
    use std::panic::Location;
    use std::sync::Mutex;
    use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering::Relaxed};

    /// What goes wrong at the cut.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub enum Bug {
        /// The last of several pieces is not computed.
        DropsLast,
        /// Pieces beyond the second are not computed.
        DropsBeyondSecond,
        /// Every piece after the first is computed as the one before it.
        ReadsPrevious,
        /// Every piece but the first is computed as the first.
        ReadsFirst,
        /// The last of several pieces is not computed, in f32 alone.
        DropsLastInSingle,
        /// The last of several pieces lacks its last element, where pieces are cut by length.
        ShortensLast,
    }

    impl Bug {
        /// All of them.
        pub const ALL: [Bug; 6] = [
            Bug::DropsLast,
            Bug::DropsBeyondSecond,
            Bug::ReadsPrevious,
            Bug::ReadsFirst,
            Bug::DropsLastInSingle,
            Bug::ShortensLast,
        ];

        /// Name in tables.
        pub fn name(self) -> &'static str {
            match self {
                Bug::DropsLast => "drops the last",
                Bug::DropsBeyondSecond => "drops beyond the second",
                Bug::ReadsPrevious => "reads the previous",
                Bug::ReadsFirst => "reads the first",
                Bug::DropsLastInSingle => "drops the last in f32",
                Bug::ShortensLast => "shortens the last",
            }
        }

        /// The piece that is computed in the place of piece `i` of `count`, if one is.
        pub(crate) fn instead(self, i: usize, count: usize) -> Option<usize> {
            match self {
                Bug::DropsLast if i > 0 && i + 1 == count => None,
                Bug::DropsLastInSingle if SINGLE.get() && i > 0 && i + 1 == count => None,
                Bug::DropsBeyondSecond if i > 1 => None,
                Bug::ReadsPrevious => Some(i.saturating_sub(1)),
                Bug::ReadsFirst => Some(0),
                _ => Some(i),
            }
        }
    }

    thread_local! {
        /// Whether the op that runs on this thread runs in f32.
        static SINGLE: Cell<bool> = const { Cell::new(false) };
    }

    /// Notes in which element type an op is about to run.
    pub(crate) fn runs_in<T>() {
        SINGLE.set(size_of::<T>() == 4);
    }

    /// Whether a gradient that is to be added is written over what is there.
    static OVERWRITES: AtomicBool = AtomicBool::new(false);

    /// Plants it, or takes it away.
    pub fn plant_overwriting(on: bool) {
        OVERWRITES.store(on, Relaxed);
    }

    /// Whether it is planted.
    pub(crate) fn overwrites() -> bool {
        OVERWRITES.load(Relaxed)
    }

    static PLANTED: Mutex<Option<(String, u32, Bug)>> = Mutex::new(None);
    /// The number of the formula that is wrong, and 1; none if 0.
    static FORMULA: AtomicUsize = AtomicUsize::new(0);

    /// Makes a formula of the list wrong, or all right.
    pub fn plant_formula(number: Option<usize>) {
        FORMULA.store(number.map_or(0, |n| n + 1), Relaxed);
    }

    /// Whether a formula is the one that is wrong.
    #[inline(always)]
    pub fn formula(number: usize) -> bool {
        FORMULA.load(Relaxed) == number + 1
    }

    /// Plants a bug at a cut (file and line), or takes it away.
    pub fn plant(bug: Option<(String, u32, Bug)>) {
        *PLANTED.lock().expect("no panic holds this lock") = bug;
    }

    /// The bug at a place.
    pub(crate) fn at(place: &Location) -> Option<Bug> {
        let planted = PLANTED.lock().expect("no panic holds this lock");
        let (file, line, bug) = planted.as_ref()?;
        (place.line() == *line && place.file() == file).then_some(*bug)
    }
}

/// Cuts a range into runs of `usual` (see [`size`]), the last of which may be shorter: for loops inside a thread.
#[track_caller]
pub fn blocks(range: Range<usize>, usual: usize) -> impl Iterator<Item = Range<usize>> {
    let block = size(usual).max(1);
    note(Location::caller(), range.len().div_ceil(block), Some(!range.len().is_multiple_of(block)), 0);
    let runs = range.clone().step_by(block).map(move |first| first..(first + block).min(range.end));
    #[cfg(mutants)]
    let runs = {
        let (bug, all) = (mutants::at(Location::caller()), runs.collect::<Vec<_>>());
        let kept = all.clone().into_iter().enumerate();
        let (count, short) = (all.len(), bug == Some(mutants::Bug::ShortensLast) && all.len() > 1);
        kept.filter(move |(i, _)| bug.is_none_or(|bug| bug.instead(*i, count) == Some(*i)))
            .map(move |(i, run)| if short && i + 1 == count { run.start..run.end - 1 } else { run })
    };
    runs
}

#[cfg(test)]
mod tests {
    use super::super::parallel;
    use super::*;

    #[test]
    fn a_size_is_the_callers_alone_on_whatever_threads_it_computes() {
        let seen = |largest| {
            shrink(largest, || {
                parallel::with_threads(3, || {
                    parallel::map(64, usize::MAX, |_| (size(100), parallel::map(9, 9, |_| size(7))))
                })
            })
        };
        std::thread::scope(|scope| {
            for largest in [1, 2, 50, 3, 5] {
                scope.spawn(move || {
                    for (outer, inner) in (0..200).flat_map(|_| seen(largest)) {
                        assert_eq!((outer, inner), (largest.min(100), vec![largest.min(7); 9]));
                    }
                    assert_eq!(size(100), 100, "restored");
                });
            }
        });
        let _ = std::panic::catch_unwind(|| shrink(2, || panic!("on purpose")));
        assert_eq!(size(100), 100, "restored after a panic");
    }

    #[test]
    fn blocks_cover_a_range_once_and_are_noted() {
        let (found, cuts) = record(|| blocks(3..13, 4).collect::<Vec<_>>());
        assert_eq!(found, [3..7, 7..11, 11..13]);
        assert_eq!((cuts.len(), cuts[0].pieces, cuts[0].rest), (1, 3, Some(true)));
        assert!(cuts[0].place().starts_with("tensor/regime.rs:"));
        assert_eq!(blocks(5..5, 4).count(), 0);
        let (_, cuts) = record(|| blocks(0..8, 4).count());
        assert_eq!((cuts[0].pieces, cuts[0].rest), (2, Some(false)));
    }

    #[test]
    fn a_cut_says_its_work_and_whether_it_is_inside_another_one() {
        let run = || {
            parallel::with_threads(1, || {
                parallel::for_each(3, 70, |_| parallel::for_each(2, 5, |_| ()));
                parallel::for_each(1, 9, |_| ());
            });
        };
        let found: Vec<_> = record(run).1.iter().map(|cut| (cut.pieces, cut.work, cut.nested)).collect();
        assert_eq!(found, [(3, 70, false), (2, 5, true), (2, 5, true), (2, 5, true), (1, 9, false)]);
    }
}
