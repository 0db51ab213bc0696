//! `parallax info`.

use parallax::Result;
use parallax::monovit::MonoVit;
use parallax::nn::Context;
use parallax::tensor::profile;
use parallax::tensor::{Tensor, Var};
use serde::Serialize;

use super::ablation::Networks;
use super::sizes::Sizes;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    sizes: Sizes,
    #[command(flatten)]
    networks: Networks,
}

#[derive(Serialize)]
struct Parameters {
    encoder: usize,
    depth: usize,
    pose_encoder: usize,
    pose: usize,
}

#[derive(Serialize)]
struct Info {
    parameters: Parameters,
    gflop_inference: f64,
    gflop_step: f64,
    memory_bytes: u64,
}

pub fn run(args: Args) -> Result<()> {
    let Args { sizes: args, networks } = args;
    args.check()?;
    let (model, params) = MonoVit::new::<f32>(networks.config(args.preset)?, 0);
    // Counted by running one picture: the arithmetic of an op is said by the op itself.
    let c = Context::inference(&params);
    let image = Var::constant(Tensor::zeros([1, args.height, args.width, 3]));
    let (_, depth) = profile::record(false, || model.disparities(&c, &image));
    let (_, pose) = profile::record(false, || model.transforms(&c, &image, &image, &image));
    let count = |entries: &[profile::Entry]| entries.iter().map(|e| e.flops).sum::<u64>() as f64 * 1e-9;
    let outputs: usize = depth.iter().chain(&pose).map(|e| e.output.len()).sum();
    let part = |prefix: &str| params.count(prefix);
    let batch = args.batch as f64;
    let parameters = Parameters {
        encoder: part("encoder."),
        depth: part("depth."),
        pose_encoder: part("pose_encoder."),
        pose: part("pose."),
    };
    let learnt: usize = params.count("");
    let info = Info {
        gflop_inference: batch * count(&depth),
        gflop_step: batch * 3.0 * (count(&depth) + count(&pose)),
        // Weights, two moments, gradients, the average; and every op's output, kept for the backward pass.
        memory_bytes: 4 * (5 * learnt + args.batch * outputs) as u64,
        parameters,
    };
    if args.json {
        return super::print_json(&info);
    }
    let p = &info.parameters;
    say!("{} at {}x{}, batch {}", args.preset.name(), args.width, args.height, args.batch);
    for (name, n) in [("encoder", p.encoder), ("depth", p.depth), ("pose encoder", p.pose_encoder), ("pose", p.pose)] {
        say!("{name:14} {n:>12} parameters");
    }
    say!("{:14} {learnt:>12} parameters", "together");
    say!("{:14} {:>12.2} GFLOP", "inference", info.gflop_inference);
    say!("{:14} {:>12.2} GFLOP", "training step", info.gflop_step);
    say!("{:14} {:>12.0} MiB (estimate)", "training step", info.memory_bytes as f64 / f64::from(1 << 20));
    Ok(())
}
