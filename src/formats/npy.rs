//! NumPy's `.npy`: a header that says type and shape, then the values.

use std::io::{self, Write};
use std::path::Path;
use std::sync::Arc;

use super::atomic::write_atomically;
use super::bounded::read_bounded;
use super::npz::read_array;
use super::pth::MAX_FILE;
use super::stored::{Storage, StoredTensor};
use crate::{Error, Result};

/// Reads a `.npy` file, version 1, 2 or 3, of little-endian numbers.
///
/// # Errors
/// If it is none, or not as long as its header says.
pub fn read(path: &Path) -> Result<StoredTensor> {
    let bytes = read_bounded(path, MAX_FILE, "an .npy array")?;
    let whole = Storage { range: 0..bytes.len(), bytes: Arc::new(bytes) };
    read_array(whole).map_err(|why| Error::file(path, format!("expected an .npy array, which cannot be read: {why}")))
}

/// Writes a row-major `height x width` map of f32 as `.npy` (version 1.0, little-endian), whole or not at all.
///
/// # Panics
/// If `values` does not hold `height * width` values.
pub fn write_npy(path: impl AsRef<Path>, values: &[f32], height: usize, width: usize) -> Result<()> {
    write_npy_shaped(path, values, &[height, width])
}

/// Writes a row-major array of f32 of any shape as `.npy`.
///
/// # Panics
/// If `values` does not hold the product of `shape` values.
pub fn write_npy_shaped(path: impl AsRef<Path>, values: &[f32], shape: &[usize]) -> Result<()> {
    assert_eq!(values.len(), shape.iter().product::<usize>(), "write_npy: values for the shape {shape:?} expected");
    write_atomically(path, |writer| {
        writer.write_all(&header("<f4", shape))?;
        write_values(writer, values)
    })
}

/// Magic, version, length, and a Python dictionary padded with spaces so that the values start at a multiple of 64.
/// `descr` is NumPy's name of the element type.
pub(crate) fn header(descr: &str, shape: &[usize]) -> Vec<u8> {
    const FIXED: usize = 10;
    let dimensions = match shape {
        [one] => format!("{one},"),
        _ => shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", "),
    };
    let mut dictionary = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({dimensions}), }}");
    while !(FIXED + dictionary.len() + 1).is_multiple_of(64) {
        dictionary.push(' ');
    }
    dictionary.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((dictionary.len() as u16).to_le_bytes());
    bytes.extend(dictionary.as_bytes());
    bytes
}

fn write_values(writer: &mut impl Write, values: &[f32]) -> io::Result<()> {
    values.iter().try_for_each(|value| writer.write_all(&value.to_le_bytes()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_those_that_numpy_reads() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.npy");
        write_npy(&path, &[1.0, 2.5, -3.0, 0.0, f32::INFINITY, 6.0], 2, 3).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        assert_eq!(&bytes[..8], b"\x93NUMPY\x01\x00");
        let length = usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
        assert_eq!((10 + length) % 64, 0);
        let text = std::str::from_utf8(&bytes[10..10 + length]).unwrap();
        assert_eq!(text.trim_end(), "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), }");
        assert!(text.ends_with('\n'));
        let values: Vec<f32> =
            bytes[10 + length..].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
        assert_eq!(values, [1.0, 2.5, -3.0, 0.0, f32::INFINITY, 6.0]);
    }

    #[test]
    fn what_was_written_reads_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.npy");
        let values = [1.0, 2.5, -3.0, 0.0, f32::INFINITY, 6.0];
        write_npy_shaped(&path, &values, &[1, 2, 3]).unwrap();
        let found = read(&path).unwrap();
        assert_eq!((found.shape(), found.to_f32().unwrap()), (&[1, 2, 3][..], values.to_vec()));
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() - 1]).unwrap();
        let error = read(&path).unwrap_err().to_string();
        assert!(error.contains("map.npy") && error.contains("number of elements"), "{error}");
    }

    #[test]
    fn one_dimension_keeps_its_comma() {
        assert!(String::from_utf8_lossy(&header("<f4", &[7])).contains("(7,)"));
    }
}
