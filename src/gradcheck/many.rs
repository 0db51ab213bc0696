//! The cases of many ops, checked side by side.

use std::panic::resume_unwind;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::thread;

use crate::ops::registry::{AnyCase, Entry};
use crate::tensor::parallel;

/// Calls `f` for every case of every op, on as many threads as kernels use; the results in the order of the cases.
///
/// A case stays on one thread, which is none of the kernels' own: what a check sets for its thread (their number, the size
/// of pieces, who listens) no other case sees.
///
/// # Panics
/// If `f` does.
pub fn for_each_case<R: Send>(entries: &[Entry], f: impl Fn(&Entry, &dyn AnyCase) -> R + Sync) -> Vec<R> {
    let cases = |(entry, op): (usize, &Entry)| (0..op.cases().len()).map(move |case| (entry, case)).collect::<Vec<_>>();
    let all: Vec<(usize, usize)> = entries.iter().enumerate().flat_map(cases).collect();
    let next = AtomicUsize::new(0);
    let work = || {
        let mut results = Vec::new();
        while let Some(&(entry, case)) = all.get(next.fetch_add(1, Relaxed)) {
            let (op, cases) = (&entries[entry], entries[entry].cases());
            results.push(((entry, case), f(op, cases[case].as_ref())));
        }
        results
    };
    let mut results = thread::scope(|scope| {
        let threads: Vec<_> = (0..parallel::threads()).map(|_| scope.spawn(work)).collect();
        let results = threads.into_iter().map(|thread| thread.join().unwrap_or_else(|panic| resume_unwind(panic)));
        results.flatten().collect::<Vec<_>>()
    });
    results.sort_by_key(|(place, _)| *place);
    results.into_iter().map(|(_, result)| result).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::registry;

    #[test]
    fn every_case_is_visited_once_and_in_order() {
        let all = registry::all();
        let found = for_each_case(&all, |entry, case| (entry.name, case.name().to_owned()));
        let names = |e: &Entry| e.cases().iter().map(|c| (e.name, c.name().to_owned())).collect::<Vec<_>>();
        assert_eq!(found, all.iter().flat_map(names).collect::<Vec<_>>());
    }

    #[test]
    #[should_panic(expected = "on purpose")]
    fn a_panic_comes_out() {
        for_each_case(&registry::all()[..1], |_, _| panic!("on purpose"));
    }
}
