//! Every case of every op with all pieces of work made small; and whether what a real training step cuts is among it.

use parallax::data::batch::{Augment, batch_of_step};
use parallax::gradcheck::{Pieces, Regimes, SIZES, Subject, for_each_case};
use parallax::monovit::Preset;
use parallax::networks::{Architecture, EncoderKind, Network};
use parallax::ops::registry;
use parallax::street::{Street, StreetConfig};
use parallax::tensor::{parallel, regime};
use parallax::train::{RunConfig, Trainer};

#[test]
fn every_piece_of_work_is_checked() {
    let (mut regimes, mut failures, mut runs) = (Regimes::default(), Vec::new(), 0);
    let found = for_each_case(&registry::all(), |_, case| {
        let subject = Subject::new(case, 1);
        let pieces = Pieces::new(&subject);
        SIZES.map(|size| {
            let found = pieces.check(size);
            let complain = |(check, why)| format!("{}, pieces of {size}, {check}: {why}", subject.what());
            (found.cuts, found.complaints.into_iter().map(complain).collect::<Vec<_>>())
        })
    });
    for (cuts, complaints) in found.into_iter().flatten() {
        runs += usize::from(cuts.iter().any(|cut| cut.pieces > 1));
        regimes.add(&cuts);
        failures.extend(complaints);
    }
    for ((op, algo, place), row) in &regimes.rows {
        println!("{op:24} {algo:20} {place:40} {:5} times, at most {:5} pieces", row.times, row.most);
    }
    println!("{} places that cut, {} (op, path, place), {runs} cases cut", regimes.places(), regimes.rows.len());
    failures.extend(regimes.gaps());
    let monodepth2 = Architecture::of(Network::Monodepth2, Preset::Nano);
    let deepest = Architecture { network: Network::Monovit, encoder: EncoderKind::Resnet50, ..monodepth2 };
    for architecture in [Preset::Nano.into(), monodepth2, deepest] {
        failures.extend(unchecked_in_training(&regimes, architecture));
    }
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
}

/// Where a real training step cuts its work, and no case of the same op and kernel path does.
fn unchecked_in_training(checked: &Regimes, architecture: Architecture) -> Vec<String> {
    let street = StreetConfig { height: 96, width: 320, sequences: 1, frames: 6, ..StreetConfig::default() };
    let street = Street::render(&street, None);
    let config = RunConfig::new(architecture, 10);
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
    println!("a training step of {} cuts its work at {} (op, path, place)", architecture.name(), cut.len());
    assert!(cut.len() > 80, "only {} cuts were recorded", cut.len());
    let known = |key| checked.rows.get(key).is_some_and(|row| row.most > 1);
    let unknown = cut.iter().filter(|key| !known(key));
    unknown
        .map(|(op, algo, place)| {
            format!("{op} [{algo}] is cut at {place} in training {}, in no case", architecture.name())
        })
        .collect()
}
