//! Lists of the frames to take.

use std::collections::HashMap;
use std::path::Path;

use super::{Frames, Layout, Spot};
use crate::data::kitti::read_split;
use crate::formats::bounded::read_text;
use crate::{Error, Result};

/// A list of a million frames has fewer bytes.
const MAX_LIST: u64 = 64 << 20;

/// The samples that a list names, in its order.
///
/// # Errors
/// If it names none, or one that is not there: with the number of the line.
pub(super) fn keep(list: &Path, layout: Layout, frames: &Frames) -> Result<Vec<Spot>> {
    let known: HashMap<String, Spot> = frames.samples.iter().map(|&spot| (frames.name_of(spot), spot)).collect();
    let lines = match layout {
        Layout::Folder => plain(list)?,
        Layout::KittiOdometry | Layout::Cityscapes => sided(list, layout)?,
    };
    let form = if layout == Layout::Folder { "FOLDER FRAME" } else { "FOLDER FRAME SIDE" };
    let mut kept = Vec::with_capacity(lines.len());
    for (number, name) in lines {
        let Some(&spot) = known.get(&name) else {
            let first = frames.samples.first().map(|&spot| format!(", such as `{}`", frames.name_of(spot)));
            let example = first.unwrap_or_default();
            let message = format!(
                "line {number}: expected {form} of a frame that is there and has what is needed (both neighbours, to \
                 train){example}; found {name:?}"
            );
            return Err(Error::file(list, message));
        };
        kept.push(spot);
    }
    if kept.is_empty() {
        return Err(Error::file(list, format!("no samples: every line is blank; expected lines {form}")));
    }
    Ok(kept)
}

/// Lines `FOLDER FRAME`: number, and what stands there with single blanks.
fn plain(list: &Path) -> Result<Vec<(usize, String)>> {
    let text = read_text(list, MAX_LIST, "a list of frames")?;
    let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
    let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    Ok(lines.map(|(i, line)| (i + 1, line.split_whitespace().collect::<Vec<_>>().join(" "))).collect())
}

/// Lines `FOLDER FRAME SIDE` as the names that samples have: number, and name.
fn sided(list: &Path, layout: Layout) -> Result<Vec<(usize, String)>> {
    let name = |folder: &str| match layout {
        // Published lists write sequences without a leading zero.
        Layout::KittiOdometry => {
            let folder = folder.strip_prefix("sequences/").unwrap_or(folder);
            folder.parse::<u32>().map_or_else(|_| folder.to_owned(), |number| format!("{number:02}"))
        }
        _ => folder.strip_prefix("leftImg8bit_sequence/").unwrap_or(folder).to_owned(),
    };
    let lines = read_split(list)?;
    let line = |line: crate::data::kitti::SplitLine| {
        (line.number, format!("{} {} {}", name(&line.folder), line.frame, line.side.letter()))
    };
    Ok(lines.into_iter().map(line).collect())
}
