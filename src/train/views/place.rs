//! The folder of views, and how pictures are written into it.

use std::fs;
use std::path::{Path, PathBuf};

use image::RgbImage;
use image::codecs::jpeg::JpegEncoder;

use super::{View, Views};
use crate::error::{Error, Result};
use crate::formats::atomic::write_bytes_atomically;
use crate::formats::png::write_png;
use crate::train::run::VIEWS;

/// The folder of views.
pub(super) struct Place(PathBuf);

impl Place {
    pub(super) fn of(run: &Path) -> Result<Self> {
        let folder = run.join(VIEWS);
        fs::create_dir_all(&folder).map_err(|e| Error::io(&folder, e))?;
        Ok(Place(folder))
    }

    pub(super) fn read(&self, list: &str) -> Option<Views> {
        serde_json::from_slice(&fs::read(self.0.join(list)).ok()?).ok()
    }

    pub(super) fn write(&self, list: &str, views: &Views) -> Result<()> {
        let text = serde_json::to_string(views).map_err(|e| Error::Failed(format!("the views: {e}")))?;
        write_bytes_atomically(self.0.join(list), text.as_bytes())
    }

    /// A photograph, as JPEG.
    pub(super) fn photo(&self, name: &str, title: &str, picture: &RgbImage) -> Result<View> {
        let file = format!("{name}.jpg");
        let path = self.0.join(&file);
        let mut jpeg = Vec::new();
        let made = picture.write_with_encoder(JpegEncoder::new_with_quality(&mut jpeg, 85));
        made.map_err(|e| Error::file(&path, format!("could not be made: {e}")))?;
        write_bytes_atomically(&path, &jpeg)?;
        Ok(View { file, title: title.into(), bar: None })
    }

    /// A picture, as PNG.
    pub(super) fn picture(&self, name: &str, title: &str, picture: &RgbImage) -> Result<View> {
        let file = format!("{name}.png");
        write_png(self.0.join(&file), picture)?;
        Ok(View { file, title: title.into(), bar: None })
    }

    /// A map in magma, as PNG.
    pub(super) fn map(&self, name: &str, title: &str, picture: &RgbImage, bar: [String; 2]) -> Result<View> {
        Ok(View { bar: Some(bar), ..self.picture(name, title, picture)? })
    }
}
