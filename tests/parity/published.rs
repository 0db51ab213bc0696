//! Every published size against PyTorch reference values: names, shapes, parameter counts, and outputs with weights
//! made from the names.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use parallax::formats::safetensors;
use parallax::monovit::Preset;
use parallax::networks::DepthNetwork;
use parallax::nn::{Context, Folded, Params};
use parallax::tensor::{Shape, Tensor, Var};

use crate::reference::{error, fixture};

/// Path of a file under `tests/fixtures`.
pub fn fixture_path(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

/// The number at flat index `i` of the tensor called `name`, in [-1, 1): splitmix64 over FNV-1a.
fn unit(name: &str, i: u64) -> f64 {
    const SEED: u64 = 11;
    let hash = name.bytes().fold(0xCBF2_9CE4_8422_2325u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01B3));
    let mut z = hash.wrapping_add(0x9E37_79B9_7F4A_7C15u64.wrapping_mul(i + 1 + SEED));
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^= z >> 31;
    (z >> 40) as f64 / f64::from(1 << 24) * 2.0 - 1.0
}

/// A tensor (in PyTorch's layout) made from its name.
fn from_name(name: &str, shape: &Shape) -> Tensor<f64> {
    let value = |u: f64| match () {
        _ if name.starts_with("input") => u,
        _ if name.ends_with("running_var") => 1.0 + 0.5 * u,
        _ if name.ends_with("running_mean") => 0.1 * u,
        _ if shape.rank() == 1 && name.ends_with("weight") => 1.0 + 0.25 * u,
        _ if shape.rank() == 1 => 0.1 * u,
        _ => u * (3.0 / shape.dims()[1..].iter().product::<usize>() as f64).sqrt(),
    };
    Tensor::from_vec(*shape, (0..shape.len() as u64).map(|i| f64::from(value(unit(name, i)) as f32)).collect())
}

/// A picture made from its name, `[1, 64, 96, 3]` in [0, 1].
pub fn input(name: &str) -> Var<f64> {
    let image = from_name(name, &Shape::new(&[1, 3, 64, 96]));
    image.map(|x| 0.5 * x + 0.5).permute(&[0, 2, 3, 1]).into()
}

/// Weights made from the names, as far as `part` takes them; a shared tensor takes the value of its last one.
pub fn fill_from_names(params: &mut Params<f64>, part: fn(&str) -> &str) {
    let ids: Vec<_> = params.iter().map(|(id, _)| id).collect();
    for id in ids {
        let p = params.get(id);
        let theirs = from_name(part(p.names.last().expect("a name")), p.layout.export(&p.value).shape());
        let ours = p.layout.import(&theirs).expect("a layout that fits");
        params.set(id, ours);
    }
}

fn check(preset: Preset) {
    let size = preset.name();
    let shapes: HashMap<String, serde_json::Value> = serde_json::from_slice(&fixture("shapes.json")).expect("JSON");
    let (model, mut params): (_, Params<f64>) = DepthNetwork::new(preset.config(), 0);

    // Names and shapes: ours and theirs are the same set.
    let theirs = shapes[size]["tensors"].as_object().expect("tensors by name");
    let mut seen = 0;
    for (_, p) in params.iter() {
        for name in &p.names {
            let dims: Vec<u64> = p.layout.export(&p.value).dims().iter().map(|&d| d as u64).collect();
            let expected = theirs.get(name).unwrap_or_else(|| panic!("{size}: {name} is ours alone"));
            let expected: Vec<u64> = expected.as_array().expect("a shape").iter().filter_map(|d| d.as_u64()).collect();
            assert_eq!(dims, expected, "{size}: {name}");
            seen += 1;
        }
    }
    let counted = theirs.keys().filter(|n| !n.ends_with("num_batches_tracked")).count();
    assert_eq!(seen, counted, "{size}: tensors of theirs that are not ours");
    for (part, count) in shapes[size]["params"].as_object().expect("counts by part") {
        assert_eq!(params.count(&format!("{part}.")) as u64, count.as_u64().expect("a count"), "{size}: {part}");
    }

    fill_from_names(&mut params, |name| name);
    let reference = safetensors::read::<f64>(&fixture_path("published.safetensors")).expect("the fixture").tensors;
    let c = Context::inference(&params);
    let features = model.features(&c, &input("input"));
    for (i, feature) in features.iter().enumerate() {
        let e = error(feature.mean(1, 2).value(), &reference[&format!("{size}/feature_mean/{i}")]);
        assert!(e <= 1e-9, "{size}: feature {i}: error {e:.1e}");
    }
    for (s, disparity) in model.decode(&c, &features).iter().enumerate() {
        let expected = reference[&format!("{size}/disp/{s}")].permute(&[0, 2, 3, 1]);
        let e = error(disparity.value(), &expected);
        assert!(e <= 1e-9, "{size}: disparity {s}: error {e:.1e}");
    }
    let folded = Folded::new(&params);
    for (s, disparity) in model.predict(&folded, input("input").value()).iter().enumerate() {
        let expected = reference[&format!("{size}/disp/{s}")].permute(&[0, 2, 3, 1]);
        let e = error(disparity, &expected);
        assert!(e <= 1e-9, "{size}: disparity {s}, normalisations folded: error {e:.1e}");
    }
    let single = Folded::new(&params.cast::<f32>());
    for (s, disparity) in model.predict(&single, &input("input").value().cast()).iter().enumerate() {
        let expected = reference[&format!("{size}/disp/{s}")].permute(&[0, 2, 3, 1]);
        let e = error(&disparity.cast(), &expected);
        assert!(e <= 1e-4, "{size}: disparity {s} in f32: error {e:.1e}");
    }
    let c = Context::folded(&folded);
    let motion = model.motion(&c, &input("input"), &input("input2"));
    let e = error(motion.value(), &reference[&format!("{size}/pose")]);
    assert!(e <= 1e-9, "{size}: pose, normalisations folded: error {e:.1e}");
    let c = Context::inference(&params);
    let motion = model.motion(&c, &input("input"), &input("input2"));
    let e = error(motion.value(), &reference[&format!("{size}/pose")]);
    assert!(e <= 1e-9, "{size}: pose: error {e:.1e}");
}

#[test]
fn nano() {
    check(Preset::Nano);
}

#[test]
fn tiny() {
    check(Preset::Tiny);
}

#[test]
fn xsmall() {
    check(Preset::Xsmall);
}

#[test]
fn small() {
    check(Preset::Small);
}

#[test]
fn base() {
    check(Preset::Base);
}
