//! Depth as KITTI stores it: a 16-bit grey PNG of metres times 256, 0 where nothing is known.

use std::io::{self, Write};
use std::path::Path;

use image::codecs::png::PngEncoder;
use image::{DynamicImage, ExtendedColorType, ImageEncoder};

use super::atomic::write_atomically;
use crate::depth::DepthMap;
use crate::formats::picture::decode;
use crate::{Error, Result};

/// Metres in 16 bits: `round(256 * metres)`; 0 (unknown) for what is not a positive finite number. A known depth
/// never rounds to 0, and one beyond 255.996 m takes the largest value.
pub fn encode_depth(metres: f32) -> u16 {
    if metres > 0.0 && metres.is_finite() { (metres * 256.0).round().clamp(1.0, 65535.0) as u16 } else { 0 }
}

/// Writes a depth map as a 16-bit PNG of metres times 256, whole or not at all.
///
/// # Errors
/// If the map is empty or does not hold `height * width` depths, or the file cannot be written.
pub fn write_depth_png(path: impl AsRef<Path>, depth: &DepthMap) -> Result<()> {
    let path = path.as_ref();
    let (width, height) = (depth.width, depth.height);
    if depth.metres.is_empty() || depth.metres.len() != width * height {
        let found = depth.metres.len();
        return Err(Error::file(path, format!("a depth map of {width}x{height} has {found} depths")));
    }
    let bytes: Vec<u8> = depth.metres.iter().flat_map(|&m| encode_depth(m).to_ne_bytes()).collect();
    write_atomically(path, |writer| {
        PngEncoder::new(writer as &mut dyn Write)
            .write_image(&bytes, width as u32, height as u32, ExtendedColorType::L16)
            .map_err(io::Error::other)
    })
}

/// Reads a depth map in metres from a 16-bit grey PNG.
pub fn read_depth_png(path: &Path) -> Result<DepthMap> {
    match decode(path)? {
        DynamicImage::ImageLuma16(image) => Ok(DepthMap {
            width: image.width() as usize,
            height: image.height() as usize,
            metres: image.as_raw().iter().map(|&v| f32::from(v) / 256.0).collect(),
        }),
        other => {
            let message = format!(
                "expected depth as a 16-bit grey PNG (metres times 256, 0 for none), found {:?}",
                other.color()
            );
            Err(Error::file(path, message))
        }
    }
}

#[cfg(test)]
mod tests {
    use image::{ImageBuffer, Luma};

    use super::*;

    #[test]
    fn reads_metres_and_refuses_other_pictures() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("depth.png");
        ImageBuffer::<Luma<u16>, _>::from_raw(3, 1, vec![0u16, 256, 20544]).unwrap().save(&path).unwrap();
        let depth = read_depth_png(&path).unwrap();
        assert_eq!(depth, DepthMap { width: 3, height: 1, metres: vec![0.0, 1.0, 80.25] });
        ImageBuffer::<Luma<u8>, _>::from_raw(3, 1, vec![0u8, 1, 2]).unwrap().save(&path).unwrap();
        let error = read_depth_png(&path).unwrap_err().to_string();
        assert!(error.contains("depth.png") && error.contains("16-bit"), "{error}");
    }

    #[test]
    fn encodes_metres_times_256() {
        assert_eq!(encode_depth(0.0), 0);
        assert_eq!(encode_depth(-1.0), 0);
        assert_eq!(encode_depth(f32::NAN), 0);
        assert_eq!(encode_depth(f32::INFINITY), 0);
        assert_eq!(encode_depth(1.0), 256);
        assert_eq!(encode_depth(0.0001), 1);
        assert_eq!(encode_depth(80.25), 20544);
        assert_eq!(encode_depth(300.0), 65535);
    }

    #[test]
    fn what_was_written_reads_back_to_half_a_step() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("depth.png");
        let metres: Vec<f32> = (0..35).map(|i| i as f32 * 2.3).collect();
        let depth = DepthMap { width: 7, height: 5, metres };
        write_depth_png(&path, &depth).unwrap();
        let read = read_depth_png(&path).unwrap();
        assert_eq!((read.width, read.height), (7, 5));
        assert_eq!(read.metres[0], 0.0);
        for (a, b) in read.metres.iter().zip(&depth.metres) {
            assert!((a - b).abs() <= 0.5 / 256.0, "{a} {b}");
        }
    }

    #[test]
    fn a_map_of_the_wrong_size_is_refused() {
        let depth = DepthMap { width: 7, height: 5, metres: vec![1.0; 3] };
        let error = write_depth_png("/nowhere/depth.png", &depth).unwrap_err().to_string();
        assert!(error.contains("7x5") && error.contains('3'), "{error}");
    }
}
