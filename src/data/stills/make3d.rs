//! Make3D: 134 test pictures, upright, with a coarse grid of laser depth.
//!
//! ```text
//! ROOT/Test134/img-NAME.jpg                   1704 x 2272
//! ROOT/Gridlaserdata/depth_sph_corr-NAME.mat  Position3DGrid, 55 x 305 x 4, depth in the fourth layer
//! ```
//!
//! As in Monodepth2 (section 4.3), pictures are cropped to their central rows of ratio 2:1, and the grid to its 21 central
//! rows, 17 to 37.

use std::path::Path;

use super::{Camera, Still, Stills, Truth, files, stem};
use crate::camera::Intrinsics;
use crate::formats::picture::check_picture;
use crate::{Error, Result};

pub(super) fn is(root: &Path) -> bool {
    root.join("Test134").is_dir() && root.join("Gridlaserdata").is_dir()
}

pub(super) fn add(stills: &mut Stills, root: &Path, camera: Camera) -> Result<()> {
    let folder = root.join("Test134");
    for picture in files(&folder, |name| name.starts_with("img-") && name.ends_with(".jpg"))? {
        let size @ (width, height) = check_picture(&picture)?;
        if height < width / 2 || width < 2 {
            let message = format!("is {width}x{height}: expected a picture at least half as high as wide, 1704x2272");
            return Err(Error::file(&picture, message));
        }
        let mut camera = camera.resolve(root, &folder, size, None)?;
        let top = (height - width / 2) / 2;
        let (rows, full) = (f64::from(width / 2), f64::from(height));
        let k = camera.intrinsics;
        camera.intrinsics = Intrinsics { fy: k.fy * full / rows, cy: (k.cy * full - f64::from(top)) / rows, ..k };
        let frame = stem(&picture);
        let number = frame.strip_prefix("img-").unwrap_or(&frame);
        let truth = Truth::LaserGrid(root.join("Gridlaserdata").join(format!("depth_sph_corr-{number}.mat")));
        let name = format!("Test134 {frame}");
        let rows = [top, top + width / 2];
        stills.add(Still { name, picture, right: None, baseline: None, camera, rows, truth });
    }
    Ok(())
}
