//! What training costs is known beforehand. Memory is counted for the whole process, hence one test in a process of its own.

use parallax::data::batch::Batch;
use parallax::monovit::{Ablation, Preset};
use parallax::networks::{Architecture, Network};
use parallax::nn::Context;
use parallax::tensor::{Tensor, Var, pool, profile};
use parallax::train::cost::{Cost, check_memory};
use parallax::train::fit::fit_memory;
use parallax::train::{RunConfig, Trainer};

fn triplets(height: usize, width: usize, batch: usize) -> Batch {
    let picture = |scale: usize, k: usize| {
        let shape = [batch, height >> scale, width >> scale, 3];
        Tensor::build(shape, |out| out.iter_mut().enumerate().for_each(|(i, o)| *o = ((i * k) % 97) as f32 / 97.0))
    };
    let pyramid: Vec<Tensor<f32>> = (0..4).map(|scale| picture(scale, 31)).collect();
    let sources = [picture(0, 37), picture(0, 41)];
    let (w, h) = (width as f64, height as f64);
    Batch::in_time(pyramid, sources, vec![[0.58 * w, 1.92 * h, 0.5 * w, 0.5 * h]; batch])
}

#[test]
fn small_steps_tell_what_larger_ones_cost() {
    let pico = Preset::Pico;
    let [monovit, monodepth2] = [pico.into(), Architecture::of(Network::Monodepth2, pico)]
        .map(|architecture| architecture.config(&Ablation::default()).expect("a size"));
    let sizes = [([96, 160], 1), ([64, 96], 3), ([160, 64], 2), ([128, 256], 2)];
    let of_one = sizes.map(|(size, batch)| (size, batch, &monovit));
    for ([h, w], batch, config) in of_one.into_iter().chain([([96, 160], 2, &monodepth2)]) {
        let cost = Cost::of(config, [h, w], batch, false).expect("counted");
        let mut trainer = Trainer::new(config, RunConfig::usual().plan());
        let data = triplets(h, w, batch);
        trainer.step(&data).expect("a first step");
        let (_, inference) = profile::record(false, || {
            let image = Var::constant(data.target.clone());
            trainer.model.disparities(&Context::inference(&trainer.params), &image);
        });
        let (peak, step) = profile::record(false, || pool::peak_of(|| trainer.step(&data).expect("a step")).1);
        // Arithmetic is known exactly.
        let flops: f64 = inference.iter().map(|e| e.flops as f64).sum();
        assert_eq!(cost.flops_inference, flops, "{h}x{w}, batch {batch}");
        let flops: f64 = step.iter().map(|e| (e.flops + e.back.flops) as f64).sum();
        assert_eq!(cost.flops_step, flops, "{h}x{w}, batch {batch}");
        // Memory within a tenth, beside what is added for the pool.
        let ratio = cost.bytes_step / 1.12 / (peak as f64 + 16.0 * trainer.params.count("") as f64);
        assert!((0.9..1.1).contains(&ratio), "{h}x{w}, batch {batch}: {ratio}");
        assert!(cost.seconds_step > 0.0 && cost.seconds_inference < cost.seconds_step);
    }
    assert_fits();
    if std::path::Path::new("/proc/meminfo").exists() {
        assert!(check_memory(&RunConfig { preset: Preset::Pico, ..RunConfig::usual() }).is_ok());
        let huge = RunConfig { preset: Preset::Pico, height: 8192, width: 8192, batch: 1000, ..RunConfig::usual() };
        let error = check_memory(&huge).expect_err("too much").to_string();
        assert!(error.contains("pico at 8192x8192, batch 1000") && error.contains("GiB are free"), "{error}");
    }
}

/// Less and less memory: first layers are computed again, then the batch is cut, and in the end it is an error.
fn assert_fits() {
    // A folder's pictures are not held: a step is all there is.
    let usual = RunConfig { preset: Preset::Pico, data: "frames".into(), batch: 6, ..RunConfig::usual() };
    let of = |batch: usize, recompute: bool| {
        Cost::of(Preset::Pico.config(), [96, 320], batch, recompute).expect("counted").bytes_step
    };
    let fit = |most: f64| {
        let mut config = usual.clone();
        fit_memory(&mut config, most).map(|fitted| (config, fitted))
    };
    let (whole, again) = (of(6, false), of(6, true));
    assert!(again < whole, "{again} {whole}");
    let (config, fitted) = fit(1.01 * whole).expect("as it is");
    assert_eq!((config, fitted.changes.len()), (usual.clone(), 0));
    let (config, fitted) = fit(0.5 * (whole + again)).expect("computed again");
    assert!(config == RunConfig { recompute: true, ..usual.clone() } && fitted.changes.len() == 1, "{fitted:?}");
    let (config, fitted) = fit(0.99 * again).expect("in parts");
    assert!(config.batch * config.accumulate == 6 && config.batch < 6, "{config:?}");
    assert!(fitted.bytes <= 0.99 * again && fitted.changes[0].contains("parts of"), "{fitted:?}");
    let error = fit(0.5 * of(1, true)).expect_err("too little").to_string();
    assert!(error.contains("pico at 320x96") && error.contains("MiB are allowed"), "{error}");
}
