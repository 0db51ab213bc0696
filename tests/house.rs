//! The rules of the house that the compiler does not check: who may import whom, and where `unsafe` stands.

use std::fs;
use std::path::{Path, PathBuf};

/// All Rust files below a folder of the project.
fn sources(folder: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut open = vec![Path::new(env!("CARGO_MANIFEST_DIR")).join(folder)];
    while let Some(folder) = open.pop() {
        for entry in fs::read_dir(&folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display())) {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else if path.extension().is_some_and(|ending| ending == "rs") {
                found.push(path);
            }
        }
    }
    assert!(found.len() > 3, "{folder} holds Rust files");
    found
}

/// The code of a file: without comments, and without the tests at its end.
fn code(path: &Path) -> String {
    let text = fs::read_to_string(path).unwrap();
    let text = text.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
    text.lines().map(|line| line.split("//").next().unwrap_or_default()).collect::<Vec<_>>().join("\n")
}

/// The part of a path after `src/`.
fn place(path: &Path) -> String {
    path.strip_prefix(Path::new(env!("CARGO_MANIFEST_DIR")).join("src")).unwrap().to_str().unwrap().replace('\\', "/")
}

/// The words that follow `prefix` in a text.
fn words_after<'a>(text: &'a str, prefix: &str) -> impl Iterator<Item = &'a str> {
    text.split(prefix).skip(1).map(|rest| rest.split(|c: char| !c.is_alphanumeric() && c != '_').next().unwrap_or(""))
}

/// The folders and files of `src/` in the order of ARCHITECTURE.md's table.
fn order() -> Vec<String> {
    let table = include_str!("../ARCHITECTURE.md");
    let rows = table.lines().filter(|line| line.starts_with("| `src/"));
    let names = rows.flat_map(|line| {
        let cell = line.split('|').nth(1).unwrap_or_default();
        words_after(cell, "`src/").map(str::to_owned).collect::<Vec<_>>()
    });
    names.collect()
}

#[test]
fn a_folder_imports_only_what_stands_above_it() {
    let order = order();
    assert!(order.len() > 12 && order[0] == "random", "{order:?}");
    let rank = |name: &str| order.iter().position(|other| other == name);
    let mut seen = 0;
    for path in sources("src") {
        let place = place(&path);
        if place.ends_with("/tests.rs") || ["lib.rs", "main.rs", "test_support.rs"].contains(&&place[..]) {
            continue;
        }
        let own = place.split(['/', '.']).next().unwrap_or_default();
        let own_rank = rank(own).unwrap_or_else(|| panic!("src/{own} is not in ARCHITECTURE.md's table"));
        for name in words_after(&code(&path), "crate::") {
            if let Some(other) = rank(name) {
                seen += 1;
                assert!(other <= own_rank, "src/{place} imports `{name}`, which stands below it");
            }
        }
    }
    assert!(seen > 300, "{seen} imports");
}

/// A helper of two families belongs to `support`.
#[test]
fn no_family_of_ops_imports_another() {
    let families = ["reduce", "movement", "product", "normalise", "conv", "attention", "image", "depth"]
        .map(|f| format!("ops/{f}/"));
    for path in sources("src/ops") {
        let place = place(&path);
        let Some(own) = families.iter().find(|family| place.starts_with(*family)) else { continue };
        for name in words_after(&code(&path), "crate::ops::") {
            let imported = format!("ops/{name}/");
            assert!(imported == *own || !families.contains(&imported), "src/{place} imports ops::{name}");
        }
    }
}

#[test]
fn unsafe_stands_where_it_is_known_to() {
    let mut found = Vec::new();
    for path in sources("src") {
        let text = code(&path);
        let blocks = text.split(|c: char| !c.is_alphanumeric() && c != '_').filter(|word| *word == "unsafe").count();
        if blocks > 0 {
            found.push((place(&path), blocks));
        }
    }
    // A call into matrixmultiply; the way into a function for one instruction, and vectors that have no constructor.
    let known = [("tensor/bf16.rs", 2), ("tensor/gemm_small.rs", 1)].map(|(file, blocks)| (file.to_owned(), blocks));
    assert_eq!(found, known);
}

/// A size that a kernel cuts its work at is asked for (`tensor::regime`), so that checks can make it small: a constant in a
/// cutting call is a cut that no check can cross. Registers are no matter of size: their loops are allowed by name.
#[test]
fn kernels_ask_for_the_sizes_at_which_they_cut() {
    const CUTS: [&str; 7] = [
        "chunks(",
        "chunks_mut(",
        "chunks_exact(",
        "chunks_exact_mut(",
        "step_by(",
        "for_each_chunk(",
        "for_each_unit(",
    ];
    // Registers; what a window or a sum consists of.
    const ALLOWED: [&str; 4] = ["LANES", "TILE", "TAPS", "PARTS"];
    let mut seen = 0;
    for path in sources("src/ops").into_iter().chain(sources("src/optim")) {
        let (place, text) = (place(&path), code(&path));
        assert!(!text.contains("rayon::"), "src/{place} reaches threads past tensor::parallel");
        for line in text.lines() {
            for cut in CUTS {
                for arguments in line.split(cut).skip(1) {
                    seen += 1;
                    let until = arguments.split(')').next().unwrap_or_default();
                    let words = until.split(|c: char| !c.is_alphanumeric() && c != '_');
                    let constant = words
                        .into_iter()
                        .find(|word| word.len() > 2 && word.chars().all(|c| c.is_ascii_uppercase() || c == '_'));
                    let Some(constant) = constant else { continue };
                    let asked = line.contains("regime::") || ALLOWED.contains(&constant);
                    assert!(asked, "src/{place} cuts at the constant {constant}: {}", line.trim());
                }
            }
        }
    }
    assert!(seen > 150, "{seen} cutting calls");
}
