//! A recording of one camera as it lies on disk, before any picture is looked at.

use std::path::PathBuf;

use crate::data::camera::Found;
use crate::data::kitti::Side;
use crate::data::truth::Truth;
use crate::formats::picture::check_picture;
use crate::{Error, Result};

/// A frame's files.
#[derive(Clone, Debug)]
pub(super) struct FrameFiles {
    /// Neighbours in time have numbers that follow one another.
    pub(super) number: usize,
    /// As lists write it.
    pub(super) label: String,
    pub(super) picture: PathBuf,
    /// The picture of the other camera, if it is there.
    pub(super) other: Option<PathBuf>,
    /// Where its depth would be.
    pub(super) depth: Option<Truth>,
}

/// Reads a camera from a data set's calibration, for pictures of a size.
pub(super) type Calibration = Box<dyn Fn((u32, u32)) -> Result<Found>>;

/// Reads where the other camera stands: the x of the shift of points to it, in metres, and where that was found.
pub(super) type OtherAt = Box<dyn Fn() -> Result<(f64, String)>>;

/// Frames of one camera, in order.
pub(super) struct Recording {
    /// As lists write it.
    pub(super) name: String,
    /// The camera's side, in layouts whose lists name it.
    pub(super) side: Option<Side>,
    /// The folder that the camera's `camera.toml` may lie in.
    pub(super) path: PathBuf,
    pub(super) frames: Vec<FrameFiles>,
    pub(super) calibration: Option<Calibration>,
    pub(super) other_at: Option<OtherAt>,
}

/// Result of a look at the headers of a recording's pictures.
pub(super) struct Headers {
    /// Width and height of all of them; nothing if none can be read.
    pub(super) size: Option<(u32, u32)>,
    /// Of each frame whether its pictures can be read.
    pub(super) whole: Vec<bool>,
    /// Those that cannot: name, and why.
    pub(super) unreadable: Vec<(String, String)>,
}

impl Recording {
    /// The name of a frame in lists and messages.
    pub(super) fn name_of(&self, frame: &FrameFiles) -> String {
        name_of(&self.name, &frame.label, self.side)
    }

    /// Reads the headers of all pictures, those of the other camera if they are wanted.
    ///
    /// # Errors
    /// If pictures differ in size; if one cannot be read, unless bad frames are skipped.
    pub(super) fn headers(&self, with_other: bool, skip_bad_frames: bool) -> Result<Headers> {
        let mut first: Option<(&PathBuf, (u32, u32))> = None;
        let mut headers = Headers { size: None, whole: Vec::with_capacity(self.frames.len()), unreadable: Vec::new() };
        for frame in &self.frames {
            let mut whole = true;
            for picture in [Some(&frame.picture), frame.other.as_ref().filter(|_| with_other)].into_iter().flatten() {
                match check_picture(picture) {
                    Ok(size) => {
                        let (of, expected) = *first.get_or_insert((picture, size));
                        if size != expected {
                            let message = format!(
                                "is {}x{}, where {} is {}x{}: all pictures of a sequence have one size; put others into a \
                                 folder of their own",
                                size.0,
                                size.1,
                                of.display(),
                                expected.0,
                                expected.1
                            );
                            return Err(Error::file(picture, message));
                        }
                    }
                    Err(error) if skip_bad_frames => {
                        headers.unreadable.push((self.name_of(frame), error.to_string()));
                        whole = false;
                    }
                    Err(error) => return Err(error),
                }
            }
            headers.whole.push(whole);
        }
        headers.size = first.map(|(_, size)| size);
        Ok(headers)
    }
}

/// `FOLDER FRAME`, or `FOLDER FRAME SIDE`.
pub(super) fn name_of(folder: &str, label: &str, side: Option<Side>) -> String {
    match side {
        Some(side) => format!("{folder} {label} {}", side.letter()),
        None => format!("{folder} {label}"),
    }
}
