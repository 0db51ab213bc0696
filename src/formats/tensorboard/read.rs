//! Event files as they are read: every length and checksum is compared before anything is believed.

use std::path::Path;

use prost::Message;

use super::checksum;
use super::message::Event;
use crate::formats::bounded::read_bounded;
use crate::{Error, Result};

/// Some thousand validations with their pictures.
const MAX_FILE: u64 = 4 << 30;
/// Bytes of a frame in front of its message, and behind it.
const HEAD: usize = 12;
const TAIL: usize = 4;

/// The content of an event file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EventFile {
    /// Its events, oldest first.
    pub events: Vec<Event>,
    /// Whether it ends in half a frame, as that of a program that is being killed or still writes.
    pub torn: bool,
}

/// Reads an event file.
///
/// # Errors
/// If it cannot be read, or a frame's checksum or message is wrong: the frame's number and place.
pub fn read_events(path: &Path) -> Result<EventFile> {
    let bytes = read_bounded(path, MAX_FILE, "a TensorBoard event file")?;
    let mut found = EventFile::default();
    let mut rest = &bytes[..];
    while !rest.is_empty() {
        let wrong = |what: &str| {
            let (number, at) = (found.events.len(), bytes.len() - rest.len());
            Error::file(
                path,
                format!("frame {number}, at byte {at}: {what}: no event file of TensorBoard, or a damaged one"),
            )
        };
        let Some((length, sum)) = rest.split_at_checked(HEAD).map(|(head, _)| head.split_at(8)) else {
            found.torn = true;
            break;
        };
        if checksum(length).to_le_bytes() != *sum {
            return Err(wrong("the checksum of its length is another"));
        }
        let length = length.iter().rev().fold(0u64, |n, byte| n << 8 | u64::from(*byte));
        let end = usize::try_from(length).ok().and_then(|length| length.checked_add(HEAD));
        let whole = end.and_then(|end| Some((end, rest.split_at_checked(end.checked_add(TAIL)?)?)));
        let Some((end, (frame, after))) = whole else {
            found.torn = true;
            break;
        };
        let message = &frame[HEAD..end];
        if checksum(message).to_le_bytes() != frame[end..] {
            return Err(wrong("the checksum of its message is another"));
        }
        let event = Event::decode(message).map_err(|e| wrong(&format!("its message is no event ({e})")))?;
        found.events.push(event);
        rest = after;
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::formats::tensorboard::{EventWriter, FILE_VERSION, Histogram, Point, Status, What, Worth};

    /// A file of four events: version, start, a figure, a picture and a histogram.
    fn written() -> (tempfile::TempDir, std::path::PathBuf) {
        let place = tempfile::tempdir().unwrap();
        let mut writer = EventWriter::create(place.path(), 11).unwrap();
        writer.add(11, vec![Point::scalar("loss", 0.1), Point::scalar("none", f64::NAN)]).unwrap();
        let histogram = Histogram::of(&[1.0, -2.0]).unwrap();
        writer.add(12, vec![Point::image("a/b", vec![1, 2, 3], [320, 96]), Point::histogram("w", histogram)]).unwrap();
        let path = writer.path().to_owned();
        (place, path)
    }

    #[test]
    fn what_was_written_reads_back() {
        let (_place, path) = written();
        let EventFile { events, torn } = read_events(&path).unwrap();
        assert!(!torn && events.len() == 4 && events.iter().all(|event| event.wall_time > 1.7e9), "{events:?}");
        assert_eq!(events[0].what, Some(What::FileVersion(FILE_VERSION.into())));
        let Some(What::SessionLog(log)) = &events[1].what else { panic!("{events:?}") };
        assert_eq!((events[1].step, log.status()), (11, Status::Start));
        let Some(What::Summary(figures)) = &events[2].what else { panic!("{events:?}") };
        assert_eq!(figures.points[0], Point::scalar("loss", 0.1));
        assert!(matches!(figures.points[1].worth, Some(Worth::Scalar(x)) if x.is_nan()));
        let Some(What::Summary(rest)) = &events[3].what else { panic!("{events:?}") };
        let Some(Worth::Image(image)) = &rest.points[0].worth else { panic!("{rest:?}") };
        assert_eq!((image.width, image.height, &image.encoded[..]), (320, 96, &[1, 2, 3][..]));
        assert_eq!(rest.points[1], Point::histogram("w", Histogram::of(&[1.0, -2.0]).unwrap()));
    }

    #[test]
    fn damage_is_named_and_half_a_frame_at_the_end_is_told() {
        let (place, path) = written();
        let bytes = fs::read(&path).unwrap();
        let whole = read_events(&path).unwrap();
        let other = place.path().join("other");
        for length in 0..bytes.len() {
            fs::write(&other, &bytes[..length]).unwrap();
            let found = read_events(&other).unwrap();
            let ends = found.events.len();
            // As text, where a number that is none equals itself.
            assert!(ends < 4 && format!("{:?}", found.events) == format!("{:?}", &whole.events[..ends]), "{length}");
        }
        for at in 0..bytes.len() {
            let mut bad = bytes.clone();
            bad[at] ^= 0x10;
            fs::write(&other, &bad).unwrap();
            let error = read_events(&other).unwrap_err().to_string();
            assert!(error.contains("checksum") && error.contains("frame "), "{error}");
        }
        fs::write(&other, u64::MAX.to_le_bytes()).unwrap();
        assert!(read_events(&other).unwrap().torn);
    }
}
