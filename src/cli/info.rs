//! `parallax info`.

use parallax::Result;
use parallax::networks::DepthNetwork;
use parallax::tensor::parallel;
use parallax::train::cost::Cost;
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
    /// On this machine, from a short measurement.
    seconds_inference: f64,
    seconds_step: f64,
}

pub fn run(args: Args) -> Result<()> {
    let Args { sizes: args, networks } = args;
    args.check()?;
    let architecture = args.architecture()?;
    let config = networks.config(architecture)?;
    let cost = Cost::of(&config, [args.height, args.width], args.batch, args.recompute)?;
    let (_, params) = DepthNetwork::new::<f32>(config, 0);
    let part = |prefix: &str| params.count(prefix);
    let parameters = Parameters {
        encoder: part("encoder."),
        depth: part("depth."),
        pose_encoder: part("pose_encoder."),
        pose: part("pose."),
    };
    let learnt: usize = params.count("");
    let info = Info {
        gflop_inference: 1e-9 * cost.flops_inference,
        gflop_step: 1e-9 * cost.flops_step,
        memory_bytes: cost.bytes_step as u64,
        seconds_inference: cost.seconds_inference,
        seconds_step: cost.seconds_step,
        parameters,
    };
    if args.json {
        return super::print_json(&info);
    }
    let p = &info.parameters;
    say!("{} at {}x{}, batch {}", architecture.name(), args.width, args.height, args.batch);
    for (name, n) in [("encoder", p.encoder), ("depth", p.depth), ("pose encoder", p.pose_encoder), ("pose", p.pose)] {
        say!("{name:14} {n:>12} parameters");
    }
    let threads = parallel::threads();
    say!("{:14} {learnt:>12} parameters", "together");
    for (name, gflop, seconds) in [
        ("inference", info.gflop_inference, info.seconds_inference),
        ("training step", info.gflop_step, info.seconds_step),
    ] {
        say!("{name:14} {gflop:>12.2} GFLOP, about {} on {threads} threads of this machine", time(seconds));
    }
    say!("{:14} {:>12.0} MiB (estimate)", "training step", info.memory_bytes as f64 / f64::from(1 << 20));
    Ok(())
}

/// A stretch of time in a unit that fits it.
fn time(seconds: f64) -> String {
    match seconds {
        s if s < 1.0 => format!("{:.0} ms", 1e3 * s),
        s if s < 600.0 => format!("{s:.1} s"),
        s => format!("{:.0} min", s / 60.0),
    }
}
