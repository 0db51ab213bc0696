//! Checkpoints as safetensors, in PyTorch's names and layouts, so that one file serves both sides.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fmt;
use std::fs::File;
use std::io::{Read, Write};
use std::path::Path;
use std::sync::Arc;

use safetensors::tensor::{Dtype, Metadata};
use serde::Deserializer;
use serde::de::{IgnoredAny, MapAccess, Visitor};

use super::atomic::write_atomically;
use super::pth::shown;
use super::stored::{self, StoredTensor};
use super::tensor_file::TensorFile;
use crate::error::{Error, Result};
use crate::tensor::{Float, Tensor, bf16_bits};

/// The largest file that is read, in bytes. The training state of the largest size has 2 GB.
const MAX_FILE: u64 = 8 << 30;
/// The longest header, in bytes. A tensor takes some 150.
const MAX_HEADER: u64 = 8 << 20;

/// The metadata entry that holds the CRC-32 of all numbers, in the order of the tensors' names.
const CHECKSUM: &str = "parallax_crc32";

/// The numbers of a file that is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Numbers {
    /// Four bytes each.
    F32,
    /// bfloat16, two bytes each: rounded to nearest, ties to even, to 8 bits of precision.
    Bf16,
}

/// Calls `take` with the bytes of tensors, a block after the other.
fn for_each_block<'a, T: Float, E>(
    tensors: impl Iterator<Item = &'a Tensor<T>>,
    stored: Numbers,
    mut take: impl FnMut(&[u8]) -> Result<(), E>,
) -> Result<(), E> {
    let mut bytes = Vec::new();
    for numbers in tensors.flat_map(|t| t.data().chunks(1 << 14)) {
        bytes.clear();
        let numbers = numbers.iter().map(|x| x.f64() as f32);
        match stored {
            Numbers::F32 => bytes.extend(numbers.flat_map(f32::to_le_bytes)),
            Numbers::Bf16 => bytes.extend(numbers.flat_map(|x| bf16_bits(x).to_le_bytes())),
        }
        take(&bytes)?;
    }
    Ok(())
}

fn checksum<'a, T: Float>(tensors: impl Iterator<Item = &'a Tensor<T>>, stored: Numbers) -> String {
    let mut crc = crc32fast::Hasher::new();
    let Ok(()) = for_each_block(tensors, stored, |bytes| {
        crc.update(bytes);
        Ok::<(), std::convert::Infallible>(())
    });
    format!("{:08x}", crc.finalize())
}

/// Writes a checkpoint, aside first and then in place: every tensor under its own name, in f32, and `metadata`, to which
/// a checksum of all numbers is added. Nothing is held in memory twice, and equal contents are equal files.
///
/// # Errors
/// If the file cannot be written.
pub fn write<T: Float>(
    path: &Path,
    tensors: &BTreeMap<String, Tensor<T>>,
    metadata: HashMap<String, String>,
) -> Result<()> {
    write_in(path, tensors, metadata, Numbers::F32)
}

/// [`write`](write()), with numbers of this kind.
///
/// # Errors
/// If the file cannot be written.
pub fn write_in<T: Float>(
    path: &Path,
    tensors: &BTreeMap<String, Tensor<T>>,
    metadata: HashMap<String, String>,
    stored: Numbers,
) -> Result<()> {
    let mut about: BTreeMap<String, String> = metadata.into_iter().collect();
    about.insert(CHECKSUM.into(), checksum(tensors.values(), stored));
    let (dtype, size) = match stored {
        Numbers::F32 => ("F32", 4),
        Numbers::Bf16 => ("BF16", 2),
    };
    let mut header = serde_json::Map::from_iter([("__metadata__".to_owned(), serde_json::json!(about))]);
    let mut end = 0;
    for (name, tensor) in tensors {
        let start = end;
        end += size * tensor.len();
        let entry = serde_json::json!({"dtype": dtype, "shape": tensor.dims(), "data_offsets": [start, end]});
        header.insert(name.clone(), entry);
    }
    let mut header = serde_json::to_vec(&header).map_err(|e| Error::file(path, format!("its header: {e}")))?;
    // The numbers begin at a multiple of eight bytes.
    header.resize(header.len().next_multiple_of(8), b' ');
    write_atomically(path, |writer| {
        writer.write_all(&(header.len() as u64).to_le_bytes())?;
        writer.write_all(&header)?;
        for_each_block(tensors.values(), stored, |bytes| writer.write_all(bytes))
    })
}

/// Opens a safetensors file.
///
/// # Errors
/// If the header does not describe the file exactly: every tensor a range of the length that its shape needs, no two
/// overlapping, nothing left over. Nothing larger than the header is read before that is known. If the numbers are not
/// those of the checksum that [`write`](write()) added.
pub fn open(path: &Path) -> Result<TensorFile> {
    let io = |e| Error::io(path, e);
    let file = File::open(path).map_err(io)?;
    let size = file.metadata().map_err(io)?.len();
    open_stream(file, size, path)
}

/// [`open`], of a file that is in memory; `name` is what errors call it.
///
/// # Errors
/// As [`open`].
pub fn open_bytes(bytes: &[u8], name: &Path) -> Result<TensorFile> {
    open_stream(bytes, bytes.len() as u64, name)
}

fn open_stream(mut file: impl Read, size: u64, path: &Path) -> Result<TensorFile> {
    let io = |e| Error::io(path, e);
    let not = |why: String| Error::file(path, format!("not a safetensors file: {why}"));
    if size > MAX_FILE {
        return Err(Error::file(path, format!("has {size} bytes (at most {MAX_FILE} are read)")));
    }
    let mut length = [0; 8];
    if size < 8 {
        return Err(not(format!("it has {size} bytes and no header")));
    }
    file.read_exact(&mut length).map_err(io)?;
    let length = u64::from_le_bytes(length);
    if length > size - 8 {
        return Err(not(format!("its header claims {length} bytes, of a file of {size}")));
    }
    if length > MAX_HEADER {
        return Err(Error::file(path, format!("its header has {length} bytes (at most {MAX_HEADER} are read)")));
    }
    let mut header = Vec::new();
    (&mut file).take(length).read_to_end(&mut header).map_err(io)?;
    if let Some(name) = duplicate(&header) {
        let message = format!("its safetensors header has the name {} twice, which the format forbids", shown(&name));
        return Err(Error::file(path, message));
    }
    let header: Metadata =
        serde_json::from_slice(&header).map_err(|e| Error::file(path, format!("its safetensors header: {e}")))?;
    let claimed = header.data_len() as u64;
    let there = size - 8 - length;
    if there < claimed {
        let message = format!("is cut short: {there} bytes of numbers, expected {claimed}. Copy or download it again");
        return Err(Error::file(path, message));
    }
    if there > claimed {
        return Err(Error::file(path, format!("is damaged: {} bytes belong to no tensor", there - claimed)));
    }
    let mut bytes = Vec::with_capacity(usize::try_from(claimed).unwrap_or(0));
    file.take(claimed).read_to_end(&mut bytes).map_err(io)?;
    let metadata = header.metadata().clone().unwrap_or_default();
    if let Some(said) = metadata.get(CHECKSUM)
        && *said != format!("{:08x}", crc32fast::hash(&bytes))
    {
        let message = "is damaged: its numbers are not those that its checksum was made of. Copy or download it again; if another program rewrote it, save it there without the metadata entry parallax_crc32";
        return Err(Error::file(path, message));
    }
    let bytes = Arc::new(bytes);

    let mut tensors = Vec::new();
    for name in header.offset_keys() {
        let Some(info) = header.info(&name) else { continue };
        let Some(dtype) = dtype(info.dtype) else {
            let message = format!("{} holds {:?}, which cannot be read", shown(&name), info.dtype);
            return Err(Error::file(path, message));
        };
        let range = info.data_offsets.0..info.data_offsets.1;
        let tensor = StoredTensor::contiguous(&bytes, range, dtype, info.shape.clone())
            .ok_or_else(|| Error::file(path, format!("is damaged: {} goes beyond its end", shown(&name))))?;
        tensors.push((name, tensor));
    }
    Ok(TensorFile { path: path.to_owned(), tensors, integers: Vec::new(), metadata })
}

/// A name that stands twice in a JSON object; of repeated keys a JSON reader keeps the last.
fn duplicate(header: &[u8]) -> Option<String> {
    struct Names(Option<String>);
    impl<'de> Visitor<'de> for Names {
        type Value = Option<String>;
        fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
            f.write_str("an object")
        }
        fn visit_map<A: MapAccess<'de>>(mut self, mut map: A) -> Result<Self::Value, A::Error> {
            let mut seen = HashSet::new();
            while let Some(name) = map.next_key::<String>()? {
                map.next_value::<IgnoredAny>()?;
                if !seen.insert(name.clone()) {
                    self.0.get_or_insert(name);
                }
            }
            Ok(self.0)
        }
    }
    // What is no object is reported by who reads it.
    serde_json::Deserializer::from_slice(header).deserialize_map(Names(None)).ok().flatten()
}

fn dtype(theirs: Dtype) -> Option<stored::Dtype> {
    Some(match theirs {
        Dtype::F64 => stored::Dtype::F64,
        Dtype::F32 => stored::Dtype::F32,
        Dtype::F16 => stored::Dtype::F16,
        Dtype::BF16 => stored::Dtype::BF16,
        Dtype::I64 => stored::Dtype::I64,
        Dtype::I32 => stored::Dtype::I32,
        Dtype::I16 => stored::Dtype::I16,
        Dtype::I8 => stored::Dtype::I8,
        Dtype::U8 => stored::Dtype::U8,
        Dtype::BOOL => stored::Dtype::Bool,
        _ => return None,
    })
}

/// What a safetensors file holds.
pub struct Contents<T: Float> {
    /// The tensors by name, in the file's layout.
    pub tensors: HashMap<String, Tensor<T>>,
    /// The file's metadata.
    pub metadata: HashMap<String, String>,
}

/// Reads a whole safetensors file of floating-point tensors.
///
/// # Errors
/// As [`open`]; and if a tensor holds integers, or has more dimensions than a tensor can.
pub fn read<T: Float>(path: &Path) -> Result<Contents<T>> {
    let file = open(path)?;
    let mut tensors = HashMap::new();
    for (name, stored) in file.tensors {
        let rank = stored.shape().len();
        if rank > crate::tensor::shape::MAX_RANK {
            return Err(Error::file(path, format!("{} has {rank} dimensions, more than a tensor can", shown(&name))));
        }
        let numbers = stored.to_f64().ok_or_else(|| {
            let found = stored.dtype().name();
            Error::file(path, format!("{} holds {found}: floating point was expected", shown(&name)))
        })?;
        let numbers = numbers.into_iter().map(T::of).collect();
        tensors.insert(name, Tensor::from_vec(stored.shape(), numbers));
    }
    Ok(Contents { tensors, metadata: file.metadata })
}
