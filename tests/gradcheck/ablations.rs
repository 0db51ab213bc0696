//! The switches of the paper's ablation study: each trains, has the parameters it should have, takes checked kernel
//! paths alone, and has a gradient that the Taylor test believes.

use std::collections::BTreeSet;

use parallax::data::batch::{Augment, Batch, batch_of_step};
use parallax::monovit::loss::{LossConfig, Reprojection, Scales};
use parallax::monovit::{Ablation, Preset};
use parallax::networks::{Architecture, DepthNetwork, EncoderKind, Network};
use parallax::nn::Params;
use parallax::ops::registry;
use parallax::street::{Street, StreetConfig};
use parallax::tensor::profile;
use parallax::train::RunConfig;
use parallax::train::Trainer;

use super::whole_model::assert_taylor;

fn batch() -> Batch {
    let config = StreetConfig { height: 64, width: 96, sequences: 1, frames: 5, ..StreetConfig::default() };
    let street = Street::render(&config, None);
    batch_of_step(&street, Augment { flip: false, jitter: false, sensor: false }, 1, 0, 0).expect("a batch")
}

/// Takes a step, and compares the kernel paths with the checked ones. Gives the weights before and after.
fn step(ablation: Ablation, change: impl FnOnce(&mut LossConfig)) -> [Params<f32>; 2] {
    let mut config = RunConfig { ablation, height: 64, width: 96, ..RunConfig::new(Preset::Pico, 10) };
    config.auto_mask_delay = 0.0;
    config.rotations.keep = 0.0;
    change(&mut config.loss);
    config.check().expect("a configuration that can be run");
    let mut trainer = Trainer::new(config.model(), config.plan());
    let before = trainer.params.clone();
    let batch = batch();
    let (report, entries) = profile::record(false, || trainer.step(&batch));
    let report = report.expect("a step");
    assert!(report.loss.is_finite() && report.grad_norm > 0.0, "{report:?}");
    let checked: BTreeSet<(&str, &str)> =
        registry::all().iter().flat_map(|e| e.cases()).map(|c| (c.op(), c.algo())).collect();
    let unchecked: BTreeSet<_> =
        entries.iter().map(|e| (e.op, e.algo)).filter(|path| !checked.contains(path)).collect();
    assert!(unchecked.is_empty(), "kernel paths without a gradient check: {unchecked:?}");
    [before, trainer.params]
}

fn names(params: &Params<f32>) -> Vec<String> {
    params.iter().map(|(_, p)| p.name().to_owned()).collect()
}

/// What an ablation takes away: every name that contains one of `gone`, and nothing else. All that is left and takes part
/// in the result moves with a step.
#[track_caller]
fn assert_takes_away(ablation: Ablation, gone: &[&str]) -> Params<f32> {
    let whole = names(&DepthNetwork::new::<f32>(Preset::Pico.config(), 0).1);
    let [before, after] = step(ablation, |_| ());
    let expected: Vec<_> = whole.iter().filter(|n| !gone.iter().any(|g| n.contains(g))).cloned().collect();
    assert!(expected.len() < whole.len(), "{gone:?} is nothing");
    assert_eq!(names(&before), expected);
    for ((_, a), (_, b)) in before.iter().zip(after.iter()) {
        let idle = ["X_00_Conv_0", "X_01_Conv_0", "X_02_Conv_0", "X_03_Conv_0"].iter().any(|n| a.name().contains(n));
        assert!(idle || !a.value.same_bits(&b.value), "{} did not move", a.name());
    }
    before
}

/// The width of what the fusing convolution of a stage reads.
fn fused(params: &Params<f32>, stage: usize) -> usize {
    let id = params.find(&format!("encoder.mhca_stages.{stage}.aggregate.conv.weight")).expect("fused");
    params.get(id).value.dims()[2]
}

#[test]
fn without_the_cnn_path() {
    let params = assert_takes_away(Ablation { cnn_path: false, ..Ablation::default() }, &["InvRes"]);
    assert_eq!([0, 1, 2, 3].map(|stage| fused(&params, stage)), [2 * 8, 3 * 16, 3 * 24, 3 * 32]);
}

#[test]
fn with_fewer_transformer_paths() {
    let gone = ["patch_embeds.2.", "patch_embeds.1.", "mhca_blks.2.", "mhca_blks.1."];
    let two = Ablation { transformer_paths: Some(2), ..Ablation::default() };
    let params = assert_takes_away(two, &[gone[0], gone[2]]);
    assert_eq!([0, 1, 2, 3].map(|stage| fused(&params, stage)), [3 * 8, 3 * 16, 3 * 24, 3 * 32]);
    let one = Ablation { transformer_paths: Some(1), ..Ablation::default() };
    let params = assert_takes_away(one, &gone);
    assert_eq!([0, 1, 2, 3].map(|stage| fused(&params, stage)), [2 * 8, 2 * 16, 2 * 24, 2 * 32]);
    // The CNN path reads the first embedding, which stays.
    let none = Ablation { transformer_paths: Some(0), ..Ablation::default() };
    let params = assert_takes_away(none, &["patch_embeds.2.", "patch_embeds.1.", "mhca_blks"]);
    assert_eq!([0, 1, 2, 3].map(|stage| fused(&params, stage)), [8, 16, 24, 32]);
}

#[test]
fn without_the_decoders_attention() {
    assert_takes_away(Ablation { decoder_attention: false, ..Ablation::default() }, &[".ca.fc.", "_attention.fc."]);
}

#[test]
fn with_paths_dropped() {
    let plain = step(Ablation::default(), |_| ());
    let dropped = step(Ablation { drop_path: Some(0.9), ..Ablation::default() }, |_| ());
    assert_eq!(names(&plain[0]), names(&dropped[0]));
    let differs = plain[1].iter().zip(dropped[1].iter()).any(|((_, a), (_, b))| !a.value.same_bits(&b.value));
    assert!(differs, "nothing was dropped");
}

#[test]
fn every_setting_of_the_loss_takes_a_step() {
    for auto_mask in [true, false] {
        for reprojection in [Reprojection::Minimum, Reprojection::Average] {
            for (scales, ssim) in [(Scales::Full, 0.0), (Scales::Own, 0.85), (Scales::Own, 0.0)] {
                step(Ablation::default(), |loss| *loss = LossConfig { auto_mask, reprojection, scales, ssim, ..*loss });
            }
        }
    }
}

#[test]
fn without_ssim_it_is_not_computed() {
    let batch = batch();
    for (ssim, path) in [(0.85, "rgb"), (0.0, "l1")] {
        let mut config = RunConfig::new(Preset::Pico, 10);
        config.loss.ssim = ssim;
        let mut trainer = Trainer::new(config.model(), config.plan());
        let (_, entries) = profile::record(false, || trainer.step(&batch));
        let photometric: BTreeSet<_> = entries.iter().filter(|e| e.op == "photometric").map(|e| e.algo).collect();
        assert_eq!(photometric, BTreeSet::from([path]));
    }
}

#[test]
fn the_taylor_remainder_of_average_reprojection_at_each_scales_own_size() {
    let loss = LossConfig { reprojection: Reprojection::Average, scales: Scales::Own, ..LossConfig::default() };
    assert_taylor(Preset::Pico.config(), &loss, &["depth.", "pose.", ""]);
}

#[test]
fn the_taylor_remainder_of_other_networks() {
    // Deeper encoders bend the loss so much at these steps that a wrong gradient of theirs alone would not stand out.
    for (network, encoder, prefixes) in [
        (Network::Monodepth2, EncoderKind::Resnet18, &["encoder.", "depth.", ""][..]),
        (Network::Monodepth2, EncoderKind::Resnet50, &["depth."]),
        (Network::Monovit, EncoderKind::Resnet34, &["depth.", ""]),
    ] {
        let architecture = Architecture { network, encoder, preset: Preset::Pico };
        let sizes = architecture.config(&Ablation::default()).expect("a size");
        assert_taylor(sizes, &LossConfig::default(), prefixes);
    }
}

#[test]
fn the_taylor_remainder_of_what_ablations_leave() {
    let one = Ablation { cnn_path: false, transformer_paths: Some(1), decoder_attention: false, drop_path: None };
    assert_taylor(one.apply(Preset::Pico.config()), &LossConfig::default(), &[""]);
    let none = Ablation { transformer_paths: Some(0), ..Ablation::default() };
    assert_taylor(none.apply(Preset::Pico.config()), &LossConfig { ssim: 0.0, ..LossConfig::default() }, &[""]);
}
