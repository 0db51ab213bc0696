//! Every case of every op with all pieces of work made small; and whether what a real training step cuts is among it.
//!
//! The sizes are a switch of the whole process (`tensor::regime`), hence a process of its own.

use std::sync::{Mutex, MutexGuard, PoisonError};

use parallax::data::batch::{Augment, batch_of_step};
use parallax::gradcheck::{Pieces, Regimes, SIZES, Subject};
use parallax::monovit::Preset;
use parallax::ops::registry;
use parallax::street::{Street, StreetConfig};
use parallax::tensor::{parallel, regime};
use parallax::train::{RunConfig, Trainer};

fn take_turns() -> MutexGuard<'static, ()> {
    static TURN: Mutex<()> = Mutex::new(());
    TURN.lock().unwrap_or_else(PoisonError::into_inner)
}

#[test]
fn every_piece_of_work_is_checked() {
    let _turn = take_turns();
    let (mut regimes, mut failures, mut runs) = (Regimes::default(), Vec::new(), 0);
    for case in registry::all().iter().flat_map(|entry| entry.cases()) {
        let subject = Subject::new(case.as_ref(), 1);
        let pieces = Pieces::new(&subject);
        for size in SIZES {
            let found = pieces.check(size);
            runs += usize::from(found.cuts.iter().any(|cut| cut.pieces > 1));
            regimes.add(&found.cuts);
            let complain = |(check, why)| format!("{}, pieces of {size}, {check}: {why}", subject.what());
            failures.extend(found.complaints.into_iter().map(complain));
        }
    }
    for ((op, algo, place), row) in &regimes.rows {
        println!("{op:24} {algo:20} {place:40} {:5} times, at most {:5} pieces", row.times, row.most);
    }
    println!("{} places that cut, {} (op, path, place), {runs} cases cut", regimes.places(), regimes.rows.len());
    failures.extend(regimes.gaps());
    failures.extend(unchecked_in_training(&regimes));
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
}

/// Where a real training step cuts its work, and no case of the same op and kernel path does.
fn unchecked_in_training(checked: &Regimes) -> Vec<String> {
    let street = StreetConfig { height: 96, width: 320, sequences: 1, frames: 6, ..StreetConfig::default() };
    let street = Street::render(&street, None);
    let config = RunConfig::new(Preset::Nano, 10);
    let mut trainer = Trainer::new(config.model(), config.plan());
    let batch = batch_of_step(&street, Augment::default(), 4, 0, 0).expect("a batch");
    let step = || parallel::with_threads(1, || trainer.step(&batch).map(drop));
    let (done, cuts) = regime::record(step);
    done.expect("a step");
    let mut real = Regimes::default();
    real.add(&cuts);
    // What is cut outside of ops (the optimiser, the norm of gradients) has tests of its own.
    let cut = real.rows.iter().filter(|((op, ..), row)| row.most > 1 && !op.is_empty());
    let cut: Vec<_> = cut.map(|(key, _)| key.clone()).collect();
    println!("a training step cuts its work at {} (op, path, place)", cut.len());
    assert!(cut.len() > 100, "only {} cuts were recorded", cut.len());
    let known = |key| checked.rows.get(key).is_some_and(|row| row.most > 1);
    let unknown = cut.iter().filter(|key| !known(key));
    unknown.map(|(op, algo, place)| format!("{op} [{algo}] is cut at {place} in training, in no case")).collect()
}
