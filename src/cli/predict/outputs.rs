//! Which files a prediction writes, and that no two pictures share one.

use std::collections::{HashMap, HashSet};
use std::fs;
use std::path::{Path, PathBuf};

use parallax::data::inputs::Input;
use parallax::{Error, Result};
use serde::{Serialize, Serializer};

use super::Args;

/// The files that the results of one picture are written to.
pub struct Outputs {
    pub disparity: PathBuf,
    pub depth: Option<PathBuf>,
    pub inverse_depth: Option<PathBuf>,
    pub points: Option<PathBuf>,
}

/// A picture and what is made of it.
pub struct Job {
    pub input: Input,
    pub outputs: Outputs,
}

/// What is made of all pictures.
///
/// # Errors
/// If two pictures would write the same file, or one of the pictures would be overwritten.
pub fn jobs(pictures: Vec<Input>, args: &Args) -> Result<Vec<Job>> {
    let job = |input: Input| Job { outputs: Outputs::of(&input.name, args), input };
    let jobs: Vec<Job> = pictures.into_iter().map(job).collect();
    check(&jobs)?;
    Ok(jobs)
}

fn check(jobs: &[Job]) -> Result<()> {
    let mut writers: HashMap<&Path, &Path> = HashMap::new();
    let pictures: HashSet<PathBuf> = jobs.iter().filter_map(|job| fs::canonicalize(&job.input.path).ok()).collect();
    for Job { input, outputs } in jobs {
        for (_, output) in outputs.named() {
            if let Some(other) = writers.insert(output, &input.path) {
                let (one, two) = (other.display(), input.path.display());
                let message = format!(
                    "the results of {one} and of {two} would both be written here: rename one of them, or give them \
                     different --out folders"
                );
                return Err(Error::file(output, message));
            }
            if fs::canonicalize(output).is_ok_and(|output| pictures.contains(&output)) {
                let message = "is one of the pictures and would be overwritten: give another --out";
                return Err(Error::file(output, message));
            }
        }
    }
    Ok(())
}

impl Outputs {
    fn of(name: &Path, args: &Args) -> Outputs {
        // A name may hold dots and need not be UTF-8: endings are appended, not replaced.
        let to = |ending: &str| {
            let mut path = args.out.join(name).into_os_string();
            path.push(ending);
            PathBuf::from(path)
        };
        Outputs {
            disparity: to("_disp.png"),
            depth: args.depth_png.then(|| to("_depth.png")),
            inverse_depth: args.npy.then(|| to(".npy")),
            points: args.ply.then(|| to(".ply")),
        }
    }

    /// Whether all of them are there.
    pub fn exist(&self) -> bool {
        self.named().all(|(_, path)| path.is_file())
    }

    fn named(&self) -> impl Iterator<Item = (&'static str, &Path)> {
        let all = [
            ("disparity", Some(&self.disparity)),
            ("depth", self.depth.as_ref()),
            ("inverse_depth", self.inverse_depth.as_ref()),
            ("points", self.points.as_ref()),
        ];
        all.into_iter().filter_map(|(name, path)| Some((name, path?.as_path())))
    }
}

impl Serialize for Outputs {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.named().map(|(name, path)| (name, path.to_string_lossy())))
    }
}
