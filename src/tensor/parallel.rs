//! Threads inside kernels: work is cut into chunks whose bounds depend on shapes alone, so that the bits of a result
//! do not depend on how many threads there were.

use std::cell::RefCell;
use std::panic::Location;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::regime;

/// Where the chunks of a kernel run.
#[derive(Clone, Default)]
enum Width {
    /// In rayon's pool of whoever calls.
    #[default]
    Ambient,
    /// One after the other, on the calling thread.
    One,
    /// In a pool of a given size.
    Pool(Arc<rayon::ThreadPool>),
}

thread_local! {
    static WIDTH: RefCell<Width> = const { RefCell::new(Width::Ambient) };
}

/// Runs `f` with kernels on `threads` threads. `f` stays on the calling thread, so it need not be `Send`.
///
/// # Panics
/// If `threads` is 0, or the system cannot start that many.
pub fn with_threads<R>(threads: usize, f: impl FnOnce() -> R) -> R {
    struct Restore(Width);
    impl Drop for Restore {
        fn drop(&mut self) {
            WIDTH.set(std::mem::take(&mut self.0));
        }
    }
    let width = if threads == 1 { Width::One } else { Width::Pool(pool_of(threads)) };
    let _restore = Restore(WIDTH.replace(width));
    f()
}

/// One pool for each size asked for, kept.
fn pool_of(threads: usize) -> Arc<rayon::ThreadPool> {
    static POOLS: Mutex<Vec<Arc<rayon::ThreadPool>>> = Mutex::new(Vec::new());
    assert!(threads > 0, "at least one thread");
    let mut pools = POOLS.lock().expect("no panic holds this lock");
    if let Some(pool) = pools.iter().find(|p| p.current_num_threads() == threads) {
        return pool.clone();
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("the system starts threads");
    pools.push(Arc::new(pool));
    pools[pools.len() - 1].clone()
}

/// How many threads kernels run on.
pub fn threads() -> usize {
    match WIDTH.with_borrow(Width::clone) {
        Width::Ambient => rayon::current_num_threads(),
        Width::One => 1,
        Width::Pool(pool) => pool.current_num_threads(),
    }
}

/// Whether work of this size stays on the calling thread. A shrunk size makes all work worth while.
fn stays(pieces: usize, work: usize) -> bool {
    pieces < 2 || work < regime::size(WORTHWHILE) || threads() == 1
}

/// Runs `f` inside the pool that kernels use.
fn in_pool(f: &mut (dyn FnMut() + Send)) {
    match WIDTH.with_borrow(Width::clone) {
        Width::Pool(pool) => pool.install(f),
        _ => f(),
    }
}

/// Halves the chunks until one is left, and the halves run side by side.
fn split<T: Send>(data: &mut [T], chunk: usize, first: usize, f: &(dyn Fn(usize, &mut [T]) + Sync)) {
    let chunks = data.len().div_ceil(chunk);
    if chunks <= 1 {
        return f(first, data);
    }
    let (left, right) = data.split_at_mut(chunks / 2 * chunk);
    rayon::join(|| split(left, chunk, first, f), || split(right, chunk, first + chunks / 2, f));
}

/// The one place where work is handed over. The kernel comes as a `dyn Fn`: it is compiled once, not once for each way
/// of running it, and the machinery once for each element type.
fn cut<T: Send>(
    data: &mut [T],
    chunk: usize,
    work: usize,
    place: &'static Location<'static>,
    f: &(dyn Fn(usize, &mut [T]) + Sync),
) {
    #[cfg(mutants)]
    if let Some(bug) = regime::mutants::at(place) {
        let count = data.len().div_ceil(chunk);
        for (i, piece) in data.chunks_mut(chunk).enumerate() {
            let short = bug == regime::mutants::Bug::ShortensLast && i > 0 && i + 1 == count && size_of::<T>() > 0;
            let length = piece.len() - usize::from(short);
            if let Some(other) = bug.instead(i, count) {
                f(other, &mut piece[..length]);
            }
        }
        return;
    }
    let _ = place;
    if stays(data.len().div_ceil(chunk), work) {
        regime::inside(|| data.chunks_mut(chunk).enumerate().for_each(|(i, c)| f(i, c)));
    } else {
        // Whoever computes a chunk cuts it further as the thread would that hands it over.
        let largest = regime::largest();
        in_pool(&mut || split(data, chunk, 0, &|i, c| regime::inside(|| regime::shrink(largest, || f(i, c)))));
    }
}

/// Calls `f(i)` for every i below `count`, on all threads. `work` is a rough count of elementary operations: below
/// [`WORTHWHILE`] everything stays on the calling thread.
#[track_caller]
pub fn for_each(count: usize, work: usize, f: impl Fn(usize) + Sync + Send) {
    indices(count, work, Location::caller(), &f);
}

/// Nothing to be cut but the indices: the threads' machinery is compiled once for all that runs by index.
fn indices(count: usize, work: usize, place: &'static Location<'static>, f: &(dyn Fn(usize) + Sync)) {
    regime::note(place, count, None, work);
    cut(&mut vec![(); count], 1, work, place, &|i, _| f(i));
}

/// Collects `f(i)` for every i below `count`, in order.
#[track_caller]
pub fn map<R: Send>(count: usize, work: usize, f: impl Fn(usize) -> R + Sync + Send) -> Vec<R> {
    let results: Vec<Mutex<Option<R>>> = (0..count).map(|_| Mutex::new(None)).collect();
    indices(count, work, Location::caller(), &|i| *lock(&results[i]) = Some(f(i)));
    results.into_iter().filter_map(|r| r.into_inner().unwrap_or_else(PoisonError::into_inner)).collect()
}

/// Cuts `data` into chunks of `chunk` elements (the last may be shorter) and calls `f(index, chunk)` for each.
#[track_caller]
pub fn for_each_chunk<T: Send>(data: &mut [T], chunk: usize, work: usize, f: impl Fn(usize, &mut [T]) + Sync + Send) {
    let chunk = chunk.max(1);
    let place = Location::caller();
    regime::note(place, data.len().div_ceil(chunk), Some(!data.len().is_multiple_of(chunk)), work);
    cut(data, chunk, work, place, &f);
}

/// Cuts `data` into units of `unit` elements each (rows, images, matrices) and calls `f(index, unit)` for each.
///
/// # Panics
/// If units do not fill the data.
#[track_caller]
pub fn for_each_unit<T: Send>(data: &mut [T], unit: usize, work: usize, f: impl Fn(usize, &mut [T]) + Sync + Send) {
    assert!(data.len().is_multiple_of(unit.max(1)), "{} elements in units of {unit}", data.len());
    let place = Location::caller();
    regime::note(place, data.len() / unit.max(1), None, work);
    cut(data, unit.max(1), work, place, &f);
}

/// Calls `f` for every piece: for kernels that write several slices, cut and zipped by the caller.
#[track_caller]
pub fn for_each_piece<P: Send>(pieces: impl IntoIterator<Item = P>, work: usize, f: impl Fn(P) + Sync + Send) {
    let place = Location::caller();
    // Each is taken once, so no thread waits for a lock.
    let pieces: Vec<Mutex<Option<P>>> = pieces.into_iter().map(|p| Mutex::new(Some(p))).collect();
    indices(pieces.len(), work, place, &|i| {
        let piece = lock(&pieces[i]).take();
        piece.into_iter().for_each(&f);
    });
}

/// A lock of which nobody keeps a broken half: a panic of another thread is reported by that thread.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Elementary operations below which handing work over costs more than it saves.
pub const WORTHWHILE: usize = 1 << 14;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_chunk_is_visited_once_for_any_width() {
        for threads in [1, 2, 3] {
            let mut data = vec![0usize; 100_003];
            with_threads(threads, || {
                assert_eq!(super::threads(), threads);
                for_each_chunk(&mut data, 1000, usize::MAX, |i, chunk| chunk.iter_mut().for_each(|x| *x += i + 1));
            });
            assert!(data.iter().enumerate().all(|(i, &x)| x == i / 1000 + 1));
        }
    }

    #[test]
    fn the_width_is_restored_even_after_a_panic() {
        let before = threads();
        let _ = std::panic::catch_unwind(|| with_threads(1, || panic!("on purpose")));
        assert_eq!(threads(), before);
    }
}
