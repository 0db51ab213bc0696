//! Checkpoints as safetensors, in PyTorch's names and layouts, so that one file serves both sides.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use safetensors::tensor::{Dtype, SafeTensors, TensorView, serialize};

use super::params::Params;
use crate::error::{Error, Result};
use crate::tensor::{Float, Tensor};

/// The bytes of a checkpoint: every tensor under its own name, in PyTorch's layout, in f32, and `metadata`.
pub fn to_bytes<T: Float>(tensors: &BTreeMap<String, Tensor<T>>, metadata: HashMap<String, String>) -> Result<Vec<u8>> {
    let bytes: Vec<(&String, Vec<usize>, Vec<u8>)> = tensors
        .iter()
        .map(|(name, t)| {
            let numbers = t.data().iter().flat_map(|x| (x.f64() as f32).to_le_bytes()).collect();
            (name, t.dims().to_vec(), numbers)
        })
        .collect();
    let views: Result<Vec<_>, _> = bytes
        .iter()
        .map(|(name, dims, numbers)| Ok((name.as_str(), TensorView::new(Dtype::F32, dims.clone(), numbers)?)))
        .collect();
    let failed = |e: safetensors::SafeTensorError| Error::Failed(format!("a checkpoint could not be written: {e}"));
    serialize(views.map_err(failed)?, Some(metadata)).map_err(failed)
}

/// Writes a checkpoint, aside first and then in place.
pub fn write<T: Float>(
    path: &Path,
    tensors: &BTreeMap<String, Tensor<T>>,
    metadata: HashMap<String, String>,
) -> Result<()> {
    crate::files::write_bytes_atomically(path, &to_bytes(tensors, metadata)?)
}

/// A model's tensors under their own names, in PyTorch's layout.
pub fn export<T: Float>(params: &Params<T>) -> BTreeMap<String, Tensor<T>> {
    params.iter().map(|(_, p)| (p.name().to_owned(), p.layout.export(&p.value))).collect()
}

/// What a safetensors file holds.
pub struct Contents<T: Float> {
    /// The tensors by name, in the file's layout.
    pub tensors: HashMap<String, Tensor<T>>,
    /// The file's metadata.
    pub metadata: HashMap<String, String>,
}

/// Reads a safetensors file (f32 or f64 tensors).
pub fn read<T: Float>(path: &Path) -> Result<Contents<T>> {
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, e))?;
    let not = |e| Error::file(path, format!("not a safetensors file: {e}"));
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(not)?;
    let file = SafeTensors::deserialize(&bytes).map_err(not)?;
    let mut tensors = HashMap::new();
    for (name, view) in file.tensors() {
        if view.shape().len() > crate::tensor::shape::MAX_RANK {
            return Err(Error::file(
                path,
                format!("{name} has {} dimensions, more than a tensor can", view.shape().len()),
            ));
        }
        let data = view.data();
        let numbers: Vec<T> = match view.dtype() {
            Dtype::F32 => data.as_chunks::<4>().0.iter().map(|b| T::of(f32::from_le_bytes(*b) as f64)).collect(),
            Dtype::F64 => data.as_chunks::<8>().0.iter().map(|b| T::of(f64::from_le_bytes(*b))).collect(),
            other => {
                let message = format!("{name} holds {other:?}: only F32 and F64 can be read");
                return Err(Error::file(path, message));
            }
        };
        tensors.insert(name, Tensor::from_vec(view.shape(), numbers));
    }
    Ok(Contents { tensors, metadata: header.metadata().clone().unwrap_or_default() })
}

/// Puts tensors (in PyTorch's layout) into a model; every one of the model's must be there, and no other.
///
/// A tensor may stand under any of its names. `num_batches_tracked` counters are passed over.
pub fn import<T: Float>(params: &mut Params<T>, tensors: &HashMap<String, Tensor<T>>, path: &Path) -> Result<()> {
    let mut missing = Vec::new();
    let mut found = Vec::new();
    for (id, p) in params.iter() {
        let Some(theirs) = p.names.iter().find_map(|n| tensors.get(n)) else {
            missing.push(p.name().to_owned());
            continue;
        };
        let ours = p.layout.import(theirs).filter(|t| t.shape() == p.value.shape());
        let Some(ours) = ours else {
            let expected = p.layout.export(&p.value);
            return Err(Error::file(
                path,
                format!(
                    "{} has shape {}, this model's has {}: were these weights made with another preset?",
                    p.name(),
                    theirs.shape(),
                    expected.shape()
                ),
            ));
        };
        found.push((id, ours));
    }
    let unexpected: Vec<&String> =
        tensors.keys().filter(|n| params.find(n).is_none() && !n.ends_with("num_batches_tracked")).collect();
    if !missing.is_empty() || !unexpected.is_empty() {
        let mut message = format!("{} tensors are missing, {} are unexpected", missing.len(), unexpected.len());
        for (what, name) in [("missing", missing.first()), ("unexpected", unexpected.first().copied())] {
            if let Some(name) = name {
                message += &format!("; {what}: {name}, for example");
            }
        }
        return Err(Error::file(path, message + ". Were these weights made with another preset?"));
    }
    for (id, value) in found {
        params.set(id, value);
    }
    Ok(())
}
