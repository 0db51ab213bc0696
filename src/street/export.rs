//! Writes a street as files: in the layout of KITTI raw, so that any reader of KITTI can take it, or as folders of frames.
//!
//! ```text
//! OUT/2011_09_26/calib_cam_to_cam.txt
//! OUT/2011_09_26/2011_09_26_drive_0000_sync/image_02/data/0000000000.png (and image_03 of a second camera)
//! OUT/2011_09_26/2011_09_26_drive_0000_sync/proj_depth/groundtruth/image_02/0000000000.png
//! OUT/2011_09_26/2011_09_26_drive_0000_sync/poses.txt
//! OUT/splits/train_files.txt
//! ```
//!
//! ```text
//! OUT/camera.toml
//! OUT/0000/000000.jpg
//! OUT/0000/depth/000000.png
//! OUT/0000/right/000000.jpg of a second camera
//! ```

use std::path::Path;
use std::{fs, io};

use image::RgbImage;
use image::codecs::jpeg::JpegEncoder;

use super::{Pose, Street, StreetConfig};
use crate::depth::DepthMap;
use crate::formats::atomic::write_atomically;
use crate::formats::depth_png::write_depth_png;
use crate::formats::png::write_png;
use crate::{Error, Result};

/// The day under which all drives are filed.
const DAY: &str = "2011_09_26";
/// Depth is clipped here, in metres: the 16-bit files hold metres times 256.
const DEEPEST: f32 = 250.0;

/// Writes the pictures (8-bit PNG), exact depth (16-bit PNG, metres times 256, 0 for the sky), camera-to-world poses
/// (`poses.txt`: the twelve numbers of `[R | C]`, a line a frame), the calibration and a split file with every frame
/// that has both neighbours. Refuses a folder that exists and is not empty.
pub fn write(street: &Street, out: &Path) -> Result<()> {
    refuse_what_is_there(out)?;
    let config = street.config();
    let day = out.join(DAY);
    folder(&day)?;
    text(&day.join("calib_cam_to_cam.txt"), &calibration(config))?;
    let mut split = String::new();
    for sequence in 0..config.sequences {
        let name = format!("{DAY}_drive_{sequence:04}_sync");
        let drive = day.join(&name);
        let (images, right) = (drive.join("image_02/data"), drive.join("image_03/data"));
        let depths = drive.join("proj_depth/groundtruth/image_02");
        folder(&images)?;
        if config.baseline != 0.0 {
            folder(&right)?;
        }
        folder(&depths)?;
        for frame in 0..config.frames {
            let file = format!("{frame:010}.png");
            write_png(images.join(&file), street.frame(sequence, frame))?;
            if let Some(image) = street.right_frame(sequence, frame) {
                write_png(right.join(&file), image)?;
            }
            write_depth_png(depths.join(&file), &clipped_depth(street, sequence, frame))?;
            if frame > 0 && frame + 1 < config.frames {
                split += &format!("{DAY}/{name} {frame} l\n");
            }
        }
        let poses: String = street.poses(sequence).iter().map(line).collect();
        text(&drive.join("poses.txt"), &poses)?;
    }
    folder(&out.join("splits"))?;
    text(&out.join("splits/train_files.txt"), &split)
}

/// Writes a folder of JPEG frames for each sequence, exact depth (as in [`write()`]) and the second camera's frames beside
/// them, and the camera in `camera.toml`. Refuses a folder that exists and is not empty.
///
/// # Errors
/// If the folder is not empty, or a file cannot be written.
pub fn write_frames(street: &Street, out: &Path) -> Result<()> {
    refuse_what_is_there(out)?;
    let config = street.config();
    folder(out)?;
    let (w, h, k) = (config.width as f64, config.height as f64, config.intrinsics);
    let (fx, fy, cx, cy) = (k.fx * w, k.fy * h, k.cx * w, k.cy * h);
    let mut camera = format!("width = {w}\nheight = {h}\nfx = {fx:?}\nfy = {fy:?}\ncx = {cx:?}\ncy = {cy:?}\n");
    if config.baseline != 0.0 {
        camera += &format!("baseline = {:?}\n", config.baseline);
    }
    text(&out.join("camera.toml"), &camera)?;
    for sequence in 0..config.sequences {
        let frames = out.join(format!("{sequence:04}"));
        folder(&frames.join("depth"))?;
        if config.baseline != 0.0 {
            folder(&frames.join("right"))?;
        }
        for frame in 0..config.frames {
            write_jpeg(&frames.join(format!("{frame:06}.jpg")), street.frame(sequence, frame))?;
            if let Some(picture) = street.right_frame(sequence, frame) {
                write_jpeg(&frames.join(format!("right/{frame:06}.jpg")), picture)?;
            }
            let depth = clipped_depth(street, sequence, frame);
            write_depth_png(frames.join(format!("depth/{frame:06}.png")), &depth)?;
        }
    }
    Ok(())
}

fn write_jpeg(path: &Path, picture: &RgbImage) -> Result<()> {
    write_atomically(path, |file| {
        JpegEncoder::new_with_quality(file, JPEG_QUALITY).encode_image(picture).map_err(io::Error::other)
    })
}

/// Quality of JPEG frames, of 100: as cameras store them.
const JPEG_QUALITY: u8 = 92;

fn refuse_what_is_there(out: &Path) -> Result<()> {
    match fs::read_dir(out).is_ok_and(|mut entries| entries.next().is_some()) {
        true => {
            Err(Error::file(out, "the folder is not empty; give a new one, or empty it first: nothing was written"))
        }
        false => Ok(()),
    }
}

/// The depth of a frame, as far as a depth PNG holds it.
fn clipped_depth(street: &Street, sequence: usize, frame: usize) -> DepthMap {
    let mut depth = street.frame_depth(sequence, frame);
    depth.metres.iter_mut().for_each(|z| *z = z.min(DEEPEST));
    depth
}

fn folder(path: &Path) -> Result<()> {
    fs::create_dir_all(path).map_err(|e| Error::io(path, e))
}

fn text(path: &Path, content: &str) -> Result<()> {
    fs::write(path, content).map_err(|e| Error::io(path, e))
}

/// A pose as twelve numbers that read back exactly.
fn line(pose: &Pose) -> String {
    let numbers: Vec<String> = pose.matrix().iter().flatten().map(|x| format!("{x:?}")).collect();
    numbers.join(" ") + "\n"
}

/// The entries of KITTI's calibration that readers use, for the colour cameras that there are.
fn calibration(config: &StreetConfig) -> String {
    let left = camera(config, "02", 0.0);
    let right = if config.baseline == 0.0 { String::new() } else { camera(config, "03", config.baseline) };
    format!(
        "calib_time: 26-Sep-2011 00:00:00\n\
         corner_dist: 1.000000e+00\n\
         R_rect_00: 1.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 1.0\n\
         {left}{right}"
    )
}

/// Those of one camera, `beside` metres to the right of the first.
fn camera(config: &StreetConfig, number: &str, beside: f64) -> String {
    let (w, h, k) = (config.width as f64, config.height as f64, config.intrinsics);
    let (fx, fy, cx, cy) = (k.fx * w, k.fy * h, k.cx * w, k.cy * h);
    let (away, shift) = (0.0 - beside, 0.0 - fx * beside);
    format!(
        "S_{number}: {w:?} {h:?}\n\
         K_{number}: {fx:?} 0.0 {cx:?} 0.0 {fy:?} {cy:?} 0.0 0.0 1.0\n\
         D_{number}: 0.0 0.0 0.0 0.0 0.0\n\
         R_{number}: 1.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 1.0\n\
         T_{number}: {away:?} 0.0 0.0\n\
         S_rect_{number}: {w:?} {h:?}\n\
         R_rect_{number}: 1.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 1.0\n\
         P_rect_{number}: {fx:?} 0.0 {cx:?} {shift:?} 0.0 {fy:?} {cy:?} 0.0 0.0 0.0 1.0 0.0\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::DataSource;

    #[test]
    fn files_say_what_was_rendered_and_nothing_is_overwritten() {
        let config = StreetConfig { height: 24, width: 64, sequences: 2, frames: 4, ..StreetConfig::default() };
        let street = Street::render(&config, None);
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("street");
        write(&street, &out).unwrap();

        let split = fs::read_to_string(out.join("splits/train_files.txt")).unwrap();
        assert_eq!(split.lines().count(), street.len());
        assert_eq!(split.lines().nth(3), Some("2011_09_26/2011_09_26_drive_0001_sync 2 l"));

        let drive = out.join("2011_09_26/2011_09_26_drive_0001_sync");
        let image = image::open(drive.join("image_02/data/0000000003.png")).unwrap().into_rgb8();
        assert_eq!(&image, street.frame(1, 3).as_ref());
        let raw = image::open(drive.join("proj_depth/groundtruth/image_02/0000000003.png")).unwrap().into_luma16();
        let depth = street.frame_depth(1, 3);
        for (&raw, &z) in raw.as_raw().iter().zip(&depth.metres) {
            assert!((raw as f32 / 256.0 - z).abs() <= 0.5 / 256.0 && (raw == 0) == (z == 0.0));
        }
        let poses = fs::read_to_string(drive.join("poses.txt")).unwrap();
        for (line, pose) in poses.lines().zip(street.poses(1)) {
            let numbers: Vec<f64> = line.split(' ').map(|x| x.parse().unwrap()).collect();
            assert_eq!(numbers, pose.matrix().concat());
        }
        let calibration = fs::read_to_string(out.join("2011_09_26/calib_cam_to_cam.txt")).unwrap();
        let projection = calibration.lines().find_map(|l| l.strip_prefix("P_rect_02: ")).unwrap();
        let projection: Vec<f64> = projection.split(' ').map(|x| x.parse().unwrap()).collect();
        assert_eq!(projection.len(), 12);
        assert!((projection[0] - 0.58 * 64.0).abs() < 1e-9 && (projection[6] - 12.0).abs() < 1e-9);

        let again = write(&street, &out).unwrap_err().to_string();
        assert!(again.contains("not empty") && again.contains("street"), "{again}");
    }

    #[test]
    fn frames_come_with_their_camera_and_their_depth() {
        use crate::camera::Intrinsics;
        use crate::data::{Opening, open_folder};
        // 4:3, wide, off centre.
        let intrinsics = Intrinsics { fx: 0.7, fy: 0.7 * 4.0 / 3.0, cx: 0.46, cy: 0.55 };
        let config =
            StreetConfig { height: 96, width: 128, sequences: 2, frames: 4, intrinsics, ..StreetConfig::default() };
        let street = Street::render(&config, None);
        let place = tempfile::tempdir().unwrap();
        let out = place.path().join("frames");
        write_frames(&street, &out).unwrap();
        let data = open_folder(&out, Opening::of([32, 96])).unwrap();
        assert_eq!(data.len(), 4);
        let k = crate::data::batch::in_pixels(data.intrinsics(0), 96, 32);
        let said = [0.7 * 128.0, 0.7 * 128.0, 0.46 * 128.0, 0.55 * 96.0];
        let scaled = [said[0] * 96.0 / 128.0, said[1] * 32.0 / 96.0, said[2] * 96.0 / 128.0, said[3] * 32.0 / 96.0];
        assert!(k.iter().zip(scaled).all(|(a, b)| (a - b).abs() < 1e-9), "{k:?} {scaled:?}");
        let (found, truth) = (data.depth(3).unwrap().unwrap(), street.frame_depth(1, 2));
        assert!(found.metres.iter().zip(&truth.metres).all(|(a, b)| (a - b.min(250.0)).abs() <= 0.5 / 256.0));
        let jpeg = crate::formats::picture::read_picture(&out.join("0001/000002.jpg")).unwrap();
        let off = jpeg.as_raw().iter().zip(street.frame(1, 2).as_raw()).map(|(a, b)| f64::from(a.abs_diff(*b)));
        assert!(off.sum::<f64>() / (3.0 * 96.0 * 128.0) < 5.0, "about the same picture");
        let again = write_frames(&street, &out).unwrap_err().to_string();
        assert!(again.contains("not empty"), "{again}");
    }

    #[test]
    fn a_second_camera_is_read_back_as_the_other_one_of_a_pair() {
        use crate::data::kitti::{Kitti, Options, Side};
        let config =
            StreetConfig { height: 32, width: 64, sequences: 1, frames: 4, baseline: 0.5, ..StreetConfig::default() };
        let street = Street::render(&config, None);
        let place = tempfile::tempdir().unwrap();
        let out = place.path().join("street");
        write(&street, &out).unwrap();
        let options = Options { stereo: true, ..Options::default() };
        let kitti = Kitti::open(&out, None, 32, 64, options).unwrap();
        assert_eq!(kitti.len(), 4, "two frames of two cameras");
        for sample in 0..kitti.len() {
            let left = kitti.side(sample) == Side::Left;
            assert!((kitti.other_camera_at(sample).unwrap() - if left { -0.5 } else { 0.5 }).abs() < 1e-12);
            let frame = sample % 2 + 1;
            let pair = [street.frame(0, frame), street.right_frame(0, frame).unwrap()];
            let [this, other] = if left { pair } else { [pair[1], pair[0]] };
            assert_eq!(&kitti.image(sample, 0).unwrap(), this);
            assert_eq!(&kitti.other_image(sample).unwrap(), other);
        }
        assert!(kitti.image(0, 0).unwrap() != kitti.other_image(0).unwrap());
    }
}
