//! A run's folder as the page shows it: everything that can be read of it, and a word about everything that cannot.

use std::path::{Path, PathBuf};

use parallax::formats::bounded::read_bounded;
use parallax::train::run::is_running;
use parallax::train::views::{AT_END, AT_VALIDATION, Views};
use parallax::{Error, Result};
use serde_json::Value;

use super::gaps::{self, Gap};
use super::reading::{config, files, json, lines, views};

/// The most bytes of a picture that is shown.
const MAX_PICTURE: u64 = 1 << 24;

/// A run, as far as it can be read.
pub struct Record {
    /// The last part of the folder's path; the others may name a user.
    pub name: String,
    /// Whether it is being trained now.
    pub running: bool,
    /// Logged steps, oldest first.
    pub steps: Vec<Value>,
    /// Validations, oldest first.
    pub validations: Vec<Value>,
    /// Lines of the log on the time that its page took.
    pub pages: Vec<Value>,
    /// Lines of `warnings.jsonl`.
    pub warnings: Vec<Value>,
    /// Names and values of the configuration.
    pub config: Vec<(String, String)>,
    /// `metrics.json`, null where there is none.
    pub metrics: Value,
    /// `machine.json`, null where there is none.
    pub machine: Value,
    /// Pictures of the last validation.
    pub pictures: Vec<PathBuf>,
    /// Pictures as training went on: the step, the sample, the file.
    pub snapshots: Vec<(u64, usize, PathBuf)>,
    /// Views of the last validation, and of the end, each under the name of its list.
    pub views: Vec<(&'static str, Views)>,
    /// The folder that holds their pictures.
    place: PathBuf,
    /// Things that could not be read, in words.
    pub problems: Vec<String>,
    /// Things that are not there, and how to get them.
    pub gaps: Vec<Gap>,
}

impl Record {
    /// Reads a folder.
    ///
    /// # Errors
    /// If it holds neither a log nor a configuration of a run.
    pub fn read(folder: &Path) -> Result<Self> {
        Self::read_as(folder, is_running(folder))
    }

    /// Reads a folder of which is known whether it is being trained.
    ///
    /// # Errors
    /// As [`read`](Record::read).
    pub fn read_as(folder: &Path, running: bool) -> Result<Self> {
        if !folder.join("log.jsonl").is_file() && !folder.join("config.toml").is_file() {
            let message =
                "holds no run: expected log.jsonl or config.toml in it. Give a folder that `parallax train` made";
            return Err(Error::file(folder, message));
        }
        let mut problems = Vec::new();
        let problems = &mut problems;
        let log = lines(folder, "log.jsonl", problems);
        let of = |field: &str| log.iter().filter(|line| line[field].is_u64()).cloned().collect::<Vec<_>>();
        let mut record = Record {
            name: name_of(folder),
            running,
            steps: of("step"),
            validations: of("validated"),
            pages: of("page"),
            warnings: lines(folder, "warnings.jsonl", problems),
            config: config(folder, problems),
            metrics: json(folder, "metrics.json", problems),
            machine: json(folder, "machine.json", problems),
            pictures: files(&folder.join("images"), "png"),
            views: [AT_VALIDATION, AT_END].into_iter().filter_map(|list| views(folder, list, problems)).collect(),
            place: folder.join("views"),
            snapshots: files(&folder.join("pages"), "jpg").into_iter().filter_map(snapshot).collect(),
            problems: Vec::new(),
            gaps: Vec::new(),
        };
        record.problems.append(problems);
        record.gaps = gaps::of(folder, &record);
        Ok(record)
    }

    /// The file of a view: never one outside the folder of views, whatever the list says.
    pub fn view(&self, file: &str) -> PathBuf {
        self.place.join(Path::new(file).file_name().unwrap_or_default())
    }

    /// The last logged step.
    pub fn last_step(&self) -> u64 {
        self.steps.last().and_then(|line| line["step"].as_u64()).unwrap_or(0)
    }

    /// A value of the configuration, by its dotted name.
    pub fn setting(&self, name: &str) -> Option<&str> {
        self.config.iter().find(|(n, _)| n == name).map(|(_, value)| value.as_str())
    }

    /// Whether the run came to its end.
    pub fn finished(&self) -> bool {
        self.metrics["steps"].as_u64().is_some_and(|steps| steps > 0 && steps >= self.last_step())
    }

    /// The names of warnings that hold at the end of the log.
    pub fn standing(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for line in &self.warnings {
            let Some(name) = line["warning"].as_str() else { continue };
            names.retain(|other| *other != name);
            if line["begins"] == true {
                names.push(name);
            }
        }
        names
    }

    /// The seconds that its pages and pictures have taken, and those of the training loop until then.
    pub fn page_time(&self) -> Option<[f64; 2]> {
        let trained = self.pages.last()?["trained"].as_f64()?;
        let taken: f64 = self.pages.iter().filter_map(|line| line["seconds"].as_f64()).sum();
        (trained > 0.0).then_some([taken, trained])
    }
}

/// The bytes of a picture that is not too large to be shown.
pub fn picture(path: &Path) -> Result<Vec<u8>> {
    read_bounded(path, MAX_PICTURE, "a picture of a run")
}

fn name_of(folder: &Path) -> String {
    let whole = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    whole.file_name().map_or_else(|| "run".into(), |name| name.to_string_lossy().into_owned())
}

/// `pages/0000200-1.jpg`: the step and the sample.
fn snapshot(path: PathBuf) -> Option<(u64, usize, PathBuf)> {
    let (step, sample) = path.file_stem()?.to_str()?.split_once('-')?;
    let found = (step.parse().ok()?, sample.parse().ok()?);
    Some((found.0, found.1, path))
}
