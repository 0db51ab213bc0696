//! A file of named tensors, in any of the formats that are read.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::Read;
use std::path::{Path, PathBuf};

use super::pth::{self, Plain};
use super::stored::StoredTensor;
use super::{npz, safetensors};
use crate::error::{Error, Result};

/// What a file of named tensors holds.
///
/// The numbers are not taken out yet: whatever the file claims, this costs about the file's own size.
#[derive(Clone, Debug)]
pub struct TensorFile {
    /// The file.
    pub path: PathBuf,
    /// The tensors, in the file's order. No name is there twice.
    pub tensors: Vec<(String, StoredTensor)>,
    /// Whole numbers that stand beside the tensors: the `height` and `width` of a published encoder's file.
    pub integers: Vec<(String, i64)>,
    /// What a safetensors file says about itself.
    pub metadata: HashMap<String, String>,
}

impl TensorFile {
    /// Opens a safetensors, `.pth` (zip or legacy) or `.npz` file.
    ///
    /// # Errors
    /// Names the file and what is wrong with it: cut short, damaged, of another kind, with claims that its length does
    /// not bear out.
    pub fn open(path: &Path) -> Result<Self> {
        let about = fs::metadata(path).map_err(|e| Error::io(path, e))?;
        if !about.is_file() {
            return Err(Error::file(path, "is not a file"));
        }
        let mut head = Vec::new();
        let file = File::open(path).map_err(|e| Error::io(path, e))?;
        file.take(9).read_to_end(&mut head).map_err(|e| Error::io(path, e))?;
        if head.is_empty() {
            return Err(Error::file(path, "is empty: copy or download it again"));
        }
        let ends_with = |ending: &str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(ending));
        // The length of a header, and the JSON that it is.
        let like_safetensors = head.get(8) == Some(&b'{') && head.get(5..8) == Some(&[0; 3]);
        if ends_with("safetensors") || like_safetensors {
            safetensors::open(path)
        } else if ends_with("npz") {
            npz::open(path)
        } else {
            let state = pth::read(path).map_err(|e| e.in_file(path))?;
            let integer = |(name, value): (&str, &Plain)| match value {
                Plain::Int(i) => Some((name.to_owned(), i64::try_from(*i).ok()?)),
                _ => None,
            };
            Ok(TensorFile {
                path: path.to_owned(),
                tensors: state.tensors().map(|(name, t)| (name.to_owned(), t.clone())).collect(),
                integers: state.plain().filter_map(integer).collect(),
                metadata: HashMap::new(),
            })
        }
    }
}
