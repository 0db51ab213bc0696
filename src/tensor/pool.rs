//! A pool of buffers: a dropped buffer waits in a free list for the next one of its size class.
//!
//! Fresh pages cost more than many ops do, and a training step asks for the same sizes every time. A buffer comes
//! back *without being zeroed*: its stale values are valid floats, so no `unsafe` is needed, and an op that reads what
//! it did not write is caught by [`set_poison`], which fills every buffer with NaN before handing it out.

use std::ops::{Deref, DerefMut};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering::Relaxed};

use super::float::Float;

/// Free buffers of one element type, by size class.
pub struct Pool<T> {
    classes: [Mutex<Vec<Vec<T>>>; CLASSES],
}

/// Four classes to each doubling: at most a fifth of a buffer lies idle.
const CLASSES: usize = 4 * 40;
/// Buffers below this length are not worth a lock.
const SMALLEST: usize = 64;

static POISON: AtomicBool = AtomicBool::new(false);
static HELD: AtomicUsize = AtomicUsize::new(0);
static CAP: AtomicUsize = AtomicUsize::new(8 << 30);
static FRESH: AtomicU64 = AtomicU64::new(0);
static USED: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

/// Counts a buffer that somebody holds from now on.
fn count(bytes: usize) {
    let used = USED.fetch_add(bytes, Relaxed) + bytes;
    PEAK.fetch_max(used, Relaxed);
}

/// The class that holds `len` elements, and the length of its buffers.
fn class_of(len: usize) -> (usize, usize) {
    let len = len.max(SMALLEST);
    let log = len.ilog2() as usize;
    let quarter = 1usize << (log - 2);
    let step = (len - (1 << log)).div_ceil(quarter);
    (4 * log + step, (1 << log) + step * quarter)
}

impl<T: Float> Pool<T> {
    pub(crate) const fn new() -> Self {
        Pool { classes: [const { Mutex::new(Vec::new()) }; CLASSES] }
    }

    fn take(&self, len: usize) -> Vec<T> {
        if len < SMALLEST {
            return vec![T::ZERO; len];
        }
        let (class, capacity) = class_of(len);
        if let Some(buffer) = self.classes[class].lock().expect("no panic holds this lock").pop() {
            HELD.fetch_sub(capacity * size_of::<T>(), Relaxed);
            return buffer;
        }
        FRESH.fetch_add(1, Relaxed);
        vec![T::ZERO; capacity]
    }

    fn give(&self, buffer: Vec<T>) {
        let bytes = buffer.len() * size_of::<T>();
        if buffer.len() < SMALLEST || HELD.load(Relaxed) + bytes > CAP.load(Relaxed) {
            return;
        }
        let (class, capacity) = class_of(buffer.len());
        if capacity == buffer.len() {
            HELD.fetch_add(bytes, Relaxed);
            self.classes[class].lock().expect("no panic holds this lock").push(buffer);
        }
    }
}

/// A run of elements that goes back to its pool when dropped.
pub struct Buffer<T: Float> {
    store: Vec<T>,
    len: usize,
}

impl<T: Float> Buffer<T> {
    /// `len` elements of *unspecified* value: whoever asks writes every one of them before reading it.
    pub fn stale(len: usize) -> Self {
        let mut store = T::pool().take(len);
        count(len * size_of::<T>());
        if POISON.load(Relaxed) {
            store[..len].fill(T::NAN);
        }
        Buffer { store, len }
    }

    /// `len` copies of `value`.
    pub fn filled(len: usize, value: T) -> Self {
        let mut buffer = Self::stale(len);
        buffer.fill(value);
        buffer
    }
}

impl<T: Float> From<Vec<T>> for Buffer<T> {
    fn from(store: Vec<T>) -> Self {
        let len = store.len();
        count(len * size_of::<T>());
        Buffer { store, len }
    }
}

impl<T: Float> Deref for Buffer<T> {
    type Target = [T];
    #[inline]
    fn deref(&self) -> &[T] {
        &self.store[..self.len]
    }
}

impl<T: Float> DerefMut for Buffer<T> {
    #[inline]
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.store[..self.len]
    }
}

impl<T: Float> Clone for Buffer<T> {
    fn clone(&self) -> Self {
        let mut copy = Self::stale(self.len);
        copy.copy_from_slice(self);
        copy
    }
}

impl<T: Float> Drop for Buffer<T> {
    fn drop(&mut self) {
        USED.fetch_sub(self.len * size_of::<T>(), Relaxed);
        T::pool().give(std::mem::take(&mut self.store));
    }
}

/// Whether buffers are filled with NaN before they are handed out, to expose reads of stale values.
pub fn set_poison(on: bool) {
    POISON.store(on, Relaxed);
}

/// The bytes of all buffers that somebody holds now.
pub fn used_bytes() -> usize {
    USED.load(Relaxed)
}

/// The most bytes that were held at once while `f` ran, by anybody in this process, beyond what was held before.
pub fn peak_of<R>(f: impl FnOnce() -> R) -> (R, usize) {
    let before = used_bytes();
    PEAK.store(before, Relaxed);
    let result = f();
    (result, PEAK.load(Relaxed).saturating_sub(before))
}

/// The bytes that wait in free lists.
pub fn held_bytes() -> usize {
    HELD.load(Relaxed)
}

/// How many buffers had to be allocated anew since the program started; steady work adds none.
pub fn fresh_buffers() -> u64 {
    FRESH.load(Relaxed)
}

/// The most bytes that may wait in free lists (8 GiB unless set); what exceeds it goes back to the system.
pub fn set_cap(bytes: usize) {
    CAP.store(bytes, Relaxed);
}

/// Gives every waiting buffer back to the system.
pub fn clear() {
    fn empty<T: Float>() {
        for class in &T::pool().classes {
            for buffer in class.lock().expect("no panic holds this lock").drain(..) {
                HELD.fetch_sub(buffer.len() * size_of::<T>(), Relaxed);
            }
        }
    }
    empty::<f32>();
    empty::<f64>();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_class_holds_its_lengths_with_little_waste() {
        for len in (1..5000).chain([1 << 20, (1 << 20) + 1, 12_345_678]) {
            let (class, capacity) = class_of(len);
            assert!(capacity >= len);
            assert!(len <= SMALLEST || capacity as f64 <= 1.25 * len as f64, "{len} -> {capacity}");
            assert_eq!(class_of(capacity), (class, capacity), "a buffer must return to the class it came from");
        }
    }

    #[test]
    fn a_dropped_buffer_comes_back() {
        let mut first = Buffer::<f64>::stale(987_654);
        first[0] = 42.0;
        let address = first.as_ptr();
        drop(first);
        let again = Buffer::<f64>::stale(987_600);
        assert_eq!(again.as_ptr(), address);
        assert_eq!(again[0], 42.0, "not zeroed");
    }
}
