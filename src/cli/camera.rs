//! The flags that say which camera took a folder's pictures.

use parallax::data::camera::Camera;

#[derive(clap::Args)]
pub struct CameraArgs {
    /// Horizontal field of view, in degrees, of the camera that took a folder's pictures [default: from camera.toml
    /// among the data (width, height, fx, fy, cx, cy in pixels, or fov), or else from the calibration].
    #[arg(long, value_name = "DEGREES", conflicts_with_all = ["intrinsics", "camera"])]
    pub fov: Option<f64>,
    /// Focal lengths and principal point of that camera, in pixels of the pictures as they are stored [default: as for
    /// --fov].
    #[arg(long, value_name = "FX,FY,CX,CY", value_parser = super::pinhole, conflicts_with = "camera")]
    pub intrinsics: Option<[f64; 4]>,
    /// A camera by name: KITTI's published constants (fx 0.58, fy 1.92 of the size) whatever the data say, or the
    /// calibration and nothing else [default: as for --fov].
    #[arg(long, value_name = "kitti-published|calibrated")]
    pub camera: Option<NamedCamera>,
}

/// Cameras that are called by a name.
#[derive(Clone, Copy, clap::ValueEnum)]
pub enum NamedCamera {
    KittiPublished,
    Calibrated,
}

impl CameraArgs {
    /// The camera that the flags name, or `otherwise`.
    pub fn or(&self, otherwise: Camera) -> Camera {
        match (self.intrinsics, self.fov, self.camera) {
            (Some([fx, fy, cx, cy]), ..) => Camera::Pixels { fx, fy, cx, cy },
            (None, Some(degrees), _) => Camera::Fov { degrees },
            (None, None, Some(NamedCamera::KittiPublished)) => Camera::KittiPublished,
            (None, None, Some(NamedCamera::Calibrated)) => Camera::Calibrated,
            (None, None, None) => otherwise,
        }
    }
}
