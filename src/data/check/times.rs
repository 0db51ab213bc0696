//! The times of frames: `timestamps.txt` of KITTI raw (`2011-09-26 13:02:25.951199337`), `times.txt` of its odometry data
//! (seconds), a line a frame.

use std::path::{Path, PathBuf};

use super::survey::number;
use crate::formats::bounded::read_text;
use crate::{Error, Result};

/// A million frames have fewer bytes.
const MAX_TIMES: u64 = 64 << 20;

/// Days from 1 March of the year 0 to the beginning of 1970.
const EPOCH: i64 = 719_468;

/// The times of a folder's pictures in seconds, if a file beside them or one folder above says them. A picture whose name
/// is a number has the line of that number (from 0), others the line of their place.
///
/// # Errors
/// If the file cannot be read, a line is no time, or there is no line for a picture: names the file and the line.
pub(super) fn of_frames(folder: &Path, pictures: &[PathBuf]) -> Result<Option<Vec<f64>>> {
    let places = [Some(folder), folder.parent()];
    let files = places.iter().flatten().flat_map(|place| ["timestamps.txt", "times.txt"].map(|name| place.join(name)));
    let Some(file) = files.into_iter().find(|file| file.is_file()) else { return Ok(None) };
    let text = read_text(&file, MAX_TIMES, "a list of times")?;
    let mut lines = Vec::new();
    for (i, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let time = seconds(line.trim()).ok_or_else(|| {
            let message = format!(
                "line {}: expected seconds, or a time like 2011-09-26 13:02:25.951199337, found {:?}",
                i + 1,
                line.trim()
            );
            Error::file(&file, message)
        })?;
        lines.push(time);
    }
    let numbered = |picture: &PathBuf| {
        let stem = picture.file_stem()?.to_str()?;
        stem.bytes().all(|b| b.is_ascii_digit()).then(|| number(picture)).flatten()
    };
    let numbers: Option<Vec<f64>> = pictures.iter().map(numbered).collect();
    let time = |(place, picture): (usize, &PathBuf)| {
        let line = numbers.as_ref().map_or(place, |numbers| numbers[place] as usize);
        lines.get(line).copied().ok_or_else(|| {
            let name = picture.file_name().unwrap_or_default().to_string_lossy();
            Error::file(&file, format!("has {} lines, and none for {name}: expected a line a frame", lines.len()))
        })
    };
    pictures.iter().enumerate().map(time).collect::<Result<Vec<f64>>>().map(Some)
}

/// A number of seconds, or a date and a time, in seconds.
fn seconds(text: &str) -> Option<f64> {
    if let Ok(seconds) = text.parse::<f64>() {
        return Some(seconds).filter(|seconds| seconds.is_finite());
    }
    let (date, time) = text.split_once([' ', 'T'])?;
    let whole = |text: &str, range: std::ops::RangeInclusive<i64>| text.parse().ok().filter(|n| range.contains(n));
    let [year, month, day] = date.split('-').collect::<Vec<_>>().try_into().ok()?;
    let days = days(whole(year, 1900..=9999)?, whole(month, 1..=12)?, whole(day, 1..=31)?);
    let [hour, minute, second] = time.split(':').collect::<Vec<_>>().try_into().ok()?;
    let minutes = 60 * whole(hour, 0..=23)? + whole(minute, 0..=59)?;
    let second = second.parse::<f64>().ok().filter(|second| (0.0..61.0).contains(second))?;
    Some((86_400 * days + 60 * minutes) as f64 + second)
}

/// Days since the beginning of 1970 (Gregorian), counted in years that begin in March, so that the leap day is the last one.
fn days(year: i64, month: i64, day: i64) -> i64 {
    let (year, month) = if month > 2 { (year, month - 3) } else { (year - 1, month + 9) };
    365 * year + year / 4 - year / 100 + year / 400 + (153 * month + 2) / 5 + day - 1 - EPOCH
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_counted_over_leap_days_and_what_is_none_is_refused() {
        assert_eq!(days(1970, 1, 1), 0);
        assert_eq!(days(2000, 3, 1) - days(2000, 2, 28), 2);
        assert_eq!(days(1900, 3, 1) - days(1900, 2, 28), 1);
        assert_eq!(days(2012, 1, 1) - days(2011, 1, 1), 365);
        assert_eq!(days(2013, 1, 1) - days(2012, 1, 1), 366);
        let step = seconds("2011-09-26 13:02:26.051").unwrap() - seconds("2011-09-26 13:02:25.951").unwrap();
        assert!((step - 0.1).abs() < 1e-4);
        assert_eq!(seconds("1.5e-1"), Some(0.15));
        for bad in ["", "noon", "nan", "2011-13-01 00:00:00", "2011-09-26", "2011-09-26 13:02", "2011-09-26 25:00:00"] {
            assert_eq!(seconds(bad), None, "{bad}");
        }
    }
}
