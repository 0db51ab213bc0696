//! What unit tests share: the fixture files, and the real piece of KITTI.

use std::path::{Path, PathBuf};

use image::RgbImage;
use safetensors::SafeTensors;

/// The path of a file of `tests/fixtures`.
pub fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

/// The bytes of a file of `tests/fixtures`.
pub fn fixture_bytes(name: &str) -> Vec<u8> {
    std::fs::read(fixture(name)).unwrap_or_else(|e| panic!("fixture {name}: {e}"))
}

/// An 8-bit RGB picture `[height, width, 3]` of a safetensors file.
pub fn rgb(file: &SafeTensors, name: &str) -> RgbImage {
    let view = file.tensor(name).unwrap();
    let &[height, width, 3] = view.shape() else { panic!("{name}: {:?}", view.shape()) };
    RgbImage::from_raw(width as u32, height as u32, view.data().to_vec()).unwrap()
}

/// The values of an f32 tensor and its shape.
pub fn f32s(file: &SafeTensors, name: &str) -> (Vec<f32>, Vec<usize>) {
    let view = file.tensor(name).unwrap();
    assert_eq!(view.dtype(), safetensors::Dtype::F32, "{name}");
    let values = view.data().chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    (values, view.shape().to_vec())
}

/// The mean and the largest absolute difference between two pictures of one size.
pub fn difference(a: &RgbImage, b: &RgbImage) -> (f64, u8) {
    assert_eq!(a.dimensions(), b.dimensions());
    let differences = || a.as_raw().iter().zip(b.as_raw()).map(|(x, y)| x.abs_diff(*y));
    let sum: f64 = differences().map(f64::from).sum();
    (sum / a.as_raw().len() as f64, differences().max().unwrap_or(0))
}

/// The folder of the real KITTI piece; the tests that call this are ignored where it is not named at build time.
pub fn kitti() -> PathBuf {
    PathBuf::from(std::env::var_os("PARALLAX_KITTI").expect("PARALLAX_KITTI was set at build time and is not now"))
}
