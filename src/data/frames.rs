//! Any folder of frames: PNG, JPEG or WebP pictures in the order in which people number them.
//!
//! ```text
//! ROOT/camera.toml           which camera took them: see `data::camera`
//! ROOT/frame_0001.jpg ..     a sequence
//! ROOT/depth/frame_0001.png  depth of that frame, if there is any: 16-bit grey, metres times 256, 0 for unknown
//! ROOT/drive_b/0001.jpg ..   another sequence, which may have a camera.toml and a depth folder of its own
//! ```
//!
//! Every folder that holds pictures is a sequence, wherever below the root it lies; `depth` folders hold depth. All
//! pictures of a sequence have one size. Frames that follow one another should be a fraction of a second apart: neighbours
//! are what depth is learnt from.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::RgbImage;

use super::cache::Pictures;
use super::camera::{self, Camera};
use super::inputs::find_pictures;
use super::kitti::LeftOut;
use super::{DataSource, Place};
use crate::camera::Intrinsics;
use crate::depth::DepthMap;
use crate::formats::bounded::read_text;
use crate::formats::depth_png::read_depth_png;
use crate::formats::picture::check_picture;
use crate::{Error, Result};

/// The folder of a sequence's depth maps.
const DEPTH: &str = "depth";
/// A list of a million frames has fewer bytes.
const MAX_LIST: u64 = 64 << 20;

/// Whether a folder has the name of one of KITTI's cameras.
fn is_kitti_camera(name: &OsStr) -> bool {
    ["image_00", "image_01", "image_02", "image_03"].iter().any(|known| name == *known)
}

/// How a folder is opened.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Every sample needs its previous and next frame (training); otherwise the target frame alone (evaluation).
    pub neighbours: bool,
    /// Every sample needs a depth map.
    pub with_depth: bool,
    /// Whose intrinsics; [`Camera::Auto`] asks `camera.toml`.
    pub camera: Camera,
    /// Whether samples are left out whose pictures cannot be read, by their headers; otherwise they are an error.
    pub skip_bad_frames: bool,
    /// How many bytes of resized pictures are kept in memory.
    pub cache_bytes: usize,
}

impl Default for Options {
    /// For training: with neighbours, the camera that the data say, a cache of 1 GiB.
    fn default() -> Self {
        Options {
            neighbours: true,
            with_depth: false,
            camera: Camera::Auto,
            skip_bad_frames: false,
            cache_bytes: 1 << 30,
        }
    }
}

/// A folder of pictures.
struct Sequence {
    /// As lists write it: the path below the root, `.` for the root itself.
    name: String,
    path: PathBuf,
    frames: Vec<PathBuf>,
    camera: camera::Found,
}

impl Sequence {
    /// Where the depth of a frame would be.
    fn depth(&self, frame: usize) -> PathBuf {
        self.path.join(DEPTH).join(self.frames[frame].file_stem().unwrap_or_default()).with_extension("png")
    }
}

/// A folder of frames as a [`DataSource`].
pub struct Frames {
    sequences: Vec<Sequence>,
    samples: Vec<Place>,
    unreadable: Vec<(String, String)>,
    left_out: LeftOut,
    pictures: Pictures<Place>,
}

impl Frames {
    /// Opens the frames that a list names (lines `FOLDER FRAME`, for example `drive_b 0001`: a sequence's folder below the
    /// root, `.` for the root, and a picture's name without its ending), or all. Pictures come out at `height x width`
    /// pixels.
    ///
    /// # Errors
    /// Everything is checked here: that there are sequences long enough, that pictures' headers can be read and have one
    /// size in a sequence, that the camera is known, that a list names frames that are there.
    pub fn open(root: &Path, list: Option<&Path>, [height, width]: [usize; 2], options: Options) -> Result<Frames> {
        let mut folders: BTreeMap<PathBuf, Vec<PathBuf>> = BTreeMap::new();
        // Nothing is written: no folder is left out.
        for picture in find_pictures(&[root.to_owned()], Path::new(""))?.pictures {
            let folder = picture.path.parent().unwrap_or(root).to_owned();
            if folder.file_name().is_none_or(|name| name != DEPTH) || folder == root {
                folders.entry(folder).or_default().push(picture.path);
            }
        }
        let pictures = Pictures::new(height, width, options.cache_bytes)?.with_prepared(root)?;
        let mut found = Frames {
            sequences: Vec::new(),
            samples: Vec::new(),
            unreadable: Vec::new(),
            left_out: LeftOut::default(),
            pictures,
        };
        for (path, frames) in folders {
            if path.ends_with("data") && path.parent().is_some_and(|p| p.file_name().is_some_and(is_kitti_camera)) {
                let message = "is a camera of KITTI raw, in a drive that does not lie at DATE/DRIVE below the folder that was \
                               given: give the folder that holds the dates";
                return Err(Error::file(path, message));
            }
            found.add(root, path, frames, options)?;
        }
        if let Some(list) = list {
            found.keep_listed(list)?;
        }
        if found.samples.is_empty() {
            return Err(Error::file(root, found.why_nothing(options)));
        }
        Ok(found)
    }

    /// Adds a sequence, and its samples.
    fn add(&mut self, root: &Path, path: PathBuf, frames: Vec<PathBuf>, options: Options) -> Result<()> {
        let name = match path.strip_prefix(root).unwrap_or(&path) {
            below if below.as_os_str().is_empty() => ".".to_owned(),
            below => below.display().to_string(),
        };
        // Which frames can be read, by their headers, and their size, which has to be one.
        let mut first: Option<(&Path, (u32, u32))> = None;
        let mut whole = Vec::with_capacity(frames.len());
        for frame in &frames {
            match check_picture(frame) {
                Ok(size) => {
                    let (of, expected) = *first.get_or_insert((frame, size));
                    if size != expected {
                        let message = format!(
                            "is {}x{}, where {} is {}x{}: all pictures of a folder have one size; put others into a \
                             folder of their own",
                            size.0,
                            size.1,
                            of.display(),
                            expected.0,
                            expected.1
                        );
                        return Err(Error::file(frame, message));
                    }
                    whole.push(true);
                }
                Err(error) if options.skip_bad_frames => {
                    let stem = frame.file_stem().unwrap_or_default().to_string_lossy().into_owned();
                    self.unreadable.push((format!("{name} {stem}"), error.to_string()));
                    whole.push(false);
                }
                Err(error) => return Err(error),
            }
        }
        let Some((_, size)) = first else { return Ok(()) };
        let camera = options.camera.resolve(root, &path, size, None)?;
        let sequence = Sequence { name, path, frames, camera };
        let around = usize::from(options.neighbours);
        for frame in around..sequence.frames.len().saturating_sub(around) {
            let readable = whole[frame - around..=frame + around].iter().all(|&whole| whole);
            if readable && options.with_depth && !sequence.depth(frame).is_file() {
                self.left_out.without_depth += 1;
                self.left_out.first_depth.get_or_insert_with(|| sequence.depth(frame));
            } else if readable {
                self.samples.push(Place { sequence: self.sequences.len(), frame });
            }
        }
        self.sequences.push(sequence);
        Ok(())
    }

    /// Keeps the samples that a list names, in its order.
    fn keep_listed(&mut self, list: &Path) -> Result<()> {
        let text = read_text(list, MAX_LIST, "a list of frames")?;
        let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
        let known: BTreeMap<String, Place> = self.samples.iter().map(|&place| (self.name_of(place), place)).collect();
        let mut kept = Vec::new();
        for (i, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
            let name = line.split_whitespace().collect::<Vec<_>>().join(" ");
            let Some(&place) = known.get(&name) else {
                let example = known.keys().next().map_or_else(String::new, |first| format!(", such as `{first}`"));
                let message = format!(
                    "line {}: expected FOLDER FRAME of a frame that is there and has what is needed (both neighbours, to \
                     train){example}; found {:?}",
                    i + 1,
                    line.trim()
                );
                return Err(Error::file(list, message));
            };
            kept.push(place);
        }
        if kept.is_empty() {
            return Err(Error::file(list, "no samples: every line is blank; expected lines FOLDER FRAME"));
        }
        self.samples = kept;
        Ok(())
    }

    pub(super) fn pictures_mut(&mut self) -> &mut Pictures<Place> {
        &mut self.pictures
    }

    /// Frames that lack the depth map that was asked for.
    pub fn left_out(&self) -> &LeftOut {
        &self.left_out
    }

    /// Why there is no sample.
    fn why_nothing(&self, options: Options) -> String {
        let frames: usize = self.sequences.iter().map(|s| s.frames.len()).sum();
        let folders = self.sequences.len();
        if let Some((_, why)) = self.unreadable.first() {
            return format!("no frame is left; the first that cannot be read: {why}");
        }
        let needs = match (options.neighbours, options.with_depth) {
            (true, _) => "a frame before it and one after it in the same folder: three frames at least",
            (false, true) => "a depth map: depth/NAME.png in its folder, 16-bit grey, metres times 256",
            (false, false) => "nothing else",
        };
        format!("{frames} pictures in {folders} folders, and no sample among them: each needs {needs}")
    }

    fn name_of(&self, place: Place) -> String {
        let sequence = &self.sequences[place.sequence];
        let stem = sequence.frames[place.frame].file_stem().unwrap_or_default();
        format!("{} {}", sequence.name, stem.to_string_lossy())
    }

    fn at(&self, sample: usize, offset: i32) -> Result<Place> {
        let place = self.samples[sample];
        let frames = self.sequences[place.sequence].frames.len();
        match place.frame.checked_add_signed(offset as isize).filter(|&frame| frame < frames) {
            Some(frame) => Ok(Place { frame, ..place }),
            None => {
                let message = format!("has no frame at {offset:+}");
                Err(Error::file(&self.sequences[place.sequence].frames[place.frame], message))
            }
        }
    }
}

impl DataSource for Frames {
    fn len(&self) -> usize {
        self.samples.len()
    }

    fn name(&self, sample: usize) -> String {
        self.name_of(self.samples[sample])
    }

    fn image(&self, sample: usize, offset: i32) -> Result<Arc<RgbImage>> {
        let place = self.at(sample, offset)?;
        self.pictures.get(place, || Ok(self.sequences[place.sequence].frames[place.frame].clone()))
    }

    fn intrinsics(&self, sample: usize) -> Intrinsics {
        self.sequences[self.samples[sample].sequence].camera.intrinsics
    }

    fn cameras(&self) -> Vec<String> {
        camera::in_words(self.sequences.iter().map(|sequence| &sequence.camera))
    }

    fn unreadable(&self) -> &[(String, String)] {
        &self.unreadable
    }

    fn place(&self, sample: usize) -> Place {
        self.samples[sample]
    }

    fn recording(&self, sample: usize) -> String {
        self.sequences[self.samples[sample].sequence].name.clone()
    }

    fn depth(&self, sample: usize) -> Result<Option<DepthMap>> {
        let place = self.samples[sample];
        let file = self.sequences[place.sequence].depth(place.frame);
        if file.is_file() { read_depth_png(&file).map(Some) } else { Ok(None) }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::formats::depth_png::write_depth_png;

    const PLAIN: Options = Options { cache_bytes: 1 << 20, ..PLAIN_DEFAULT };
    const PLAIN_DEFAULT: Options = Options {
        neighbours: true,
        with_depth: false,
        camera: Camera::Fov { degrees: 60.0 },
        skip_bad_frames: false,
        cache_bytes: 0,
    };

    fn write(path: &Path, size: (u32, u32)) {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        RgbImage::from_fn(size.0, size.1, |x, y| image::Rgb([x as u8, y as u8, 90])).save(path).unwrap();
    }

    fn folder(files: &[&str]) -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        files.iter().for_each(|file| write(&root.path().join(file), (12, 8)));
        root
    }

    fn names(frames: &Frames) -> Vec<String> {
        (0..frames.len()).map(|sample| frames.name(sample)).collect()
    }

    fn open(root: &Path, list: Option<&str>, options: Options) -> Result<Frames> {
        let list = list.map(|text| {
            let path = root.join("list.txt");
            fs::write(&path, text).unwrap();
            path
        });
        Frames::open(root, list.as_deref(), [8, 12], options)
    }

    fn message(result: Result<Frames>) -> String {
        result.map(|frames| names(&frames)).unwrap_err().to_string()
    }

    #[test]
    fn frames_come_in_natural_order_and_sequences_by_folder() {
        let root =
            folder(&["f10.png", "f9.png", "f8.png", "f11.jpg", "b/1.png", "b/2.png", "b/3.png", "c/deep/x.webp"]);
        let frames = open(root.path(), None, PLAIN).unwrap();
        assert_eq!(names(&frames), [". f9", ". f10", "b 2"]);
        assert_eq!(frames.place(0).sequence, frames.place(1).sequence);
        assert_ne!(frames.place(1).sequence, frames.place(2).sequence);
        assert_eq!(frames.image(0, -1).unwrap().dimensions(), (12, 8));
        assert!(frames.image(1, 2).unwrap_err().to_string().contains("f10.png"));
        let alone = Options { neighbours: false, ..PLAIN };
        assert_eq!(open(root.path(), None, alone).unwrap().len(), 8);
    }

    #[test]
    fn every_sequence_has_its_own_camera() {
        let root = folder(&["a/1.png", "a/2.png", "a/3.png", "b/1.png", "b/2.png", "b/3.png"]);
        fs::write(root.path().join("camera.toml"), "fov = 90").unwrap();
        fs::write(root.path().join("b/camera.toml"), "width = 24\nheight = 16\nfx = 18\nfy = 18\ncx = 10\ncy = 7")
            .unwrap();
        let frames = open(root.path(), None, Options { camera: Camera::Auto, ..PLAIN }).unwrap();
        assert_eq!(frames.cameras().len(), 2);
        assert!((frames.intrinsics(0).fx - 0.5).abs() < 1e-12);
        let expected = Intrinsics { fx: 0.75, fy: 18.0 / 16.0, cx: 10.0 / 24.0, cy: 7.0 / 16.0 };
        assert_eq!(frames.intrinsics(1), expected);
    }

    #[test]
    fn depth_lies_beside_the_frames() {
        let root = folder(&["a/1.png", "a/2.png", "a/3.png", "a/4.png"]);
        let depth = DepthMap { width: 2, height: 1, metres: vec![4.0, 0.0] };
        fs::create_dir_all(root.path().join("a/depth")).unwrap();
        write_depth_png(root.path().join("a/depth/2.png"), &depth).unwrap();
        let frames = open(root.path(), None, PLAIN).unwrap();
        assert_eq!(names(&frames), ["a 2", "a 3"]);
        assert_eq!((frames.depth(0).unwrap(), frames.depth(1).unwrap()), (Some(depth), None));
        let measured = Options { neighbours: false, with_depth: true, ..PLAIN };
        let measured = open(root.path(), None, measured).unwrap();
        assert_eq!(names(&measured), ["a 2"]);
        assert_eq!(measured.left_out().without_depth, 3);
        assert!(measured.left_out().first_depth.as_ref().unwrap().ends_with("a/depth/1.png"));
    }

    #[test]
    fn a_list_names_frames() {
        let root = folder(&["a/1.png", "a/2.png", "a/3.png", "a/4.png"]);
        let listed = open(root.path(), Some("\u{feff}a  3\r\n\r\na 2\t\r\n"), PLAIN).unwrap();
        assert_eq!(names(&listed), ["a 3", "a 2"]);
        for (list, line) in [("a 2\na 1", "line 2"), ("a 2 l", "line 1"), ("", "blank")] {
            let error = message(open(root.path(), Some(list), PLAIN));
            assert!(error.contains("list.txt") && error.contains(line), "{error}");
        }
    }

    #[test]
    fn what_cannot_be_a_sequence_is_an_error_that_says_why() {
        let two = folder(&["1.png", "2.png"]);
        assert!(message(open(two.path(), None, PLAIN)).contains("three frames at least"));
        let mixed = folder(&["1.png", "2.png", "3.png"]);
        write(&mixed.path().join("2.png"), (10, 8));
        let error = message(open(mixed.path(), None, PLAIN));
        assert!(error.contains("2.png") && error.contains("10x8") && error.contains("12x8"), "{error}");
        let bad = folder(&["1.png", "2.png", "3.png", "4.png", "5.png", "6.png"]);
        fs::write(bad.path().join("2.png"), b"no picture").unwrap();
        assert!(message(open(bad.path(), None, PLAIN)).contains("2.png"));
        let skipping = open(bad.path(), None, Options { skip_bad_frames: true, ..PLAIN }).unwrap();
        assert_eq!((names(&skipping), skipping.unreadable().len()), (vec![". 4".into(), ". 5".into()], 1));
        assert!(message(open(&bad.path().join("nowhere"), None, PLAIN)).contains("nowhere"));
        let deep = folder(&["kitti/day/drive/image_02/data/1.png"]);
        let error = message(open(deep.path(), None, PLAIN));
        assert!(error.contains("image_02/data") && error.contains("holds the dates"), "{error}");
    }
}
