//! Networks other than MonoViT from the outside: their checkpoints, what does not fit, and every command on one of them.
#![cfg(feature = "cli")]

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use parallax::formats::pth;
use parallax::formats::pth::Saved;
use parallax::monovit::{Ablation, Preset};
use parallax::networks::{Architecture, DepthNetwork, EncoderKind, Network, Setup};
use parallax::nn::Params;
use parallax::train::RunConfig;
use parallax::train::recipe::read_config;
use parallax::train::run::{load_weights, write_weights};
use parallax::train::start::Start;
use parallax::weights::{Form, Need, architecture_of, load, save};

const MONODEPTH2: Architecture =
    Architecture { network: Network::Monodepth2, encoder: EncoderKind::Resnet18, preset: Preset::Nano };

/// Starting weights of an architecture.
fn weights(architecture: Architecture, seed: u64) -> Params<f32> {
    DepthNetwork::new(architecture.config(&Ablation::default()).expect("a size"), seed).1
}

/// A tensor of a file: its name, shape and numbers, in PyTorch's layout.
type Stored = (String, Vec<usize>, Vec<f32>);

/// Names and shapes of a part in file order.
type Shapes = Vec<(String, Vec<usize>)>;

/// The tensors of a part of a model, without the part's name in front.
fn part(params: &Params<f32>, network: &str) -> Vec<Stored> {
    let of = |(_, p): (_, &parallax::nn::Param<f32>)| {
        let name = p.name().strip_prefix(network)?.strip_prefix('.')?.to_owned();
        let value = p.layout.export(&p.value);
        Some((name, value.dims().to_vec(), value.data().to_vec()))
    };
    params.iter().filter_map(of).collect()
}

fn write_pth(path: &Path, tensors: &[Stored]) {
    let entries: Vec<(String, Saved<'_>)> =
        tensors.iter().map(|(name, shape, data)| (name.clone(), Saved::F32 { shape, data })).collect();
    pth::write(std::fs::File::create(path).expect("writable"), "x", &entries).expect("written");
}

#[track_caller]
fn assert_same(a: &Params<f32>, b: &Params<f32>, network: &str) {
    let [a, b] = [a, b].map(|params| part(params, network));
    assert!(!a.is_empty() && a == b, "{network}");
}

#[test]
fn every_form_of_file_gives_back_every_network() {
    let place = tempfile::tempdir().expect("a folder");
    let over_resnet50 = Architecture { network: Network::Monovit, encoder: EncoderKind::Resnet50, ..MONODEPTH2 };
    let over_mpvit = Architecture { encoder: EncoderKind::Mpvit, ..MONODEPTH2 };
    for architecture in [MONODEPTH2, over_resnet50, over_mpvit] {
        let params = weights(architecture, 1);
        let name = architecture.name().replace('/', "_");
        let file = place.path().join(format!("{name}.safetensors"));
        write_weights(&file, &params, &Setup::of(architecture)).expect("written");
        let loaded = load(&[file], Need::All, false).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(loaded.setup.architecture(), architecture);
        for form in ["b.npz", "c.pth", "folder"] {
            let path = place.path().join(format!("{name}_{form}"));
            save(&loaded, &path, Form::of(Path::new(form)).expect("a form")).expect("written");
            // Without metadata: from names and shapes.
            let again = load(std::slice::from_ref(&path), Need::All, false).unwrap_or_else(|e| panic!("{form}: {e}"));
            assert_eq!(again.setup.architecture(), architecture, "{form}");
            for network in ["encoder", "depth", "pose_encoder", "pose"] {
                assert_same(&again.params, &params, network);
            }
        }
    }
}

/// Files with exactly the tensors of the public ones, heads and counters included.
#[test]
fn the_public_checkpoints_of_monodepth2_are_read_and_written_back() {
    let place = tempfile::tempdir().expect("a folder");
    let shapes = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/networks.json");
    let shapes: HashMap<String, HashMap<String, Shapes>> =
        serde_json::from_slice(&std::fs::read(shapes).expect("the fixture")).expect("names and shapes");
    let parts = &shapes["monodepth2_18"];
    for (part, tensors) in parts {
        let numbers: Vec<Stored> = tensors
            .iter()
            .map(|(name, shape)| (name.clone(), shape.clone(), vec![0.25; shape.iter().product()]))
            .collect();
        let mut entries: Vec<(String, Saved<'_>)> = numbers
            .iter()
            .map(|(name, shape, data)| match name.ends_with("num_batches_tracked") {
                true => (name.clone(), Saved::I64(7)),
                false => (name.clone(), Saved::F32 { shape, data }),
            })
            .collect();
        if part == "encoder" {
            entries.extend([("height".into(), Saved::Int(192)), ("width".into(), Saved::Int(640))]);
        }
        let file = std::fs::File::create(place.path().join(format!("{part}.pth"))).expect("writable");
        pth::write(file, part, &entries).expect("written");
    }
    let loaded = load(&[place.path().to_owned()], Need::All, false).expect("recognised");
    assert_eq!(loaded.setup.architecture().name(), "monodepth2/resnet18/small");
    assert_eq!((loaded.setup.height, loaded.setup.width), (192, 640));
    assert_eq!((loaded.report.matched.len(), loaded.report.problem()), (loaded.params.len(), None));
    let written = place.path().join("written");
    save(&loaded, &written, Form::Folder).expect("written");
    for (part, tensors) in parts {
        let ours = pth::read(written.join(format!("{part}.pth"))).expect("ours");
        let theirs: Vec<_> = tensors.iter().filter(|(name, _)| !name.contains(".fc.")).collect();
        assert_eq!(ours.tensors().count(), theirs.len(), "{part}");
        for (name, shape) in theirs {
            assert_eq!(ours.tensor(name).unwrap_or_else(|| panic!("{part}: {name}")).shape(), shape, "{part}: {name}");
        }
    }
    // Depth alone, and the encoder alone by its shapes.
    let files = ["encoder.pth", "depth.pth"].map(|name| place.path().join(name));
    assert_eq!(load(&files, Need::Depth, false).expect("depth").report.absent, ["pose_encoder", "pose"]);
    assert_eq!(architecture_of(&files[..1]).expect("an encoder").name(), "monodepth2/resnet18/small");
}

/// A ResNet-18 as torchvision writes it, as wide as the reduced one.
fn classifier(place: &Path) -> (PathBuf, Vec<Stored>) {
    let mut tensors: Vec<Stored> = part(&weights(MONODEPTH2, 9), "encoder.encoder");
    let inner = tensors.clone();
    tensors.push(("fc.weight".into(), vec![10, 128], vec![0.5; 1280]));
    tensors.push(("fc.bias".into(), vec![10], vec![0.5; 10]));
    let file = place.join("resnet18.pth");
    write_pth(&file, &tensors);
    (file, inner)
}

#[test]
fn one_classifier_starts_the_depth_encoder_and_the_pose_encoder() {
    let place = tempfile::tempdir().expect("a folder");
    let (file, tensors) = classifier(place.path());
    let config = RunConfig {
        init_encoder: Some(file.clone()),
        init_pose: Some(file.clone()),
        ..RunConfig::from_encoder(MONODEPTH2, 10)
    };
    let start = Start::of(&config).expect("started");
    assert_eq!(part(&start.params, "encoder.encoder"), tensors);
    let pose = part(&start.params, "pose_encoder.encoder");
    assert_eq!(pose[1..], tensors[1..]);
    assert_eq!(pose[0].1, [16, 6, 7, 7]);
    let of_one = &tensors[0].2;
    let halves: Vec<f32> = of_one[..3 * 49].iter().map(|x| x / 2.0).collect();
    assert!(pose[0].2[..3 * 49] == halves && pose[0].2[3 * 49..6 * 49] == halves);

    // Its disparity starts where the configuration says, in heads of another name.
    let head = start.params.find("depth.decoder.10.conv.bias").expect("a head");
    let bias = f64::from(start.params.get(head).value.data()[0]);
    assert!((1.0 / (1.0 + (-bias).exp()) - 0.15).abs() < 1e-6);
}

#[test]
fn what_does_not_fit_is_named_with_what_it_looks_like() {
    let place = tempfile::tempdir().expect("a folder");
    let (resnet18, _) = classifier(place.path());
    let refused = |config: RunConfig| Start::of(&config).err().expect("refused").to_string();
    let encoder = |architecture: Architecture, file: &Path| {
        refused(RunConfig { init_encoder: Some(file.to_owned()), ..RunConfig::new(architecture, 10) })
    };
    let error = encoder(Preset::Nano.into(), &resnet18);
    assert!(error.contains("resnet18.pth") && error.contains("holds no tensors of an MPViT"), "{error}");
    assert!(error.contains("but those of a ResNet for one picture"), "{error}");
    let error = encoder(Architecture { encoder: EncoderKind::Resnet34, ..MONODEPTH2 }, &resnet18);
    assert!(
        error.contains("does not fit monodepth2/resnet34/nano: these weights have blocks 2 2 2 2 instead of 3 4 6 3"),
        "{error}"
    );
    assert!(error.contains("they are of monodepth2/resnet18/nano"), "{error}");
    let error = encoder(Architecture { encoder: EncoderKind::Resnet50, ..MONODEPTH2 }, &resnet18);
    assert!(error.contains("convolutions in a block 2 instead of 3"), "{error}");
    let error = encoder(Architecture { preset: Preset::Small, ..MONODEPTH2 }, &resnet18);
    assert!(error.contains("channels 16 16 32 64 instead of 64 64 128 256"), "{error}");
    let mpvit = place.path().join("mpvit.pth");
    write_pth(&mpvit, &part(&weights(Preset::Pico.into(), 1), "encoder"));
    let error = encoder(MONODEPTH2, &mpvit);
    assert!(error.contains("a ResNet for one picture (conv1., layer1.), but those of an MPViT"), "{error}");

    // Whole networks.
    let file = place.path().join("monodepth2.safetensors");
    write_weights(&file, &weights(MONODEPTH2, 1), &Setup::of(MONODEPTH2)).expect("written");
    let init = |architecture: Architecture| {
        refused(RunConfig { init: vec![file.clone()], ..RunConfig::new(architecture, 10) })
    };
    let error = init(Preset::Nano.into());
    assert!(
        error.contains("does not fit the preset nano") && error.contains("the encoder ResNet instead of MPViT"),
        "{error}"
    );
    assert!(error.contains("the decoder of monodepth2 instead of monovit"), "{error}");
    assert!(error.contains("they are of monodepth2/resnet18/nano"), "{error}");
    let error = init(Architecture { network: Network::Monovit, ..MONODEPTH2 });
    assert!(
        error.contains("does not fit monovit/resnet18/nano: these weights have the decoder of monodepth2"),
        "{error}"
    );

    // A network that there is not.
    let mut wide = part(&weights(MONODEPTH2, 1), "encoder");
    let mut more: Vec<Stored> = wide.iter().filter(|t| t.0.contains("layer3.1.")).cloned().collect();
    more.iter_mut().for_each(|t| t.0 = t.0.replace("layer3.1.", "layer3.2."));
    wide.extend(more);
    let other = place.path().join("other.pth");
    write_pth(&other, &wide);
    let error = load(&[other], Need::Any, false).err().expect("refused").to_string();
    assert!(error.contains("the nearest is monodepth2/resnet18/nano"), "{error}");
    assert!(error.contains("blocks 2 2 3 2 instead of 2 2 2 2"), "{error}");
}

#[test]
fn configurations_name_the_network_and_those_from_before_mean_monovit() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("config.toml");
    let read = |text: &str| {
        std::fs::write(&path, text).expect("written");
        read_config(&path)
    };
    assert_eq!(read("preset = \"tiny\"").expect("read").architecture(), Preset::Tiny.into());
    assert_eq!(read("network = \"monodepth2\"").expect("read").architecture(), MONODEPTH2);
    let over = read("network = \"monovit\"\nencoder = \"resnet34\"\npreset = \"small\"").expect("read");
    assert_eq!(over.architecture().name(), "monovit/resnet34/small");
    for architecture in Architecture::all() {
        let config = RunConfig::new(architecture, 10);
        let text = toml::to_string(&config).expect("TOML");
        assert_eq!(read(&text).expect("read"), config);
        assert_eq!(config.architecture(), architecture);
    }
    for (text, words) in [
        ("network = \"unet\"", ["monovit", "monodepth2"]),
        ("encoder = \"vgg16\"", ["resnet18", "mpvit"]),
        ("encoder = \"resnet50\"\npreset = \"base\"", ["line 2: preset", "pico, nano, small"]),
        ("encoder = \"resnet18\"\n[ablation]\ncnn_path = false", ["cnn_path", "no such part"]),
        ("network = \"monodepth2\"\n[ablation]\ndecoder_attention = false", ["decoder_attention", "no such part"]),
    ] {
        let error = read(text).expect_err("refused").to_string();
        assert!(words.iter().all(|word| error.contains(word)), "{text}: {error}");
    }
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

#[test]
fn every_command_works_with_another_network() {
    let place = tempfile::tempdir().expect("a folder");
    let path = |name: &str| place.path().join(name).to_str().expect("a path in UTF-8").to_owned();
    let size = ["--height", "64", "--width", "96"];
    let street = path("street");
    succeeds(&[&["data", "street", "--out", &street][..], &size].concat());
    let networks = ["--network", "monodepth2", "--encoder", "resnet18", "--preset", "pico"];
    let run = path("run");
    let short = ["--batch", "1", "--steps", "2", "--checkpoint-every", "2", "--log-every", "1"];
    succeeds(&[&["train", "--data", &street, "--out", &run][..], &networks, &size, &short].concat());
    let (model, _, setup) = load_weights(Path::new(&run)).expect("weights");
    assert_eq!(setup.architecture(), Architecture { preset: Preset::Pico, ..MONODEPTH2 });
    assert!(model.config.mpvit().is_none());
    assert!(place.path().join("run/report.html").is_file());
    succeeds(&["train", "--resume", &run, "--steps", "3"]);

    let picture = path("picture.png");
    image::RgbImage::from_fn(130, 70, |x, y| image::Rgb([x as u8, 2 * y as u8, 90])).save(&picture).expect("written");
    succeeds(&["predict", "--weights", &run, &picture, "--out", &path("depth")]);
    let said = succeeds(&["attention", "--weights", &run, &picture, "--at", "60,40", "--out", &path("attention")]);
    assert!(said.contains("the encoder resnet18 has no attention"), "{said}");
    assert!(place.path().join("attention/picture_saliency.png").is_file());
    succeeds(&["eval", "--weights", &run, "--data", &street]);
    let folder = path("published");
    succeeds(&["convert", &run, &folder]);
    succeeds(&["predict", "--weights", &folder, &picture, "--out", &path("again")]);

    let said = succeeds(&[&["info"][..], &networks, &size].concat());
    assert!(said.starts_with("monodepth2/resnet18/pico at 96x64"), "{said}");
    for (arguments, words) in [
        (&["info", "--encoder", "resnet50", "--preset", "tiny"][..], &["no tiny of resnet50", "pico, nano, small"][..]),
        (&["info", "--encoder", "mpvit-tiny", "--preset", "small"], &["--encoder", "--preset is small"]),
        (&["info", "--network", "monodepth2", "--no-decoder-attention"], &["no such part", "network monovit"]),
        (&["info", "--encoder", "resnet18", "--transformer-paths", "1"], &["--transformer-paths", "encoder mpvit"]),
        (&["info", "--encoder", "vgg16"], &["resnet18", "mpvit-tiny"]),
        (
            &["train", "--init", &run, "--network", "monovit", "--encoder", "mpvit"],
            &["does not fit the preset pico", "monodepth2"],
        ),
    ] {
        let output = parallax(arguments);
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && words.iter().all(|word| said.contains(word)), "{arguments:?}: {said}");
    }
}
