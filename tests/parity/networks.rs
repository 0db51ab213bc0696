//! The networks that MonoViT is compared with, against PyTorch reference values: names, shapes and order of every tensor, and
//! outputs with weights made from the names.

use std::collections::HashMap;

use parallax::formats::safetensors;
use parallax::monovit::{Ablation, Preset};
use parallax::networks::{Architecture, DepthNetwork, EncoderKind, Network};
use parallax::nn::{Context, Folded, Params};
use parallax::tensor::{Tensor, Var};

use crate::published::{fill_from_names, fixture_path, input};
use crate::reference::{error, fixture};

/// What stands in a checkpoint beside the weights: counters, and the head that classified.
fn is_weight(name: &str) -> bool {
    !name.ends_with("num_batches_tracked") && !name.contains(".fc.")
}

/// Names and shapes of a part in file order.
type Shapes = Vec<(String, Vec<usize>)>;

fn check(name: &str, encoder: EncoderKind) {
    let architecture = Architecture { network: Network::Monodepth2, encoder, preset: Preset::Small };
    let config = architecture.config(&Ablation::default()).expect("a published size");
    let (model, mut params): (_, Params<f64>) = DepthNetwork::new(config, 0);
    let shapes: HashMap<String, HashMap<String, Shapes>> =
        serde_json::from_slice(&fixture("networks.json")).expect("names and shapes");
    for (part, theirs) in &shapes[name] {
        let theirs: Shapes = theirs.iter().filter(|(name, _)| is_weight(name)).cloned().collect();
        let prefix = format!("{part}.");
        let ours = params.iter().filter_map(|(_, p)| {
            let name = p.name().strip_prefix(&prefix)?.to_owned();
            Some((name, p.layout.exported(p.value.dims())))
        });
        assert_eq!(ours.collect::<Shapes>(), theirs, "{name}: {part}");
    }
    // Each part is a file of its own there: names without the part's in front.
    fill_from_names(&mut params, |name| name.split_once('.').map_or(name, |(_, inner)| inner));

    let reference = safetensors::read::<f64>(&fixture_path("networks.safetensors")).expect("the fixture").tensors;
    let c = Context::inference(&params);
    let features = model.features(&c, &input("input"));
    assert_eq!(features.len(), 5);
    for (i, feature) in features.iter().enumerate() {
        let expected = &reference[&format!("{name}/feature_mean/{i}")];
        let e = error(&feature.mean(1, 2).value().reshape(*expected.shape()), expected);
        assert!(e <= 1e-9, "{name}: feature {i}: error {e:.1e}");
    }
    let compare = |what: &str, found: &[Tensor<f64>], bound: f64| {
        assert_eq!(found.len(), 4);
        for (scale, disparity) in found.iter().enumerate() {
            let expected = &reference[&format!("{name}/disp/{scale}")];
            let e = error(&disparity.reshape(*expected.shape()), expected);
            assert!(e <= bound, "{name}: disparity {scale}{what}: error {e:.1e}");
        }
    };
    let image = input("input").into_value();
    let values = |all: Vec<Var<f64>>| all.into_iter().map(Var::into_value).collect::<Vec<_>>();
    compare("", &values(model.decode(&c, &features)), 1e-9);
    let folded = Folded::new(&params);
    compare(", normalisations folded", &model.predict(&folded, &image), 1e-9);
    let single = Folded::new(&params.cast::<f32>());
    let found: Vec<Tensor<f64>> = model.predict(&single, &image.cast()).iter().map(Tensor::cast).collect();
    compare(" in f32, normalisations folded", &found, 1e-4);
    let single = params.cast::<f32>();
    let c = Context::inference(&single);
    let found = model.disparities(&c, &Var::constant(image.cast()));
    let found: Vec<Tensor<f64>> = found.iter().map(|disparity| disparity.value().cast()).collect();
    compare(" in f32", &found, 1e-4);
    if let Some(expected) = reference.get(&format!("{name}/pose")) {
        for c in [Context::inference(&params), Context::folded(&folded)] {
            let motion = model.motion(&c, &input("input"), &input("input2"));
            let e = error(&motion.value().reshape(*expected.shape()), expected);
            assert!(e <= 1e-9, "{name}: pose: error {e:.1e}");
        }
    }
}

#[test]
fn monodepth2_over_resnet18() {
    check("monodepth2_18", EncoderKind::Resnet18);
}

#[test]
fn monodepth2_over_resnet34() {
    check("monodepth2_34", EncoderKind::Resnet34);
}

#[test]
fn monodepth2_over_resnet50() {
    check("monodepth2_50", EncoderKind::Resnet50);
}

/// The ablation of MonoViT's encoder: 27 million parameters in the paper's table.
#[test]
fn monovit_over_resnet34_has_the_papers_parameters() {
    let architecture =
        Architecture { network: Network::Monovit, encoder: EncoderKind::Resnet34, preset: Preset::Small };
    let config = architecture.config(&Ablation::default()).expect("a published size");
    let (_, params): (_, Params<f32>) = DepthNetwork::new(config, 0);
    let millions = (params.count("encoder.") + params.count("depth.")) as f64 / 1e6;
    assert!((27.35..27.45).contains(&millions), "{millions} million parameters");
}
