//! A run's folder as the page shows it: everything that can be read of it, and a word about everything that cannot.

use std::fs;
use std::path::{Path, PathBuf};

use parallax::formats::bounded::{MAX_SETTINGS, read_bounded};
use parallax::train::views::{AT_END, AT_VALIDATION, Views};
use parallax::{Error, Result};
use serde_json::Value;

/// Some million lines.
const MAX_LOG: u64 = 1 << 30;
/// The most bytes of a picture that is shown.
const MAX_PICTURE: u64 = 1 << 24;

/// A run, as far as it can be read.
pub struct Record {
    /// The last part of the folder's path; the others may name a user.
    pub name: String,
    /// Logged steps, oldest first.
    pub steps: Vec<Value>,
    /// Validations, oldest first.
    pub validations: Vec<Value>,
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
}

impl Record {
    /// Reads a folder.
    ///
    /// # Errors
    /// If it holds neither a log nor a configuration of a run.
    pub fn read(folder: &Path) -> Result<Self> {
        if !folder.join("log.jsonl").is_file() && !folder.join("config.toml").is_file() {
            let message =
                "holds no run: expected log.jsonl or config.toml in it. Give a folder that `parallax train` made";
            return Err(Error::file(folder, message));
        }
        let mut problems = Vec::new();
        let log = lines(folder, "log.jsonl", &mut problems);
        let warnings = lines(folder, "warnings.jsonl", &mut problems);
        let (steps, rest): (Vec<_>, Vec<_>) = log.into_iter().partition(|line| line["step"].is_u64());
        let validations: Vec<_> = rest.into_iter().filter(|line| line["validated"].is_u64()).collect();
        if steps.last().is_some_and(|line| line.get("flow").is_none()) {
            problems.push("the log is of an older version: figures it lacks are left out".into());
        }
        Ok(Record {
            name: name_of(folder),
            config: config(folder, &mut problems),
            metrics: json(folder, "metrics.json", &mut problems),
            machine: json(folder, "machine.json", &mut problems),
            pictures: files(&folder.join("images")).into_iter().filter(|p| has_ending(p, "png")).collect(),
            views: [AT_VALIDATION, AT_END].into_iter().filter_map(|list| views(folder, list, &mut problems)).collect(),
            place: folder.join("views"),
            snapshots: files(&folder.join("pages")).into_iter().filter_map(snapshot).collect(),
            steps,
            validations,
            warnings,
            problems,
        })
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
}

/// The bytes of a picture that is not too large to be shown.
pub fn picture(path: &Path) -> Result<Vec<u8>> {
    read_bounded(path, MAX_PICTURE, "a picture of a run")
}

fn name_of(folder: &Path) -> String {
    let whole = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    whole.file_name().map_or_else(|| "run".into(), |name| name.to_string_lossy().into_owned())
}

fn has_ending(path: &Path, ending: &str) -> bool {
    path.extension().is_some_and(|e| e == ending)
}

/// The files of a folder by their names; none where there is no folder.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> = fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path()).collect();
    found.sort();
    found
}

/// `pages/0000200-1.jpg`: the step and the sample.
fn snapshot(path: PathBuf) -> Option<(u64, usize, PathBuf)> {
    let (step, sample) = path.file_stem()?.to_str()?.split_once('-')?;
    let found = (step.parse().ok()?, sample.parse().ok()?);
    has_ending(&path, "jpg").then_some((found.0, found.1, path))
}

/// Lines of JSON; what is none is counted among the problems.
fn lines(folder: &Path, name: &str, problems: &mut Vec<String>) -> Vec<Value> {
    let path = folder.join(name);
    if !path.exists() {
        problems.push(format!("there is no {name}: what it would show is left out"));
        return Vec::new();
    }
    let Ok(bytes) = read_bounded(&path, MAX_LOG, "the log of a run") else {
        problems.push(format!("{name} cannot be read: what it would show is left out"));
        return Vec::new();
    };
    let text = String::from_utf8_lossy(&bytes);
    let all: Vec<&str> = text.lines().filter(|line| !line.trim().is_empty()).collect();
    let parsed: Vec<Option<Value>> =
        all.iter().map(|line| serde_json::from_str(line).ok().filter(Value::is_object)).collect();
    let bad = parsed.iter().filter(|line| line.is_none()).count();
    if bad == 1 && parsed.last().is_some_and(Option::is_none) {
        problems.push(format!("the last line of {name} is torn and left out"));
    } else if bad > 0 {
        problems.push(format!("{bad} lines of {name} are no JSON objects and left out"));
    }
    parsed.into_iter().flatten().collect()
}

fn json(folder: &Path, name: &str, problems: &mut Vec<String>) -> Value {
    let path = folder.join(name);
    if !path.exists() {
        return Value::Null;
    }
    let read = read_bounded(&path, MAX_SETTINGS, "figures of a run").ok();
    read.and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_else(|| {
        problems.push(format!("{name} cannot be read and is left out"));
        Value::Null
    })
}

/// A list of views; `None` where there is none, which is told only if it cannot be read.
fn views(folder: &Path, list: &'static str, problems: &mut Vec<String>) -> Option<(&'static str, Views)> {
    match json(folder, &format!("views/{list}"), problems) {
        Value::Null => None,
        found => {
            let views = serde_json::from_value(found).ok().map(|views| (list, views));
            if views.is_none() {
                problems.push(format!("views/{list} is none of this version's and is left out"));
            }
            views
        }
    }
}

fn config(folder: &Path, problems: &mut Vec<String>) -> Vec<(String, String)> {
    let read = read_bounded(&folder.join("config.toml"), MAX_SETTINGS, "a configuration").ok();
    let table = read.and_then(|bytes| toml::from_str::<toml::Table>(&String::from_utf8_lossy(&bytes)).ok());
    let Some(table) = table else {
        problems.push("config.toml cannot be read: the configuration is left out".into());
        return Vec::new();
    };
    let mut found = Vec::new();
    flatten("", &toml::Value::Table(table), &mut found);
    found
}

/// Names with dots, and values in which paths are cut down to their last part.
fn flatten(name: &str, value: &toml::Value, found: &mut Vec<(String, String)>) {
    match value {
        toml::Value::Table(table) => {
            for (key, value) in table {
                let name = if name.is_empty() { key.clone() } else { format!("{name}.{key}") };
                flatten(&name, value, found);
            }
        }
        other => found.push((name.to_owned(), plain(other))),
    }
}

fn plain(value: &toml::Value) -> String {
    match value {
        toml::Value::String(text) if text.contains(['/', '\\']) => {
            format!("…/{}", text.trim_end_matches(['/', '\\']).rsplit(['/', '\\']).next().unwrap_or_default())
        }
        toml::Value::String(text) => text.clone(),
        toml::Value::Array(values) => {
            format!("[{}]", values.iter().map(plain).collect::<Vec<_>>().join(", "))
        }
        other => other.to_string(),
    }
}
