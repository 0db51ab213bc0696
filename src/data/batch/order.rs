//! Which samples a step takes.

use crate::data::DataSource;
use crate::random::{Random, Stream};

/// The epoch that a position in the endless order of samples lies in, and the place in that epoch's order; both from 0.
///
/// # Panics
/// If an epoch has no samples.
pub fn epoch_and_place(len: usize, position: u64) -> (u64, usize) {
    (position / len as u64, (position % len as u64) as usize)
}

/// The samples of a step: every epoch is a new order of all samples; a batch may straddle two.
pub fn samples_of_step(len: usize, batch: usize, seed: u64, step: u64) -> Vec<usize> {
    with_epochs(len, batch, seed, step).into_iter().map(|(_, index)| index).collect()
}

/// The samples of a step as the data number them: those whose samples change from epoch to epoch are asked which.
pub(super) fn of_step(data: &dyn DataSource, batch: usize, seed: u64, step: u64) -> Vec<usize> {
    with_epochs(data.len(), batch, seed, step).into_iter().map(|(epoch, index)| data.of_epoch(epoch, index)).collect()
}

/// The epochs and indices of a step's samples.
fn with_epochs(len: usize, batch: usize, seed: u64, step: u64) -> Vec<(u64, usize)> {
    let mut orders: Vec<(u64, Vec<usize>)> = Vec::new();
    let positions = (step * batch as u64..).take(batch);
    positions
        .map(|at| {
            let (epoch, place) = epoch_and_place(len, at);
            if orders.last().is_none_or(|(e, _)| *e != epoch) {
                let mut order: Vec<usize> = (0..len).collect();
                Random::of(seed, Stream::Order(epoch)).shuffle(&mut order);
                orders.push((epoch, order));
            }
            (epoch, orders[orders.len() - 1].1[place])
        })
        .collect()
}
