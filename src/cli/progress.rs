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
    /// When the first of them was done, and which that was: what came before is no part of the rate.
    start: Option<(Instant, u64)>,
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
        Progress { bar, plain, what, total, start: None, last_line: None }
    }

    /// `done` of them are done; `note` stands beside.
    pub fn set(&mut self, done: u64, note: &str) {
        let (start, first) = *self.start.get_or_insert_with(|| {
            self.bar.reset_elapsed();
            self.bar.reset_eta();
            (Instant::now(), done)
        });
        self.bar.set_position(done);
        self.bar.set_message(note.to_owned());
        let due = self.last_line.is_none_or(|at| at.elapsed() > Duration::from_secs(10));
        if self.plain && (due || done == self.total) {
            self.last_line = Some(Instant::now());
            let rate = (done - first) as f64 / start.elapsed().as_secs_f64().max(1e-9);
            let left = (self.total.saturating_sub(done)) as f64 / rate;
            let rate = if done > first { format!("{rate:.2}/s  {left:.0} s left") } else { "just begun".to_owned() };
            note!("{} {done}/{}  {rate}  {note}", self.what, self.total);
        }
    }

    /// A line above the bar.
    pub fn say(&self, line: &str) {
        if self.plain { note!("{line}") } else { self.bar.println(parallax::printable(line)) }
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}
