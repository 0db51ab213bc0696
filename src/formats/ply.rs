//! Coloured point clouds as PLY, which MeshLab, CloudCompare, Blender and Open3D read.

use std::io::{self, Write};
use std::path::Path;

use image::RgbImage;

use super::atomic::write_atomically;
use crate::Result;
use crate::camera::Intrinsics;
use crate::depth::DepthMap;

/// Writes every pixel of known depth as a point with the pixel's colour (binary little-endian PLY), whole or not at
/// all. Pixel (u, v) of depth z lies at `((u - cx) z / fx, (v - cy) z / fy, z)`, fx, fy, cx, cy in pixels: x right,
/// y down, z forward from the camera, in the depth map's unit.
///
/// # Errors
/// If the file cannot be written.
///
/// # Panics
/// If depth and picture differ in size.
pub fn write_point_cloud(
    path: impl AsRef<Path>,
    depth: &DepthMap,
    picture: &RgbImage,
    camera: Intrinsics,
) -> Result<()> {
    let (w, h) = (depth.width, depth.height);
    assert_eq!(depth.metres.len(), w * h, "write_point_cloud: depths for {w}x{h} pixels expected");
    assert_eq!(
        (picture.width() as usize, picture.height() as usize),
        (w, h),
        "write_point_cloud: a picture of {w}x{h}"
    );
    let known = |z: f32| z > 0.0 && z.is_finite();
    let count = depth.metres.iter().filter(|&&z| known(z)).count();
    let (w, h) = (w as f64, h as f64);
    let (fx, fy, cx, cy) = (camera.fx * w, camera.fy * h, camera.cx * w, camera.cy * h);
    write_atomically(path, |writer| {
        write_header(writer, count)?;
        for ((u, v, colour), &z) in picture.enumerate_pixels().zip(&depth.metres).filter(|(_, z)| known(**z)) {
            let along = f64::from(z);
            let point = [(f64::from(u) - cx) * along / fx, (f64::from(v) - cy) * along / fy, along];
            for coordinate in point {
                writer.write_all(&(coordinate as f32).to_le_bytes())?;
            }
            writer.write_all(&colour.0)?;
        }
        Ok(())
    })
}

fn write_header(writer: &mut impl Write, points: usize) -> io::Result<()> {
    writeln!(writer, "ply\nformat binary_little_endian 1.0")?;
    writeln!(writer, "comment x right, y down, z forward from the camera")?;
    writeln!(writer, "element vertex {points}")?;
    for property in ["float x", "float y", "float z", "uchar red", "uchar green", "uchar blue"] {
        writeln!(writer, "property {property}")?;
    }
    writeln!(writer, "end_header")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A point and its colour.
    type Point = ([f32; 3], [u8; 3]);

    /// The header's lines, and the points.
    fn parse(bytes: &[u8]) -> (Vec<&str>, Vec<Point>) {
        let end = b"end_header\n";
        let at = bytes.windows(end.len()).position(|w| w == end).unwrap();
        let header = std::str::from_utf8(&bytes[..at]).unwrap().lines().collect();
        let (points, rest) = bytes[at + end.len()..].as_chunks::<15>();
        assert!(rest.is_empty());
        let float = |b: &[u8]| f32::from_le_bytes(b.try_into().unwrap());
        let point = |p: &[u8; 15]| ([float(&p[..4]), float(&p[4..8]), float(&p[8..12])], [p[12], p[13], p[14]]);
        (header, points.iter().map(point).collect())
    }

    #[test]
    fn what_was_written_parses_and_projects_back_to_its_pixels() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cloud.ply");
        let (w, h) = (8usize, 4usize);
        let picture = RgbImage::from_fn(8, 4, |x, y| image::Rgb([x as u8, y as u8, 7]));
        let mut metres: Vec<f32> = (0..w * h).map(|i| 1.0 + i as f32 / 4.0).collect();
        (metres[3], metres[9], metres[20]) = (0.0, f32::INFINITY, f32::NAN);
        let camera = Intrinsics { fx: 0.6, fy: 1.3, cx: 0.45, cy: 0.55 };
        write_point_cloud(&path, &DepthMap { width: w, height: h, metres: metres.clone() }, &picture, camera).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let (header, points) = parse(&bytes);
        assert_eq!(header[..2], ["ply", "format binary_little_endian 1.0"]);
        assert!(header.contains(&"element vertex 29") && points.len() == 29, "unknown depths are left out");
        for ([x, y, z], [u, v, blue]) in points {
            assert_eq!(z, metres[usize::from(v) * w + usize::from(u)]);
            assert_eq!(blue, 7);
            let seen_u = 0.6 * 8.0 * f64::from(x) / f64::from(z) + 0.45 * 8.0;
            let seen_v = 1.3 * 4.0 * f64::from(y) / f64::from(z) + 0.55 * 4.0;
            assert!((seen_u - f64::from(u)).abs() < 1e-5 && (seen_v - f64::from(v)).abs() < 1e-5, "{u} {v}");
        }
    }
}
