//! Files of a run's folder, read so that what is wrong with one costs no other: problems are kept in words.

use std::fs;
use std::path::{Path, PathBuf};

use parallax::formats::bounded::{MAX_SETTINGS, read_bounded};
use parallax::train::views::Views;
use serde_json::Value;

/// Some million lines.
const MAX_LOG: u64 = 1 << 30;

/// The files of a folder with an ending, by their names; none where there is no folder.
pub fn files(folder: &Path, ending: &str) -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> = fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path()).collect();
    found.retain(|path| path.extension().is_some_and(|e| e == ending));
    found.sort();
    found
}

/// Lines of JSON; none where there is no file. What is no JSON is counted among the problems.
pub fn lines(folder: &Path, name: &str, problems: &mut Vec<String>) -> Vec<Value> {
    let path = folder.join(name);
    if !path.exists() {
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

/// A file of JSON; null where there is none, or none that can be read, which is a problem.
pub fn json(folder: &Path, name: &str, problems: &mut Vec<String>) -> Value {
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
pub fn views(folder: &Path, list: &'static str, problems: &mut Vec<String>) -> Option<(&'static str, Views)> {
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

/// The configuration, names with dots and their values; none where it cannot be read, which is a problem.
pub fn config(folder: &Path, problems: &mut Vec<String>) -> Vec<(String, String)> {
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
