//! Whether what is measured on was seen in training: equal frames, and neighbours.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::Path;

use super::DataSource;
use crate::{Error, Result};

/// Samples of one recording that are so many frames apart, or fewer, have a picture in common.
const NEAR: usize = 2;

/// Makes sure that no frame is both trained on and set aside; `list` is the one of what is set aside.
///
/// # Errors
/// If one is: names the list and the frame.
pub fn refuse_shared(train: &dyn DataSource, aside: &dyn DataSource, list: &Path) -> Result<()> {
    let trained: HashSet<String> = (0..train.len()).map(|i| train.name(i)).collect();
    match (0..aside.len()).map(|i| aside.name(i)).find(|name| trained.contains(name)) {
        Some(name) => Err(Error::file(list, format!("{name} is trained on, too: take it out of one of the lists"))),
        None => Ok(()),
    }
}

/// A warning if samples that are set aside share a picture with samples that are trained on: one is a neighbour of the
/// other, or both have the same neighbour, or they were taken by two cameras at once. What is measured is then better than
/// on new frames.
pub fn neighbours(train: &dyn DataSource, aside: &dyn DataSource) -> Option<String> {
    let mut trained: BTreeMap<String, BTreeSet<usize>> = BTreeMap::new();
    for sample in 0..train.len() {
        trained.entry(train.recording(sample)).or_default().insert(train.place(sample).frame);
    }
    let is_near = |&sample: &usize| {
        let frame = aside.place(sample).frame;
        let near = frame.saturating_sub(NEAR)..=frame.saturating_add(NEAR);
        trained.get(&aside.recording(sample)).is_some_and(|frames| frames.range(near).next().is_some())
    };
    let near: Vec<usize> = (0..aside.len()).filter(is_near).collect();
    let first = aside.name(*near.first()?);
    Some(format!(
        "{} of {} frames that are set aside have a picture in common with frames that are trained on (the first: {first}): \
         leave {NEAR} frames between the lists",
        near.len(),
        aside.len()
    ))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use image::RgbImage;

    use super::*;
    use crate::data::camera::Camera;
    use crate::data::{Opening, open_folder};
    use crate::street::{Street, StreetConfig};

    #[test]
    fn streets_of_other_seeds_have_nothing_in_common() {
        let street = |seed: u64| {
            let config =
                StreetConfig { height: 8, width: 16, sequences: 2, frames: 5, seed, ..StreetConfig::default() };
            Street::render(&config, None)
        };
        let (train, aside) = (street(0), street(1_000_000));
        refuse_shared(&train, &aside, Path::new("none")).unwrap();
        assert_eq!(neighbours(&train, &aside), None);
        assert!(neighbours(&train, &street(0)).unwrap().contains("6 of 6"));
    }

    #[test]
    fn equal_frames_are_refused_and_neighbours_are_warned_of() {
        for kitti in [false, true] {
            let place = tempfile::tempdir().unwrap();
            for drive in ["day/drive_a", "day/drive_b"] {
                let folder = place.path().join(drive).join(if kitti { "image_02/data" } else { "" });
                fs::create_dir_all(&folder).unwrap();
                (0..12).for_each(|i| RgbImage::new(8, 8).save(folder.join(format!("{i:010}.png"))).unwrap());
            }
            let side = if kitti { " l" } else { "" };
            let number = |n: usize| if kitti { n.to_string() } else { format!("{n:010}") };
            let open = |name: &str, frames: &[(&str, usize)]| {
                let lines = frames.iter().map(|(drive, n)| format!("day/{drive} {}{side}\n", number(*n)));
                let list = place.path().join(name);
                fs::write(&list, lines.collect::<String>()).unwrap();
                let camera = Camera::Fov { degrees: 60.0 };
                (open_folder(place.path(), Opening { list: Some(&list), camera, ..Opening::of([8, 8]) }).unwrap(), list)
            };
            let (train, _) = open("train.txt", &[("drive_a", 2), ("drive_a", 3), ("drive_b", 9)]);
            // The drives come in another order here: a recording is known by its name.
            let (far, list) = open("far.txt", &[("drive_b", 2), ("drive_b", 6), ("drive_a", 9), ("drive_a", 6)]);
            refuse_shared(train.as_ref(), far.as_ref(), &list).unwrap();
            assert_eq!(neighbours(train.as_ref(), far.as_ref()), None);
            let (near, list) = open("near.txt", &[("drive_b", 2), ("drive_b", 7), ("drive_a", 4)]);
            refuse_shared(train.as_ref(), near.as_ref(), &list).unwrap();
            let warning = neighbours(train.as_ref(), near.as_ref()).unwrap();
            assert!(warning.contains("2 of 3") && warning.contains("drive_b"), "{warning}");
            let (equal, list) = open("equal.txt", &[("drive_b", 2), ("drive_a", 3)]);
            let error = refuse_shared(train.as_ref(), equal.as_ref(), &list).unwrap_err().to_string();
            assert!(error.contains("equal.txt") && error.contains("drive_a"), "{error}");
        }
    }
}
