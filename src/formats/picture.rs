//! Pictures from files (PNG, JPEG, WebP): headers checked before anything is decoded, sizes bounded, turned as their
//! EXIF orientation says, messages with the path.

use std::cell::Cell;
use std::fs::File;
use std::io::{BufReader, Cursor, Read, Seek};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::Once;

use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageError, ImageReader, Limits, RgbImage};

pub use super::bounded::MAX_PIXELS;
use super::exif::Exif;
use super::picture_structure as structure;
use super::source::Source;
use crate::{Error, Result};

/// Files with more bytes are not read: no picture of [`MAX_PIXELS`] needs so many.
pub const MAX_BYTES: u64 = 1 << 30;

/// A header lies within so many bytes, nearly always.
const HEAD: u64 = 64 << 10;

/// What may stand in front of a header: a colour profile, previews.
const MAX_PREFACE: u64 = 32 << 20;

/// Whether a picture may be so large: whole pixels, at least one each way, at most [`MAX_PIXELS`].
pub fn is_size(width: f64, height: f64) -> bool {
    let whole = |n: f64| n >= 1.0 && n.fract() == 0.0;
    whole(width) && whole(height) && width * height <= MAX_PIXELS as f64
}

/// Reads the header alone: width and height as they are stored, before any orientation is applied.
///
/// # Errors
/// If the file is missing, is no PNG, JPEG or WebP, is empty, or has more than 100 megapixels or a gigabyte.
pub fn check_picture(path: &Path) -> Result<(u32, u32)> {
    let file = open(path)?;
    let mut head = Vec::new();
    (&file).take(HEAD).read_to_end(&mut head).map_err(|e| Error::io(path, e))?;
    let dimensions = match dimensions(&mut Cursor::new(&head)) {
        Err(_) if head.len() as u64 == HEAD => {
            let mut reader = BufReader::new(&file);
            reader.rewind().map_err(|e| Error::io(path, e))?;
            match head.starts_with(b"\xff\xd8") {
                // A header behind a long preface: read on.
                true => {
                    head.clear();
                    reader.take(MAX_PREFACE).read_to_end(&mut head).map_err(|e| Error::io(path, e))?;
                    dimensions(&mut Cursor::new(&head))
                }
                // A WebP's blocks are passed over, not read.
                false => dimensions(&mut reader),
            }
        }
        result => result,
    };
    check_size(path, dimensions.map_err(|e| undecodable(path, &e))?)
}

/// Opens a file that is not too large to be a picture.
fn open(path: &Path) -> Result<File> {
    let file = File::open(path).map_err(|e| Error::io(path, e))?;
    let bytes = file.metadata().map_err(|e| Error::io(path, e))?.len();
    if bytes > MAX_BYTES {
        return Err(Error::file(path, format!("{bytes} bytes: pictures above 1 GiB are refused; make it smaller")));
    }
    Ok(file)
}

/// Width and height by the header. Of a PNG nothing else is looked at: its decoder would unpack a colour profile first,
/// whatever that comes to.
fn dimensions(mut file: &mut dyn Source) -> Result<(u32, u32), Undecodable> {
    fenced(|| {
        let mut start = Vec::new();
        (&mut file).take(structure::PNG_HEADER).read_to_end(&mut start)?;
        if let Some(size) = structure::png_size(&start) {
            return Ok(size);
        }
        file.rewind()?;
        ImageReader::new(file).with_guessed_format()?.into_dimensions()
    })
}

/// Why a decoder gave up.
enum Undecodable {
    /// It says why.
    Said(ImageError),
    /// It met something that its authors did not think of.
    Panicked,
}

thread_local! {
    /// Whether panics of this thread are somebody else's: caught, and reported as errors.
    static FENCED: Cell<bool> = const { Cell::new(false) };
}

/// Runs a decoder, whose panics become errors and print nothing.
fn fenced<T>(decode: impl FnOnce() -> Result<T, ImageError>) -> Result<T, Undecodable> {
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let usual = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            if !FENCED.get() {
                usual(info);
            }
        }));
    });
    FENCED.set(true);
    // What a decoder leaves half done is dropped with it.
    let result = catch_unwind(AssertUnwindSafe(decode));
    FENCED.set(false);
    match result {
        Ok(result) => result.map_err(Undecodable::Said),
        Err(_) => Err(Undecodable::Panicked),
    }
}

fn check_size(path: &Path, (width, height): (u32, u32)) -> Result<(u32, u32)> {
    if width == 0 || height == 0 {
        return Err(Error::file(path, "the picture is empty"));
    }
    if u64::from(width) * u64::from(height) > MAX_PIXELS {
        let message = format!("{width}x{height} pixels: pictures above 100 megapixels are refused; make it smaller");
        return Err(Error::file(path, message));
    }
    Ok((width, height))
}

fn undecodable(path: &Path, error: &Undecodable) -> Error {
    let why = match error {
        Undecodable::Said(error) => error.to_string(),
        Undecodable::Panicked => "the decoder failed on what is in it".to_owned(),
    };
    let message = format!("expected a PNG, JPEG or WebP picture, could not decode it ({why}); convert or restore it");
    Error::file(path, message)
}

/// Decodes a PNG, JPEG or WebP, whatever its name ends in, with its own channels and bits, turned and mirrored as its
/// EXIF orientation says. Of an animation the first frame.
///
/// # Errors
/// As [`check_picture`], if the file ends early, or if the pixels cannot be decoded.
pub fn decode(path: &Path) -> Result<DynamicImage> {
    decode_with_lens(path).map(|(picture, _)| picture)
}

/// [`decode`], and the focal length in pixels of the picture, where its EXIF data tell it.
fn decode_with_lens(path: &Path) -> Result<(DynamicImage, Option<f64>)> {
    let mut bytes = Vec::new();
    open(path)?.take(MAX_BYTES).read_to_end(&mut bytes).map_err(|e| Error::io(path, e))?;
    decode_bytes(path, &bytes)
}

/// Decodes the bytes of a picture's file; `path` is what messages call it.
fn decode_bytes(path: &Path, bytes: &[u8]) -> Result<(DynamicImage, Option<f64>)> {
    let size = dimensions(&mut Cursor::new(bytes)).map_err(|e| undecodable(path, &e))?;
    let (width, height) = check_size(path, size)?;
    structure::check(bytes).map_err(|fault| Error::file(path, fault))?;
    fenced(|| {
        let mut source = Cursor::new(bytes);
        let mut reader = ImageReader::new(&mut source as &mut dyn Source).with_guessed_format()?;
        // Pixels have at most eight bytes; what lies beside them (colour profiles, texts) gets no more than that again.
        let mut limits = Limits::default();
        limits.max_alloc = Some(16 * u64::from(width) * u64::from(height) + (32 << 20));
        reader.limits(limits);
        let mut decoder = reader.into_decoder()?;
        // Metadata that cannot be read is no reason to refuse a picture.
        let exif = decoder.exif_metadata().ok().flatten();
        let exif = exif.map(|raw| Exif::parse(&raw)).unwrap_or_default();
        let orientation = exif.orientation.and_then(Orientation::from_exif);
        let mut picture = DynamicImage::from_decoder(decoder)?;
        let focal = exif.focal(f64::from(width), f64::from(height));
        picture.apply_orientation(orientation.unwrap_or(Orientation::NoTransforms));
        Ok((picture, focal))
    })
    .map_err(|e| undecodable(path, &e))
}

/// [`decode`] as 8-bit RGB: grey in all three channels, 16 bits rounded to 8, alpha left out, CMYK as its inks look.
pub fn read_picture(path: &Path) -> Result<RgbImage> {
    decode(path).map(DynamicImage::into_rgb8)
}

/// [`read_picture`], and the focal length in pixels of the picture, where its [EXIF data](super::exif) tell it.
pub fn read_picture_with_lens(path: &Path) -> Result<(RgbImage, Option<f64>)> {
    decode_with_lens(path).map(|(picture, focal)| (picture.into_rgb8(), focal))
}

/// [`read_picture_with_lens`] of a file that is in memory; messages call it `name`.
///
/// # Errors
/// As [`read_picture`].
pub fn picture_of_bytes(name: &Path, bytes: &[u8]) -> Result<(RgbImage, Option<f64>)> {
    decode_bytes(name, bytes).map(|(picture, focal)| (picture.into_rgb8(), focal))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    /// A PNG's signature and header chunk with any size, followed by nothing.
    fn png_header(width: u32, height: u32) -> Vec<u8> {
        let mut chunk = b"IHDR".to_vec();
        chunk.extend(width.to_be_bytes());
        chunk.extend(height.to_be_bytes());
        chunk.extend([8, 2, 0, 0, 0]);
        let mut crc = u32::MAX;
        for &byte in &chunk {
            crc ^= u32::from(byte);
            for _ in 0..8 {
                crc = if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 };
            }
        }
        let mut bytes = b"\x89PNG\r\n\x1a\n\0\0\0\x0d".to_vec();
        bytes.extend(chunk);
        bytes.extend((!crc).to_be_bytes());
        // The start of the pixels: all that a header's reader looks for.
        bytes.extend(b"\0\0\x10\0IDAT");
        bytes
    }

    #[test]
    fn headers_are_read_without_the_pixels() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        fs::write(&path, png_header(1242, 375)).unwrap();
        assert_eq!(check_picture(&path).unwrap(), (1242, 375));
        let error = read_picture(&path).unwrap_err().to_string();
        assert!(error.contains("a.png") && error.contains("cut short"), "{error}");
    }

    #[test]
    fn more_than_a_hundred_megapixels_are_refused_before_decoding() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("huge.png");
        fs::write(&path, png_header(20_000, 5_001)).unwrap();
        for error in [check_picture(&path).unwrap_err(), read_picture(&path).unwrap_err()] {
            let error = error.to_string();
            assert!(error.contains("huge.png") && error.contains("20000x5001"), "{error}");
        }
    }

    #[test]
    fn a_size_is_whole_pixels_and_not_too_many() {
        assert!(is_size(1.0, 1.0) && is_size(10_000.0, 10_000.0) && is_size(1e8, 1.0));
        for (width, height) in
            [(0.0, 5.0), (-3.0, -3.0), (2.5, 2.0), (16384.0, 16384.0), (f64::NAN, 1.0), (1e300, 1e300)]
        {
            assert!(!is_size(width, height), "{width}x{height}");
        }
    }

    /// The chunks of a PNG: kind and data.
    fn chunks(png: &[u8]) -> Vec<(&[u8], &[u8])> {
        let (mut rest, mut found) = (&png[8..], Vec::new());
        while let Some(length) = rest.first_chunk() {
            let length = u32::from_be_bytes(*length) as usize;
            found.push((&rest[4..8], &rest[8..8 + length]));
            rest = &rest[12 + length..];
        }
        found
    }

    fn chunk(kind: &[u8], data: &[u8]) -> Vec<u8> {
        let checked = [kind, data].concat();
        [&(data.len() as u32).to_be_bytes()[..], &checked, &crc32fast::hash(&checked).to_be_bytes()].concat()
    }

    #[test]
    fn a_png_with_an_enormous_colour_profile_is_read_without_it() {
        // The pixels of a large black picture are 40 MiB of nothing, packed small.
        let nothing = encoded(&image::GrayImage::new(6400, 6400).into(), image::ImageFormat::Png);
        let packed: Vec<u8> =
            chunks(&nothing).into_iter().filter(|c| c.0 == b"IDAT").flat_map(|c| c.1.to_vec()).collect();
        assert!(packed.len() < 1_000_000, "{}", packed.len());
        let profile = chunk(b"iCCP", &[b"p\0\0", &packed[..]].concat());
        let plain = encoded(&six().into(), image::ImageFormat::Png);
        let bomb = [&plain[..33], &profile, &plain[33..]].concat();
        assert_eq!(reread("bomb.png", &bomb), six());
        // Its size is known without what stands behind the header.
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bomb.png");
        fs::write(&path, [&bomb[..33], &profile].concat()).unwrap();
        assert_eq!(check_picture(&path).unwrap(), (3, 2));
    }

    #[test]
    fn a_png_header_that_is_damaged_is_no_header() {
        let whole = png_header(30, 20);
        assert_eq!(structure::png_size(&whole), Some((30, 20)));
        for at in 12..33 {
            let mut damaged = whole.clone();
            damaged[at] ^= 4;
            assert_eq!(structure::png_size(&damaged), None, "byte {at}");
        }
        assert_eq!(structure::png_size(&whole[..32]), None);
    }

    #[test]
    fn what_is_no_picture_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("b.png");
        for bytes in [b"".as_slice(), b"not a picture", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0"] {
            fs::write(&path, bytes).unwrap();
            for error in [check_picture(&path).unwrap_err(), read_picture(&path).unwrap_err()] {
                assert!(error.to_string().contains("b.png"), "{error}");
            }
        }
        assert!(check_picture(&folder.path().join("c.png")).unwrap_err().to_string().contains("c.png"));
    }

    #[test]
    fn jpeg_and_grey_become_rgb() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.jpg");
        RgbImage::from_pixel(16, 8, image::Rgb([90, 120, 30])).save(&path).unwrap();
        assert_eq!(check_picture(&path).unwrap(), (16, 8));
        let pixel = read_picture(&path).unwrap().get_pixel(8, 4).0;
        assert!(pixel.iter().zip([90, 120, 30]).all(|(a, b)| a.abs_diff(b) < 6), "{pixel:?}");
        let path = folder.path().join("g.png");
        image::GrayImage::from_pixel(4, 4, image::Luma([77])).save(&path).unwrap();
        assert_eq!(read_picture(&path).unwrap().get_pixel(1, 1).0, [77, 77, 77]);
    }

    #[test]
    fn a_decoder_that_panics_is_an_error_and_prints_nothing() {
        let found = fenced(|| -> Result<(), ImageError> { panic!("index out of bounds") });
        assert!(matches!(found, Err(Undecodable::Panicked)));
        assert!(!FENCED.get());
        for name in ["fuzzed_465.jpg", "fuzzed_559.jpg", "coarse_brightness_scans.jpg", "coarse_brightness.jpg"] {
            let error = read_picture(&crate::test_support::fixture("pictures").join(name)).unwrap_err().to_string();
            assert!(error.contains(name), "{error}");
        }
    }

    #[test]
    fn a_jpeg_that_is_cut_is_no_picture() {
        for name in ["trunc_40.jpg", "trunc_90.jpg", "trunc_prog_60.jpg"] {
            let error = read_picture(&crate::test_support::fixture("pictures").join(name)).unwrap_err().to_string();
            assert!(error.contains(name) && error.contains("cut short"), "{error}");
        }
    }

    /// The bytes of a picture in a format.
    fn encoded(picture: &DynamicImage, format: image::ImageFormat) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        picture.write_to(&mut bytes, format).unwrap();
        bytes.into_inner()
    }

    fn reread(name: &str, bytes: &[u8]) -> RgbImage {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        fs::write(&path, bytes).unwrap();
        read_picture(&path).unwrap()
    }

    /// 3x2, every pixel another: no turn and no mirror maps it onto itself.
    fn six() -> RgbImage {
        RgbImage::from_fn(3, 2, |x, y| image::Rgb([40 * x as u8, 90 * y as u8, 10]))
    }

    #[test]
    fn every_kind_of_png_becomes_8_bit_rgb() {
        let plain = DynamicImage::from(six());
        let grey = RgbImage::from_fn(3, 2, |x, y| image::Rgb([plain.to_luma8().get_pixel(x, y)[0]; 3]));
        for (kind, picture, expected) in [
            ("rgb16", DynamicImage::from(plain.to_rgb16()), six()),
            ("rgba8", DynamicImage::from(plain.to_rgba8()), six()),
            ("rgba16", DynamicImage::from(plain.to_rgba16()), six()),
            ("grey8", DynamicImage::from(plain.to_luma8()), grey.clone()),
            ("grey16", DynamicImage::from(plain.to_luma8()).to_luma16().into(), grey.clone()),
            ("grey with alpha", DynamicImage::from(plain.to_luma8()).to_luma_alpha8().into(), grey),
        ] {
            assert_eq!(reread("a.png", &encoded(&picture, image::ImageFormat::Png)), expected, "{kind}");
        }
        // What is transparent keeps its colour.
        let mut clear = plain.to_rgba8();
        clear.pixels_mut().for_each(|p| p[3] = 0);
        assert_eq!(reread("a.png", &encoded(&clear.into(), image::ImageFormat::Png)), six());
    }

    #[test]
    fn webp_is_read_whatever_its_name() {
        let bytes = encoded(&six().into(), image::ImageFormat::WebP);
        assert_eq!(reread("a.webp", &bytes), six());
        assert_eq!(reread("misnamed.png", &bytes), six());
    }

    #[test]
    fn exif_orientation_of_a_webp_is_applied() {
        use image::ImageEncoder;
        let mut bytes = Vec::new();
        let mut encoder = image::codecs::webp::WebPEncoder::new_lossless(&mut bytes);
        // Little-endian TIFF with one entry: orientation (0x112), one short: 6, a quarter turn clockwise.
        let exif = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0";
        encoder.set_exif_metadata(exif.to_vec()).unwrap();
        encoder.write_image(six().as_raw(), 3, 2, image::ExtendedColorType::Rgb8).unwrap();
        assert_eq!(reread("a.webp", &bytes), image::imageops::rotate90(&six()));
    }

    /// A baseline JPEG of one block of a single colour in four channels, as Adobe's programs write CMYK: 255 is no ink.
    fn cmyk_jpeg(inks: [u8; 4]) -> Vec<u8> {
        let mut bytes = b"\xff\xd8\xff\xee\0\x0eAdobe\0\x64\0\0\0\0\0".to_vec();
        // Quantisation by 8: the mean of a block is its first coefficient.
        bytes.extend(b"\xff\xdb\0\x43\0");
        bytes.extend([8; 64]);
        bytes.extend(b"\xff\xc0\0\x14\x08\0\x08\0\x08\x04");
        (1..=4).for_each(|channel| bytes.extend([channel, 0x11, 0]));
        // Means: nine lengths, of four bits each. The rest of a block: its end alone, in one bit.
        bytes.extend(b"\xff\xc4\0\x1c\0\0\0\0\x09\0\0\0\0\0\0\0\0\0\0\0\0\0\x01\x02\x03\x04\x05\x06\x07\x08");
        bytes.extend(b"\xff\xc4\0\x14\x10\x01\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0");
        bytes.extend(b"\xff\xda\0\x0e\x04\x01\0\x02\0\x03\0\x04\0\0\x3f\0");
        let mut bits = String::new();
        for ink in inks {
            let mean = i32::from(ink) - 128;
            let length = (32 - mean.unsigned_abs().leading_zeros()) as usize;
            let coded = if mean < 0 { mean + (1 << length) - 1 } else { mean };
            bits += &format!("{length:04b}");
            if length > 0 {
                bits += &format!("{coded:0length$b}");
            }
            bits += "0";
        }
        while !bits.len().is_multiple_of(8) {
            bits += "1";
        }
        for byte in bits.as_bytes().chunks(8) {
            let byte = u8::from_str_radix(std::str::from_utf8(byte).unwrap(), 2).unwrap();
            bytes.push(byte);
            if byte == 0xff {
                bytes.push(0);
            }
        }
        bytes.extend(b"\xff\xd9");
        bytes
    }

    #[test]
    fn cmyk_looks_as_its_inks_do() {
        for (inks, looks) in [([200, 100, 50, 255], [200, 100, 50]), ([200, 100, 50, 128], [100, 50, 25])] {
            let pixel = reread("a.jpg", &cmyk_jpeg(inks)).get_pixel(4, 4).0;
            assert!(pixel.iter().zip(looks).all(|(a, b)| a.abs_diff(b) < 3), "{inks:?}: {pixel:?}");
        }
    }

    #[test]
    fn a_format_of_another_kind_is_refused_with_advice() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.gif");
        fs::write(&path, b"GIF89a\x01\0\x01\0\0\0\0;").unwrap();
        let error = read_picture(&path).unwrap_err().to_string();
        assert!(error.contains("a.gif") && error.contains("Gif") && error.contains("convert"), "{error}");
    }

    #[test]
    fn a_file_of_gigabytes_is_not_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("huge.png");
        // A hole: it takes no room on the disk.
        File::create(&path).unwrap().set_len(MAX_BYTES + 1).unwrap();
        for error in [check_picture(&path).unwrap_err(), read_picture(&path).unwrap_err()] {
            assert!(error.to_string().contains("1 GiB"), "{error}");
        }
    }
}
