//! Finds drives and frames where no list names them.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use crate::data::inputs::ENDINGS;
use crate::{Error, Result};

/// Drives lie at most this many folders below the root: `DATE/DRIVE`.
const DEPTH: usize = 2;

/// The drives under `root` in the order of their names, each with its folder as split lists write it: every folder
/// that has frames of a colour camera.
pub fn drives(root: &Path) -> Result<Vec<(String, PathBuf)>> {
    let mut found = Vec::new();
    visit(root, "", DEPTH, &mut found)?;
    Ok(found)
}

fn visit(folder: &Path, name: &str, depth: usize, found: &mut Vec<(String, PathBuf)>) -> Result<()> {
    if ["image_02", "image_03"].iter().any(|camera| folder.join(camera).join("data").is_dir()) {
        found.push((if name.is_empty() { "." } else { name }.to_owned(), folder.to_owned()));
        return Ok(());
    }
    if depth == 0 {
        return Ok(());
    }
    let children: BTreeSet<String> = entries(folder)?.filter(|child| folder.join(child).is_dir()).collect();
    for child in children {
        let name = if name.is_empty() { child.clone() } else { format!("{name}/{child}") };
        visit(&folder.join(&child), &name, depth - 1, found)?;
    }
    Ok(())
}

/// The frames in a camera's `data` folder, number and file name, in order; none if the folder is not there. Files that are
/// not named ten digits and the ending of a picture, in capitals or not, are something else. Of a frame that is there
/// more than once the first in the order of [`ENDINGS`] counts.
pub fn frames(folder: &Path) -> Result<BTreeMap<u32, String>> {
    let mut found: BTreeMap<u32, (usize, String)> = BTreeMap::new();
    if !folder.is_dir() {
        return Ok(BTreeMap::new());
    }
    for name in entries(folder)? {
        let Some((number, ending)) = numbered(&name) else { continue };
        let this = (ending, name);
        match found.get(&number) {
            Some(other) if *other <= this => {}
            _ if folder.join(&this.1).is_file() => drop(found.insert(number, this)),
            _ => {}
        }
    }
    Ok(found.into_iter().map(|(number, (_, name))| (number, name)).collect())
}

/// A frame's number, and the index of its ending.
fn numbered(name: &str) -> Option<(u32, usize)> {
    let (stem, ending) = name.rsplit_once('.')?;
    let ending = ENDINGS.iter().position(|known| ending.eq_ignore_ascii_case(known))?;
    let digits = stem.len() == 10 && stem.bytes().all(|b| b.is_ascii_digit());
    Some((digits.then(|| stem.parse().ok())??, ending))
}

/// The names in a folder; those that are not Unicode cannot be KITTI's.
fn entries(folder: &Path) -> Result<impl Iterator<Item = String>> {
    let entries: std::io::Result<Vec<fs::DirEntry>> = fs::read_dir(folder).and_then(Iterator::collect);
    let entries = entries.map_err(|e| Error::io(folder, e))?;
    Ok(entries.into_iter().filter_map(|entry| entry.file_name().into_string().ok()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_drives_and_frames_in_order() {
        let root = tempfile::tempdir().unwrap();
        for name in ["day/b/image_02/data", "day/a/image_03/data", "day/c/image_00/data", "splits"] {
            fs::create_dir_all(root.path().join(name)).unwrap();
        }
        let data = root.path().join("day/b/image_02/data");
        for name in ["0000000010.png", "0000000002.jpg", "0000000003.txt", "12.png", "00000000x4.png"] {
            fs::write(data.join(name), b"").unwrap();
        }
        let names: Vec<String> = drives(root.path()).unwrap().into_iter().map(|(name, _)| name).collect();
        assert_eq!(names, ["day/a", "day/b"]);
        assert_eq!(frames(&data).unwrap().into_keys().collect::<Vec<_>>(), [2, 10]);
        assert!(frames(&root.path().join("nowhere")).unwrap().is_empty());
    }

    #[test]
    fn frames_have_every_ending_that_pictures_have() {
        let data = tempfile::tempdir().unwrap();
        let names = ["0000000001.jpeg", "0000000002.JPG", "0000000003.webp", "0000000004.PNG", "0000000005.WebP"];
        let others = ["0000000002.webp", "0000000006.gif", "+000000007.png", "0000000003.JPeG", "0000000009"];
        for name in names.iter().chain(&others) {
            fs::write(data.path().join(name), b"").unwrap();
        }
        fs::create_dir(data.path().join("0000000008.png")).unwrap();
        let found: Vec<(u32, String)> = frames(data.path()).unwrap().into_iter().collect();
        let expected = [(1, names[0]), (2, names[1]), (3, "0000000003.JPeG"), (4, names[3]), (5, names[4])];
        assert_eq!(found, expected.map(|(number, name)| (number, name.to_owned())));
    }

    #[test]
    fn a_day_or_a_drive_may_be_the_root() {
        let root = tempfile::tempdir().unwrap();
        fs::create_dir_all(root.path().join("day/b/image_02/data")).unwrap();
        assert_eq!(drives(&root.path().join("day")).unwrap()[0].0, "b");
        assert_eq!(drives(&root.path().join("day/b")).unwrap()[0].0, ".");
    }
}
