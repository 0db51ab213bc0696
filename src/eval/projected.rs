//! KITTI raw whose scans somebody has projected already: `proj_depth/velodyne/image_0c/FRAME.npz` in every drive, each
//! with the depths of the picture's pixels in metres under the name `velodyne_depth`, 0 where no point falls.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::RgbImage;

use crate::camera::Intrinsics;
use crate::data::kitti::{Kitti, LeftOut};
use crate::data::{DataSource, Place};
use crate::depth::DepthMap;
use crate::formats::picture::is_size;
use crate::formats::{bounded, npz};
use crate::{Error, Result};

/// The array in an archive.
const NAME: &str = "velodyne_depth";
/// The folder of the archives in a drive.
const FOLDER: &str = "proj_depth/velodyne";

/// [`Kitti`]'s frames that have a projected scan.
pub struct Projected {
    kitti: Kitti,
    /// The samples of `kitti` that have one.
    samples: Vec<usize>,
    left_out: LeftOut,
}

impl Projected {
    /// The frames of `kitti` that have a projected scan; `listed` says that they come from a list, whose frames must all have
    /// one.
    ///
    /// # Errors
    /// If no frame has one, or a listed frame has none: names the file that was looked for.
    pub fn new(kitti: Kitti, listed: bool) -> Result<Projected> {
        let mut found = Projected { samples: Vec::new(), left_out: LeftOut::default(), kitti };
        for sample in 0..found.kitti.len() {
            let file = found.file(sample)?;
            if file.is_file() {
                found.samples.push(sample);
            } else {
                found.left_out.without_depth += 1;
                found.left_out.first_depth.get_or_insert(file);
            }
        }
        match &found.left_out.first_depth {
            Some(file) if listed || found.samples.is_empty() => {
                let message = format!(
                    "the projected scan of this frame is missing ({} of {} frames lack it): use a list of the frames that \
                     have it, or the protocol eigen, which projects scans itself",
                    found.left_out.without_depth,
                    found.kitti.len()
                );
                Err(Error::file(file, message))
            }
            _ => Ok(found),
        }
    }

    /// The frames that have no projected scan.
    pub fn left_out(&self) -> &LeftOut {
        &self.left_out
    }

    /// Where the scan of a sample of `kitti` lies.
    fn file(&self, sample: usize) -> Result<PathBuf> {
        let picture = self.kitti.path(sample, 0)?;
        // DRIVE/image_0c/data/FRAME.png
        let drive = picture.ancestors().nth(3).unwrap_or(Path::new(""));
        let name = Path::new(picture.file_stem().unwrap_or_default()).with_extension("npz");
        Ok(drive.join(FOLDER).join(self.kitti.side(sample).folder()).join(name))
    }
}

/// Reads a projected scan.
fn read(path: &Path) -> Result<DepthMap> {
    let bytes = std::fs::metadata(path).map_err(|e| Error::io(path, e))?.len();
    if bytes > 8 * bounded::MAX_PIXELS {
        return Err(Error::file(path, format!("{bytes} bytes: no scan projected into a picture is so large")));
    }
    let file = npz::open(path)?;
    let Some((_, array)) = file.tensors.iter().find(|(name, _)| name == NAME) else {
        let names: Vec<&str> = file.tensors.iter().map(|(name, _)| name.as_str()).collect();
        return Err(Error::file(path, format!("expected an array `{NAME}`, found {names:?}")));
    };
    let &[height, width] = array.shape() else {
        return Err(Error::file(path, format!("expected {NAME} as [height, width], found {:?}", array.shape())));
    };
    let numbers = array.to_f32().filter(|_| is_size(width as f64, height as f64)).ok_or_else(|| {
        let found = array.dtype().name();
        Error::file(path, format!("expected {NAME} as floats of a picture's size, found {found} of {height}x{width}"))
    })?;
    if let Some(i) = numbers.iter().position(|d| !d.is_finite()) {
        let (row, column) = (i / width, i % width);
        let message = format!("the depth at row {row}, column {column} is {}: expected metres, 0 for none", numbers[i]);
        return Err(Error::file(path, message));
    }
    let metres = numbers.into_iter().map(|d| d.max(0.0)).collect();
    Ok(DepthMap { width, height, metres })
}

impl DataSource for Projected {
    fn len(&self) -> usize {
        self.samples.len()
    }

    fn name(&self, sample: usize) -> String {
        self.kitti.name(self.samples[sample])
    }

    fn image(&self, sample: usize, offset: i32) -> Result<Arc<RgbImage>> {
        self.kitti.image(self.samples[sample], offset)
    }

    fn intrinsics(&self, sample: usize) -> Intrinsics {
        self.kitti.intrinsics(self.samples[sample])
    }

    fn cameras(&self) -> Vec<String> {
        self.kitti.cameras()
    }

    fn unreadable(&self) -> &[(String, String)] {
        self.kitti.unreadable()
    }

    fn place(&self, sample: usize) -> Place {
        self.kitti.place(self.samples[sample])
    }

    fn depth(&self, sample: usize) -> Result<Option<DepthMap>> {
        read(&self.file(self.samples[sample])?).map(Some)
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::data::camera::Camera;
    use crate::data::kitti::{GroundTruth, Options};

    const DRIVE: &str = "2011_09_26/2011_09_26_drive_0023_sync";

    fn open(root: &Path, listed: bool) -> Result<Projected> {
        let options = Options {
            neighbours: false,
            ground_truth: GroundTruth::Off,
            camera: Camera::KittiPublished,
            ..Options::default()
        };
        Projected::new(Kitti::open(root, None, 32, 64, options)?, listed)
    }

    #[test]
    fn scans_are_read_in_kittis_layout_and_every_fault_is_named() {
        let root = tempfile::tempdir().unwrap();
        let drive = root.path().join(DRIVE);
        for (side, frame) in [("image_02", 0), ("image_02", 1), ("image_03", 0)] {
            let folder = drive.join(side).join("data");
            fs::create_dir_all(&folder).unwrap();
            RgbImage::new(64, 32).save(folder.join(format!("{frame:010}.png"))).unwrap();
        }
        assert!(open(root.path(), false).err().unwrap().to_string().contains("0000000000.npz"));
        let file = drive.join("proj_depth/velodyne/image_02/0000000001.npz");
        let scan = |name: &str, shape: &[usize], numbers: &[f32]| {
            npz::write(&file, &[(name, shape, numbers)], &[]).unwrap();
        };
        scan(NAME, &[1, 3], &[0.0, 4.5, -1.0]);
        let found = open(root.path(), false).unwrap();
        assert_eq!((found.len(), found.left_out().without_depth, found.name(0)), (1, 2, format!("{DRIVE} 1 l")));
        assert_eq!(found.depth(0).unwrap().unwrap().metres, [0.0, 4.5, 0.0]);
        assert!(open(root.path(), true).err().unwrap().to_string().contains("2 of 3 frames lack it"));
        let message = || found.depth(0).unwrap_err().to_string();
        for (name, shape, numbers, what) in [
            ("depth", &[1, 3][..], &[1.0, 2.0, 3.0], "expected an array `velodyne_depth`, found [\"depth\"]"),
            (NAME, &[3], &[1.0, 2.0, 3.0], "[height, width], found [3]"),
            (NAME, &[1, 3], &[1.0, f32::NAN, 3.0], "row 0, column 1 is NaN"),
        ] {
            scan(name, shape, numbers);
            assert!(message().contains("0000000001.npz") && message().contains(what), "{}", message());
        }
        let whole = fs::read(&file).unwrap();
        fs::write(&file, &whole[..whole.len() / 2]).unwrap();
        assert!(message().contains("0000000001.npz"), "{}", message());
    }
}
