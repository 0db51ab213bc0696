//! Bugs planted in the kernels themselves: the checks of the op must notice each.
//!
//! Two kinds. At every place where a kernel cuts its work, bugs made from the list `regime::mutants::Bug`; and those of
//! `planted/formulas.txt`, each a piece of a kernel's source and what stands there instead. All are compiled in at once and
//! switched on one after the other, in a copy of the crate, so that kernels bear no trace of it:
//!
//! ```text
//! PARALLAX_PLANT=target/planted cargo test --test planted plant -- --ignored       # writes the copy
//! cd target/planted && RUSTFLAGS="--cfg mutants" cargo test --test planted -- --nocapture
//! ```
#![cfg_attr(mutants, allow(dead_code, unused_imports))]

use std::fs;
use std::path::Path;

/// One bug of the list.
#[cfg_attr(not(mutants), expect(dead_code, reason = "what is wrong is told by the copy"))]
struct Formula {
    /// Those of which one has to notice.
    ops: Vec<String>,
    what: String,
    file: String,
    right: String,
    wrong: String,
    single: bool,
}

fn formulas() -> Vec<Formula> {
    let list = fs::read_to_string("tests/planted/formulas.txt").expect("the list");
    let entries = list.split("\n\n").map(|e| e.lines().filter(|l| !l.starts_with('#')).collect::<Vec<_>>());
    let entries = entries.filter(|lines| !lines.is_empty());
    let parse = |lines: Vec<&str>| {
        let [title, file, right, wrong] = lines[..] else { panic!("four lines, not {lines:?}") };
        let (ops, what) = title.split_once(": ").expect("OPS: WHAT IS WRONG");
        let (how, wrong) = wrong.split_once(' ').expect("+ CODE");
        assert!(["+", "+f32"].contains(&how), "{title}: `{how}`");
        Formula {
            ops: ops.split(", ").map(str::to_owned).collect(),
            what: what.to_owned(),
            file: file.to_owned(),
            right: right.strip_prefix("- ").expect("- CODE").to_owned(),
            wrong: wrong.to_owned(),
            single: how == "+f32",
        }
    };
    entries.map(parse).collect()
}

/// The source with the bug beside what is right.
fn planted(source: &str, number: usize, bug: &Formula) -> String {
    let Formula { right, wrong, single, .. } = bug;
    let f32_alone = if *single { " && std::mem::size_of::<T>() == 4" } else { "" };
    let on = format!("crate::tensor::regime::mutants::formula({number}){f32_alone}");
    let both = match right.strip_prefix("let ") {
        None => format!("(if {on} {{ {wrong} }} else {{ {right} }})"),
        Some(right) => {
            let right = right.strip_suffix(';').expect("let NAME = CODE;");
            let (name, right) = right.split_once(" = ").expect("let NAME = CODE;");
            let wrong = wrong.strip_prefix(&format!("let {name} = ")).and_then(|w| w.strip_suffix(';'));
            format!("let {name} = if {on} {{ {} }} else {{ {right} }};", wrong.expect("the same name"))
        }
    };
    source.replacen(right, &both, 1)
}

/// The list is of the source as it is.
#[cfg(not(mutants))]
#[test]
fn every_formula_stands_where_the_list_says() {
    let all = formulas();
    assert!(all.len() > 40);
    for Formula { ops, file, right, wrong, .. } in &all {
        let source = fs::read_to_string(file).unwrap_or_else(|e| panic!("{file}: {e}"));
        assert_eq!(source.matches(right.as_str()).count(), 1, "{file}: `{right}`");
        assert_ne!(right, wrong);
        let known = |op: &String| parallax::ops::registry::all().iter().any(|entry| entry.name == op);
        assert!(ops.iter().all(known), "{ops:?}");
    }
}

/// Writes a copy of the crate with all formulas' bugs in it, to the folder that `PARALLAX_PLANT` names.
#[cfg(not(mutants))]
#[test]
#[ignore = "writes a copy of the crate to PARALLAX_PLANT"]
fn plant() {
    let to = std::env::var("PARALLAX_PLANT").expect("PARALLAX_PLANT names a folder");
    fs::create_dir_all(&to).expect("a folder");
    for name in ["Cargo.toml", "Cargo.lock", "build.rs", "rustfmt.toml", "src", "tests", "benches", "examples"] {
        copy(Path::new(name), &Path::new(&to).join(name));
    }
    for (number, bug) in formulas().iter().enumerate() {
        let path = Path::new(&to).join(&bug.file);
        let source = fs::read_to_string(&path).expect("copied");
        fs::write(path, planted(&source, number, bug)).expect("writable");
    }
}

#[cfg(not(mutants))]
fn copy(from: &Path, to: &Path) {
    if from.is_dir() {
        fs::create_dir_all(to).expect("a folder");
        for entry in fs::read_dir(from).expect("readable") {
            let name = entry.expect("readable").file_name();
            copy(&from.join(&name), &to.join(&name));
        }
    } else if fs::read(to).ok() != Some(fs::read(from).expect("readable")) {
        // What is the same keeps its time, and is not compiled again.
        fs::copy(from, to).expect("writable");
    }
}

#[cfg(mutants)]
mod noticed {
    use std::collections::BTreeMap;
    use std::panic::{AssertUnwindSafe, catch_unwind};

    use parallax::gradcheck::{CHECKS, Pieces, SIZES, Subject};
    use parallax::ops::registry;
    use parallax::tensor::pool;
    use parallax::tensor::regime::mutants::{Bug, plant, plant_formula, plant_overwriting};

    /// Cuts of which a bug changes nothing.
    /// File, and what stands at the cut.
    const HARMLESS: [(&str, &str); 1] =
        // The last piece is the row below the image, which has no differences.
        [("src/ops/depth/smoothness.rs", "parallel::for_each_piece(pieces, 24 * image.len(),")];

    fn is_harmless(file: &str, line: u32) -> bool {
        let at = |known: &str| {
            std::fs::read_to_string(known).expect("a source").lines().nth(line as usize - 1).map(str::to_owned)
        };
        HARMLESS.iter().any(|(known, code)| file.ends_with(known) && at(known).is_some_and(|line| line.contains(code)))
    }

    /// How many bugs each check noticed first.
    #[derive(Default)]
    struct Score {
        planted: usize,
        by: BTreeMap<(&'static str, &'static str), usize>,
        survivors: Vec<String>,
    }

    impl Score {
        fn add(&mut self, kind: &'static str, what: String, noticed: Option<&'static str>) {
            self.planted += 1;
            match noticed {
                Some(check) => *self.by.entry((kind, check)).or_default() += 1,
                None => self.survivors.push(what),
            }
        }
    }

    /// The first check of a case that fails, with pieces of these sizes too; a panic is noticed like a failure.
    fn first_failure(subject: &Subject, sizes: &[usize]) -> Option<&'static str> {
        for (name, check) in CHECKS {
            if !matches!(catch_unwind(AssertUnwindSafe(|| check(subject))), Ok(Ok(()))) {
                return Some(name);
            }
        }
        with_small_pieces(&Pieces::new(subject), sizes)
    }

    fn with_small_pieces(pieces: &Pieces, sizes: &[usize]) -> Option<&'static str> {
        sizes.iter().find_map(|&size| match catch_unwind(AssertUnwindSafe(|| pieces.check(size))) {
            Ok(found) => found.complaints.first().map(|(check, _)| *check),
            Err(_) => Some("panic"),
        })
    }

    #[test]
    fn every_planted_bug_is_noticed_by_the_checks_of_its_op() {
        let mut score = Score::default();
        let entries = registry::all();
        std::panic::set_hook(Box::new(|_| ()));
        // What a piece that is not computed leaves behind must not be the right numbers of the time before.
        pool::set_poison(true);
        for entry in &entries {
            let cases = entry.cases();
            let subjects: Vec<Subject> = cases.iter().map(|case| Subject::new(case.as_ref(), 1)).collect();
            let pieces: Vec<Pieces> = subjects.iter().map(Pieces::new).collect();
            // Which cases cut where, at which size; the most pieces, and whether they are cut by length.
            let mut places: BTreeMap<(&str, u32), (Vec<(usize, usize)>, usize, bool)> = BTreeMap::new();
            for (k, pieces) in pieces.iter().enumerate() {
                for size in SIZES {
                    for cut in pieces.check(size).cuts.iter().filter(|cut| cut.pieces > 1) {
                        let file = cut.location.file();
                        let (at, most, by_length) = places.entry((file, cut.location.line())).or_default();
                        *most = cut.pieces.max(*most);
                        *by_length |= cut.rest.is_some();
                        if at.last() != Some(&(k, size)) {
                            at.push((k, size));
                        }
                    }
                }
            }
            for ((file, line), (at, most, by_length)) in places {
                for bug in Bug::ALL {
                    let harmless = is_harmless(file, line)
                        || (bug == Bug::DropsBeyondSecond && most < 3)
                        || (bug == Bug::ShortensLast && !by_length);
                    if harmless {
                        continue;
                    }
                    plant(Some((file.to_owned(), line, bug)));
                    let look = || at.iter().find_map(|&(k, size)| with_small_pieces(&pieces[k], &[size]));
                    let noticed = look().or_else(|| {
                        // Some kernels do what overflowed again with more care, and NaN looks like overflow.
                        pool::set_poison(false);
                        let noticed = look();
                        pool::set_poison(true);
                        noticed
                    });
                    score.add(bug.name(), format!("{}: {bug:?} at {file}:{line}", entry.name), noticed);
                }
            }
            plant(None);
            plant_overwriting(true);
            let noticed = subjects.iter().find_map(|subject| first_failure(subject, &[]));
            plant_overwriting(false);
            if subjects.iter().any(|subject| subject.all.contains(&true)) {
                score.add("overwrites", format!("{}: gradients are not added", entry.name), noticed);
            }
        }
        pool::set_poison(false);
        for (number, formula) in super::formulas().iter().enumerate() {
            let mut noticed = None;
            for op in &formula.ops {
                let entry = entries.iter().find(|entry| entry.name == op).expect("a registered op");
                for case in entry.cases() {
                    // Differences are of the planted forward pass, too: of what the op computes.
                    plant_formula(Some(number));
                    let found =
                        catch_unwind(AssertUnwindSafe(|| first_failure(&Subject::new(case.as_ref(), 1), &SIZES[1..3])));
                    plant_formula(None);
                    noticed = noticed.or(found.unwrap_or(Some("panic")));
                }
            }
            score.add("formula", format!("{}: {}", formula.ops.join(", "), formula.what), noticed);
        }
        let _ = std::panic::take_hook();
        println!("{:24} {:16} {:>6}", "bug", "first noticed by", "bugs");
        for ((kind, check), count) in &score.by {
            println!("{kind:24} {check:16} {count:6}");
        }
        println!("{} bugs planted, {} not noticed", score.planted, score.survivors.len());
        assert!(score.survivors.is_empty(), "{}", score.survivors.join("\n"));
    }
}
