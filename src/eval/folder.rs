//! A folder of depth maps from another program, matched with frames by their names.
//!
//! A frame `FOLDER FRAME SIDE` of KITTI raw is looked for as `FOLDER/image_02/data/0000000005` (`image_03` for the right
//! side), as `FOLDER/image_02/0000000005`; any other frame, such as `drive_b 0001` of a folder of frames, as its words with
//! `/` between them. One of Cityscapes, `train/aachen/aachen_000000 5 l`, may also be `train/aachen/aachen_000000_000005_leftImg8bit`.
//! Files end in `.png` (16-bit grey, metres times 256), `.npy` (floats `[height, width]`) or `.pfm`; `_depth` may stand in front
//! of the ending, and the pictures `NAME_disp.png` that `predict` writes beside its depth are passed over.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use super::evaluate::Predicts;
use crate::data::DataSource;
use crate::error::{Error, Result};
use crate::formats::depth_png::read_depth_png;
use crate::formats::npy;
use crate::formats::pfm::read_pfm;

/// Content of `.npy` and `.pfm` files.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Holds {
    /// Depth, up to a factor.
    Depth,
    /// Inverse depth, up to a factor, as `parallax predict --npy` writes it.
    InverseDepth,
}

/// Depth maps of the frames of a data set, each in a file of its own.
#[derive(Clone, Debug)]
pub struct PredictionFolder {
    holds: Holds,
    /// One for each frame, in the order of the data.
    files: Vec<PathBuf>,
    /// The files that are of no frame.
    extra: Vec<PathBuf>,
}

impl PredictionFolder {
    /// Finds the file of every frame of a data set; `with_extra` says that there may be files of other frames.
    ///
    /// # Errors
    /// If a frame has no file, or two; if a file belongs to no frame, unless `with_extra`.
    pub fn open(folder: &Path, data: &dyn DataSource, holds: Holds, with_extra: bool) -> Result<PredictionFolder> {
        let mut found = BTreeMap::new();
        walk(folder, Path::new(""), &mut found)?;
        let (mut files, mut missing, mut used) = (Vec::new(), Vec::new(), BTreeSet::new());
        for sample in 0..data.len() {
            let name = data.name(sample);
            let names = file_names(&name);
            match names.iter().find_map(|key| Some((key, found.get(key)?))) {
                Some((key, file)) => {
                    used.insert(key.clone());
                    files.push(file.clone());
                }
                None => missing.push((name, names)),
            }
        }
        if let Some((name, names)) = missing.first() {
            let message = format!(
                "{} of {} frames have no prediction; the first: {name}, looked for as {}.png, .npy or .pfm",
                missing.len(),
                data.len(),
                names.join(" or ")
            );
            return Err(Error::file(folder, message));
        }
        let extra: Vec<PathBuf> = found.into_iter().filter(|(key, _)| !used.contains(key)).map(|(_, f)| f).collect();
        if let (Some(first), false) = (extra.first(), with_extra) {
            let message = format!(
                "{} files are predictions of no frame that is measured; the first: {}: take them away, or pass them over \
                 with --ignore-extra",
                extra.len(),
                first.display()
            );
            return Err(Error::file(folder, message));
        }
        Ok(PredictionFolder { holds, files, extra })
    }

    /// The files that are of no frame.
    pub fn extra(&self) -> &[PathBuf] {
        &self.extra
    }

    /// Inverse depth from a file, and its rows and columns.
    fn read(&self, file: &Path) -> Result<(Vec<f32>, (usize, usize))> {
        let is = |known: &str| file.extension().is_some_and(|ending| ending.eq_ignore_ascii_case(known));
        let (values, size, holds) = if is("png") {
            let map = read_depth_png(file)?;
            (map.metres, (map.height, map.width), Holds::Depth)
        } else if is("pfm") {
            let map = read_pfm(file)?;
            (map.values, (map.height, map.width), self.holds)
        } else {
            let (values, size) = read_npy(file)?;
            (values, size, self.holds)
        };
        if let Some(i) = values.iter().position(|v| !(*v > 0.0 && v.is_finite())) {
            let (row, column) = (i / size.1.max(1), i % size.1.max(1));
            let message = format!(
                "the prediction at row {row}, column {column} is {}: expected a depth above 0 in every pixel",
                values[i]
            );
            return Err(Error::file(file, message));
        }
        let inverse = match holds {
            Holds::Depth => values.into_iter().map(|depth| 1.0 / depth).collect(),
            Holds::InverseDepth => values,
        };
        Ok((inverse, size))
    }
}

/// A map of floats.
fn read_npy(file: &Path) -> Result<(Vec<f32>, (usize, usize))> {
    let array = npy::read(file)?;
    let &[height, width] = array.shape() else {
        let message = format!("expected a map of the shape [height, width], found {:?}", array.shape());
        return Err(Error::file(file, message));
    };
    let values = array.to_f32().filter(|values| !values.is_empty()).ok_or_else(|| {
        let (shape, found) = (array.shape(), array.dtype().name());
        Error::file(
            file,
            format!("expected floating-point numbers, at least one, found {found} of the shape {shape:?}"),
        )
    })?;
    Ok((values, (height, width)))
}

impl Predicts for PredictionFolder {
    fn inverse_depth(&self, data: &dyn DataSource, sample: usize) -> Result<(Vec<f32>, (usize, usize))> {
        let Some(file) = self.files.get(sample) else {
            return Err(Error::Failed(format!("{}: no prediction", data.name(sample))));
        };
        let (values, size) = self.read(file)?;
        // A map of another shape than the picture's is of something else: the truth's sides, up to a pixel's rounding.
        if let Some(truth) = data.depth(sample)? {
            let (h, w) = (truth.height as f64, truth.width as f64);
            let expected = size.1 as f64 * h / w;
            if (expected - size.0 as f64).abs() > 0.25 * expected + 1.0 {
                let message = format!(
                    "is {} rows of {}, where the ground truth of {} is {} rows of {}: expected the whole picture, at any size",
                    size.0,
                    size.1,
                    data.name(sample),
                    truth.height,
                    truth.width
                );
                return Err(Error::file(file, message));
            }
        }
        Ok((values, size))
    }
}

/// Names that a frame's file may have, without its ending.
fn file_names(name: &str) -> Vec<String> {
    let words: Vec<&str> = name.split_whitespace().filter(|word| *word != ".").collect();
    if let [folder, frame, side @ ("l" | "r")] = words[..]
        && let Ok(number) = frame.parse::<u32>()
    {
        let camera = if side == "l" { "image_02" } else { "image_03" };
        let mut names = ["/data/", "/"].map(|between| format!("{folder}/{camera}{between}{number:010}")).to_vec();
        // Cityscapes.
        let side = if side == "l" { "left" } else { "right" };
        names.push(format!("{folder}_{number:06}_{side}Img8bit"));
        return names;
    }
    vec![words.join("/")]
}

/// Finds the predictions below `root/inside`, by their names without ending.
fn walk(root: &Path, inside: &Path, found: &mut BTreeMap<String, PathBuf>) -> Result<()> {
    let folder = root.join(inside);
    for entry in fs::read_dir(&folder).map_err(|e| Error::io(&folder, e))? {
        let entry = entry.map_err(|e| Error::io(&folder, e))?;
        let kind = entry.file_type().map_err(|e| Error::io(entry.path(), e))?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if name.starts_with('.') {
            continue;
        }
        if kind.is_dir() {
            walk(root, &inside.join(&name), found)?;
            continue;
        }
        let Some((stem, ending)) = name.rsplit_once('.') else { continue };
        if !["png", "npy", "pfm"].iter().any(|known| ending.eq_ignore_ascii_case(known)) || stem.ends_with("_disp") {
            continue;
        }
        let stem = stem.strip_suffix("_depth").unwrap_or(stem);
        let key = inside.join(stem).to_string_lossy().replace('\\', "/");
        if let Some(other) = found.insert(key, entry.path()) {
            let message = format!("and {} are predictions of one frame: keep one of them", other.display());
            return Err(Error::file(entry.path(), message));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use image::RgbImage;

    use super::*;
    use crate::camera::Intrinsics;
    use crate::depth::DepthMap;
    use crate::formats::depth_png::write_depth_png;
    use crate::formats::npy::write_npy_shaped;

    /// Frames with these names, each with a truth of 4 rows of 8.
    struct Named(Vec<&'static str>);

    impl DataSource for Named {
        fn len(&self) -> usize {
            self.0.len()
        }
        fn name(&self, sample: usize) -> String {
            self.0[sample].to_owned()
        }
        fn image(&self, _: usize, _: i32) -> Result<Arc<RgbImage>> {
            Ok(Arc::new(RgbImage::new(8, 4)))
        }
        fn intrinsics(&self, _: usize) -> Intrinsics {
            Intrinsics::KITTI
        }
        fn depth(&self, _: usize) -> Result<Option<DepthMap>> {
            Ok(Some(DepthMap { width: 8, height: 4, metres: vec![5.0; 32] }))
        }
    }

    fn png(path: PathBuf, metres: f32) {
        write_depth_png(path, &DepthMap { width: 8, height: 4, metres: vec![metres; 32] }).unwrap();
    }

    #[test]
    fn files_are_matched_by_name_in_every_layout() {
        let place = tempfile::tempdir().unwrap();
        let at = |name: &str| place.path().join(name);
        png(at("day/drive/image_02/data/0000000005_depth.png"), 4.0);
        png(at("day/drive/image_03/0000000007.png"), 8.0);
        png(at("day/drive/image_02/data/0000000005_disp.png"), 1.0);
        write_npy_shaped(at("b/0001.npy"), &[0.5; 8], &[2, 4]).unwrap();
        let mut map = b"Pf\n4 2\n-1.0\n".to_vec();
        map.extend([0.25f32; 8].iter().flat_map(|value| value.to_le_bytes()));
        fs::write(at("0002.pfm"), map).unwrap();
        let data = Named(vec!["b 0001", "day/drive 5 l", ". 0002", "day/drive 7 r"]);
        for (holds, expected) in
            [(Holds::Depth, [2.0, 0.25, 4.0, 0.125]), (Holds::InverseDepth, [0.5, 0.25, 0.25, 0.125])]
        {
            let found = PredictionFolder::open(place.path(), &data, holds, false).unwrap();
            let values = [0, 1, 2, 3].map(|sample| found.inverse_depth(&data, sample).unwrap().0[0]);
            assert_eq!(values, expected);
        }
        let fewer = Named(vec!["b 0001"]);
        let error = PredictionFolder::open(place.path(), &fewer, Holds::Depth, false).unwrap_err().to_string();
        assert!(error.contains("3 files are predictions of no frame") && error.contains("--ignore-extra"), "{error}");
        assert_eq!(PredictionFolder::open(place.path(), &fewer, Holds::Depth, true).unwrap().extra().len(), 3);
    }

    #[test]
    fn missing_twofold_and_broken_predictions_are_named() {
        let place = tempfile::tempdir().unwrap();
        let at = |name: &str| place.path().join(name);
        let data = Named(vec!["b 1", "b 2"]);
        let open = || PredictionFolder::open(place.path(), &data, Holds::Depth, false);
        write_npy_shaped(at("b/1.npy"), &[1.0; 8], &[2, 4]).unwrap();
        let error = open().unwrap_err().to_string();
        assert!(error.contains("1 of 2 frames have no prediction; the first: b 2, looked for as b/2.png"), "{error}");
        png(at("b/2.png"), 4.0);
        let found = open().unwrap();
        let message = |sample| found.inverse_depth(&data, sample).unwrap_err().to_string();
        for (values, shape, what) in [
            (vec![1.0, f32::NAN, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0], &[2, 4][..], "row 0, column 1 is NaN"),
            (vec![1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0], &[2, 4], "row 1, column 1 is 0"),
            (vec![1.0; 16], &[4, 4], "is 4 rows of 4, where the ground truth of b 1 is 4 rows of 8"),
            (vec![1.0; 8], &[8], "[height, width], found [8]"),
        ] {
            write_npy_shaped(at("b/1.npy"), &values, shape).unwrap();
            assert!(message(0).contains("1.npy") && message(0).contains(what), "{}", message(0));
        }
        image::GrayImage::new(8, 4).save(at("b/2.png")).unwrap();
        assert!(message(1).contains("2.png") && message(1).contains("16-bit"), "{}", message(1));
        png(at("b/1.png"), 4.0);
        assert!(open().unwrap_err().to_string().contains("predictions of one frame"));
    }
}
