//! NumPy's `.npz`: a zip archive with one `.npy` array for each name.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::Path;
use std::sync::Arc;

use zip::write::{SimpleFileOptions, ZipWriter};
use zip::{CompressionMethod, DateTime};

use super::atomic::write_atomically;
use super::npy;
use super::pth::archive::{self, Archive, Expected};
use super::pth::{MAX_FILE, shown};
use super::stored::{Dtype, Storage, StoredTensor};
use super::tensor_file::TensorFile;
use crate::error::{Error, Result};

/// The most dimensions of an array.
const MAX_RANK: usize = 16;

/// Writes arrays of f32 (name, shape, numbers in row-major order) and whole numbers, for `numpy.load`.
///
/// # Panics
/// If an array does not hold the product of its shape numbers.
pub fn write(path: &Path, arrays: &[(&str, &[usize], &[f32])], integers: &[(&str, i64)]) -> Result<()> {
    write_atomically(path, |out| {
        let mut zip = ZipWriter::new(out);
        let start = |zip: &mut ZipWriter<&mut BufWriter<File>>, name: &str, bytes: usize| {
            let options = SimpleFileOptions::default()
                .compression_method(CompressionMethod::Stored)
                .last_modified_time(DateTime::default())
                .with_alignment(64)
                .large_file(u32::try_from(bytes).is_err());
            zip.start_file(format!("{name}.npy"), options).map_err(io::Error::from)
        };
        for (name, shape, numbers) in arrays {
            assert_eq!(numbers.len(), shape.iter().product::<usize>(), "npz::write: {name} has the shape {shape:?}");
            start(&mut zip, name, numbers.len() * 4 + 1024)?;
            zip.write_all(&npy::header("<f4", shape))?;
            for part in numbers.chunks(4096) {
                let bytes: Vec<u8> = part.iter().flat_map(|x| x.to_le_bytes()).collect();
                zip.write_all(&bytes)?;
            }
        }
        for (name, value) in integers {
            start(&mut zip, name, 1024)?;
            zip.write_all(&npy::header("<i8", &[]))?;
            zip.write_all(&value.to_le_bytes())?;
        }
        zip.finish().map_err(io::Error::from)?;
        Ok(())
    })
}

/// Opens a `.npz` file. Integers without dimensions stand among [`TensorFile::integers`].
///
/// # Errors
/// If it is no archive of arrays, or an array is not as long as its header says.
pub fn open(path: &Path) -> Result<TensorFile> {
    let io = |e| Error::io(path, e);
    let mut file = File::open(path).map_err(io)?;
    let size = file.seek(SeekFrom::End(0)).map_err(io)?;
    if size > MAX_FILE {
        return Err(Error::file(path, format!("has {size} bytes (at most {MAX_FILE} are read)")));
    }
    file.seek(SeekFrom::Start(0)).map_err(io)?;
    let mut head = Vec::new();
    (&mut file).take(4).read_to_end(&mut head).map_err(io)?;
    if head != b"PK\x03\x04" {
        return Err(Error::file(path, "not an .npz file: it does not begin like a zip archive"));
    }
    archive::check(BufReader::new(&mut file)).map_err(|e| e.in_file(path))?;
    file.seek(SeekFrom::Start(0)).map_err(io)?;
    let mut bytes = Vec::with_capacity(usize::try_from(size).unwrap_or(0));
    file.take(size).read_to_end(&mut bytes).map_err(io)?;

    let bytes = Arc::new(bytes);
    let mut archive = Archive::open(&bytes).map_err(|e| e.in_file(path))?;
    let mut found =
        TensorFile { path: path.to_owned(), tensors: Vec::new(), integers: Vec::new(), metadata: HashMap::new() };
    for entry in archive.names() {
        let Some(name) = entry.strip_suffix(".npy") else {
            let message = format!("not an .npz file: its entry `{}` is no .npy array", shown(&entry));
            return Err(Error::file(path, message));
        };
        let array = archive.take(&entry, Expected::AtMost(MAX_FILE)).map_err(|e| e.in_file(path))?;
        let tensor = read_array(array)
            .map_err(|why| Error::file(path, format!("the array `{}` cannot be read: {why}", shown(name))))?;
        match tensor.as_i64().filter(|_| tensor.shape().is_empty()) {
            Some(integer) => found.integers.push((name.to_owned(), integer)),
            None => found.tensors.push((name.to_owned(), tensor)),
        }
    }
    Ok(found)
}

/// An array from the bytes of a `.npy` file (version 1, 2 or 3).
pub(super) fn read_array(file: Storage) -> Result<StoredTensor, String> {
    let bytes = file.bytes.get(file.range.clone()).unwrap_or(&[]);
    let (fixed, length): (usize, usize) = match bytes {
        [0x93, b'N', b'U', b'M', b'P', b'Y', 1, _, a, b, ..] => (10, usize::from(u16::from_le_bytes([*a, *b]))),
        [0x93, b'N', b'U', b'M', b'P', b'Y', 2 | 3, _, a, b, c, d, ..] => {
            (12, u32::from_le_bytes([*a, *b, *c, *d]) as usize)
        }
        _ => return Err("it does not begin as one".into()),
    };
    let header = bytes.get(fixed..fixed.saturating_add(length)).ok_or("its header is cut short")?;
    let header = str::from_utf8(header).map_err(|_| "its header is not text")?;
    let missing = |what: &str| format!("its header does not say its {what}");
    let field = |name: &str| {
        let (_, rest) = header.split_once(&format!("'{name}':"))?;
        Some(rest.trim_start())
    };
    let descr = field("descr").and_then(|f| f.strip_prefix('\'')?.split('\'').next());
    let dtype = match descr.ok_or_else(|| missing("type"))? {
        "<f8" => Dtype::F64,
        "<f4" => Dtype::F32,
        "<f2" => Dtype::F16,
        "<i8" => Dtype::I64,
        "<i4" => Dtype::I32,
        "<i2" => Dtype::I16,
        "|i1" => Dtype::I8,
        "|u1" => Dtype::U8,
        "|b1" => Dtype::Bool,
        other => return Err(format!("it holds `{}`, little-endian numbers were expected", shown(other))),
    };
    let columns_first = match field("fortran_order") {
        Some(f) if f.starts_with("False") => false,
        Some(f) if f.starts_with("True") => true,
        _ => return Err(missing("order")),
    };
    let shape = field("shape").and_then(|f| f.strip_prefix('(')?.split_once(')')).ok_or_else(|| missing("shape"))?.0;
    let shape: Result<Vec<usize>, _> =
        shape.split(',').map(str::trim).filter(|d| !d.is_empty()).map(str::parse).collect();
    let mut shape = shape.map_err(|_| missing("shape"))?;
    if shape.len() > MAX_RANK {
        return Err(format!("it has {} dimensions (at most {MAX_RANK})", shape.len()));
    }
    // Column-major numbers are those of the transposed array in row-major order.
    if columns_first {
        shape.reverse();
    }
    let start = file.range.start + fixed + length;
    let tensor = StoredTensor::contiguous(&file.bytes, start..file.range.end, dtype, shape);
    let tensor = tensor.ok_or("it has another number of elements than its shape says")?;
    Ok(if columns_first { tensor.transposed() } else { tensor })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An array file with this header and these bytes behind it.
    fn array(header: &str, numbers: &[u8]) -> Storage {
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend(numbers);
        Storage { range: 0..bytes.len(), bytes: Arc::new(bytes) }
    }

    #[test]
    fn arrays_are_read_in_either_order() {
        let numbers: Vec<u8> = (0..6).flat_map(|i| (i as f32).to_le_bytes()).collect();
        for (order, expected) in [("False", [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]), ("True", [0.0, 2.0, 4.0, 1.0, 3.0, 5.0])] {
            let header = format!("{{'descr': '<f4', 'fortran_order': {order}, 'shape': (2, 3), }}\n");
            let tensor = read_array(array(&header, &numbers)).unwrap();
            assert_eq!(tensor.shape(), [2, 3]);
            assert_eq!(tensor.to_f32().unwrap(), expected, "{order}");
        }
    }

    #[test]
    fn arrays_that_lie_are_refused() {
        let header =
            |descr: &str, shape: &str| format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n");
        let cases = [
            (array(&header("<f4", "(3,)"), &[0; 8]), "another number of elements"),
            (array(&header("<f4", "(18446744073709551615, 3)"), &[0; 8]), "another number of elements"),
            (array(&header("<f4", "(99999999999999999999,)"), &[0; 8]), "does not say its shape"),
            (array(&header(">f4", "(2,)"), &[0; 8]), "little-endian"),
            (array(&header("|O", "(2,)"), &[0; 8]), "holds `|O`"),
            (array(&header("<f4", "(1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 2)"), &[0; 8]), "17 dimensions"),
            (array("{'shape': (2,)}", &[0; 8]), "does not say its type"),
            (Storage { range: 0..12, bytes: Arc::new(b"\x93NUMPY\x01\x00\xff\xff{}".to_vec()) }, "cut short"),
            (Storage { range: 0..3, bytes: Arc::new(b"abc".to_vec()) }, "does not begin as one"),
        ];
        for (file, expected) in cases {
            let error = read_array(file).unwrap_err();
            assert!(error.contains(expected), "expected {expected}: {error}");
        }
    }
}
