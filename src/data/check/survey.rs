//! The files of a folder of frames, whatever its layout: counts, sizes, headers, gaps in numbers and times.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::Serialize;

use super::times;
use crate::data::frames::picture_files;
use crate::data::inputs::find_pictures;
use crate::data::kitti::is_kitti;
use crate::formats::picture::check_picture;
use crate::{Error, Result};

/// A step between numbers or times is a gap if it is longer than the usual one by this factor.
pub(super) const GAP: f64 = 1.8;

/// Pictures of one size.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct OfSize {
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
    /// How many there are.
    pub pictures: usize,
    /// The name of the first.
    pub first: String,
}

/// A folder that holds pictures.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Folder {
    /// The path below the folder that was given; `.` for that folder itself.
    pub name: String,
    /// How many pictures it holds.
    pub pictures: usize,
    /// Their sizes, by the headers, the most frequent first. A sequence has one.
    pub sizes: Vec<OfSize>,
    /// Pictures whose header cannot be read: name, and why.
    pub unreadable: Vec<(String, String)>,
    /// Places where numbers are missing: the names before and after.
    pub missing: Vec<[String; 2]>,
    /// Places where time jumps or stands still, by `timestamps.txt` or `times.txt`: the names before and after.
    pub time_gaps: Vec<[String; 2]>,
    /// The usual time from frame to frame, in seconds, where one of these files is there.
    pub seconds: Option<f64>,
    /// The file's fault.
    pub times_fault: Option<String>,
}

/// Looks at the headers and names of all pictures below a folder, but for depth (`depth`, `proj_depth`) and the grey
/// cameras of KITTI raw.
///
/// # Errors
/// If the folder cannot be read or holds no picture.
pub fn survey(root: &Path) -> Result<Vec<Folder>> {
    let mut folders: BTreeMap<PathBuf, Vec<PathBuf>> = BTreeMap::new();
    for picture in frame_files(root)? {
        folders.entry(picture.parent().unwrap_or(root).to_owned()).or_default().push(picture);
    }
    Ok(folders.into_iter().map(|(path, pictures)| look(root, &path, &pictures)).collect())
}

/// The pictures below a folder that may be frames, in order: not depth, and not the grey cameras of KITTI raw.
///
/// # Errors
/// If it is no folder, cannot be read, or holds no picture.
pub(in crate::data) fn frame_files(root: &Path) -> Result<Vec<PathBuf>> {
    if !root.is_dir() {
        return Err(Error::file(root, "expected a folder of frames; check the path"));
    }
    if !is_kitti(root)? {
        return picture_files(root);
    }
    let pictures = find_pictures(&[root.to_owned()], Path::new(""))?.pictures.into_iter().map(|picture| picture.path);
    let is_passed_over = |below: &Path| {
        below.iter().any(|part| ["depth", "proj_depth", "image_00", "image_01"].iter().any(|known| part == *known))
    };
    let is_frame =
        |path: &PathBuf| !is_passed_over(path.strip_prefix(root).ok().and_then(Path::parent).unwrap_or(root));
    Ok(pictures.filter(is_frame).collect())
}

fn look(root: &Path, path: &Path, pictures: &[PathBuf]) -> Folder {
    let name = match path.strip_prefix(root).unwrap_or(path) {
        below if below.as_os_str().is_empty() => ".".to_owned(),
        below => below.display().to_string(),
    };
    let mut folder = Folder { name, pictures: pictures.len(), ..Folder::default() };
    let names: Vec<String> = pictures.iter().map(|picture| file_name(picture)).collect();
    let headers: Vec<_> = pictures.par_iter().map(|picture| check_picture(picture)).collect();
    for (name, header) in names.iter().zip(headers) {
        match header {
            Ok((width, height)) => {
                match folder.sizes.iter_mut().find(|size| (size.width, size.height) == (width, height)) {
                    Some(size) => size.pictures += 1,
                    None => folder.sizes.push(OfSize { width, height, pictures: 1, first: name.clone() }),
                }
            }
            Err(error) => folder.unreadable.push((name.clone(), error.to_string())),
        }
    }
    folder.sizes.sort_by_key(|size| std::cmp::Reverse(size.pictures));
    let numbers: Option<Vec<f64>> = pictures.iter().map(|picture| number(picture)).collect();
    if let Some(numbers) = &numbers {
        folder.missing = gaps(numbers).into_iter().map(|at| [names[at].clone(), names[at + 1].clone()]).collect();
    }
    match times::of_frames(path, pictures) {
        Ok(Some(seconds)) => {
            folder.time_gaps =
                gaps(&seconds).into_iter().map(|at| [names[at].clone(), names[at + 1].clone()]).collect();
            folder.seconds = usual(&seconds);
        }
        Ok(None) => {}
        Err(error) => folder.times_fault = Some(error.to_string()),
    }
    folder
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// The number at the end of a picture's name: of `frame_0012.png` it is 12.
pub(super) fn number(picture: &Path) -> Option<f64> {
    let stem = picture.file_stem()?.to_str()?;
    let digits = stem.len() - stem.trim_end_matches(|c: char| c.is_ascii_digit()).len();
    // More digits than a number of nanoseconds has are no number.
    (1..=20).contains(&digits).then(|| stem[stem.len() - digits..].parse().ok()).flatten()
}

/// The usual step from value to value: the median.
fn usual(values: &[f64]) -> Option<f64> {
    let mut steps: Vec<f64> = values.windows(2).map(|pair| pair[1] - pair[0]).collect();
    steps.sort_by(f64::total_cmp);
    steps.get(steps.len() / 2).copied().filter(|&step| step > 0.0)
}

/// After which values a step is too long, or none forward.
fn gaps(values: &[f64]) -> Vec<usize> {
    let Some(usual) = usual(values) else { return Vec::new() };
    let steps = values.windows(2).map(|pair| pair[1] - pair[0]);
    steps.enumerate().filter(|&(_, step)| step > GAP * usual || step <= 0.0).map(|(at, _)| at).collect()
}

impl Folder {
    /// Faults that make training on the folder impossible, in words.
    pub fn faults(&self) -> Vec<String> {
        let mut faults = Vec::new();
        if let Some((name, why)) = self.unreadable.first() {
            let n = self.unreadable.len();
            faults.push(format!(
                "{}: {n} pictures cannot be read (the first, {name}: {why}): restore them, or train with \
                 --skip-bad-frames",
                self.name
            ));
        }
        if let [most, others @ ..] = &self.sizes[..]
            && let Some(other) = others.first()
        {
            let n: usize = others.iter().map(|size| size.pictures).sum();
            faults.push(format!(
                "{}: {} pictures are {}x{} and {n} have another size (the first of those, {}: {}x{}): put them into a \
                 folder of their own",
                self.name, most.pictures, most.width, most.height, other.first, other.width, other.height
            ));
        }
        faults
    }

    /// Advice on things to look at, in words.
    pub fn advice(&self) -> Vec<String> {
        let mut advice = Vec::new();
        if let Some([before, after]) = self.missing.first() {
            let n = self.missing.len();
            advice.push(format!(
                "{}: frames are missing between {before} and {after} ({n} such places): they count as neighbours if the \
                 folder is a plain one; split it there",
                self.name
            ));
        }
        if let Some([before, after]) = self.time_gaps.first() {
            let n = self.time_gaps.len();
            advice.push(format!("{}: time jumps between {before} and {after} ({n} such places)", self.name));
        }
        advice.extend(self.times_fault.clone());
        advice
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use image::RgbImage;

    use super::*;

    fn write(path: &Path, width: u32) {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        RgbImage::new(width, 8).save(path).unwrap();
    }

    #[test]
    fn sizes_headers_and_gaps_are_counted_by_folder() {
        let place = tempfile::tempdir().unwrap();
        let root = place.path();
        for number in [0, 2, 4, 6, 12, 14] {
            write(&root.join(format!("a/f{number:03}.png")), 12);
        }
        write(&root.join("a/f016.png"), 10);
        fs::write(root.join("a/f018.png"), "no picture").unwrap();
        write(&root.join("b/x.png"), 12);
        write(&root.join("a/depth/f000.png"), 3);
        let folders = survey(root).unwrap();
        assert_eq!(folders.iter().map(|f| (&f.name[..], f.pictures)).collect::<Vec<_>>(), [("a", 8), ("b", 1)]);
        let a = &folders[0];
        assert_eq!(a.missing, [["f006.png".to_owned(), "f012.png".to_owned()]]);
        assert_eq!(a.sizes.iter().map(|s| (s.width, s.pictures)).collect::<Vec<_>>(), [(12, 6), (10, 1)]);
        let faults = a.faults();
        assert!(faults[0].contains("1 pictures cannot be read") && faults[0].contains("f018.png"), "{faults:?}");
        assert!(faults[1].contains("6 pictures are 12x8") && faults[1].contains("f016.png: 10x8"), "{faults:?}");
        assert!(a.advice()[0].contains("between f006.png and f012.png"), "{:?}", a.advice());
        assert!(folders[1].faults().is_empty() && folders[1].advice().is_empty());
        assert!(survey(&root.join("nowhere")).is_err());
    }

    #[test]
    fn times_of_kitti_and_of_the_odometry_data_are_read() {
        let place = tempfile::tempdir().unwrap();
        let drive = place.path().join("2011_09_26/2011_09_26_drive_0001_sync/image_02");
        (0..5).for_each(|frame| write(&drive.join(format!("data/{frame:010}.png")), 12));
        let stamps = ["23:59:59.800000000", "23:59:59.900000001", "00:00:00.000000000", "00:00:00.100", "00:00:00.5"];
        let day = |i: usize| if i < 2 { 28 } else { 29 };
        let lines = stamps.iter().enumerate().map(|(i, at)| format!("2012-02-{} {at}\n", day(i)));
        fs::write(drive.join("timestamps.txt"), lines.collect::<String>()).unwrap();
        let folder = &survey(place.path()).unwrap()[0];
        assert!((folder.seconds.unwrap() - 0.1).abs() < 1e-6, "{folder:?}");
        assert_eq!(folder.time_gaps, [["0000000003.png".to_owned(), "0000000004.png".to_owned()]]);
        fs::write(drive.join("timestamps.txt"), "2012-02-28 12:00:00\nnoon\n").unwrap();
        let fault = survey(place.path()).unwrap()[0].times_fault.clone().unwrap();
        assert!(fault.contains("timestamps.txt") && fault.contains("line 2") && fault.contains("noon"), "{fault}");

        let place = tempfile::tempdir().unwrap();
        (0..4).for_each(|frame| write(&place.path().join(format!("00/image_2/{frame:06}.png")), 12));
        fs::write(place.path().join("00/times.txt"), "0.0\n1.037e-01\n2.07e-01\n3.11e-01\n").unwrap();
        let folder = &survey(place.path()).unwrap()[0];
        assert!((folder.seconds.unwrap() - 0.1037).abs() < 1e-9 && folder.time_gaps.is_empty(), "{folder:?}");
        fs::write(place.path().join("00/times.txt"), "0.0\n0.1\n0.1\n").unwrap();
        let fault = survey(place.path()).unwrap()[0].times_fault.clone().unwrap();
        assert!(fault.contains("times.txt") && fault.contains("3 lines") && fault.contains("000003.png"), "{fault}");
    }
}
