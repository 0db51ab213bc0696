//! What another program predicted, to be measured here.

use std::path::{Path, PathBuf};

use crate::error::{Error, Result};
use crate::formats::npy;

/// Maps of inverse depth from a file, one for each frame of a data set, in its order.
#[derive(Clone, Debug, PartialEq)]
pub struct Predictions {
    path: PathBuf,
    count: usize,
    /// Rows and columns of each.
    pub size: (usize, usize),
    values: Vec<f32>,
}

impl Predictions {
    /// Reads a `.npy` file of floating-point numbers `[frames, height, width]`: inverse depth up to a factor, not the
    /// sigmoid that a network ends with. Monodepth2's `--save_pred_disps` writes such files.
    ///
    /// # Errors
    /// If it is no such file.
    pub fn read(path: &Path) -> Result<Predictions> {
        let array = npy::read(path)?;
        let &[count, height, width] = array.shape() else {
            let found = array.shape();
            let message = format!("expected disparities of the shape [frames, height, width], found {found:?}");
            return Err(Error::file(path, message));
        };
        if array.is_empty() {
            let message = format!("has no disparities: its shape is [{count}, {height}, {width}]");
            return Err(Error::file(path, message));
        }
        let Some(values) = array.to_f32() else {
            let message = format!("expected floating-point numbers, found {}", array.dtype().name());
            return Err(Error::file(path, message));
        };
        Ok(Predictions { path: path.to_owned(), count, size: (height, width), values })
    }

    /// The map of a frame.
    pub(super) fn map(&self, frame: usize) -> Option<&[f32]> {
        self.values.chunks_exact(self.size.0 * self.size.1).nth(frame)
    }

    /// Makes sure that there is one map for each of so many frames.
    ///
    /// # Errors
    /// Names both numbers.
    pub fn check(&self, frames: usize) -> Result<()> {
        if self.count == frames {
            return Ok(());
        }
        let (count, (height, width)) = (self.count, self.size);
        let message = format!(
            "has {count} maps (its shape is [{count}, {height}, {width}]), but there are {frames} frames: expected one \
             map for each frame, in the order of the split"
        );
        Err(Error::file(&self.path, message))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::npy::write_npy_shaped;

    #[test]
    fn maps_are_read_in_order_and_other_shapes_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("disps.npy");
        let values: Vec<f32> = (0..24).map(|i| i as f32).collect();
        write_npy_shaped(&path, &values, &[2, 3, 4]).unwrap();
        let found = Predictions::read(&path).unwrap();
        assert_eq!((found.size, found.map(1)), ((3, 4), Some(&values[12..])));
        assert_eq!(found.map(2), None);
        assert!(found.check(2).is_ok());
        let error = found.check(7).unwrap_err().to_string();
        for part in ["disps.npy", "has 2 maps", "[2, 3, 4]", "there are 7 frames"] {
            assert!(error.contains(part), "{error}");
        }
        for (shape, what) in [(&[6, 4][..], "found [6, 4]"), (&[2, 1, 3, 4], "found [2, 1, 3, 4]"), (&[24], "[24]")] {
            write_npy_shaped(&path, &values, shape).unwrap();
            let error = Predictions::read(&path).unwrap_err().to_string();
            assert!(error.contains("disps.npy") && error.contains(what), "{error}");
        }
        write_npy_shaped(&path, &[], &[0, 3, 4]).unwrap();
        assert!(Predictions::read(&path).unwrap_err().to_string().contains("[0, 3, 4]"));
        std::fs::write(&path, b"PK").unwrap();
        assert!(Predictions::read(&path).unwrap_err().to_string().contains("disps.npy"));
    }
}
