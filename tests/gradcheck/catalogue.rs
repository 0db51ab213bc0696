//! The catalogue: wrong gradients that were found in public libraries, and what stands against each of them here.
//!
//! `CATALOGUE.md` is written from it: with `PARALLAX_WRITE_CATALOGUE=1 cargo test --test gradcheck catalogue`. Without,
//! the test fails where the page says something else.

use std::fmt::Write;

use crate::regressions::REGRESSIONS;

/// A gradient that was wrong somewhere, and the test that shows it right here.
pub struct Regression {
    /// Its number in the catalogue.
    pub row: u32,
    /// The test.
    pub test: &'static str,
    /// The op here.
    pub op: &'static str,
    /// What was wrong, where it was found.
    pub bug: &'static str,
    /// The report.
    pub link: &'static str,
}

/// Bugs that no single test of ours can repeat: (row, op, what was wrong, link, what stands against it).
const ELSEWHERE: &[(u32, &str, &str, &str, &str)] = &[
    (
        38,
        "gemm",
        "dfdx: accumulated into memory that was never written",
        "https://github.com/coreylowman/dfdx/pull/777",
        "check `poison`: every case over memory full of NaN",
    ),
    (
        64,
        "max_pool2d",
        "executorch: the buffer was not cleared",
        "https://github.com/pytorch/executorch/issues/21686",
        "check `poison`; mutant `max_pool2d onto memory that was not cleared`",
    ),
    (
        35,
        "attention",
        "burn: a row that is masked throughout becomes NaN",
        "https://github.com/tracel-ai/burn/issues/4694",
        "no op here takes a mask; a softmax over nothing but minus infinity is NaN, documented and tested",
    ),
    (
        61,
        "attention",
        "PyTorch: one masked row poisons the batch",
        "https://github.com/pytorch/pytorch/issues/41508",
        "no op here takes a mask; rows of a softmax do not meet",
    ),
    (
        54,
        "avg_pool2d",
        "PyTorch: an offset forgotten for padded NHWC images",
        "https://github.com/pytorch/pytorch/issues/188344",
        "`avg_pool2d` has no padding; NHWC is the only layout, and every other test uses it",
    ),
    (
        55,
        "avg_pool2d",
        "PyTorch inductor: forward divides by the clipped window, backward by the whole",
        "https://github.com/pytorch/pytorch/issues/198119",
        "windows are never clipped here (no `ceil_mode`); see row 31",
    ),
    (
        62,
        "views",
        "PyTorch: a change in place through a view loses gradients",
        "https://github.com/pytorch/pytorch/issues/49824",
        "nothing changes in place: a `Var` is a value, and writing to a shared `Tensor` copies",
    ),
    (
        63,
        "layer_norm",
        "PyTorch: second derivative with a bias but no weight",
        "https://github.com/pytorch/pytorch/issues/79705",
        "first order only: a tape is reversed once",
    ),
    (
        88,
        "conv3d",
        "neon: a wrong index along the depth",
        "https://github.com/NervanaSystems/neon/issues/111",
        "no op here has three spatial dimensions",
    ),
    (
        89,
        "sign",
        "warp: the adjoint of abs used for sign",
        "https://github.com/NVIDIA/warp/issues/1466",
        "sign has no gradient to speak of, and is no op here",
    ),
];

/// Rows of the catalogue.
const ROWS: u32 = 93;

fn page() -> String {
    let mut rows: Vec<(u32, String)> = Vec::new();
    for r in REGRESSIONS {
        rows.push((r.row, format!("| W{} | {} | [{}]({}) | test `{}` | right |", r.row, r.op, r.bug, r.link, r.test)));
    }
    for (row, op, bug, link, against) in ELSEWHERE {
        rows.push((*row, format!("| W{row} | {op} | [{bug}]({link}) | {against} | cannot be |")));
    }
    rows.sort_by_key(|(row, _)| *row);
    let mut page = String::from(
        "# Wrong gradients found in the wild\n\n\
         Each was reported against a public library. A test here has the input that exposed it, or the table says why the\n\
         bug cannot be. This page is written by the suite from `regressions.rs` and `catalogue.rs`; do not edit it.\n\n\
         | | op | what was wrong | what stands against it here | status |\n|---|---|---|---|---|\n",
    );
    for (_, row) in &rows {
        let _ = writeln!(page, "{row}");
    }
    let _ = writeln!(page, "\n{} tests; {} rows that cannot be.", REGRESSIONS.len(), ELSEWHERE.len());
    page
}

#[test]
fn the_catalogue_is_complete_and_its_page_says_what_the_tests_say() {
    let mut found: Vec<u32> = REGRESSIONS.iter().map(|r| r.row).chain(ELSEWHERE.iter().map(|r| r.0)).collect();
    found.sort();
    found.dedup();
    let missing: Vec<u32> = (1..=ROWS).filter(|row| !found.contains(row)).collect();
    assert!(missing.is_empty() && found.len() == ROWS as usize, "rows without an answer: {missing:?}");
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/gradcheck/CATALOGUE.md");
    if std::env::var_os("PARALLAX_WRITE_CATALOGUE").is_some() {
        std::fs::write(path, page()).expect("the page can be written");
    }
    let written = std::fs::read_to_string(path).unwrap_or_default();
    assert!(written == page(), "{path} is out of date: run with PARALLAX_WRITE_CATALOGUE=1");
}
