//! What ran: op by op, with kernel path, arithmetic and time. Off unless somebody listens.
//!
//! Coverage asks it which kernel paths a training step takes, `bench` where the time goes, and the trainer which op
//! first made a number that is not finite.

use std::cell::RefCell;
use std::time::{Duration, Instant};

use crate::tensor::{Float, Shape, Tensor};

/// One op that ran.
#[derive(Clone, Debug)]
pub struct Entry {
    /// The op's name.
    pub op: &'static str,
    /// The kernel path it took.
    pub algo: &'static str,
    /// Arithmetic of the forward pass.
    pub flops: u64,
    /// Time of the forward pass.
    pub forward: Duration,
    /// Time of the backward pass; zero if there was none.
    pub backward: Duration,
    /// The shape of the first output.
    pub output: Shape,
    /// Whether every output was finite; only looked at if asked for.
    pub finite: bool,
}

struct Listening {
    entries: Vec<Entry>,
    look_for_nan: bool,
}

thread_local! {
    static TRACE: RefCell<Option<Listening>> = const { RefCell::new(None) };
}

/// Runs `f` and returns what ran on this thread meanwhile. With `look_for_nan`, every output is examined.
pub fn record<R>(look_for_nan: bool, f: impl FnOnce() -> R) -> (R, Vec<Entry>) {
    let before = TRACE.replace(Some(Listening { entries: Vec::new(), look_for_nan }));
    let result = f();
    let entries = TRACE.replace(before).map(|l| l.entries).unwrap_or_default();
    (result, entries)
}

pub(super) fn begin(what: impl FnOnce() -> (&'static str, &'static str, u64)) -> Option<usize> {
    TRACE.with_borrow_mut(|trace| {
        let listening = trace.as_mut()?;
        let (op, algo, flops) = what();
        listening.entries.push(Entry {
            op,
            algo,
            flops,
            forward: Duration::ZERO,
            backward: Duration::ZERO,
            output: Shape::new(&[]),
            finite: true,
        });
        Some(listening.entries.len() - 1)
    })
}

pub(super) fn end_forward<T: Float>(entry: Option<usize>, start: Instant, outputs: &[Tensor<T>]) {
    let Some(i) = entry else { return };
    let elapsed = start.elapsed();
    TRACE.with_borrow_mut(|trace| {
        let Some(listening) = trace else { return };
        let entry = &mut listening.entries[i];
        entry.forward = elapsed;
        entry.output = outputs.first().map_or(entry.output, |t| *t.shape());
        entry.finite = !listening.look_for_nan || outputs.iter().all(Tensor::is_finite);
    });
}

pub(super) fn end_backward(entry: Option<usize>, start: Instant) {
    let Some(i) = entry else { return };
    let elapsed = start.elapsed();
    TRACE.with_borrow_mut(|trace| {
        if let Some(entry) = trace.as_mut().and_then(|l| l.entries.get_mut(i)) {
            entry.backward = elapsed;
        }
    });
}
