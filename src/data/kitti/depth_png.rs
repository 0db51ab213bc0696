//! KITTI's depth files: 16-bit grey PNG, metres times 256, 0 where nothing is known.

use std::path::Path;

use image::DynamicImage;

use crate::data::DepthMap;
use crate::data::picture::decode;
use crate::{Error, Result};

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
}
