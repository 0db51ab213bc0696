//! The camera's path through every folder of frames: which frames, and where it is written.

use std::path::{Path, PathBuf};

use parallax::eval::odometry::Odometry;
use parallax::eval::trajectory::write_poses;
use parallax::formats::picture::{read_picture, read_picture_with_lens};
use parallax::{Error, Result};

use super::Args;
use super::outputs::Job;
use super::scale::Scaling;

/// Frames of one folder, in order, and the file of their poses.
pub struct CameraPath {
    frames: Vec<PathBuf>,
    /// `poses.txt` where the frames' results lie.
    pub file: PathBuf,
}

/// The paths through the folders that pictures lie in.
///
/// # Errors
/// If no folder holds two pictures.
pub fn of(jobs: &[Job], out: &Path) -> Result<Vec<CameraPath>> {
    let mut paths: Vec<(PathBuf, CameraPath)> = Vec::new();
    for job in jobs {
        let folder = job.input.path.parent().unwrap_or(Path::new("")).to_owned();
        let file = out.join(&job.input.name).with_file_name("poses.txt");
        match paths.last_mut().filter(|(last, _)| *last == folder) {
            Some((_, path)) => path.frames.push(job.input.path.clone()),
            None => paths.push((folder, CameraPath { frames: vec![job.input.path.clone()], file })),
        }
    }
    let mut paths: Vec<CameraPath> = paths.into_iter().map(|(_, path)| path).collect();
    paths.retain(|path| path.frames.len() > 1);
    match paths.is_empty() {
        true => Err(Error::setting("--poses", "a camera's path needs a folder of two or more frames, or a film")),
        false => Ok(paths),
    }
}

impl CameraPath {
    /// Finds the poses and writes them, lengths in the unit of depth.
    pub fn write(&self, args: &Args, odometry: &Odometry, scaling: &Scaling) -> Result<()> {
        let (first, focal) = read_picture_with_lens(&self.frames[0])?;
        let size = [f64::from(first.width()), f64::from(first.height())];
        let scale = scaling.factor_of_all(args.lens(&self.frames[0], size, focal)?.intrinsics);
        let poses = odometry.path(self.frames.iter().map(|frame| read_picture(frame)), scale)?;
        write_poses(&self.file, &poses)?;
        note!("{} poses in {}", poses.len(), self.file.display());
        Ok(())
    }
}
