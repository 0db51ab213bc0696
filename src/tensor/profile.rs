//! What ran: op by op, with kernel path, arithmetic, memory traffic and time, and what a step does besides its ops. Off
//! unless somebody listens.
//!
//! Coverage asks it which kernel paths a training step takes, `bench` where the time goes, and the trainer which op
//! first made a number that is not finite.
//!
//! Scopes nest (an op's backward pass adds a gradient to one that is there): every scope's time is without that of the
//! scopes inside it, so that the times of a profile add up.

use std::cell::RefCell;
use std::time::{Duration, Instant};

use super::{Float, Shape, Tensor, parallel};

/// Least work of one pass of an op.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Work {
    /// Floating-point operations, a multiplication and an addition counted as two; 0 where it is not a matter of
    /// arithmetic.
    pub flops: u64,
    /// Bytes to be read and written if each is touched once.
    pub bytes: u64,
}

/// Profile of one op that ran.
#[derive(Clone, Debug)]
pub struct Entry {
    /// The op's name.
    pub op: &'static str,
    /// The kernel path it took.
    pub algo: &'static str,
    /// Arithmetic of the forward pass.
    pub flops: u64,
    /// Least memory traffic of the forward pass: inputs and outputs, in bytes.
    pub bytes: u64,
    /// What its backward pass has to do for the gradients that somebody wants.
    pub back: Work,
    /// Time of the forward pass.
    pub forward: Duration,
    /// Time of the backward pass; zero if there was none.
    pub backward: Duration,
    /// The shape of the first output.
    pub output: Shape,
    /// Whether every output was finite; only looked at if asked for.
    pub finite: bool,
}

/// Profile of a named part of the work that is no op.
#[derive(Clone, Copy, Debug)]
pub struct Phase {
    /// What it is called.
    pub name: &'static str,
    /// The time it took, without ops and phases inside it.
    pub time: Duration,
}

/// Profile of a piece of work: its ops and other parts, with their times.
#[derive(Clone, Debug, Default)]
pub struct Profile {
    /// The ops, in the order of their forward passes.
    pub ops: Vec<Entry>,
    /// What is no op, in the order in which it ended.
    pub phases: Vec<Phase>,
    /// From the beginning to the end.
    pub total: Duration,
}

impl Profile {
    /// The time that ops and phases account for: at most the total.
    pub fn accounted(&self) -> Duration {
        let ops: Duration = self.ops.iter().map(|e| e.forward + e.backward).sum();
        ops + self.phases.iter().map(|p| p.time).sum::<Duration>()
    }
}

struct Listening {
    profile: Profile,
    look_for_nan: bool,
    /// What scopes inside the present one took.
    inside: Duration,
}

thread_local! {
    static TRACE: RefCell<Option<Listening>> = const { RefCell::new(None) };
}

/// Runs `f` and returns the ops that ran on this thread meanwhile. With `look_for_nan`, every output is examined.
pub fn record<R>(look_for_nan: bool, f: impl FnOnce() -> R) -> (R, Vec<Entry>) {
    let (result, profile) = listen(look_for_nan, f);
    (result, profile.ops)
}

/// Runs `f` and says which op first made a number that is not finite, if one did: its name, kernel path, place and
/// shape.
pub fn first_not_finite<R>(f: impl FnOnce() -> R) -> Option<String> {
    let (_, entries) = record(true, f);
    let (i, e) = entries.iter().enumerate().find(|(_, e)| !e.finite)?;
    Some(format!(
        "the first op that made such a number is {} [{}], op {i} of the forward pass, output {}",
        e.op, e.algo, e.output
    ))
}

/// Runs `f` and returns all that ran on this thread meanwhile, with the time it took.
pub fn profile<R>(f: impl FnOnce() -> R) -> (R, Profile) {
    listen(false, f)
}

fn listen<R>(look_for_nan: bool, f: impl FnOnce() -> R) -> (R, Profile) {
    let mine = Listening { profile: Profile::default(), look_for_nan, inside: Duration::ZERO };
    let before = TRACE.replace(Some(mine));
    let start = Instant::now();
    let result = f();
    let total = start.elapsed();
    let profile = TRACE.replace(before).map(|l| l.profile).unwrap_or_default();
    (result, Profile { total, ..profile })
}

/// Runs `f`, whose ops will not be reversed, for whoever listens.
pub(super) fn without_backward<R>(f: impl FnOnce() -> R) -> R {
    let ops = || TRACE.with_borrow(|trace| trace.as_ref().map_or(0, |listening| listening.profile.ops.len()));
    let first = ops();
    let result = f();
    TRACE.with_borrow_mut(|trace| {
        let ops = trace.iter_mut().flat_map(|listening| listening.profile.ops.iter_mut().skip(first));
        ops.for_each(|entry| entry.back = Work { flops: 0, bytes: 0 });
    });
    result
}

/// Runs `f` as a part with a name, for whoever listens: what takes time and is no op.
///
/// ```
/// use parallax::tensor::profile;
/// let (sum, profile) = profile::profile(|| profile::phase("a sum", || (0..1000).sum::<u64>()));
/// assert_eq!((sum, profile.phases[0].name), (499_500, "a sum"));
/// ```
pub fn phase<R>(name: &'static str, f: impl FnOnce() -> R) -> R {
    let Some(scope) = Scope::begin() else { return f() };
    let result = f();
    scope.end(|listening, time| listening.profile.phases.push(Phase { name, time }));
    result
}

/// Calls `f(i)` for every i below `count`, on all threads, and collects the results in order; whoever listens to this
/// thread hears what runs on the others too. As many run at a time, so each counts for its share of the time.
pub fn map<R: Send>(count: usize, f: impl Fn(usize) -> R + Sync + Send) -> Vec<R> {
    let Some(look_for_nan) = TRACE.with_borrow(|trace| trace.as_ref().map(|listening| listening.look_for_nan)) else {
        return parallel::map(count, usize::MAX, f);
    };
    let heard = parallel::map(count, usize::MAX, |i| listen(look_for_nan, || f(i)));
    let at_a_time = parallel::threads().min(count) as u32;
    let (results, profiles): (Vec<R>, Vec<Profile>) = heard.into_iter().unzip();
    TRACE.with_borrow_mut(|trace| {
        let Some(listening) = trace else { return };
        for mut profile in profiles {
            profile.ops.iter_mut().for_each(|op| op.forward /= at_a_time);
            profile.phases.iter_mut().for_each(|phase| phase.time /= at_a_time);
            listening.inside += profile.accounted();
            listening.profile.ops.append(&mut profile.ops);
            listening.profile.phases.append(&mut profile.phases);
        }
    });
    results
}

/// A stretch of time that somebody listens to.
pub(crate) struct Scope {
    start: Instant,
    /// What scopes before this one, inside the one around it, took.
    inside_before: Duration,
}

impl Scope {
    fn begin() -> Option<Scope> {
        TRACE.with_borrow_mut(|trace| {
            let inside_before = std::mem::take(&mut trace.as_mut()?.inside);
            Some(Scope { start: Instant::now(), inside_before })
        })
    }

    /// Ends it; `tell` gets the time without that of the scopes inside.
    fn end(self, tell: impl FnOnce(&mut Listening, Duration)) {
        let elapsed = self.start.elapsed();
        TRACE.with_borrow_mut(|trace| {
            let Some(listening) = trace else { return };
            let own = elapsed.saturating_sub(listening.inside);
            listening.inside = self.inside_before + elapsed;
            tell(listening, own);
        });
    }
}

/// An op's place in the profile, and the scope of the pass that runs.
pub(crate) type Running = Option<(usize, Scope)>;

/// The forward pass of an op begins; `what` is asked only if somebody listens.
pub(crate) fn begin_forward(what: impl FnOnce() -> Entry) -> Running {
    if !TRACE.with_borrow(Option::is_some) {
        return None;
    }
    let entry = what();
    let place = TRACE.with_borrow_mut(|trace| {
        let ops = &mut trace.as_mut()?.profile.ops;
        ops.push(entry);
        Some(ops.len() - 1)
    })?;
    Some((place, Scope::begin()?))
}

/// It ends: the op's place, for its backward pass.
pub(crate) fn end_forward<T: Float>(running: Running, outputs: &[Tensor<T>]) -> Option<usize> {
    let (place, scope) = running?;
    scope.end(|listening, own| {
        let finite = !listening.look_for_nan || outputs.iter().all(Tensor::is_finite);
        let entry = &mut listening.profile.ops[place];
        entry.forward = own;
        entry.output = outputs.first().map_or(entry.output, |t| *t.shape());
        entry.finite = finite;
    });
    Some(place)
}

/// The backward pass of the op at a place begins.
pub(crate) fn begin_backward(place: Option<usize>) -> Running {
    Some((place?, Scope::begin()?))
}

/// It ends.
pub(crate) fn end_backward(running: Running) {
    let Some((place, scope)) = running else { return };
    scope.end(|listening, own| {
        // Whoever listens now need not be who listened to the forward pass.
        if let Some(entry) = listening.profile.ops.get_mut(place) {
            entry.backward = own;
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::{Tape, Tensor};

    fn busy(microseconds: u64) {
        let start = Instant::now();
        while start.elapsed() < Duration::from_micros(microseconds) {}
    }

    #[test]
    fn times_of_nested_scopes_add_up_to_no_more_than_the_total() {
        let ((), profile) = profile(|| {
            phase("outer", || {
                busy(300);
                phase("inner", || busy(500));
                phase("inner", || busy(500));
            });
            busy(200);
        });
        let time = |name| profile.phases.iter().filter(|p| p.name == name).map(|p| p.time).sum::<Duration>();
        assert!(time("inner") >= Duration::from_micros(1000));
        assert!(time("outer") >= Duration::from_micros(300));
        assert_eq!(time("inner") + time("outer"), profile.accounted());
        // Had the outer phase kept the inner ones' time, the sum would exceed the total.
        assert!(profile.accounted() + Duration::from_micros(200) <= profile.total, "{profile:?}");
    }

    #[test]
    fn what_runs_side_by_side_is_heard_and_shares_the_time() {
        let numbers = |threads| {
            let one = |i: usize| {
                phase("a piece", || busy(400));
                i
            };
            parallel::with_threads(threads, || profile(|| map(4, one)))
        };
        for threads in [1, 2] {
            let (results, profile) = numbers(threads);
            assert_eq!(results, [0, 1, 2, 3]);
            assert_eq!(profile.phases.len(), 4);
            assert!(profile.accounted() >= Duration::from_micros(1600 / threads as u64));
        }
    }

    #[test]
    fn a_gradient_that_is_added_is_not_counted_as_the_ops_time_too() {
        let ((), profile) = profile(|| {
            let tape = Tape::new();
            let x = tape.leaf(Tensor::<f32>::full([1 << 16], 2.0));
            // Two paths: a reshape hands its gradient over, and the second one is added to the first.
            let y = &x.reshape([1 << 8, 1 << 8]) * &x.reshape([1 << 8, 1 << 8]);
            y.sum_all().backward();
        });
        assert_eq!(profile.phases.iter().filter(|p| p.name == "gradient accumulation").count(), 1);
        assert!(profile.phases.iter().any(|p| p.name == "tape"));
        assert!(profile.ops.iter().any(|e| e.op == "mul" && e.backward > Duration::ZERO));
        assert!(profile.accounted() <= profile.total, "{profile:?}");
    }

    #[test]
    fn nothing_is_kept_where_nobody_listens() {
        assert_eq!(phase("unheard", || 7), 7);
        let ((), profile) = profile(|| ());
        assert!(profile.ops.is_empty() && profile.phases.is_empty());
    }
}
