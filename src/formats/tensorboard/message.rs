//! The messages of an event file, as far as they are written here; others are passed over when they are read.

use prost::{Enumeration, Message, Oneof};

use super::Histogram;

/// Something that happened at a step.
#[derive(Clone, PartialEq, Message)]
pub struct Event {
    /// Seconds since 1970.
    #[prost(double, tag = "1")]
    pub wall_time: f64,
    /// The step.
    #[prost(int64, tag = "2")]
    pub step: i64,
    /// The thing itself.
    #[prost(oneof = "What", tags = "3, 5, 7")]
    pub what: Option<What>,
}

/// The content of an [`Event`].
#[derive(Clone, PartialEq, Oneof)]
pub enum What {
    /// The version of the format, in the first event of a file.
    #[prost(string, tag = "3")]
    FileVersion(String),
    /// Figures, pictures and histograms.
    #[prost(message, tag = "5")]
    Summary(Summary),
    /// A training begins or goes on.
    #[prost(message, tag = "7")]
    SessionLog(SessionLog),
}

/// Figures, pictures and histograms of one step.
#[derive(Clone, PartialEq, Message)]
pub struct Summary {
    /// All of them.
    #[prost(message, repeated, tag = "1")]
    pub points: Vec<Point>,
}

/// A named value.
#[derive(Clone, PartialEq, Message)]
pub struct Point {
    /// The name. TensorBoard groups by the part in front of the first slash.
    #[prost(string, tag = "1")]
    pub tag: String,
    /// The value.
    #[prost(oneof = "Worth", tags = "2, 4, 5")]
    pub worth: Option<Worth>,
}

/// The value of a [`Point`].
#[derive(Clone, PartialEq, Oneof)]
pub enum Worth {
    /// A number.
    #[prost(float, tag = "2")]
    Scalar(f32),
    /// A picture.
    #[prost(message, tag = "4")]
    Image(Image),
    /// How numbers are spread.
    #[prost(message, tag = "5")]
    Histogram(Histogram),
}

/// A picture in its file format.
#[derive(Clone, PartialEq, Message)]
pub struct Image {
    /// Height in pixels.
    #[prost(int32, tag = "1")]
    pub height: i32,
    /// Width in pixels.
    #[prost(int32, tag = "2")]
    pub width: i32,
    /// Number of channels: 3 for red, green and blue.
    #[prost(int32, tag = "3")]
    pub colorspace: i32,
    /// The bytes of a PNG or JPEG file.
    #[prost(bytes = "vec", tag = "4")]
    pub encoded: Vec<u8>,
}

/// A training that begins or goes on: of what was written before, readers forget all events from this one's step on.
#[derive(Clone, PartialEq, Message)]
pub struct SessionLog {
    /// What happens.
    #[prost(enumeration = "Status", tag = "1")]
    pub status: i32,
}

/// The states of a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Enumeration)]
#[repr(i32)]
pub enum Status {
    /// None is said.
    Unspecified = 0,
    /// It begins.
    Start = 1,
    /// It ends.
    Stop = 2,
    /// It was saved.
    Checkpoint = 3,
}

impl Point {
    /// A number; TensorBoard keeps it in single precision.
    pub fn scalar(tag: impl Into<String>, value: f64) -> Self {
        Point { tag: tag.into(), worth: Some(Worth::Scalar(value as f32)) }
    }

    /// How numbers are spread.
    pub fn histogram(tag: impl Into<String>, histogram: Histogram) -> Self {
        Point { tag: tag.into(), worth: Some(Worth::Histogram(histogram)) }
    }

    /// A PNG or JPEG file's bytes and its width and height, in pixels.
    pub fn image(tag: impl Into<String>, encoded: Vec<u8>, [width, height]: [u32; 2]) -> Self {
        let side = |n: u32| i32::try_from(n).unwrap_or(i32::MAX);
        let image = Image { height: side(height), width: side(width), colorspace: 3, encoded };
        Point { tag: tag.into(), worth: Some(Worth::Image(image)) }
    }
}
