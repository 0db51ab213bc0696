//! The outer structure of picture files: what a decoder would pass over in silence, or trust.
//!
//! A decoder that meets the end of a JPEG in the middle fills the rest with grey, and one that is told of a block of
//! 4 GB takes memory for it. Neither needs decoding to be seen; what a JPEG's scans lack, [`jpeg_scans`] counts.

use super::jpeg_scans;

/// Why a file should not be decoded: words to go on with after the file's name.
pub(super) type Fault = &'static str;

const CUT_SHORT: Fault = "is cut short: its end is missing. Copy or download it again";

const SCAN_CUT_SHORT: Fault =
    "is cut short: it has an end, but not all of the picture stands before it. Copy or download it again";

/// Looks at the structure of a JPEG, PNG or WebP; nothing of a file of another kind.
pub(super) fn check(bytes: &[u8]) -> Result<(), Fault> {
    if bytes.starts_with(b"\xff\xd8") {
        check_jpeg(bytes)?;
        if jpeg_scans::end_early(bytes) { Err(SCAN_CUT_SHORT) } else { Ok(()) }
    } else if bytes.starts_with(b"\x89PNG\r\n\x1a\n") {
        check_png(bytes)
    } else if bytes.starts_with(b"RIFF") && bytes.get(8..12) == Some(b"WEBP") {
        check_webp(bytes)
    } else {
        Ok(())
    }
}

fn check_jpeg(bytes: &[u8]) -> Result<(), Fault> {
    let mut at = 2;
    let mut scans = 0;
    while let Some(found) = bytes.get(at..).and_then(|rest| rest.iter().position(|&b| b == 0xff)) {
        let Some(&marker) = bytes.get(at + found + 1) else { break };
        at += found + 1;
        match marker {
            // A stuffed byte of a scan, padding, or a marker without a segment.
            0x00 | 0x01 | 0xd0..=0xd7 => at += 1,
            0xff => {}
            0xd9 if scans > 0 => return Ok(()),
            0xd9 => return Err("holds no picture: it ends before its first scan"),
            _ => {
                let Some(&[high, low]) = bytes.get(at + 1..at + 3) else { break };
                let length = usize::from(u16::from_be_bytes([high, low]));
                let Some(segment) = bytes.get(at + 3..at + 1 + length) else { break };
                match marker {
                    0xc0..=0xc3 | 0xc5..=0xc7 | 0xc9..=0xcb | 0xcd..=0xcf => check_sampling(segment)?,
                    0xda => scans += 1,
                    _ => {}
                }
                at += 1 + length;
            }
        }
    }
    Err(CUT_SHORT)
}

/// A frame header's sampling factors: the first component (brightness) has to be sampled most finely.
fn check_sampling(frame: &[u8]) -> Result<(), Fault> {
    let components = frame.get(6..).unwrap_or_default().chunks_exact(3).map(|c| (c[1] >> 4, c[1] & 15));
    let finest = components.clone().fold((0, 0), |(h, v), (ch, cv)| (h.max(ch), v.max(cv)));
    match components.clone().next() {
        Some(first) if components.len() > 1 && first != finest => {
            Err("samples brightness more coarsely than colour, which cannot be decoded here; convert it")
        }
        _ => Ok(()),
    }
}

fn check_png(bytes: &[u8]) -> Result<(), Fault> {
    let mut at = 8;
    while let Some(&[a, b, c, d]) = bytes.get(at..at + 4) {
        let Some(kind) = bytes.get(at + 4..at + 8) else { break };
        if kind == b"IEND" {
            return Ok(());
        }
        // Length, kind, data, checksum.
        at = at.saturating_add(u32::from_be_bytes([a, b, c, d]) as usize).saturating_add(12);
    }
    Err(CUT_SHORT)
}

/// How many bytes [`png_size`] looks at: the signature and the first chunk.
pub(super) const PNG_HEADER: u64 = 33;

/// Width and height of a PNG by its header, if that is whole.
pub(super) fn png_size(bytes: &[u8]) -> Option<(u32, u32)> {
    let chunk = bytes.strip_prefix(b"\x89PNG\r\n\x1a\n\0\0\0\x0d")?;
    let number = |at: usize| Some(u32::from_be_bytes(*chunk.get(at..)?.first_chunk()?));
    let header = chunk.get(..17).filter(|header| header.starts_with(b"IHDR"))?;
    (number(17)? == crc32fast::hash(header)).then_some((number(4)?, number(8)?))
}

fn check_webp(bytes: &[u8]) -> Result<(), Fault> {
    let number = |at: usize| Some(u32::from_le_bytes(*bytes.get(at..)?.first_chunk()?) as usize);
    let end = number(4).unwrap_or(0).saturating_add(8);
    if end > bytes.len() {
        return Err(CUT_SHORT);
    }
    let mut at = 12;
    while at < end {
        let length = number(at + 4).unwrap_or(usize::MAX);
        at = at.saturating_add(8).saturating_add(length).saturating_add(length % 2);
        // The byte that makes an odd length even may be missing at the end.
        if at > end + 1 {
            return Err("is cut short, or claims a block that is longer than the file. Copy or download it again");
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_that_ends_early_is_seen_to() {
        use image::ImageFormat::{Jpeg, Png, WebP};
        let picture = image::DynamicImage::from(image::RgbImage::from_fn(40, 30, |x, y| {
            image::Rgb([(6 * x) as u8, (8 * y) as u8, (x * y) as u8])
        }));
        for format in [Jpeg, Png, WebP] {
            let mut bytes = std::io::Cursor::new(Vec::new());
            picture.write_to(&mut bytes, format).unwrap();
            let bytes = bytes.into_inner();
            assert_eq!(check(&bytes), Ok(()), "{format:?}");
            let more = [&bytes[..], b"what a camera adds"].concat();
            assert_eq!(check(&more), Ok(()), "{format:?} with more behind it");
            for share in [0.3, 0.6, 0.9, 0.99] {
                let cut = &bytes[..(bytes.len() as f64 * share) as usize];
                assert!(check(cut).is_err_and(|fault| fault.contains("cut short")), "{format:?} cut at {share}");
                if format == Jpeg && (0.5..0.95).contains(&share) {
                    let ended = [cut, b"\xff\xd9"].concat();
                    assert_eq!(check(&ended), Err(SCAN_CUT_SHORT), "with an end, cut at {share}");
                }
            }
        }
    }

    #[test]
    fn coarse_brightness_is_refused_and_other_sampling_is_not() {
        let frame = |factors: &[u8]| {
            let mut frame = vec![8, 0, 1, 0, 1, factors.len() as u8];
            factors.iter().enumerate().for_each(|(i, &f)| frame.extend([i as u8, f, 0]));
            frame
        };
        for good in
            [&[0x22, 0x11, 0x11][..], &[0x11, 0x11, 0x11], &[0x21, 0x11, 0x11], &[0x22], &[0x22, 0x11, 0x11, 0x22]]
        {
            assert_eq!(check_sampling(&frame(good)), Ok(()), "{good:x?}");
        }
        for bad in [&[0x11, 0x22, 0x22][..], &[0x12, 0x21, 0x11], &[0x11, 0x11, 0x21]] {
            assert!(check_sampling(&frame(bad)).is_err(), "{bad:x?}");
        }
    }
}
