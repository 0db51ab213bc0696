//! Progress: a bar with rate and time left on a terminal, plain lines elsewhere. Always on standard error.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

/// Progress of something countable.
pub struct Progress {
    bar: ProgressBar,
    plain: bool,
    what: &'static str,
    total: u64,
    start: Instant,
    first: Option<u64>,
    last_line: Option<Instant>,
}

impl Progress {
    /// Progress towards `total`.
    pub fn new(what: &'static str, total: u64) -> Self {
        let plain = !std::io::stderr().is_terminal();
        let bar = if plain { ProgressBar::hidden() } else { ProgressBar::new(total) };
        if let Ok(style) =
            ProgressStyle::with_template("{prefix:>10} [{bar:32}] {pos}/{len} {per_sec} {eta} left {msg}")
        {
            bar.set_style(style.progress_chars("=> "));
        }
        bar.set_prefix(what);
        Progress { bar, plain, what, total, start: Instant::now(), first: None, last_line: None }
    }

    /// `done` of them are done; `note` stands beside.
    pub fn set(&mut self, done: u64, note: &str) {
        let first = *self.first.get_or_insert(done.saturating_sub(1));
        self.bar.set_position(done);
        self.bar.set_message(note.to_owned());
        let due = self.last_line.is_none_or(|at| at.elapsed() > Duration::from_secs(10));
        if self.plain && (due || done == self.total) {
            self.last_line = Some(Instant::now());
            let rate = (done - first) as f64 / self.start.elapsed().as_secs_f64();
            let left = (self.total.saturating_sub(done)) as f64 / rate.max(1e-9);
            eprintln!("{} {done}/{}  {rate:.2}/s  {left:.0} s left  {note}", self.what, self.total);
        }
    }

    /// A line above the bar.
    pub fn say(&self, line: &str) {
        if self.plain { eprintln!("{line}") } else { self.bar.println(line) }
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}
