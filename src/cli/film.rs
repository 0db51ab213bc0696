//! Films where a folder of frames is expected.

use std::path::{Path, PathBuf};

use parallax::data::film::{FPS, folder_of, is_film, take_frames};
use parallax::{Error, Result};

#[derive(clap::Args)]
pub struct FilmArgs {
    /// Frames a second that are taken out of a film [default: 10].
    #[arg(long, value_name = "N")]
    pub fps: Option<f64>,
}

impl FilmArgs {
    /// The rate.
    pub fn rate(&self) -> f64 {
        self.fps.unwrap_or(FPS)
    }

    /// Paths to read: a film is replaced by the folder of its frames, which are taken out first.
    pub fn folders(&self, paths: &[PathBuf]) -> Result<Vec<PathBuf>> {
        if self.fps.is_some() && !paths.iter().any(|path| is_film(path)) {
            return Err(Error::setting("--fps", "is for films, and none is given"));
        }
        paths.iter().map(|path| if is_film(path) { self.frames(path) } else { Ok(path.clone()) }).collect()
    }

    /// [`folders`](FilmArgs::folders) of one path.
    pub fn folder(&self, path: &Path) -> Result<PathBuf> {
        Ok(self.folders(&[path.to_owned()])?.swap_remove(0))
    }

    fn frames(&self, film: &Path) -> Result<PathBuf> {
        let folder = folder_of(film, self.rate());
        if !folder.exists() {
            note!("taking {} frames a second out of {} into {}", self.rate(), film.display(), folder.display());
        }
        let count = take_frames(film, self.rate(), &folder)?;
        note!("{count} frames of {} are in {}", film.display(), folder.display());
        Ok(folder)
    }
}
