//! `parallax report`, and the page that every training leaves.

mod cards;
mod curves;
mod film;
mod gaps;
mod machine;
mod page;
mod pictures;
mod reading;
mod record;
mod tables;
mod verdict;
mod views;

use std::path::{Path, PathBuf};

use parallax::formats::atomic::write_bytes_atomically;
use parallax::train::views::make_views;
use parallax::{Error, Result};

pub use machine::record as record_machine;
use record::Record;

/// The page's name in a run's folder.
pub const PAGE: &str = "report.html";

#[derive(clap::Args)]
pub struct Args {
    /// Folders of runs; several are compared.
    #[arg(value_name = "RUN", required = true, num_args = 1..)]
    runs: Vec<PathBuf>,
    /// The page to write [default: report.html in the folder of a single run, comparison.html here for several].
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Make the views that a run has not left (errors, warped neighbours, attention, path, worst samples) from its weights
    /// first: its data are opened, or rendered, for that.
    #[arg(long)]
    views: bool,
    /// Open the page in the default browser.
    #[arg(long)]
    open: bool,
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
        if args.views {
            make_missing_views(folder)?;
        }
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
        for gap in &run.gaps {
            note!("{}: {}; to get it: {}", run.name, gap.what, gap.how);
        }
    }
    write_bytes_atomically(&out, page::page(&runs, &missing).as_bytes())?;
    say!("wrote {}", out.display());
    if args.open {
        show(&out);
    }
    Ok(())
}

/// Makes the views of a run that has left none. A run that has some keeps them: they are those of training itself.
fn make_missing_views(folder: &Path) -> Result<()> {
    if Record::read(folder)?.views.is_empty() {
        note!("making the views of {}", folder.display());
        make_views(folder, &|_, _, _| ())?;
    }
    Ok(())
}

/// Opens a page in the default browser. That there is none is told and no failure: the page is there.
pub fn show(page: &Path) {
    note!("opening {}", page.display());
    let page = std::path::absolute(page).unwrap_or_else(|_| page.to_owned());
    // Some systems wait for the browser to be closed.
    std::thread::spawn(move || {
        if let Err(error) = opener::open_browser(&page) {
            note!("warning: no browser could be opened ({error}): open {} yourself", page.display());
        }
    });
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
    // The lock of a run that has just ended is still held by this process.
    let page = Record::read_as(folder, running).map(|run| page::page(&[run], &[]));
    if let Err(error) = page.and_then(|page| write_bytes_atomically(folder.join(PAGE), page.as_bytes())) {
        note!("warning: the page of the run could not be written: {error}");
    }
}

#[cfg(test)]
mod contrast;
#[cfg(test)]
mod tests;
