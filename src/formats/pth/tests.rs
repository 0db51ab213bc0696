//! Files that PyTorch wrote, compared number by number; files that are wrong; files that mean harm.

use std::io::{Cursor, Read, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use super::*;
use crate::formats::stored::{Dtype, StoredTensor};

/// What is written, in memory.
fn to_bytes(name: &str, entries: &[(String, Saved<'_>)]) -> Result<Vec<u8>, PthError> {
    let mut out = Cursor::new(Vec::new());
    write(&mut out, name, entries)?;
    Ok(out.into_inner())
}

/// The checkpoints that `gen_pth.py` made, and what torch says is in them.
fn made(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/pth").join(name)
}

/// Those with the names of the published network.
fn reference(name: &str) -> PathBuf {
    made(&format!("reference/{name}.pth"))
}

const REFERENCE: [&str; 7] =
    ["encoder", "depth", "pose_encoder", "pose", "one_file/depth", "legacy/encoder", "nested_encoder"];
const MADE: [&str; 14] = [
    "odd",
    "odd_legacy",
    "odd_deflated",
    "odd_protocol3",
    "odd_protocol4",
    "odd_protocol5",
    "odd_legacy_protocol4",
    "bytes",
    "training",
    "training_legacy",
    "namespace",
    "nothing",
    "halves",
    "python2",
];

fn good_files() -> Vec<(String, PathBuf)> {
    let references = REFERENCE.iter().map(|f| (format!("reference-{}", f.replace('/', "-")), reference(f)));
    references.chain(MADE.iter().map(|f| (f.to_string(), made(&format!("{f}.pth"))))).collect()
}

fn fnv(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |h, b| (h ^ u64::from(*b)).wrapping_mul(0x100_0000_01b3))
}

/// Whether an entry is what `gen_pth.py` wrote down for it.
fn agrees(item: &Item, expected: &[&str]) -> bool {
    match (item, expected) {
        (Item::Tensor(t), [dtype, shape, hash]) => {
            t.dtype().name() == *dtype
                && format!("{:?}", t.shape()) == *shape
                && format!("{:016x}", fnv(&t.raw_bytes())) == *hash
        }
        (Item::Plain(plain), ["plain", value]) => match plain {
            Plain::Unread(name) => value == name,
            Plain::None => *value == "None",
            Plain::Bool(b) => *value == if *b { "True" } else { "False" },
            Plain::Int(i) => *value == i.to_string(),
            Plain::Float(x) => value.parse() == Ok(*x),
            Plain::Text(text) => *value == format!("'{text}'") || *value == text,
            Plain::Bytes(bytes) => {
                let inner: String = bytes.iter().flat_map(|b| std::ascii::escape_default(*b)).map(char::from).collect();
                *value == format!("b'{inner}'")
            }
        },
        _ => false,
    }
}

#[test]
fn every_file_holds_what_torch_says() {
    for (label, path) in good_files() {
        let state = read(&path).unwrap_or_else(|e| panic!("{label}: {e}"));
        let legacy = label.contains("legacy") || label == "python2";
        assert_eq!(state.format(), if legacy { Format::Legacy } else { Format::Zip }, "{label}");
        let expected = std::fs::read_to_string(made(&format!("{label}.txt"))).unwrap();
        let expected: Vec<&str> = expected.lines().filter(|l| !l.is_empty()).collect();
        assert_eq!(state.entries().len(), expected.len(), "{label}");
        for ((name, item), line) in state.entries().iter().zip(expected) {
            let fields: Vec<&str> = line.split('\t').collect();
            assert!(name == fields[0] && agrees(item, &fields[1..]), "{label}: {name} {item:?}, expected {line}");
        }
    }
}

#[test]
fn the_contents_are_easy_to_reach() {
    let encoder = read(reference("encoder")).unwrap();
    assert_eq!((encoder.int("height"), encoder.int("width")), (Some(64), Some(96)));
    assert!(matches!(encoder.get("use_stereo"), Some(Item::Plain(Plain::Bool(false)))));
    assert_eq!(encoder.tensors().count(), 637);
    assert_eq!(encoder.plain().count(), 3);
    let tracked = encoder.tensors().find(|(name, _)| name.ends_with("num_batches_tracked")).unwrap();
    assert_eq!((tracked.1.dtype(), tracked.1.as_i64(), tracked.1.to_f32()), (Dtype::I64, Some(0), None));
    assert_eq!(encoder.int(tracked.0), Some(0));

    let nested = read(reference("nested_encoder")).unwrap();
    assert_eq!(nested.int("epoch"), Some(3));
    let nested = nested.under("model.");
    for (name, t) in encoder.tensors() {
        assert_eq!(nested.tensor(name).map(StoredTensor::raw_bytes), Some(t.raw_bytes()), "{name}");
    }

    let one = read(reference("one_file/depth")).unwrap();
    assert!(one.tensor("module.encoder.stem.0.conv.weight").is_some());
    let one = one.strip_prefix("module.").unwrap();
    assert!(
        one.tensor("encoder.stem.0.conv.weight").is_some() && one.get("module.encoder.stem.0.conv.weight").is_none()
    );
}

#[test]
fn stripping_reports_names_that_fall_together() {
    let number = |x: &'static [f32; 1]| Saved::F32 { shape: &[1], data: x };
    let entries = [("module.a".to_owned(), number(&[1.0])), ("a".to_owned(), number(&[2.0]))];
    let state = from_bytes(to_bytes("x", &entries).unwrap()).unwrap();
    assert!(matches!(state.strip_prefix("module."), Err(PthError::Duplicate(name)) if name == "a"));
}

#[test]
fn halves_become_the_same_float_as_in_torch() {
    let state = read(made("halves.pth")).unwrap();
    for (half, float) in [("half", "float"), ("bhalf", "bfloat")] {
        let ours = state.tensor(half).unwrap().to_f32().unwrap();
        let theirs = state.tensor(float).unwrap().to_f32().unwrap();
        assert_eq!(ours.len(), 65_536);
        for (i, (a, b)) in ours.iter().zip(&theirs).enumerate() {
            assert!(a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan(), "{half} {i:#x}: {a} {b}");
        }
        let wide = state.tensor(half).unwrap().to_f64().unwrap();
        assert!(wide.iter().zip(&ours).all(|(w, x)| *w == f64::from(*x) || w.is_nan()));
    }
}

#[test]
fn numbers_are_converted() {
    let state = read(made("odd.pth")).unwrap();
    let doubles = state.tensor("f64").unwrap();
    let rounded: Vec<f32> = doubles.to_f64().unwrap().iter().map(|x| *x as f32).collect();
    assert_eq!(doubles.to_f32().unwrap(), rounded);
    assert_eq!(state.tensor("i64").unwrap().to_i64().unwrap(), [-1, 1 << 62, 3, i64::MIN]);
    assert_eq!(state.tensor("i32").unwrap().to_i64().unwrap(), [-5, 7]);
    assert_eq!(state.tensor("i16").unwrap().to_i64().unwrap(), [-5, 7]);
    assert_eq!(state.tensor("i8").unwrap().to_i64().unwrap(), [-5, 7]);
    assert_eq!(state.tensor("u8").unwrap().to_i64().unwrap(), [250, 7]);
    assert_eq!(state.tensor("bool").unwrap().to_i64().unwrap(), [1, 0]);
    assert_eq!(state.tensor("scalar").unwrap().to_f32().unwrap(), [2.5]);
    assert_eq!(state.int("tracked"), Some(12_345));
    assert!(state.tensor("empty").unwrap().to_f32().unwrap().is_empty());
    assert_eq!(state.tensor("expanded").unwrap().to_f32().unwrap(), [1.5, 1.5, 1.5, 1.5, 2.5, 2.5, 2.5, 2.5]);
}

#[test]
fn wrong_files_get_a_named_error() {
    let cases = [
        ("bad_big_endian", "big-endian"),
        ("bad_big_endian_legacy", "big-endian"),
        ("bad_no_pickle", "without the entry data.pkl"),
        ("bad_no_storage", "the entry `odd/data/3` is missing"),
        ("bad_short_storage", "the entry `odd/data/13` has "),
        ("bad_version", "format version 11, expected at most 10"),
        ("bad_two_pickles", "it has both `odd/data.pkl` and `other/data.pkl`"),
        ("bad_bomb", "64 times the file's size"),
        ("bad_torchscript", "TorchScript"),
        ("bad_whole_model", "refers to `torch.nn.modules.linear.Linear`"),
        ("bad_complex", "refers to `torch.ComplexFloatStorage`"),
        ("bad_bare_tensor", "holds no dictionary of names"),
        ("bad_evil", "refers to `posix.system`, which no list of weights needs"),
        ("bad_evil_legacy", "refers to `posix.system`"),
        ("bad_evil4", "refers to `posix.system`"),
        ("bad_cycle", "nested deeper than 32 levels (or contains itself)"),
        ("bad_cycle_list", "nested deeper than 32 levels"),
    ];
    for (name, expected) in cases {
        let error = read(made(&format!("{name}.pth"))).expect_err(name).to_string();
        assert!(error.contains(expected), "{name}: {error}");
    }
}

#[test]
fn other_files_get_a_named_error() {
    let cases: [(&[u8], &str); 10] = [
        (b"", "cut short: it is empty"),
        (b"P", "begins neither like"),
        (b"PK\x03\x04 and nothing", "table of contents"),
        (b"PK\x05\x06", "an empty zip archive"),
        (b"\x80", "begins neither like"),
        (b"\x80\x02", "its pickle ends at byte 2"),
        (b"\x80\x02K\x05.", "not one that torch.save wrote"),
        (b"\x40\x00\x00\x00\x00\x00\x00\x00{\"a\":", "safetensors"),
        (b"<!DOCTYPE html>", "a web page"),
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
    ];
    for (bytes, expected) in cases {
        let error = from_bytes(bytes.to_vec()).unwrap_err().to_string();
        assert!(error.contains(expected), "{bytes:?}: {error}");
    }
    assert!(matches!(read("/nowhere/at/all.pth"), Err(PthError::Io(_))));
    assert!(matches!(read(std::env::temp_dir()), Err(PthError::NotACheckpoint(_) | PthError::Io(_))));
}

/// An archive of these entries, stored as they are.
fn archive(entries: &[(&str, &[u8])]) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in entries {
        let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
        zip.start_file(format!("x/{name}"), options).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

/// The error that this pickle gives, with one storage of 24 bytes at hand, within a second or so.
fn refusal(pickle: &[u8]) -> String {
    let start = Instant::now();
    let result = from_bytes(archive(&[("data.pkl", pickle), ("data/0", &[0; 24])]));
    assert!(start.elapsed() < Duration::from_secs(10), "too slow: {:?}", start.elapsed());
    result.expect_err("a hostile pickle was accepted").to_string()
}

/// `{"w": tensor}` with these fields of the tensor. Dimensions are written as LONG1.
fn claim(numel: i64, offset: i64, shape: &[i64], strides: &[i64]) -> Vec<u8> {
    fn int(out: &mut Vec<u8>, n: i64) {
        out.extend([0x8a, 8]);
        out.extend(n.to_le_bytes());
    }
    let mut out = b"\x80\x02}X\x01\0\0\0wctorch._utils\n_rebuild_tensor_v2\n((X\x07\0\0\0storagectorch\nFloatStorage\nX\x01\0\0\x000X\x03\0\0\0cpu".to_vec();
    int(&mut out, numel);
    out.extend(b"tQ");
    int(&mut out, offset);
    for sizes in [shape, strides] {
        out.push(b'(');
        sizes.iter().for_each(|n| int(&mut out, *n));
        out.push(b't');
    }
    out.extend(b"\x89ccollections\nOrderedDict\n)RtRs.");
    out
}

fn concat(parts: &[&[u8]]) -> Vec<u8> {
    parts.concat()
}

#[test]
fn tensors_cannot_claim_more_than_is_there() {
    let ok = from_bytes(archive(&[("data.pkl", &claim(6, 0, &[2, 3], &[3, 1])), ("data/0", &[0; 24])])).unwrap();
    assert_eq!(ok.tensor("w").unwrap().to_f32().unwrap(), [0.0; 6]);
    // A stride of a dimension of 1 says nothing, and neither do those of an empty tensor.
    for (shape, strides) in [([1, 6], [i64::MAX, 1]), ([0, 6], [i64::MAX, i64::MAX])] {
        let ok = from_bytes(archive(&[("data.pkl", &claim(6, 0, &shape, &strides)), ("data/0", &[0; 24])])).unwrap();
        assert_eq!(ok.tensor("w").unwrap().to_f32().unwrap().len() as i64, shape[0] * 6);
    }
    let larger = "tensor `w`: shape";
    let cases: [(Vec<u8>, &str); 17] = [
        (claim(6, 0, &[1 << 60], &[1]), larger),
        (claim(6, 0, &[1 << 60], &[0]), "the tensors claim 4611686018427387904 bytes"),
        (claim(6, 0, &[1 << 40], &[0]), "the tensors claim 4398046511104 bytes"),
        (claim(6, 0, &[1 << 40, 1 << 40], &[0, 0]), larger),
        (claim(6, 0, &[0, 1 << 62, 1 << 62], &[1, 1, 1]), larger),
        (claim(6, 0, &[2, 3], &[4, 1]), larger),
        (claim(6, 1, &[2, 3], &[3, 1]), larger),
        (claim(6, i64::MAX, &[2, 3], &[3, 1]), larger),
        (claim(6, 0, &[2, 3], &[i64::MAX, i64::MAX]), larger),
        (claim(6, 0, &[2, 3], &[-3, 1]), "tensor `w`: its strides contains -3"),
        (claim(6, 0, &[-2, 3], &[3, 1]), "tensor `w`: its shape contains -2"),
        (claim(6, -1, &[2, 3], &[3, 1]), "tensor `w`: its offset contains -1"),
        (claim(6, 0, &[2, 3], &[1]), "different lengths"),
        (claim(6, 0, &[1; 17], &[1; 17]), "17 dimensions"),
        (claim(-1, 0, &[], &[]), "storage 0 of -1 elements"),
        (claim(7, 0, &[2, 3], &[3, 1]), "the entry `x/data/0` has 24 bytes, expected 28"),
        (claim(1 << 62, 0, &[1 << 60], &[1]), "storage 0 claims"),
    ];
    for (pickle, expected) in cases {
        let error = refusal(&pickle);
        assert!(error.contains(expected), "expected {expected}: {error}");
    }
}

#[test]
fn hostile_pickles_are_refused() {
    let text = |n: usize| concat(&[b"X", &(n as u32).to_le_bytes(), &vec![b'k'; n]]);
    // A ladder of tuples in which each holds the one below twice.
    let mut ladder = b"\x80\x02}X\x01\0\0\0a)".to_vec();
    for _ in 0..31 {
        ladder.extend(b"q\0h\0\x86");
    }
    ladder.extend(b"s.");
    // A long string under many keys, and a long key on many levels.
    let mut strings = concat(&[b"\x80\x02}(X\x01\0\0\0a", &text(1 << 20), b"q\0"]);
    for i in 0..200_u16 {
        strings.extend(concat(&[b"M", &i.to_le_bytes(), b"h\0"]));
    }
    strings.extend(b"u.");
    let mut keys = concat(&[b"\x80\x02}(", &text(1 << 20), b"q\0N"]);
    for i in 0..200_u16 {
        keys.extend(concat(&[b"M", &i.to_le_bytes(), b"}h\0)s"]));
    }
    keys.extend(b"u.");
    let nest = |open: &[u8], close: &[u8], n: usize| {
        concat(&[b"\x80\x02}X\x01\0\0\0a", &open.repeat(n), b"N", &close.repeat(n), b"s."])
    };
    let cases: Vec<(Vec<u8>, &str)> = vec![
        (b"\x80\x02cos\nsystem\nX\x02\0\0\0id\x85R.".to_vec(), "refers to `os.system`, which no list of weights needs"),
        // A name alone is no call.
        (b"\x80\x02cposix\nsystem\n.".to_vec(), "no dictionary of names"),
        (b"\x80\x02cposix\nsystem\n)R.".to_vec(), "refers to `posix.system`"),
        (b"\x80\x02}X\x01\0\0\0acposix\nsystem\nX\x02\0\0\0id\x85Rs.".to_vec(), "refers to `posix.system`"),
        (b"\x80\x02c__builtin__\neval\n)R.".to_vec(), "refers to `__builtin__.eval`"),
        (b"\x80\x02cbuiltins\ngetattr\n)R.".to_vec(), "refers to `builtins.getattr`"),
        (b"\x80\x02ctorch\nload\n)R.".to_vec(), "refers to `torch.load`"),
        (b"\x80\x02ctorch\nStorage\n)R.".to_vec(), "refers to `torch.Storage`"),
        (b"\x80\x02ctorch.hub\nload\n)R.".to_vec(), "refers to `torch.hub.load`"),
        (b"\x80\x02ctorch\nFloatStorage.from_file\n)R.".to_vec(), "refers to `torch.FloatStorage.from_file`"),
        (b"\x80\x02ctorch._utils\n_rebuild_wrapper_subclass\n)R.".to_vec(), "refers to `torch._utils._rebuild_wrapper"),
        (b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x02id\x85R.".to_vec(), "refers to `os.system`"),
        (b"\x80\x04\x8c\x02os\x8c\x0csystem\x1b[31m\n\x93)R.".to_vec(), "refers to `os.system\\u{1b}[31m\\n`"),
        (b"\x80\x02(X\x02\0\0\0idios\nsystem\n.".to_vec(), "refers to `os.system`"),
        (concat(&[b"\x80\x02cos\n", &b"a".repeat(500), b"\n."]), "a global's name without an end"),
        (b"\x80\x02c\xff\xfe\nx\n.".to_vec(), "name that is not UTF-8"),
        (b"\x80\x02X\x01\0\0\0aX\x01\0\0\0b\x85R.".to_vec(), "calls something that is not a name"),
        (b"\x80\x02ctorch\nFloatStorage\n)R.".to_vec(), "with 0 arguments that do not fit"),
        (b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n)R.".to_vec(), "with 0 arguments that do not fit"),
        (b"\x80\x02ctorch\nSize\n)\x81.".to_vec(), "it makes a new Size"),
        (b"\x80\x02X\x01\0\0\0aQ.".to_vec(), "something that is not a storage"),
        (b"\x80\x02(X\x06\0\0\0modulecos\nsystem\ntQ.".to_vec(), "something that is not a storage"),
        (b"\x80\x02K\x01K\x01b.".to_vec(), "builds something that has no parts"),
        (b"\x80\x02)Nb.".to_vec(), "builds something that is neither"),
        (b"\x80\x02}X\x01\0\0\0actorch\nFloatTensor\n)\x81s.".to_vec(), "tensor `a`: it is unfinished"),
        (b"\x80\x02h\x05.".to_vec(), "memo 5 is read before it is set"),
        (b"\x80\x02j\xff\xff\xff\xff.".to_vec(), "memo 4294967295 is read before it is set"),
        (b"\x80\x02q\0.".to_vec(), "empty stack"),
        (b"\x80\x02.".to_vec(), "empty stack"),
        (b"\x80\x02NN.".to_vec(), "more than one value"),
        (b"\x80\x02}(N.".to_vec(), "more than one value"),
        (b"\x80\x02t.".to_vec(), "a mark that was not set"),
        (b"\x80\x02N(\x85.".to_vec(), "empty stack"),
        (b"\x80\x02}(Nu.".to_vec(), "sets items"),
        (b"\x80\x02}NNNs.".to_vec(), "changes something that has no parts"),
        (b"\x80\x02])NNs.".to_vec(), "sets items of something that is not a dictionary"),
        (b"\x80\x02}Na.".to_vec(), "appends to something that is not a list"),
        (b"\x80\x09N.".to_vec(), "pickle protocol 9"),
        (b"\x80\x02I1\n.".to_vec(), "opcode 0x49"),
        (b"\x80\x02\x82\x01.".to_vec(), "opcode 0x82"),
        (concat(&[b"\x80\x02\x8a\xff", &[1; 255], b"."]), "no dictionary of names"),
        (b"\x80\x02\x8b\xff\xff\xff\x7f".to_vec(), "its pickle ends at byte"),
        (b"\x80\x02X\xff\xff\xff\xffabc".to_vec(), "its pickle ends at byte"),
        (b"\x80\x04\x8d\xff\xff\xff\xff\xff\xff\xff\xffabc".to_vec(), "its pickle ends at byte"),
        (b"\x80\x02X\x02\0\0\0\xff\xff.".to_vec(), "not UTF-8"),
        (b"".to_vec(), "its pickle ends at byte 0"),
        (nest(b"]", b"a", 33), "nested deeper than 32 levels"),
        (nest(b"]", b"a", 200_000), "nested deeper than 32 levels"),
        (nest(b"}X\x01\0\0\0b", b"s", 50_000), "nested deeper than 32 levels"),
        (nest(b"(", b"t", 200_000), "nested deeper than 32 levels"),
        (nest(b"", b"\x85", 200_000), "nested deeper than 32 levels"),
        (concat(&[b"\x80\x02}", &b"(".repeat(2_000_000)]), "more than 1048576 instructions"),
        (concat(&[b"\x80\x02", &b"]".repeat(2_000_000)]), "more than 1048576 instructions"),
        (b"\x80\x02}q\0X\x01\0\0\0ah\0s.".to_vec(), "or contains itself"),
        (b"\x80\x02}X\x01\0\0\0a]q\0h\0as.".to_vec(), "or contains itself"),
        (b"\x80\x02}X\x01\0\0\0a]q\0h\0\x85h\0\x86as.".to_vec(), "or contains itself"),
        (b"\x80\x02}X\x01\0\0\0acargparse\nNamespace\n)\x81q\0}X\x01\0\0\0ah\0sbs.".to_vec(), "or contains itself"),
        (b"\x80\x02}X\x01\0\0\0acargparse\nNamespace\n)\x81q\0h\0bs.".to_vec(), "a Namespace of something"),
        (b"\x80\x02ccollections\nOrderedDict\n]q\0h\0a\x85R.".to_vec(), "an item that is not a pair"),
        (ladder, "more than 1048576 values"),
        (strings, "names and strings have more than"),
        (keys, "names and strings have more than"),
    ];
    for (pickle, expected) in cases {
        let error = refusal(&pickle);
        assert!(error.contains(expected), "{:?}: expected {expected}: {error}", &pickle[..pickle.len().min(60)]);
    }
}

#[test]
fn what_a_call_would_make_is_passed_over() {
    // A number of NumPy's, an object with attributes and items, a complex tensor beside a real one.
    let mut pickle = b"\x80\x02}(X\x01\0\0\0acnumpy.core.multiarray\nscalar\ncnumpy\ndtype\nX\x02\0\0\0f8\x85R\
        U\x0812345678\x86R"
        .to_vec();
    pickle.extend(b"X\x01\0\0\0bc__main__\nConfig\n)\x81}X\x01\0\0\0xK\x01sb(K\x02K\x03eX\x01\0\0\0yK\x04s");
    for (name, class) in [(b'c', "ComplexFloat"), (b'd', "Float")] {
        pickle.extend([b'X', 1, 0, 0, 0, name]);
        pickle.extend(b"ctorch._utils\n_rebuild_tensor\n((X\x07\0\0\0storagectorch\n");
        pickle.extend(class.as_bytes());
        pickle.extend(b"Storage\nX\x01\0\0\x000X\x03\0\0\0cpuK\x02tQK\0K\x02\x85K\x01\x85tR");
    }
    pickle.extend(b"u.");
    let data: Vec<u8> = [1.5_f32, -2.0].iter().flat_map(|x| x.to_le_bytes()).collect();
    let state = from_bytes(archive(&[("data.pkl", &pickle), ("data/0", &data)])).unwrap();
    assert_eq!(state.tensor("d").unwrap().to_f32().unwrap(), [1.5, -2.0]);
    let unread = |name| match state.get(name) {
        Some(Item::Plain(Plain::Unread(what))) => what.clone(),
        other => panic!("{name}: {other:?}"),
    };
    assert_eq!(unread("a"), "numpy.core.multiarray.scalar");
    assert_eq!(unread("b"), "__main__.Config");
    assert_eq!(unread("c"), "torch.ComplexFloatStorage");
}

#[test]
fn shared_numbers_have_a_bound() {
    // A mebibyte that a thousand tensors share.
    let numel: i32 = 1 << 18;
    let mut pickle = b"\x80\x02}(".to_vec();
    for i in 0..1000_u16 {
        pickle.push(b'M');
        pickle.extend(i.to_le_bytes());
        pickle.extend(
            b"ctorch._utils\n_rebuild_tensor\n((X\x07\0\0\0storagectorch\nFloatStorage\nX\x01\0\0\x000X\x03\0\0\0cpuJ",
        );
        pickle.extend(numel.to_le_bytes());
        pickle.extend(b"tQK\0(J");
        pickle.extend(numel.to_le_bytes());
        pickle.extend(b"tK\x01\x85tR");
    }
    pickle.extend(b"u.");
    let bytes = archive(&[("data.pkl", &pickle), ("data/0", &vec![0; 1 << 20])]);
    let error = from_bytes(bytes).unwrap_err().to_string();
    assert!(error.contains("up to `9` the tensors claim 10485760 bytes out of the 1048576"), "{error}");
}

#[test]
fn archives_that_lie_are_refused() {
    let pickle = claim(6, 0, &[2, 3], &[3, 1]);
    let good = archive(&[("data.pkl", &pickle), ("data/0", &[7; 24])]);
    from_bytes(good.clone()).unwrap();
    let at = |needle: &[u8], from: usize| good[from..].windows(needle.len()).position(|w| w == needle).unwrap() + from;
    let refused = |change: &dyn Fn(&mut Vec<u8>), expected: &str| {
        let mut bytes = good.clone();
        change(&mut bytes);
        let error = from_bytes(bytes).expect_err(expected).to_string();
        assert!(error.contains(expected), "expected {expected}: {error}");
    };
    // A number changed: the checksum tells.
    refused(&|b| b[at(&[7; 24], 0)] = 8, "the entry `x/data/0` cannot be read (Invalid checksum)");
    // The central entries: data.pkl, then data/0.
    let first = at(b"PK\x01\x02", 0);
    let second = at(b"PK\x01\x02", first + 4);
    refused(&|b| b[second + 8] |= 1, "the entry `x/data/0` cannot be read");
    refused(&|b| b[second + 10] = 99, "the entry `x/data/0` cannot be read");
    refused(&|b| b[second + 24..second + 28].fill(0xfe), "the entry `x/data/0` has 4278124286 bytes, expected 24");
    refused(&|b| b[first + 24..first + 28].fill(0xfe), "the entry `x/data.pkl` has 4278124286 bytes");
    refused(&|b| b[second + 42..second + 46].fill(0xfe), "the entry `x/data/0` cannot be read");
    refused(&|b| b.truncate(second), "table of contents at its end is missing");
    refused(&|b| b[second] = b'X', "its zip archive cannot be read");
    // Two entries of one name.
    let name = second + 46;
    refused(&|b| b[name..name + 8].copy_from_slice(b"y/data/0"), "the entry `x/data/0` is missing");
    let two = archive(&[("data.pkl", &pickle), ("data/0", &[7; 24]), ("data/1", &[7; 24])]);
    let last = two.windows(8).rposition(|w| w == b"x/data/1").unwrap();
    let mut same = two;
    same[last + 7] = b'0';
    assert!(from_bytes(same).unwrap_err().to_string().contains("two entries of one name"));
}

#[test]
fn overlapping_entries_are_counted_together() {
    // 60 storages whose entries all point at the same 64 KiB.
    let mut pickle = b"\x80\x02}(".to_vec();
    let names: Vec<String> = (0..60).map(|i| format!("data/{i:02}")).collect();
    for (i, name) in names.iter().enumerate() {
        pickle.extend([b'K', i as u8]);
        pickle.extend(b"ctorch._utils\n_rebuild_tensor\n((X\x07\0\0\0storagectorch\nFloatStorage\nX\x02\0\0\0");
        pickle.extend(&name.as_bytes()[5..]);
        pickle.extend(b"X\x03\0\0\0cpuJ\0\x40\0\0tQK\0(M\0\x40tK\x01\x85tR");
    }
    pickle.extend(b"u.");
    let numbers = vec![0; 1 << 16];
    let mut entries: Vec<(&str, &[u8])> = vec![("data.pkl", &pickle)];
    entries.extend(names.iter().map(|n| (n.as_str(), numbers.as_slice())));
    let honest = archive(&entries);
    assert_eq!(from_bytes(honest.clone()).unwrap().tensors().count(), 60);
    // Leave out the numbers but the first, and let every entry point there.
    let locals: Vec<usize> =
        honest.windows(4).enumerate().filter(|(_, w)| *w == b"PK\x03\x04").map(|(i, _)| i).collect();
    let centrals: Vec<usize> =
        honest.windows(4).enumerate().filter(|(_, w)| *w == b"PK\x01\x02").map(|(i, _)| i).collect();
    let mut bytes = honest[..locals[2]].to_vec();
    let mut directory = honest[centrals[0]..].to_vec();
    for central in &centrals[1..] {
        let offset = central - centrals[0] + 42;
        directory[offset..offset + 4].copy_from_slice(&(locals[1] as u32).to_le_bytes());
    }
    let end = directory.windows(4).rposition(|w| w == b"PK\x05\x06").unwrap();
    let start = bytes.len() as u32;
    directory[end + 16..end + 20].copy_from_slice(&start.to_le_bytes());
    bytes.extend(directory);
    let error = from_bytes(bytes).unwrap_err().to_string();
    assert!(error.contains("the entries are larger than the file"), "{error}");
}

/// splitmix64.
struct Dice(u64);

impl Dice {
    fn roll(&mut self, below: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ z >> 31) % below.max(1) as u64) as usize
    }

    /// Bytes changed, put in, left out or doubled at a few places.
    fn mutate(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut out = bytes.to_vec();
        for _ in 0..=self.roll(4) {
            if out.is_empty() {
                break;
            }
            let at = self.roll(out.len());
            match self.roll(6) {
                0 => out[at] = self.roll(256) as u8,
                1 => out[at] ^= 1 << self.roll(8),
                2 => out.insert(at, b"(.}]Rbsuqh\x81\x85\xff\0"[self.roll(14)]),
                3 => {
                    out.remove(at);
                }
                4 => {
                    let end = (at + self.roll(40)).min(out.len());
                    let part = out[at..end].to_vec();
                    let to = self.roll(out.len());
                    out.splice(to..to, part);
                }
                _ => {
                    let end = (at + 8).min(out.len());
                    out[at..end].fill([0, 0xff, 0x7f][self.roll(3)]);
                }
            }
        }
        out
    }
}

/// Reads the bytes and every number in them; only panics and slowness count.
fn survives(what: &str, bytes: Vec<u8>) -> bool {
    let start = Instant::now();
    let state = from_bytes(bytes);
    if let Ok(state) = &state {
        for (_, t) in state.tensors() {
            let _ = (t.to_f32(), t.to_f64(), t.to_i64(), t.as_i64());
        }
    }
    let took = start.elapsed();
    assert!(took < Duration::from_secs(10), "{what}: {took:?}");
    state.is_ok()
}

#[test]
fn cut_files_are_refused_without_panic() {
    let mut dice = Dice(1);
    for (label, path) in good_files() {
        let bytes = std::fs::read(path).unwrap();
        for i in 0..60 {
            // The first and last bytes, and places in between.
            let length = match i {
                0..20 => i,
                20..40 => bytes.len() - 1 - (i - 20),
                _ => dice.roll(bytes.len()),
            };
            assert!(!survives(&format!("{label} cut to {length}"), bytes[..length.min(bytes.len() - 1)].to_vec()));
        }
    }
}

#[test]
fn changed_files_do_not_panic() {
    let mut dice = Dice(2);
    for (label, path) in good_files() {
        let bytes = std::fs::read(path).unwrap();
        let rounds = if bytes.len() > 100_000 { 60 } else { 400 };
        for i in 0..rounds {
            survives(&format!("{label} change {i}"), dice.mutate(&bytes));
        }
        // The ends, where the table of contents or the first pickles are.
        for i in 0..rounds {
            let part = bytes.len().min(400);
            let mut changed = dice.mutate(&bytes[..part]);
            changed.extend(&bytes[part..]);
            survives(&format!("{label} change of the head {i}"), changed);
            let mut changed = bytes[..bytes.len() - part].to_vec();
            changed.extend(dice.mutate(&bytes[bytes.len() - part..]));
            survives(&format!("{label} change of the tail {i}"), changed);
        }
    }
}

#[test]
fn changed_pickles_do_not_panic() {
    let mut dice = Dice(3);
    let mut accepted = 0;
    for name in ["odd", "odd_protocol5", "training", "namespace", "bytes"] {
        // The archive is made anew around each changed pickle, so that its checksum is right.
        let mut zip = ZipArchive::new(Cursor::new(std::fs::read(made(&format!("{name}.pth"))).unwrap())).unwrap();
        let mut entries = Vec::new();
        for i in 0..zip.len() {
            let mut entry = zip.by_index(i).unwrap();
            let inner = entry.name().unwrap().split_once('/').unwrap().1.to_owned();
            let mut bytes = Vec::new();
            entry.read_to_end(&mut bytes).unwrap();
            entries.push((inner, bytes));
        }
        let pickle = entries.iter().position(|(inner, _)| inner == "data.pkl").unwrap();
        let original = entries[pickle].1.clone();
        for i in 0..600 {
            entries[pickle].1 = dice.mutate(&original);
            let parts: Vec<(&str, &[u8])> = entries.iter().map(|(n, b)| (n.as_str(), b.as_slice())).collect();
            accepted += usize::from(survives(&format!("{name} pickle {i}"), archive(&parts)));
        }
    }
    // Some changes do no harm (a number, a letter of a name); most must be noticed.
    assert!((1..2000).contains(&accepted), "{accepted} of 3000 accepted");
}

#[test]
fn what_is_written_is_read() {
    let numbers: Vec<f32> = (0..70_000).map(|i| (i as f32).sin()).chain([f32::NAN, f32::INFINITY, -0.0]).collect();
    let matrix = &numbers[..24_000];
    let entries: Vec<(String, Saved<'_>)> = vec![
        ("conv.weight".into(), Saved::F32 { shape: &[2, 3, 4_000, 1], data: matrix }),
        ("again".into(), Saved::F32 { shape: &[24_000], data: matrix }),
        ("large".into(), Saved::F32 { shape: &[70_003], data: &numbers }),
        ("scalar".into(), Saved::F32 { shape: &[], data: &numbers[5..6] }),
        ("empty".into(), Saved::F32 { shape: &[0, 3], data: &[] }),
        ("bn.num_batches_tracked".into(), Saved::I64(-(1 << 40))),
        ("height".into(), Saved::Int(192)),
        ("far".into(), Saved::Int(i64::MIN)),
        ("use_stereo".into(), Saved::Bool(false)),
        ("scale".into(), Saved::Float(0.1)),
        ("size".into(), Saved::Text("tiny, Größe")),
    ];
    let bytes = to_bytes("encoder", &entries).unwrap();
    assert_eq!(bytes, to_bytes("encoder", &entries).unwrap());
    if let Ok(path) = std::env::var("PTH_WRITTEN") {
        std::fs::write(path, &bytes).unwrap();
    }
    assert!(bytes.len() < (70_003 + 24_000) * 4 + 10_000, "the shared tensor was written twice");
    let state = from_bytes(bytes).unwrap();
    let names: Vec<&str> = state.entries().iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, entries.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>());
    for (name, value) in &entries {
        match value {
            Saved::F32 { shape, data } => {
                let t = state.tensor(name).unwrap();
                assert_eq!(t.shape(), *shape, "{name}");
                let same = t.to_f32().unwrap().iter().map(|x| x.to_bits()).eq(data.iter().map(|x| x.to_bits()));
                assert!(same, "{name}");
            }
            Saved::I64(n) => assert_eq!(state.tensor(name).unwrap().as_i64(), Some(*n)),
            Saved::Int(n) => {
                assert!(matches!(state.get(name), Some(Item::Plain(Plain::Int(i))) if *i == i128::from(*n)))
            }
            Saved::Bool(b) => assert!(matches!(state.get(name), Some(Item::Plain(Plain::Bool(x))) if x == b)),
            Saved::Float(f) => assert!(matches!(state.get(name), Some(Item::Plain(Plain::Float(x))) if x == f)),
            Saved::Text(t) => assert!(matches!(state.get(name), Some(Item::Plain(Plain::Text(x))) if x == t)),
        }
    }
}

#[test]
fn the_writer_refuses_what_would_not_load() {
    let wrong = [("w".to_owned(), Saved::F32 { shape: &[2, 3], data: &[0.0; 5] })];
    assert_eq!(to_bytes("x", &wrong).unwrap_err().to_string(), "tensor `w`: shape [2, 3] with 5 numbers");
    let twice = [("w".to_owned(), Saved::Int(1)), ("w".to_owned(), Saved::Int(2))];
    assert!(matches!(to_bytes("x", &twice), Err(PthError::Duplicate(_))));
    assert!(matches!(to_bytes("a/b", &[]), Err(PthError::Unsupported(_))));
}
