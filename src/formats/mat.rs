//! MATLAB's `.mat` files of version 5: one named array of real numbers is taken out, all else passed over.
//!
//! 128 bytes of header, then elements: a tag (type and length), the data, and padding to eight bytes; an element may be
//! compressed by zlib. An array is an element of elements: flags, dimensions, name, numbers column by column ("MAT-File
//! Format", The MathWorks, chapter 1).

use std::io::Read;
use std::path::Path;

use flate2::read::ZlibDecoder;

use super::bounded::read_bounded;
use crate::{Error, Result};

/// Files with more bytes are not read; arrays do not unpack to more.
const MAX_FILE: u64 = 256 << 20;
const HEADER: usize = 128;
/// Types of elements.
const INT32: u32 = 5;
const MATRIX: u32 = 14;
const COMPRESSED: u32 = 15;
/// Arrays with more dimensions are not read.
const MAX_RANK: usize = 32;

/// An array of real numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct MatArray {
    /// Its dimensions.
    pub shape: Vec<usize>,
    /// Its numbers in column-major order: the first dimension varies fastest.
    pub values: Vec<f64>,
}

/// Reads the array of a name from a MATLAB 5 file.
///
/// # Errors
/// If the file cannot be read, is of another version (7.3 is HDF5: the message says how to convert it), is cut short or
/// damaged, has no array of that name, or one that does not hold real numbers.
pub fn read_mat(path: &Path, name: &str) -> Result<MatArray> {
    let bytes = read_bounded(path, MAX_FILE, "a MATLAB file")?;
    find(&bytes, name)
        .map_err(|why| Error::file(path, format!("expected a MATLAB 5 file with the array {name}: {why}")))
}

fn find(bytes: &[u8], name: &str) -> Result<MatArray, String> {
    let order = order(bytes)?;
    let mut rest = Elements { bytes: bytes.get(HEADER..).unwrap_or_default(), order };
    let mut others = Vec::new();
    while let Some((kind, data)) = rest.next_element()? {
        let unpacked;
        let (kind, data) = if kind == COMPRESSED {
            unpacked = unpack(data)?;
            let inside = Elements { bytes: &unpacked, order }.next_element()?;
            inside.ok_or("a compressed element of it is empty: the file is damaged")?
        } else {
            (kind, data)
        };
        if kind != MATRIX {
            continue;
        }
        let mut parts = Elements { bytes: data, order };
        let head = Head::read(&mut parts)?;
        if head.name == name {
            return head.array(&mut parts);
        }
        others.push(head.name);
    }
    Err(match others.as_slice() {
        [] => "it holds no arrays".to_owned(),
        others => format!("it holds only {}", others.join(", ")),
    })
}

/// Whether numbers have their last byte first.
#[derive(Clone, Copy, PartialEq)]
enum Order {
    Little,
    Big,
}

/// The order of bytes that the header states.
fn order(bytes: &[u8]) -> Result<Order, String> {
    let hdf5 = b"\x89HDF\r\n\x1a\n";
    if bytes.starts_with(hdf5) || bytes.starts_with(b"MATLAB 7.3") || bytes.get(512..520) == Some(&hdf5[..]) {
        let todo = "it is of version 7.3 (HDF5), which is not read: in MATLAB, load it and save(FILE, NAME, '-v7')";
        return Err(todo.to_owned());
    }
    match bytes.get(124..HEADER) {
        None => Err(format!("it has {} bytes, fewer than the header's {HEADER}: fetch it again", bytes.len())),
        Some([0, 1, b'I', b'M']) => Ok(Order::Little),
        Some([1, 0, b'M', b'I']) => Ok(Order::Big),
        Some(other) => Err(format!("its header ends with {other:?}, which is not that of version 5 (save with '-v7')")),
    }
}

fn unpack(data: &[u8]) -> Result<Vec<u8>, String> {
    let mut unpacked = Vec::new();
    let read = ZlibDecoder::new(data).take(MAX_FILE + 1).read_to_end(&mut unpacked);
    read.map_err(|e| format!("a compressed element cannot be unpacked ({e}): the file is damaged, fetch it again"))?;
    if unpacked.len() as u64 > MAX_FILE {
        return Err(format!("a compressed element unpacks to more than {MAX_FILE} bytes"));
    }
    Ok(unpacked)
}

/// Elements, one after another.
struct Elements<'a> {
    bytes: &'a [u8],
    order: Order,
}

impl<'a> Elements<'a> {
    /// The type and data of the next element; none at the end.
    fn next_element(&mut self) -> Result<Option<(u32, &'a [u8])>, String> {
        // What is left over is padding.
        let Some((tag, after)) = self.bytes.split_first_chunk::<8>() else { return Ok(None) };
        let [first, second] = [&tag[..4], &tag[4..]].map(|half| self.number(half) as u32);
        // A small element: its length stands beside its type, its data where the length would.
        if first >> 16 != 0 {
            let (kind, length) = (first & 0xffff, (first >> 16) as usize);
            let data = self.bytes.get(4..8).and_then(|data| data.get(..length));
            self.bytes = after;
            return data.map(|data| Some((kind, data))).ok_or_else(|| format!("a small element claims {length} bytes"));
        }
        let length = second as usize;
        let Some(data) = after.get(..length) else {
            let left = after.len();
            return Err(format!(
                "an element claims {length} bytes, and {left} are left: it is cut short, fetch it again"
            ));
        };
        // Compressed elements are not padded.
        let padded = if first == COMPRESSED { length } else { length.next_multiple_of(8) };
        self.bytes = after.get(padded..).unwrap_or_default();
        Ok(Some((first, data)))
    }

    /// The next element, which has to be there.
    fn part(&mut self, what: &str) -> Result<(u32, &'a [u8]), String> {
        self.next_element()?.ok_or_else(|| format!("an array ends before its {what}: the file is damaged"))
    }

    /// An unsigned number of up to eight bytes.
    fn number(&self, bytes: &[u8]) -> u64 {
        let join = |sum: u64, &b: &u8| sum << 8 | u64::from(b);
        match self.order {
            Order::Little => bytes.iter().rev().fold(0, join),
            Order::Big => bytes.iter().fold(0, join),
        }
    }
}

/// Header of an array, before its numbers.
struct Head {
    class: u32,
    complex: bool,
    shape: Vec<usize>,
    name: String,
}

impl Head {
    fn read(parts: &mut Elements) -> Result<Head, String> {
        let (_, flags) = parts.part("flags")?;
        let flags = parts.number(flags.get(..4).ok_or("an array has no flags: the file is damaged")?) as u32;
        // Objects have no dimensions; they are passed over by whatever stands there.
        let (kind, dimensions) = parts.part("dimensions")?;
        let shape = match kind {
            INT32 => dimensions.chunks_exact(4).take(MAX_RANK + 1).map(|n| parts.number(n) as usize).collect(),
            _ => Vec::new(),
        };
        let (_, name) = parts.part("name")?;
        let name = String::from_utf8_lossy(name).into_owned();
        Ok(Head { class: flags & 0xff, complex: flags & 0x800 != 0, shape, name })
    }

    /// The numbers.
    fn array(self, parts: &mut Elements) -> Result<MatArray, String> {
        // Classes: 6 double, 7 single, 8 to 15 integers.
        if self.complex || !(6..=15).contains(&self.class) {
            let what = if self.complex { "complex numbers" } else { "no plain numbers (text, a cell, a structure)" };
            return Err(format!("the array holds {what}; expected real ones"));
        }
        let (kind, data) = parts.part("numbers")?;
        let (size, convert) = reader(kind).ok_or_else(|| format!("its numbers have the type {kind}, unknown"))?;
        let count = self.shape.iter().try_fold(1usize, |n, &m| n.checked_mul(m));
        if count != Some(data.len() / size) || data.len() % size != 0 || !(1..=MAX_RANK).contains(&self.shape.len()) {
            let (shape, found) = (&self.shape, data.len() / size);
            return Err(format!("its dimensions are {shape:?}, but {found} numbers are there: the file is damaged"));
        }
        let values = data.chunks_exact(size).map(|bytes| convert(parts.number(bytes))).collect();
        Ok(MatArray { shape: self.shape, values })
    }
}

/// The number that bits, as they are stored, stand for.
type Convert = fn(u64) -> f64;

/// The bytes of a number of an element's type, and what they mean.
fn reader(kind: u32) -> Option<(usize, Convert)> {
    Some(match kind {
        1 => (1, |n| f64::from(n as i8)),
        2 => (1, |n| n as f64),
        3 => (2, |n| f64::from(n as i16)),
        4 => (2, |n| n as f64),
        5 => (4, |n| f64::from(n as i32)),
        6 => (4, |n| n as f64),
        7 => (4, |n| f64::from(f32::from_bits(n as u32))),
        9 => (8, f64::from_bits),
        12 => (8, |n| n as i64 as f64),
        13 => (8, |n| n as f64),
        _ => return None,
    })
}

/// Files as MATLAB writes them, for tests.
#[cfg(test)]
pub(crate) mod write {
    use std::io::Write;

    use flate2::Compression;
    use flate2::write::ZlibEncoder;

    /// An element, padded.
    pub fn element(kind: u32, data: &[u8]) -> Vec<u8> {
        let mut bytes = [kind.to_le_bytes(), (data.len() as u32).to_le_bytes()].concat();
        bytes.extend(data);
        bytes.resize(bytes.len().next_multiple_of(8), 0);
        bytes
    }

    /// An array of a class whose numbers are stored as an element.
    pub fn array(name: &str, class: u32, shape: &[i32], numbers: Vec<u8>) -> Vec<u8> {
        let flags = [class.to_le_bytes(), [0; 4]].concat();
        let shape: Vec<u8> = shape.iter().flat_map(|n| n.to_le_bytes()).collect();
        element(14, &[element(6, &flags), element(5, &shape), element(1, name.as_bytes()), numbers].concat())
    }

    /// An array of doubles, column-major.
    pub fn doubles(name: &str, shape: &[i32], values: &[f64]) -> Vec<u8> {
        let numbers: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        array(name, 6, shape, element(9, &numbers))
    }

    /// A file of elements.
    pub fn file(elements: &[Vec<u8>]) -> Vec<u8> {
        let mut bytes = b"MATLAB 5.0 MAT-file".to_vec();
        bytes.resize(124, b' ');
        bytes.extend([0, 1, b'I', b'M']);
        bytes.extend(elements.concat());
        bytes
    }

    /// An element, compressed.
    pub fn compressed(element: &[u8]) -> Vec<u8> {
        let mut encoder = ZlibEncoder::new(Vec::new(), Compression::fast());
        encoder.write_all(element).unwrap();
        let data = encoder.finish().unwrap();
        [&15u32.to_le_bytes()[..], &(data.len() as u32).to_le_bytes()[..], &data[..]].concat()
    }
}

#[cfg(test)]
mod tests {
    use super::write::{array, compressed, doubles, element, file};
    use super::*;

    fn grid() -> Vec<u8> {
        doubles("Grid", &[2, 3], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.5])
    }

    #[test]
    fn a_named_array_is_found_plain_and_compressed() {
        let expected = MatArray { shape: vec![2, 3], values: vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.5] };
        let other = doubles("other", &[1, 1], &[9.0]);
        assert_eq!(find(&file(&[other.clone(), grid()]), "Grid").unwrap(), expected);
        assert_eq!(find(&file(&[compressed(&other), compressed(&grid())]), "Grid").unwrap(), expected);
        let error = find(&file(&[other]), "Grid").unwrap_err();
        assert!(error.contains("only other"), "{error}");
    }

    #[test]
    fn numbers_are_stored_in_any_type_and_in_small_elements() {
        // A double array whose numbers fit into signed bytes, in a small element.
        let small = [&(1u32 | 3 << 16).to_le_bytes()[..], &[1, 0xfe, 3, 0]].concat();
        let found = find(&file(&[array("a", 6, &[3, 1], small)]), "a").unwrap();
        assert_eq!(found, MatArray { shape: vec![3, 1], values: vec![1.0, -2.0, 3.0] });
        let single: Vec<u8> = [0.5f32, -8.0].iter().flat_map(|v| v.to_le_bytes()).collect();
        assert_eq!(find(&file(&[array("b", 7, &[1, 2], element(7, &single))]), "b").unwrap().values, [0.5, -8.0]);
        let words: Vec<u8> = [65535u16, 2].iter().flat_map(|v| v.to_le_bytes()).collect();
        assert_eq!(find(&file(&[array("c", 11, &[1, 2], element(4, &words))]), "c").unwrap().values, [65535.0, 2.0]);
    }

    #[test]
    fn other_versions_and_damage_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("depth.mat");
        let whole = file(&[grid()]);
        let packed = file(&[compressed(&grid())]);
        let wrong_shape = file(&[doubles("Grid", &[2, 4], &[1.0; 6])]);
        let mut hdf5 = b"MATLAB 7.3 MAT-file".to_vec();
        hdf5.resize(600, 0);
        let text = file(&[array("Grid", 4, &[1, 2], element(4, &[65, 0, 66, 0]))]);
        for (bytes, why) in [
            (hdf5, "'-v7'"),
            (b"\x89HDF\r\n\x1a\n".to_vec(), "7.3"),
            (whole[..100].to_vec(), "100 bytes"),
            (whole[..whole.len() - 9].to_vec(), "cut short"),
            (packed[..packed.len() - 9].to_vec(), "cut short"),
            (wrong_shape, "[2, 4]"),
            (text, "real"),
            (file(&[doubles("Grid", &[-1, -1], &[1.0])]), "numbers are there"),
            (vec![b' '; 300], "version 5"),
            (file(&[]), "no arrays"),
        ] {
            std::fs::write(&path, bytes).unwrap();
            let error = read_mat(&path, "Grid").unwrap_err().to_string();
            assert!(error.contains("depth.mat") && error.contains(why), "{why}: {error}");
        }
        // Whatever byte is wrong, nothing panics.
        for i in 124..whole.len() {
            let mut damaged = whole.clone();
            damaged[i] ^= 0xff;
            let _ = find(&damaged, "Grid");
        }
    }
}
