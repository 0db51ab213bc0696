//! Writes the zip format, for `torch.load(weights_only=True)`.

use std::collections::{HashMap, HashSet};
use std::io::{Seek, Write};

use zip::write::{SimpleFileOptions, ZipWriter};
use zip::{CompressionMethod, DateTime};

use super::{PthError, shown};

/// One value to save.
#[derive(Clone, Debug)]
pub enum Saved<'a> {
    /// A float32 tensor in row-major order. Two entries with the very same `data` share their numbers in the file.
    F32 {
        /// The dimensions, outermost first.
        shape: &'a [usize],
        /// As many numbers as the dimensions' product.
        data: &'a [f32],
    },
    /// An int64 tensor without dimensions: `num_batches_tracked`.
    I64(i64),
    /// A plain integer: the `height` and `width` of an encoder's file.
    Int(i64),
    /// A plain truth value: `use_stereo`.
    Bool(bool),
    /// A plain floating-point number.
    Float(f64),
    /// A plain string.
    Text(&'a str),
}

/// Writes an OrderedDict of these entries, in this order. `name` is the folder inside the archive, by custom the
/// file's name without its ending. The same entries give the same bytes.
pub fn write<W: Write + Seek>(out: W, name: &str, entries: &[(String, Saved<'_>)]) -> Result<(), PthError> {
    if name.is_empty() || name.contains(['/', '\\']) {
        return Err(PthError::Unsupported(format!(
            "the archive's name `{}` is empty or contains a slash",
            shown(name)
        )));
    }
    let mut program = Program::new();
    for (name, value) in entries {
        program.entry(name, value)?;
    }
    let Program { bytes: pickle, storages, .. } = program.finish();

    let mut zip = ZipWriter::new(out);
    let mut add = |entry: &str, bytes: &dyn Fn(&mut ZipWriter<W>) -> std::io::Result<()>, size: usize| {
        let options = SimpleFileOptions::default()
            .compression_method(CompressionMethod::Stored)
            .last_modified_time(DateTime::default())
            // PyTorch maps the numbers into memory.
            .with_alignment(64)
            .large_file(u32::try_from(size).is_err());
        zip.start_file(format!("{name}/{entry}"), options).map_err(zip_error)?;
        bytes(&mut zip).map_err(PthError::Io)
    };
    add("data.pkl", &|zip| zip.write_all(&pickle), pickle.len())?;
    add("byteorder", &|zip| zip.write_all(b"little"), 6)?;
    for (key, numbers) in storages.iter().enumerate() {
        match numbers {
            Numbers::F32(data) => add(&format!("data/{key}"), &|zip| write_f32(zip, data), data.len() * 4)?,
            Numbers::I64(n) => add(&format!("data/{key}"), &|zip| zip.write_all(&n.to_le_bytes()), 8)?,
        }
    }
    add("version", &|zip| zip.write_all(b"3\n"), 2)?;
    zip.finish().map_err(zip_error)?.flush()?;
    Ok(())
}

fn zip_error(e: zip::result::ZipError) -> PthError {
    PthError::Io(e.into())
}

fn write_f32(out: &mut impl Write, data: &[f32]) -> std::io::Result<()> {
    let mut buffer = Vec::with_capacity(4 * 4096);
    for part in data.chunks(4096) {
        buffer.clear();
        buffer.extend(part.iter().flat_map(|x| x.to_le_bytes()));
        out.write_all(&buffer)?;
    }
    Ok(())
}

/// The contents of `data/K`.
enum Numbers<'a> {
    F32(&'a [f32]),
    I64(i64),
}

/// The pickle while it is written, protocol 2 without a memo.
struct Program<'a> {
    bytes: Vec<u8>,
    storages: Vec<Numbers<'a>>,
    /// The storages by where their numbers lie in memory.
    shared: HashMap<(*const f32, usize), usize>,
    names: HashSet<&'a str>,
}

impl<'a> Program<'a> {
    fn new() -> Self {
        let mut program =
            Program { bytes: vec![0x80, 2], storages: Vec::new(), shared: HashMap::new(), names: HashSet::new() };
        program.empty_ordered_dict();
        program.bytes.push(b'(');
        program
    }

    fn finish(mut self) -> Self {
        // SETITEMS, STOP
        self.bytes.extend(b"u.");
        self
    }

    fn entry(&mut self, name: &'a str, value: &Saved<'a>) -> Result<(), PthError> {
        if !self.names.insert(name) {
            return Err(PthError::Duplicate(shown(name)));
        }
        self.text(name)?;
        match value {
            Saved::F32 { shape, data } => {
                let expected = shape.iter().try_fold(1_usize, |n, d| n.checked_mul(*d));
                if expected != Some(data.len()) {
                    return Err(PthError::Tensor {
                        name: shown(name),
                        message: format!("shape {shape:?} with {} numbers", data.len()),
                    });
                }
                let key = *self.shared.entry((data.as_ptr(), data.len())).or_insert_with(|| {
                    self.storages.push(Numbers::F32(data));
                    self.storages.len() - 1
                });
                self.tensor("FloatStorage", key, data.len(), shape)?;
            }
            Saved::I64(n) => {
                self.storages.push(Numbers::I64(*n));
                self.tensor("LongStorage", self.storages.len() - 1, 1, &[])?;
            }
            Saved::Int(n) => self.int(*n),
            Saved::Bool(b) => self.bytes.push(if *b { 0x88 } else { 0x89 }),
            Saved::Float(x) => {
                self.bytes.push(b'G');
                self.bytes.extend(x.to_be_bytes());
            }
            Saved::Text(text) => self.text(text)?,
        }
        Ok(())
    }

    /// `_rebuild_tensor_v2(storage, 0, shape, strides, False, OrderedDict())`
    fn tensor(&mut self, class: &str, key: usize, numel: usize, shape: &[usize]) -> Result<(), PthError> {
        self.global("torch._utils", "_rebuild_tensor_v2");
        self.bytes.extend(b"((");
        self.text("storage")?;
        self.global("torch", class);
        self.text(&key.to_string())?;
        self.text("cpu")?;
        self.int(i64::try_from(numel).unwrap_or(i64::MAX));
        // TUPLE, BINPERSID
        self.bytes.extend(b"tQ");
        self.int(0);
        let mut strides = vec![1; shape.len()];
        for axis in (1..shape.len()).rev() {
            strides[axis - 1] = strides[axis] * shape[axis].max(1);
        }
        self.sizes(shape);
        self.sizes(&strides);
        // NEWFALSE
        self.bytes.push(0x89);
        self.empty_ordered_dict();
        // TUPLE, REDUCE
        self.bytes.extend(b"tR");
        Ok(())
    }

    fn sizes(&mut self, sizes: &[usize]) {
        self.bytes.push(b'(');
        for n in sizes {
            self.int(i64::try_from(*n).unwrap_or(i64::MAX));
        }
        self.bytes.push(b't');
    }

    fn empty_ordered_dict(&mut self) {
        self.global("collections", "OrderedDict");
        // EMPTY_TUPLE, REDUCE
        self.bytes.extend(b")R");
    }

    fn global(&mut self, module: &str, name: &str) {
        self.bytes.extend(format!("c{module}\n{name}\n").as_bytes());
    }

    fn text(&mut self, text: &str) -> Result<(), PthError> {
        let length =
            u32::try_from(text.len()).map_err(|_| PthError::TooLarge(format!("a string has {} bytes", text.len())))?;
        self.bytes.push(b'X');
        self.bytes.extend(length.to_le_bytes());
        self.bytes.extend(text.as_bytes());
        Ok(())
    }

    fn int(&mut self, n: i64) {
        if let Ok(small) = u8::try_from(n) {
            self.bytes.extend([b'K', small]);
        } else if let Ok(n) = i32::try_from(n) {
            self.bytes.push(b'J');
            self.bytes.extend(n.to_le_bytes());
        } else {
            // LONG1 with eight bytes.
            self.bytes.extend([0x8a, 8]);
            self.bytes.extend(n.to_le_bytes());
        }
    }
}
