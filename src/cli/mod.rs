//! The command line: arguments in, library calls, tables and JSON out. Exit status 0 done, 1 failed, 2 wrong usage.

/// A line on standard output: `println!` for which a reader that has seen enough (`| head`) is no failure.
macro_rules! say {
    ($($text:tt)*) => { crate::cli::say(format_args!($($text)*)) };
}

/// A line on standard error: `note!` that never ends the work, whether or not anybody can still read it.
macro_rules! note {
    ($($text:tt)*) => { crate::cli::note(format_args!($($text)*)) };
}

mod ablation;
mod architecture;
mod attention;
mod bench;
mod camera;
mod control;
mod convert;
mod data;
mod eval;
mod film;
mod gradcheck;
mod info;
mod lens;
mod predict;
mod progress;
mod report;
mod sheet;
mod sizes;
mod stereo;
mod train;
mod view;
mod watch;
mod weights;

use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use parallax::{Error, Result, printable};

/// Monocular depth without supervision, from scratch on the CPU: train MonoViT, predict depth, check every gradient.
#[derive(Parser)]
#[command(name = "parallax", version, about, max_term_width = 100)]
struct Cli {
    /// Number of threads [default: one for each processor].
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Train; with no flags: the reduced network on the embedded street.
    Train(Box<train::Args>),
    /// Evaluate weights against ground-truth depth: the seven standard metrics.
    Eval(eval::Args),
    /// Predict depth maps of pictures.
    Predict(predict::Args),
    /// Look at depth in the browser: drop pictures in, point, turn the points, click for attention, play a folder.
    View(view::Args),
    /// Make the page of a run, or one that compares several: curves, warnings, pictures, configuration.
    Report(report::Args),
    /// Convert weights between file formats: PyTorch's .pth, safetensors, NumPy's .npz.
    Convert(convert::Args),
    /// Draw attention maps of a pixel, by path and head, and the saliency of its disparity.
    Attention(attention::Args),
    /// Check the gradient of every op against finite differences on this machine.
    Gradcheck(gradcheck::Args),
    /// Time a training step or an inference, op by op, and against the machine's limits.
    Bench(bench::Args),
    /// Count parameters, arithmetic and memory of a network.
    Info(info::Args),
    /// Write the embedded street as a data set of files.
    Data(data::Args),
}

/// Runs the program.
pub fn main() -> ExitCode {
    let matches = Cli::command().get_matches();
    let subcommand = matches.subcommand_name().unwrap_or_default().to_owned();
    let cli = Cli::from_arg_matches(&matches).unwrap_or_else(|e| e.exit());
    let ready = parallax::tensor::simd::level().and_then(|_| start_threads(cli.threads));
    let result = ready.and_then(|()| match cli.command {
        Command::Train(args) => train::run(*args),
        Command::Eval(args) => eval::run(args),
        Command::Predict(args) => predict::run(args),
        Command::View(args) => view::run(args),
        Command::Report(args) => report::run(args),
        Command::Convert(args) => convert::run(args),
        Command::Attention(args) => attention::run(args),
        Command::Gradcheck(args) => gradcheck::run(args),
        Command::Bench(args) => bench::run(args),
        Command::Info(args) => info::run(args),
        Command::Data(args) => data::run(args),
    });
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(Error::Setting { name, message }) => {
            note!("parallax: {}: {message}", flag_of(&subcommand, &name));
            ExitCode::from(2)
        }
        Err(error) => {
            note!("parallax: {error}");
            ExitCode::FAILURE
        }
    }
}

/// A field of a setting as it is called on the command line, if it has a flag there: `loss.ssim` is `--ssim`.
fn flag_of(subcommand: &str, field: &str) -> String {
    let long = field.rsplit('.').next().unwrap_or(field).replace('_', "-");
    let command = Cli::command();
    let found =
        command.find_subcommand(subcommand).is_some_and(|c| c.get_arguments().any(|a| a.get_long() == Some(&long)));
    if found { format!("--{long}") } else { field.to_owned() }
}

/// Focal lengths and principal point, as `--intrinsics` takes them.
fn pinhole(text: &str) -> std::result::Result<[f64; 4], String> {
    let numbers: Option<Vec<f64>> =
        text.split(',').map(|n| n.trim().parse().ok().filter(|x: &f64| x.is_finite())).collect();
    let camera = numbers.and_then(|n| <[f64; 4]>::try_from(n).ok()).filter(|[fx, fy, ..]| *fx > 0.0 && *fy > 0.0);
    camera.ok_or_else(|| "expected four numbers with commas between them, fx and fy above 0".to_owned())
}

/// The pool that kernels run in, with this thread as one of its workers: handing work over from outside a pool costs a
/// thousand times more.
fn start_threads(threads: Option<u16>) -> Result<()> {
    let available = std::thread::available_parallelism().map_or(1, usize::from);
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads.map_or(available, usize::from))
        .use_current_thread()
        .build_global()
        .map_err(|e| Error::setting("--threads", format!("the threads could not be started: {e}")))
}

/// Prints a value as one line of JSON on standard output.
fn print_json(value: &impl serde::Serialize) -> Result<()> {
    let text = serde_json::to_string(value).map_err(|e| Error::Failed(format!("the result as JSON: {e}")))?;
    say!("{text}");
    Ok(())
}

/// Writes a line for `note!`. A terminal that is gone, or a full disk behind a log, is no reason to stop.
fn note(text: std::fmt::Arguments) {
    use std::io::Write;
    let _ = writeln!(std::io::stderr(), "{}", printable(&text.to_string()));
}

/// Writes a line for `say!`. Nobody reads on when this ends the program, and all that was made is already written.
fn say(text: std::fmt::Arguments) {
    use std::io::{ErrorKind, Write};
    if let Err(error) = writeln!(std::io::stdout(), "{}", printable(&text.to_string())) {
        if error.kind() == ErrorKind::BrokenPipe {
            std::process::exit(0);
        }
        note!("parallax: standard output: {error}");
        std::process::exit(1);
    }
}
