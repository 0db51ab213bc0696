//! `parallax report`, and the page that every training leaves.

mod curves;
mod machine;
mod page;
mod pictures;
mod record;
mod views;

use std::path::{Path, PathBuf};

use parallax::formats::atomic::write_bytes_atomically;
use parallax::{Error, Result};

pub use machine::record as record_machine;
use record::Record;

/// The page's name in a run's folder.
const PAGE: &str = "report.html";

#[derive(clap::Args)]
pub struct Args {
    /// Folders of runs; several are compared.
    #[arg(value_name = "RUN", required = true, num_args = 1..)]
    runs: Vec<PathBuf>,
    /// The page to write [default: report.html in the folder of a single run, comparison.html here for several].
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Replace what stands at --out, or comparison.html.
    #[arg(long)]
    force: bool,
}

pub fn run(args: Args) -> Result<()> {
    let out = match (&args.out, &args.runs[..]) {
        (Some(out), _) => out.clone(),
        (None, [run]) => run.join(PAGE),
        (None, _) => PathBuf::from("comparison.html"),
    };
    let own = args.out.is_none() && args.runs.len() == 1;
    if out.exists() && !args.force && !own {
        return Err(Error::file(&out, "is there already: --force replaces it, --out takes another name"));
    }
    let (mut runs, mut missing) = (Vec::new(), Vec::new());
    for folder in &args.runs {
        match Record::read(folder) {
            Ok(run) => runs.push(run),
            Err(error) if args.runs.len() > 1 => {
                note!("warning: {error}");
                let name = folder.file_name().unwrap_or(folder.as_os_str()).to_string_lossy();
                missing.push(format!("{name} holds no run that can be read, and is left out."));
            }
            Err(error) => return Err(error),
        }
    }
    if runs.is_empty() {
        return Err(Error::Failed("none of the folders holds a run".into()));
    }
    tell_apart(&mut runs);
    for run in &runs {
        for problem in &run.problems {
            note!("warning: {}: {problem}", run.name);
        }
    }
    write_bytes_atomically(&out, page::page(&runs, false, &missing).as_bytes())?;
    say!("wrote {}", out.display());
    Ok(())
}

/// Numbers runs whose folders have one name.
fn tell_apart(runs: &mut [Record]) {
    let names: Vec<String> = runs.iter().map(|run| run.name.clone()).collect();
    for (i, run) in runs.iter_mut().enumerate() {
        if names.iter().filter(|name| **name == run.name).count() > 1 {
            run.name = format!("{} ({})", run.name, i + 1);
        }
    }
}

/// Writes the page of a run into its folder. A failure is told and does not end a training.
pub fn leave(folder: &Path, running: bool) {
    let page = Record::read(folder).map(|run| page::page(&[run], running, &[]));
    if let Err(error) = page.and_then(|page| write_bytes_atomically(folder.join(PAGE), page.as_bytes())) {
        note!("warning: the page of the run could not be written: {error}");
    }
}

#[cfg(test)]
mod tests;
