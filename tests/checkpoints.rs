//! Weights from elsewhere: every arrangement of the public files gives the same weights, every form of file gives back
//! what was written, and bad files are refused by name, quickly and in little memory.
#![cfg(feature = "cli")]

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use parallax::formats::TensorFile;
use parallax::formats::pth;
use parallax::formats::pth::Saved;
use parallax::monovit::Preset;
use parallax::networks::DepthNetwork;
use parallax::nn::Params;
use parallax::tensor::Tensor;
use parallax::train::RunConfig;
use parallax::train::run::load_weights;
use parallax::train::start::Start;
use parallax::weights::{Form, Need, Sources, Weights, architecture_of, load, save};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

/// A file of the small network, as PyTorch wrote it.
fn reference(name: &str) -> PathBuf {
    fixture("pth/reference").join(name)
}

fn references(names: &[&str]) -> Vec<PathBuf> {
    names.iter().map(|name| reference(name)).collect()
}

/// What the weights are: bits by name, in PyTorch's layout.
fn expected() -> HashMap<String, Vec<u32>> {
    let file = TensorFile::open(&fixture("pico.safetensors")).expect("the fixture");
    let weights = file.tensors.iter().filter_map(|(n, t)| Some((n.strip_prefix("weights/")?.to_owned(), t)));
    weights.map(|(name, t)| (name, bits(&t.to_f32().expect("floats")))).collect()
}

fn bits(numbers: &[f32]) -> Vec<u32> {
    numbers.iter().map(|x| x.to_bits()).collect()
}

/// Every parameter under `prefixes` has exactly the expected bits.
#[track_caller]
fn assert_weights(params: &Params<f32>, prefixes: &[&str], what: &str) {
    let expected = expected();
    let mut compared = 0;
    for (_, p) in params.iter().filter(|(_, p)| prefixes.iter().any(|prefix| p.name().starts_with(prefix))) {
        assert!(bits(p.layout.export(&p.value).data()) == expected[p.name()], "{what}: {}", p.name());
        compared += 1;
    }
    assert!(compared > 100, "{what}: {compared} compared");
}

const ALL: [&str; 4] = ["encoder.", "depth.", "pose_encoder.", "pose."];

#[test]
fn every_arrangement_gives_the_same_weights() {
    let rest = ["depth.pth", "pose_encoder.pth", "pose.pth"];
    let with = |first: &str| references(&[&[first][..], &rest].concat());
    let cases: [(&str, Vec<PathBuf>, (usize, usize)); 6] = [
        ("a folder", vec![reference("")], (64, 96)),
        ("four files", with("encoder.pth"), (64, 96)),
        ("legacy", with("legacy/encoder.pth"), (64, 96)),
        ("nested", with("nested_encoder.pth"), (96, 320)),
        ("one file and the pose", references(&["one_file/depth.pth", "pose_encoder.pth", "pose.pth"]), (96, 320)),
        ("twice the same", [with("encoder.pth"), references(&["one_file/depth.pth"])].concat(), (64, 96)),
    ];
    for (what, paths, size) in cases {
        let weights = load(&paths, Need::All, false).unwrap_or_else(|e| panic!("{what}: {e}"));
        assert_weights(&weights.params, &ALL, what);
        assert_eq!(weights.setup.preset, Preset::Pico, "{what}");
        assert_eq!((weights.setup.height, weights.setup.width), size, "{what}");
        assert_eq!((weights.setup.min_depth, weights.setup.max_depth), (0.1, 100.0), "{what}");
        assert_eq!(weights.report.problem(), None, "{what}");
        assert_eq!(weights.report.matched.len(), weights.params.len(), "{what}");
        let heads = weights.report.skipped.iter().filter(|s| s.what.contains("head")).count();
        assert_eq!(heads, 2, "{what}: the unused fc");
    }
    // Depth alone: the pose networks are not needed.
    for paths in [vec![reference("one_file")], references(&["encoder.pth", "depth.pth"])] {
        let weights = load(&paths, Need::Depth, false).expect("the depth networks");
        assert_weights(&weights.params, &ALL[..2], "depth alone");
        assert_eq!(weights.report.absent, ["pose_encoder", "pose"]);
    }
    let error = load(&[reference("one_file")], Need::All, false).err().expect("refused").to_string();
    assert!(error.contains("missing (pose_encoder.encoder.conv1.weight"), "{error}");
    let error = load(&[reference("pose.pth")], Need::Depth, false).err().expect("refused").to_string();
    assert!(error.contains("not exactly the weights") && error.contains("missing (encoder."), "{error}");
}

fn pico() -> Weights {
    load(&[reference("")], Need::All, false).expect("the reference")
}

#[test]
fn every_form_gives_back_what_was_written() {
    let place = tempfile::tempdir().expect("a folder");
    let weights = pico();
    for name in ["a.safetensors", "a.npz", "a.pth", "a.pt", "folder"] {
        let path = place.path().join(name);
        save(&weights, &path, Form::of(&path).expect("a form")).expect("written");
        let again = load(std::slice::from_ref(&path), Need::All, false).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_weights(&again.params, &ALL, name);
        assert_eq!((again.setup.height, again.setup.width), (64, 96), "{name}");
        // And from there to every other form.
        for next in ["b.safetensors", "b.npz", "b.pth", "other"] {
            let path = place.path().join(format!("from_{name}_{next}"));
            save(&again, &path, Form::of(Path::new(next)).expect("a form")).expect("written");
            let third = load(&[path], Need::All, false).unwrap_or_else(|e| panic!("{name}, {next}: {e}"));
            assert_weights(&third.params, &ALL, next);
        }
    }
    let (_, params, config) = load_weights(&place.path().join("a.safetensors")).expect("read");
    assert_weights(&params, &ALL, "load_weights");
    assert_eq!(config.preset, Preset::Pico);
    assert!(Form::of(Path::new("weights.onnx")).unwrap_err().to_string().contains(".onnx"));
}

#[test]
fn a_written_folder_is_the_published_set() {
    let place = tempfile::tempdir().expect("a folder");
    save(&pico(), place.path(), Form::Folder).expect("written");
    for name in ["encoder.pth", "depth.pth", "pose_encoder.pth", "pose.pth"] {
        let ours = pth::read(place.path().join(name)).expect("ours");
        let theirs = pth::read(reference(name)).expect("theirs");
        let mut compared = 0;
        for (key, t) in theirs.tensors().filter(|(key, _)| !key.contains(".fc.") || name == "depth.pth") {
            let mine = ours.tensor(key).unwrap_or_else(|| panic!("{name}: {key} is missing"));
            assert_eq!((mine.shape(), mine.dtype()), (t.shape(), t.dtype()), "{name}: {key}");
            assert!(mine.to_f64() == t.to_f64() && mine.to_i64() == t.to_i64(), "{name}: {key}");
            compared += 1;
        }
        assert_eq!(ours.tensors().count(), compared, "{name}: no more than theirs");
        assert_eq!((ours.int("height"), ours.int("width")), (theirs.int("height"), theirs.int("width")), "{name}");
        assert_eq!(ours.get("use_stereo").is_some(), theirs.get("use_stereo").is_some(), "{name}");
    }
}

/// The reference weights as f32 by the model's own names, for files that are made wrong.
fn tensors() -> Vec<(String, Vec<usize>, Vec<f32>)> {
    let weights = pico();
    let params = weights.params.iter().map(|(_, p)| (p.name().to_owned(), p.layout.export(&p.value)));
    params.map(|(name, t)| (name, t.dims().to_vec(), t.data().to_vec())).collect()
}

fn write_pth(path: &Path, tensors: &[(String, Vec<usize>, Vec<f32>)]) {
    let entries: Vec<(String, Saved<'_>)> =
        tensors.iter().map(|(name, shape, data)| (name.clone(), Saved::F32 { shape, data })).collect();
    pth::write(std::fs::File::create(path).expect("writable"), "x", &entries).expect("written");
}

/// The message with which this is refused, within a second.
#[track_caller]
fn refusal(paths: &[PathBuf]) -> String {
    let started = Instant::now();
    let error = load(paths, Need::All, false).err().expect("refused").to_string();
    assert!(started.elapsed() < Duration::from_secs(1), "{paths:?}: {:?}: {error}", started.elapsed());
    let name = paths[0].file_name().expect("a name").to_string_lossy().into_owned();
    assert!(error.contains(&name), "{name} is not named: {error}");
    error
}

#[test]
fn weights_that_do_not_fit_are_listed() {
    let place = tempfile::tempdir().expect("a folder");
    let file = place.path().join("w.pth");
    let find =
        |all: &[(String, Vec<usize>, Vec<f32>)], name: &str| all.iter().position(|t| t.0 == name).expect("there");

    let mut all = tensors();
    let gone = find(&all, "encoder.stem.0.bn.bias");
    all.remove(gone);
    let other = find(&all, "pose.net.1.weight");
    all[other].1 = vec![8, 72];
    all.push(("teacher.weight".into(), vec![2], vec![0.0; 2]));
    all.push(("fc.weight".into(), vec![2], vec![f32::NAN; 2]));
    write_pth(&file, &all);
    let error = refusal(std::slice::from_ref(&file));
    for part in [
        "1 missing (encoder.stem.0.bn.bias)",
        "1 unexpected (teacher.weight)",
        "pose.net.1.weight is [8, 72], expected [8, 8, 3, 3]",
        "--allow-partial",
    ] {
        assert!(error.contains(part), "{part}: {error}");
    }
    let partial = load(std::slice::from_ref(&file), Need::All, true).expect("what fits");
    let report = &partial.report;
    assert_eq!(
        (&report.missing[..], &report.unexpected[..]),
        (&["encoder.stem.0.bn.bias".into()][..], &["teacher.weight".into()][..])
    );
    assert_eq!((report.mismatched.len(), report.skipped.len()), (1, 1));
    assert_eq!(report.matched.len(), partial.params.len() - 2);
    let shown = report.to_string();
    assert!(
        shown.contains("mismatched  1: pose.net.1.weight") && shown.contains("skipped     1 tensors of a class"),
        "{shown}"
    );
    // Converting writes nothing that was not loaded.
    let converted = place.path().join("partial.safetensors");
    save(&partial, &converted, Form::Safetensors).expect("written");
    assert_eq!(TensorFile::open(&converted).expect("read").tensors.len(), report.matched.len());

    for (value, word) in [(f32::NAN, "NaN"), (f32::INFINITY, "inf"), (f32::NEG_INFINITY, "-inf")] {
        let mut all = tensors();
        let i = find(&all, "depth.convs.f4.conv_se.bias");
        all[i].2[3] = value;
        write_pth(&file, &all);
        let error = refusal(std::slice::from_ref(&file));
        assert!(error.contains(&format!("depth.convs.f4.conv_se.bias holds {word} (element 3 of")), "{error}");
        assert!(load(std::slice::from_ref(&file), Need::All, true).is_err(), "not even in part");
    }

    let mut all = tensors();
    let i = find(&all, "depth.convs.f4.conv_se.bias");
    let mut copy = all[i].clone();
    copy.0 = "depth.decoder.0.conv_se.bias".into();
    copy.2[1] += 1.0;
    all.push(copy);
    write_pth(&file, &all);
    let error = refusal(std::slice::from_ref(&file));
    assert!(
        error.contains("depth.convs.f4.conv_se.bias and depth.decoder.0.conv_se.bias") && error.contains("element 1"),
        "{error}"
    );

    // The same tensor in two files.
    let (one, two) = (place.path().join("one.pth"), place.path().join("two.pth"));
    write_pth(&one, &tensors());
    let mut all = tensors();
    all[0].2[0] += 1.0;
    write_pth(&two, &all);
    let error = refusal(&[one, two]);
    assert!(error.contains("one.pth") && error.contains("two.pth") && error.contains("differ"), "{error}");

    let mut all = tensors();
    for t in &mut all {
        if t.0.contains("patch_embed_stages.2.") && t.0.ends_with("dwconv.weight") {
            t.1[0] = 20;
            t.2.truncate(20 * 9);
        }
    }
    write_pth(&file, &all);
    let error = refusal(std::slice::from_ref(&file));
    assert!(
        error.contains("nearest is pico") && error.contains("channels 8 16 20 32 instead of 8 16 24 32"),
        "{error}"
    );

    let entries = [("height".to_owned(), Saved::Int(100)), ("stem.x".to_owned(), Saved::I64(1))];
    pth::write(std::fs::File::create(&file).expect("writable"), "x", &entries).expect("written");
    let error = refusal(std::slice::from_ref(&file));
    assert!(error.contains("height: 100 is not a multiple of 32"), "{error}");
}

/// A safetensors file of this header, and these bytes of numbers.
fn safetensors(header: &str, numbers: usize) -> Vec<u8> {
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend(header.as_bytes());
    bytes.resize(bytes.len() + numbers, 0);
    bytes
}

#[test]
fn bad_files_are_refused_by_name_quickly_and_in_little_memory() {
    let place = tempfile::tempdir().expect("a folder");
    let two = |a: &str, b: &str, shape: &str| {
        let tensor = |name: &str, range: &str| {
            format!("\"{name}\":{{\"dtype\":\"F32\",\"shape\":{shape},\"data_offsets\":{range}}}")
        };
        format!("{{{},{}}}", tensor("stem.a", a), tensor("stem.b", b))
    };
    let cases: Vec<(&str, Vec<u8>, &str)> = vec![
        ("empty.safetensors", Vec::new(), "is empty"),
        ("empty.pth", Vec::new(), "is empty"),
        ("empty.npz", Vec::new(), "is empty"),
        ("text.safetensors", b"this is no checkpoint".to_vec(), "not a safetensors file"),
        ("text.pth", b"this is no checkpoint".to_vec(), "not a PyTorch checkpoint"),
        ("text.npz", b"this is no checkpoint".to_vec(), "not an .npz file"),
        ("text", b"this is no checkpoint".to_vec(), "not a PyTorch checkpoint"),
        ("short.safetensors", vec![1, 2, 3], "it has 3 bytes"),
        (
            "gigabytes.safetensors",
            [&(5_u64 << 30).to_le_bytes()[..], b"{}"].concat(),
            "claims 5368709120 bytes, of a file of 10",
        ),
        ("endless.safetensors", [&u64::MAX.to_le_bytes()[..], b"{}"].concat(), "claims 18446744073709551615 bytes"),
        ("json.safetensors", safetensors("{\"a\":", 0), "its safetensors header"),
        ("deep.safetensors", safetensors(&"[".repeat(100_000), 0), "its safetensors header"),
        ("overlapping.safetensors", safetensors(&two("[0,8]", "[4,12]", "[2]"), 12), "invalid offset"),
        ("hole.safetensors", safetensors(&two("[0,8]", "[12,20]", "[2]"), 20), "invalid offset"),
        ("backwards.safetensors", safetensors(&two("[0,8]", "[8,0]", "[2]"), 16), "offset"),
        ("misaligned.safetensors", safetensors(&two("[0,7]", "[7,15]", "[2]"), 15), "invalid shape"),
        ("large.safetensors", safetensors(&two("[0,8]", "[8,16]", "[4611686018427387904,8]"), 16), "overflow"),
        ("shape.safetensors", safetensors(&two("[0,8]", "[8,16]", "[1073741824]"), 16), "invalid shape"),
        (
            "cut.safetensors",
            safetensors(&two("[0,8]", "[8,16]", "[2]"), 15),
            "cut short: 15 bytes of numbers, expected 16",
        ),
        ("long.safetensors", safetensors(&two("[0,8]", "[8,16]", "[2]"), 17), "1 bytes belong to no tensor"),
        (
            "kind.safetensors",
            safetensors("{\"stem.a\":{\"dtype\":\"F8_E5M2\",\"shape\":[2],\"data_offsets\":[0,2]}}", 2),
            "stem.a holds F8_E5M2",
        ),
        ("nothing.safetensors", safetensors("{}", 0), "no weights of a network of this program"),
        (
            "others.safetensors",
            safetensors("{\"a\":{\"dtype\":\"F32\",\"shape\":[2],\"data_offsets\":[0,8]}}", 8),
            "1 other tensors, such as a",
        ),
    ];
    for (name, bytes, expected) in cases {
        let path = place.path().join(name);
        std::fs::write(&path, bytes).expect("written");
        let error = refusal(&[path]);
        assert!(error.contains(expected), "{name}: expected {expected}: {error}");
    }

    // Real length, absurd header: a file with a hole.
    let sparse = place.path().join("sparse.safetensors");
    std::fs::write(&sparse, (3_u64 << 30).to_le_bytes()).expect("written");
    std::fs::OpenOptions::new().write(true).open(&sparse).and_then(|f| f.set_len(4 << 30)).expect("grown");
    assert!(refusal(&[sparse]).contains("its header has 3221225472 bytes"));
    let sparse = place.path().join("sparse.pth");
    std::fs::write(&sparse, b"PK\x03\x04").expect("written");
    std::fs::OpenOptions::new().write(true).open(&sparse).and_then(|f| f.set_len(1 << 30)).expect("grown");
    assert!(refusal(&[sparse]).contains("table of contents"));

    let hostile = [
        ("bad_evil", "posix.system"),
        ("bad_evil4", "posix.system"),
        ("bad_evil_legacy", "posix.system"),
        ("bad_cycle", "contains itself"),
        ("bad_cycle_list", "nested deeper"),
        ("bad_bomb", "64 times"),
        ("bad_short_storage", "has "),
        ("bad_whole_model", "refers to"),
        ("nothing", "no weights of a network of this program"),
    ];
    for (name, expected) in hostile {
        let error = refusal(&[fixture(&format!("pth/{name}.pth"))]);
        assert!(error.contains(expected), "{name}: {error}");
    }
    assert!(!Path::new("evil").exists(), "nothing was run");

    // Cut short, at many places.
    let weights = pico();
    let mut whole = vec![reference("pose.pth"), reference("legacy/encoder.pth")];
    for name in ["w.safetensors", "w.npz", "w.pth"] {
        let path = place.path().join(name);
        save(&weights, &path, Form::of(&path).expect("a form")).expect("written");
        whole.push(path);
    }
    for path in whole {
        let bytes = std::fs::read(&path).expect("read");
        let n = bytes.len();
        for keep in [1, 7, 8, 9, 100, n / 3, n / 2, n - 1000, n - 1] {
            let cut = place.path().join(format!("cut_{}", path.file_name().expect("a name").to_string_lossy()));
            std::fs::write(&cut, &bytes[..keep]).expect("written");
            let error = refusal(&[cut]);
            assert!(
                !error.contains("not exactly") && !error.contains("alike"),
                "cut at {keep} of {n}, it was read: {error}"
            );
        }
    }

    let folder = place.path().join("no_weights");
    std::fs::create_dir(&folder).expect("made");
    assert!(refusal(&[folder]).contains("holds no weights: expected a run's best.safetensors, or encoder.pth"));
    refusal(&[place.path().join("not_there.pth")]);

    // The peak of this whole process, which held the small network many times over.
    #[cfg(target_os = "linux")]
    {
        let status = std::fs::read_to_string("/proc/self/status").expect("linux");
        let peak =
            status.lines().find_map(|l| l.strip_prefix("VmHWM:")?.split_whitespace().next()?.parse::<u64>().ok());
        assert!(peak.expect("a number") < 400 << 10, "{peak:?} kB at the peak");
    }
}

/// The names that torchvision gives a ResNet-18's tensors, beside counters and the head.
fn resnet_names() -> Vec<String> {
    let bn = ["weight", "bias", "running_mean", "running_var"];
    let mut names = vec!["conv1.weight".to_owned()];
    names.extend(bn.map(|b| format!("bn1.{b}")));
    for layer in 1..5 {
        for block in 0..2 {
            let at = format!("layer{layer}.{block}");
            for i in 1..3 {
                names.push(format!("{at}.conv{i}.weight"));
                names.extend(bn.map(|b| format!("{at}.bn{i}.{b}")));
            }
            if layer > 1 && block == 0 {
                names.push(format!("{at}.downsample.0.weight"));
                names.extend(bn.map(|b| format!("{at}.downsample.1.{b}")));
            }
        }
    }
    names
}

#[test]
fn networks_trained_on_imagenet_are_starts() {
    let place = tempfile::tempdir().expect("a folder");
    let all = tensors();

    // An MPViT: the encoder's names without its own in front, under `model`, with a head.
    let mpvit = place.path().join("mpvit.pth");
    let mut encoder: Vec<_> = all
        .iter()
        .filter_map(|(n, s, d)| Some((format!("model.{}", n.strip_prefix("encoder.")?), s.clone(), d.clone())))
        .collect();
    encoder.push(("model.cls_head.cls.weight".into(), vec![3, 32], vec![0.5; 96]));
    encoder.push(("model.cls_head.cls.bias".into(), vec![3], vec![0.5; 3]));
    write_pth(&mpvit, &encoder);

    // A ResNet-18 for one picture: the first three channels of the pose encoder's six.
    let resnet = place.path().join("resnet18.pth");
    let mut of_one: Vec<_> = resnet_names()
        .into_iter()
        .map(|n| {
            let (_, s, d) = all.iter().find(|(o, ..)| *o == format!("pose_encoder.encoder.{n}")).expect("the name");
            (n, s.clone(), d.clone())
        })
        .collect();
    let six = of_one[0].2.clone();
    let three: Vec<f32> = six.chunks(6 * 49).flat_map(|filter| filter[..3 * 49].to_vec()).collect();
    (of_one[0].1, of_one[0].2) = (vec![4, 3, 7, 7], three.clone());
    of_one.push(("fc.weight".into(), vec![10, 32], vec![0.5; 320]));
    of_one.push(("fc.bias".into(), vec![10], vec![0.5; 10]));
    write_pth(&resnet, &of_one);

    let config = RunConfig {
        init_encoder: Some(mpvit.clone()),
        init_pose: Some(resnet.clone()),
        ..RunConfig::new(Preset::Pico, 10)
    };
    let start = Start::of(&config).expect("started");
    assert!(!start.knows_motion, "the pose decoder has learnt nothing");
    assert_weights(&start.params, &["encoder."], "an MPViT");
    let id = start.params.find("pose_encoder.encoder.conv1.weight").expect("there");
    let conv1 = start.params.get(id).layout.export(&start.params.get(id).value);
    assert_eq!(conv1.dims(), [4, 6, 7, 7]);
    for (found, given) in conv1.data().chunks(6 * 49).zip(three.chunks(3 * 49)) {
        let halves: Vec<f32> = given.iter().map(|x| x / 2.0).collect();
        assert!(found[..3 * 49] == halves && found[3 * 49..] == halves);
    }
    let expected = expected();
    let (_, untouched): (_, Params<f32>) = DepthNetwork::new(Preset::Pico.config(), config.seed);
    for ((_, p), (_, q)) in start.params.iter().zip(untouched.iter()) {
        let exported = bits(p.layout.export(&p.value).data());
        if p.name().starts_with("pose_encoder.") && !p.name().ends_with("encoder.conv1.weight") {
            assert!(exported == expected[p.name()], "{}", p.name());
        }
        if p.name().starts_with("pose.") {
            assert!(exported == bits(q.layout.export(&q.value).data()), "{}", p.name());
        }
    }

    // The names are those of every published size.
    let shapes: HashMap<String, serde_json::Value> =
        serde_json::from_slice(&std::fs::read(fixture("shapes.json")).expect("the fixture")).expect("JSON");
    let theirs = shapes["small"]["tensors"].as_object().expect("tensors");
    let mut found: Vec<&str> = theirs.keys().filter_map(|n| n.strip_prefix("pose_encoder.encoder.")).collect();
    found.retain(|n| !n.ends_with("num_batches_tracked"));
    found.sort_unstable();
    let mut names = resnet_names();
    names.sort_unstable();
    assert_eq!(found, names);

    assert_eq!(architecture_of(std::slice::from_ref(&mpvit)).expect("a size"), Preset::Pico.into());
    let nano = |encoder: Option<&PathBuf>, pose: Option<&PathBuf>| {
        let config =
            RunConfig { init_encoder: encoder.cloned(), init_pose: pose.cloned(), ..RunConfig::new(Preset::Nano, 10) };
        Start::of(&config).err().expect("refused").to_string()
    };
    let error = nano(Some(&mpvit), None);
    assert!(error.contains("mpvit.pth") && error.contains("does not fit the preset nano: these weights have channels 8 16 24 32 instead of 32 48 64 96; they are of the preset pico"), "{error}");
    let error = nano(None, Some(&resnet));
    assert!(error.contains("resnet18.pth") && error.contains("pose width 4 instead of 16"), "{error}");
    let error = nano(Some(&resnet), None);
    assert!(error.contains("holds no tensors of an MPViT"), "{error}");
    let error = nano(None, Some(&mpvit));
    assert!(error.contains("holds no tensors of a ResNet-18"), "{error}");
}

#[test]
fn a_run_starts_from_any_of_them() {
    let config = RunConfig { init: vec![reference("")], ..RunConfig::new(Preset::Pico, 10) };
    let start = Start::of(&config).expect("started");
    assert!(start.knows_motion);
    assert_weights(&start.params, &ALL, "init");
    // Encoder and decoder alone have to be asked for.
    let config = RunConfig { init: vec![reference("one_file")], ..config };
    assert!(Start::of(&config).err().expect("refused").to_string().contains("--allow-partial"));
    let start = Start::of(&RunConfig { allow_partial: true, ..config }).expect("started");
    assert!(!start.knows_motion);
    assert_weights(&start.params, &ALL[..2], "init in part");
    // A pose encoder without its decoder knows nothing of motion.
    let init = references(&["one_file/depth.pth", "pose_encoder.pth"]);
    let config = RunConfig { init, allow_partial: true, ..RunConfig::new(Preset::Pico, 10) };
    assert!(!Start::of(&config).expect("started").knows_motion);

    // Configurations as they were written before there could be several.
    let written = serde_json::to_value(RunConfig::new(Preset::Pico, 10)).expect("JSON");
    for (init, expected) in [
        (serde_json::json!(null), vec![]),
        (serde_json::json!("a.pth"), vec![PathBuf::from("a.pth")]),
        (serde_json::json!(["a", "b"]), vec![PathBuf::from("a"), PathBuf::from("b")]),
    ] {
        let mut config = written.clone();
        config["init"] = init;
        assert_eq!(serde_json::from_value::<RunConfig>(config).expect("a configuration").init, expected);
    }

    let sources = Sources::open(&[reference("")]).expect("opened");
    let error = sources.expect(Preset::Nano).unwrap_err().to_string();
    assert!(error.contains("does not fit the preset nano") && error.contains("of the preset pico"), "{error}");
}

fn parallax(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_parallax")).args(arguments).output().expect("the program runs")
}

#[track_caller]
fn succeeds(arguments: &[&str]) -> String {
    let output = parallax(arguments);
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

#[track_caller]
fn fails(arguments: &[&str], words: &[&str]) {
    let output = parallax(arguments);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{arguments:?}: {said}");
    for word in words {
        assert!(said.contains(word), "{arguments:?} should say {word:?}: {said}");
    }
}

#[test]
fn the_program_converts_and_predicts_the_same_from_every_form() {
    let place = tempfile::tempdir().expect("a folder");
    let path = |name: &str| place.path().join(name).to_str().expect("a path in UTF-8").to_owned();
    let text = |path: PathBuf| path.to_str().expect("a path in UTF-8").to_owned();
    let official = text(reference(""));
    let picture = text(fixture("resize_source.png"));
    let mut maps = Vec::new();
    let forms = ["w.safetensors", "w.npz", "w.pth", "set"].map(path);
    for form in &forms {
        let said = succeeds(&["convert", &official, form]);
        assert!(said.contains("missing     0") && said.contains(form.as_str()), "{said}");
    }
    for (i, weights) in forms.iter().chain([&official]).enumerate() {
        let out = path(&format!("out{i}"));
        succeeds(&["predict", "--weights", weights, &picture, "--out", &out, "--npy"]);
        maps.push(std::fs::read(Path::new(&out).join("resize_source.npy")).expect("a map"));
    }
    assert!(maps.iter().all(|m| *m == maps[0]), "predictions differ");

    // Files one by one; what is there is not replaced unasked.
    let [encoder, depth] = ["encoder.pth", "depth.pth"].map(|n| text(reference(n)));
    let said = succeeds(&["convert", &encoder, &depth, &path("two.safetensors"), "--json"]);
    let report: serde_json::Value = serde_json::from_str(&said).expect("JSON and nothing else");
    assert_eq!(report["absent"], serde_json::json!(["pose_encoder", "pose"]));
    fails(&["convert", &encoder, &path("two.safetensors")], &["two.safetensors", "--force"]);
    succeeds(&["convert", &encoder, &path("two.safetensors"), "--force"]);
    fails(&["predict", "--weights", &path("two.safetensors"), &picture, "--out", &path("no")], &["missing (depth."]);
    succeeds(&["predict", "--weights", &encoder, "--weights", &depth, &picture, "--out", &path("yes")]);
    let usage = parallax(&["predict", "--weights", &encoder, "--height", "100", &picture, "--out", &path("no")]);
    assert!(usage.status.code() == Some(2) && String::from_utf8_lossy(&usage.stderr).contains("--height"));

    // A preset that is not that of the weights costs no time and makes nothing.
    let started = Instant::now();
    let wrong = ["train", "--preset", "nano", "--init", &official, "--out", &path("run")];
    fails(&wrong, &["reference", "does not fit the preset nano", "channels 8 16 24 32", "of the preset pico"]);
    assert!(started.elapsed() < Duration::from_secs(5), "something was rendered first");
    assert!(!Path::new(&path("run")).exists(), "nothing was made");
}

/// Files of one network's weights with what training programs keep beside them: none of it is in the way.
#[test]
fn what_stands_beside_the_weights_never_blocks_a_file() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/pth/beside");
    let expected = parallax::formats::safetensors::read::<f32>(&folder.join("pose.safetensors"))
        .expect("the weights alone")
        .tensors;
    let mut files = 0;
    for entry in std::fs::read_dir(&folder).expect("the fixtures").flatten() {
        let path = entry.path();
        if path.extension().is_none_or(|ending| ending != "pth") {
            continue;
        }
        let weights = parallax::weights::load(std::slice::from_ref(&path), Need::Only("pose"), false);
        let weights = weights.unwrap_or_else(|e| panic!("{e}"));
        let found = weights.params.export();
        for (name, tensor) in &expected {
            let own = format!("pose.{}", name.strip_prefix("pose.").unwrap_or(name));
            assert!(found.get(&own).is_some_and(|t| t.same_bits(tensor)), "{}: {own}", path.display());
        }
        files += 1;
    }
    assert_eq!(files, 10);
}

/// The pose decoder's tensors under other names, in a file of this program's format.
fn renamed(folder: &Path, name: &str, names: &[(&str, f32)]) -> PathBuf {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/pth/beside/pose.safetensors");
    let plain = parallax::formats::safetensors::read::<f32>(&beside).expect("the weights alone").tensors;
    let mut tensors = BTreeMap::new();
    for (front, factor) in names {
        for (name, tensor) in &plain {
            let own = name.strip_prefix("pose.").unwrap_or(name);
            let scaled = Tensor::build(*tensor.shape(), |out| {
                out.iter_mut().zip(tensor.data()).for_each(|(o, x)| *o = factor * x);
            });
            tensors.insert(format!("{front}{own}"), scaled);
        }
    }
    let path = folder.join(format!("{name}.safetensors"));
    parallax::formats::safetensors::write(&path, &tensors, HashMap::new()).expect("written");
    path
}

#[test]
fn weights_are_found_whatever_wraps_them() {
    let place = tempfile::tempdir().expect("a folder");
    let load = |path: &Path| parallax::weights::load(&[path.to_owned()], Need::Only("pose"), false);
    let bias = |weights: &parallax::weights::Weights| weights.params.export()["pose.net.3.bias"].data()[0];
    let plain = bias(&load(&renamed(place.path(), "plain", &[("pose.", 1.0)])).expect("plain"));
    for front in ["", "module.", "net.pose.", "models.pose.", "generator.", "student.", "trainer.nets.pose_net."] {
        let weights =
            load(&renamed(place.path(), "wrapped", &[(front, 1.0)])).unwrap_or_else(|e| panic!("{front}: {e}"));
        assert_eq!(bias(&weights), plain, "{front}");
    }
    // Averages are taken where there is nothing else; beside plain weights they are passed over, with a word.
    let alone = load(&renamed(place.path(), "alone", &[("ema.", 2.0)])).expect("averages alone");
    assert_eq!(bias(&alone), 2.0 * plain);
    let both = renamed(place.path(), "both", &[("model.", 1.0), ("model_ema.", 2.0)]);
    let weights = load(&both).expect("the plain ones");
    assert_eq!(bias(&weights), plain);
    let said = weights.report.to_string();
    assert!(said.contains("averaged weights: the plain ones are taken (convert --averaged takes these)"), "{said}");
    let sources = parallax::weights::Sources::open_averaged(&[both]).expect("opened");
    let weights = parallax::weights::load_from(&sources, Need::Only("pose"), false).expect("the averages");
    assert_eq!(bias(&weights), 2.0 * plain);
    // Twice the same parameter with other numbers, and nothing that says which: an error.
    let error = load(&renamed(place.path(), "two", &[("a.", 1.0), ("b.", 2.0)])).err().expect("two").to_string();
    assert!(error.contains("a.net") && error.contains("b.net"), "{error}");
}

#[test]
fn a_name_that_stands_twice_and_a_bit_that_turned_are_refused_by_name() {
    let place = tempfile::tempdir().expect("a folder");
    let path = renamed(place.path(), "whole", &[("pose.", 1.0)]);
    let bytes = std::fs::read(&path).expect("read");
    let load = |bytes: &[u8]| {
        let path = place.path().join("changed.safetensors");
        std::fs::write(&path, bytes).expect("written");
        parallax::weights::load(&[path], Need::Only("pose"), false).err().map(|e| e.to_string())
    };
    assert_eq!(load(&bytes), None);
    let mut turned = bytes.clone();
    let last = turned.len() - 5;
    turned[last] ^= 1;
    let error = load(&turned).expect("refused");
    assert!(error.contains("changed.safetensors") && error.contains("checksum"), "{error}");
    // The same entry once more in the header: JSON readers would keep one of them without a word.
    let length = u64::from_le_bytes(bytes[..8].try_into().expect("eight")) as usize;
    let header = std::str::from_utf8(&bytes[8..8 + length]).expect("text").trim_end();
    let at = header.find("\"pose.net.0.bias\"").expect("the entry");
    let entry = &header[at..=at + header[at..].find('}').expect("its end")];
    let mut twice = format!("{},{entry}}}", &header[..header.len() - 1]).into_bytes();
    twice.resize(twice.len().next_multiple_of(8), b' ');
    let file = [&(twice.len() as u64).to_le_bytes()[..], &twice, &bytes[8 + length..]].concat();
    let error = load(&file).expect("refused");
    assert!(error.contains("pose.net.0.bias twice"), "{error}");
}
