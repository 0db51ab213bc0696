//! Cases that nobody listed: attributes and sizes drawn from their ranges. `PARALLAX_DRAWN` asks for more of each op, and
//! `parallax gradcheck --thorough` draws for an hour.

use std::collections::BTreeMap;

use parallax::gradcheck::{Subject, check_everything};
use parallax::ops::registry;
use parallax::random::{Random, Stream};

/// The seed of what is drawn, and how many of each op.
const SEED: u64 = 7;
const EACH: usize = 4;

#[test]
fn combinations_that_nobody_listed_are_right() {
    let each = std::env::var("PARALLAX_DRAWN").ok().and_then(|n| n.parse().ok()).unwrap_or(EACH);
    let (mut failures, mut count) = (Vec::new(), BTreeMap::new());
    for entry in registry::all() {
        let mut random = Random::of(SEED, Stream::CaseInputs);
        for seed in 0..each as u64 {
            let Some(case) = entry.draw(&mut random) else { break };
            *count.entry(entry.name).or_insert(0) += 1;
            let found = check_everything(&Subject::drawn(case.as_ref(), seed)).complaints.into_iter();
            failures.extend(found.map(|c| format!("{} [{}] {}, {}: {}", entry.name, c.algo, c.case, c.check, c.why)));
        }
    }
    println!("{count:?}");
    assert!(count.len() > 15 && count.values().all(|&n| n == each), "{count:?}");
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
}
