//! Split lists: which frames belong to a part of the data.

use std::path::{Component, Path};

use crate::formats::bounded::read_text;
use crate::{Error, Result};

/// Which of the two colour cameras.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Side {
    /// `l`, `image_02`.
    Left,
    /// `r`, `image_03`.
    Right,
}

impl Side {
    /// The folder of the camera's frames in a drive.
    pub fn folder(self) -> &'static str {
        match self {
            Side::Left => "image_02",
            Side::Right => "image_03",
        }
    }

    /// The letter in split lists.
    pub fn letter(self) -> char {
        match self {
            Side::Left => 'l',
            Side::Right => 'r',
        }
    }

    /// The other camera.
    pub fn other(self) -> Side {
        match self {
            Side::Left => Side::Right,
            Side::Right => Side::Left,
        }
    }
}

/// A list of a million frames has fewer bytes.
const MAX_LIST: u64 = 64 << 20;

/// A line of a split list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SplitLine {
    /// The number of the line, from 1.
    pub number: usize,
    /// The drive, `DATE/DRIVE`, however it is spelled: `./DATE//DRIVE/` is the same.
    pub folder: String,
    /// The target frame.
    pub frame: u32,
    /// The camera.
    pub side: Side,
}

/// Reads a split list: lines `FOLDER FRAME SIDE`, for example `2011_09_26/2011_09_26_drive_0001_sync 5 l`. Blank
/// lines are skipped.
///
/// # Errors
/// For the first line that is something else, with the file and the number of the line.
pub fn read_split(path: &Path) -> Result<Vec<SplitLine>> {
    let text = read_text(path, MAX_LIST, "a split list")?;
    let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
    let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    lines
        .map(|(i, line)| {
            parse(i + 1, line).map_err(|what| {
                let message = format!("line {}: expected FOLDER FRAME SIDE, {what}: {:?}", i + 1, line.trim());
                Error::file(path, message)
            })
        })
        .collect()
}

fn parse(number: usize, line: &str) -> Result<SplitLine, String> {
    let fields: Vec<&str> = line.split_whitespace().collect();
    let &[folder, frame, side] = fields.as_slice() else {
        return Err(format!("found {} fields", fields.len()));
    };
    let folder = spelled(folder).ok_or_else(|| "with a folder inside the data set's".to_owned())?;
    // Ten digits are the most a file name has.
    let frame = frame.parse().map_err(|_| format!("with a frame number like 5 or 0000000005, found {frame:?}"))?;
    let side = match side {
        "l" => Side::Left,
        "r" => Side::Right,
        _ => {
            return Err(format!("with the side l (image_02) or r (image_03), found {side:?}"));
        }
    };
    Ok(SplitLine { number, folder, frame, side })
}

/// The one spelling of a path that stays inside the folder that it starts from.
fn spelled(folder: &str) -> Option<String> {
    let mut names = Vec::new();
    for component in Path::new(folder).components() {
        match component {
            Component::Normal(name) => names.push(name.to_str()?),
            Component::CurDir => {}
            _ => return None,
        }
    }
    Some(if names.is_empty() { ".".to_owned() } else { names.join("/") })
}

#[cfg(test)]
mod tests {
    use std::fs::{self, File};

    use super::*;

    fn read(text: &str) -> Result<Vec<SplitLine>> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("split.txt");
        fs::write(&path, text).unwrap();
        read_split(&path)
    }

    #[test]
    fn reads_lines_and_skips_blank_ones() {
        let lines = read("a/b 5 l\r\n\n  \na/c 0000000012 r\n").unwrap();
        let line = |number, folder: &str, frame, side| SplitLine { number, folder: folder.to_owned(), frame, side };
        assert_eq!(lines, [line(1, "a/b", 5, Side::Left), line(4, "a/c", 12, Side::Right)]);
        assert!(read("\n").unwrap().is_empty());
    }

    #[test]
    fn spellings_of_a_folder_are_one_folder() {
        let lines = read("a/b 3 l\n./a/b 3 l\na//b/ 0000000003 l\na/./b 3 l\n././ 3 l\n. 3 l").unwrap();
        let folders: Vec<&str> = lines.iter().map(|line| line.folder.as_str()).collect();
        assert_eq!(folders, ["a/b", "a/b", "a/b", "a/b", ".", "."]);
        assert!(lines.iter().all(|line| line.frame == 3));
    }

    #[test]
    fn every_bad_line_names_file_and_line() {
        for (text, what) in [
            ("a/b 5 l\n\na/b 5", "found 2 fields"),
            ("a/b 5 l\n\na/b 5 l 7", "found 4 fields"),
            ("a/b 5 l\n\na/b five l", "\"five\""),
            ("a/b 5 l\n\na/b -5 l", "\"-5\""),
            ("a/b 5 l\n\na/b 99999999999 l", "\"99999999999\""),
            ("a/b 5 l\n\na/b 5 left", "\"left\""),
            ("a/b 5 l\n\n/etc 5 l", "inside"),
            ("a/b 5 l\n\n../b 5 l", "inside"),
        ] {
            let error = read(text).unwrap_err().to_string();
            assert!(error.contains("split.txt: line 3: ") && error.contains(what), "{error}");
        }
    }

    #[test]
    fn a_list_that_is_too_long_is_not_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("split.txt");
        File::create(&path).unwrap().set_len(1 << 40).unwrap();
        let error = read_split(&path).unwrap_err().to_string();
        assert!(error.contains("split.txt") && error.contains("a split list of more than 67108864"), "{error}");
    }

    #[test]
    fn a_list_that_is_not_there_is_an_error() {
        let error = read_split(Path::new("/nowhere/split.txt")).unwrap_err().to_string();
        assert!(error.contains("/nowhere/split.txt"), "{error}");
    }
}
