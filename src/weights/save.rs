//! Weights as files: safetensors, `.npz`, `.pth`, or a folder with a `.pth` for each network, as the published ones are.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

use super::Weights;
use super::names::{DECODER_KEYS, NETWORKS};
use crate::error::{Error, Result};
use crate::formats::atomic::write_atomically;
use crate::formats::pth;
use crate::formats::pth::{PthError, Saved};
use crate::formats::{npz, safetensors};
use crate::tensor::Tensor;

/// How weights are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// One safetensors file with the configuration.
    Safetensors,
    /// One NumPy archive, with `height` and `width`.
    Npz,
    /// One PyTorch file with the networks' names in front, and `height` and `width`.
    Pth,
    /// A folder: `encoder.pth` (with `height`, `width`, `use_stereo`), `depth.pth` (every tensor under both of its
    /// names), `pose_encoder.pth`, `pose.pth`.
    Folder,
}

impl Form {
    /// The form that a path's ending says; without an ending, a folder.
    ///
    /// # Errors
    /// For any other ending.
    pub fn of(path: &Path) -> Result<Self> {
        if path.is_dir() {
            return Ok(Form::Folder);
        }
        match path.extension().map(|e| e.to_string_lossy().to_lowercase()).as_deref() {
            None => Ok(Form::Folder),
            Some("safetensors") => Ok(Form::Safetensors),
            Some("npz") => Ok(Form::Npz),
            Some("pth" | "pt") => Ok(Form::Pth),
            Some(other) => {
                let message = format!(
                    "`.{other}` is no kind of weights: expected .safetensors, .npz, .pth, or a folder (no ending)"
                );
                Err(Error::file(path, message))
            }
        }
    }
}

/// One parameter on its way into a file: all its names, and its numbers in PyTorch's layout.
struct Entry<'a> {
    names: &'a [String],
    tensor: Tensor<f32>,
}

/// The parameters that were loaded; what was not is not written.
fn loaded(weights: &Weights) -> Vec<Entry<'_>> {
    let names: std::collections::HashSet<&str> = weights.report.matched.iter().map(String::as_str).collect();
    let params = weights.params.iter().map(|(_, p)| p).filter(|p| names.contains(p.name()));
    params.map(|p| Entry { names: &p.names, tensor: p.layout.export(&p.value) }).collect()
}

/// The parameters that were loaded, by name, in PyTorch's layout.
pub(super) fn tensors(weights: &Weights) -> BTreeMap<String, Tensor<f32>> {
    loaded(weights).into_iter().map(|entry| (entry.names[0].clone(), entry.tensor)).collect()
}

/// Where [`save`] would write: for a folder, the files in it.
pub fn outputs(weights: &Weights, path: &Path, form: Form) -> Vec<PathBuf> {
    if form != Form::Folder {
        return vec![path.to_owned()];
    }
    let there = |network: &str| {
        let prefix = format!("{network}.");
        weights.report.matched.iter().any(|name| name.starts_with(&prefix))
    };
    NETWORKS.into_iter().filter(|n| there(n)).map(|n| path.join(format!("{n}.pth"))).collect()
}

/// Writes the weights that were loaded, each file whole or not at all.
///
/// # Errors
/// If a file cannot be written.
pub fn save(weights: &Weights, path: &Path, form: Form) -> Result<()> {
    let entries = loaded(weights);
    // The encoder is what a configuration belongs to: the other networks alone could be of several sizes.
    let with_encoder = weights.report.matched.iter().any(|name| name.starts_with("encoder."));
    let (height, width) = (weights.setup.height as i64, weights.setup.width as i64);
    let size = if with_encoder { vec![("height", height), ("width", width)] } else { Vec::new() };
    let about = || {
        let size = size.iter().map(|&(name, pixels)| (name.to_owned(), Saved::Int(pixels)));
        size.chain(with_encoder.then(|| ("use_stereo".to_owned(), Saved::Bool(false))))
    };
    match form {
        Form::Safetensors => {
            let mut metadata = if with_encoder { weights.setup.metadata()? } else { HashMap::new() };
            if let (true, Some(origin)) = (with_encoder, &weights.origin) {
                metadata.extend(origin.metadata()?);
            }
            safetensors::write(path, &tensors(weights), metadata)
        }
        Form::Npz => {
            let arrays: Vec<_> = entries.iter().map(|e| (&*e.names[0], e.tensor.dims(), e.tensor.data())).collect();
            npz::write(path, &arrays, &size)
        }
        Form::Pth => {
            let mut all = Vec::new();
            for entry in &entries {
                push(&mut all, entry, |name| Some(name.to_owned()));
            }
            all.extend(about());
            write_pth(path, &all)
        }
        Form::Folder => {
            for (network, file) in NETWORKS.iter().zip(NETWORKS.map(|n| path.join(format!("{n}.pth")))) {
                let prefix = format!("{network}.");
                let mut all = Vec::new();
                for entry in entries.iter().filter(|e| e.names[0].starts_with(&prefix)) {
                    push(&mut all, entry, |name| Some(name.strip_prefix(&prefix)?.to_owned()));
                }
                if all.is_empty() {
                    continue;
                }
                match *network {
                    "encoder" => all.extend(about()),
                    "depth" => {
                        let numbered: Vec<(String, Saved<'_>)> =
                            all.iter().filter_map(|(name, value)| Some((numbered(name)?, value.clone()))).collect();
                        all.extend(numbered);
                    }
                    _ => {}
                }
                write_pth(&file, &all)?;
            }
            Ok(())
        }
    }
}

/// A parameter under all its names, and the counter that PyTorch keeps beside a variance.
fn push<'a>(all: &mut Vec<(String, Saved<'a>)>, entry: &'a Entry, rename: impl Fn(&str) -> Option<String>) {
    for name in entry.names.iter().filter_map(|n| rename(n)) {
        let counter = name.strip_suffix("running_var").map(|before| format!("{before}num_batches_tracked"));
        all.push((name, Saved::F32 { shape: entry.tensor.dims(), data: entry.tensor.data() }));
        all.extend(counter.map(|name| (name, Saved::I64(0))));
    }
}

/// The decoder's second name of a tensor: `decoder.N.` for `convs.KEY.`.
fn numbered(name: &str) -> Option<String> {
    let (key, rest) = name.strip_prefix("convs.")?.split_once('.')?;
    let number = DECODER_KEYS.iter().position(|k| k == key)?;
    Some(format!("decoder.{number}.{rest}"))
}

fn write_pth(path: &Path, entries: &[(String, Saved<'_>)]) -> Result<()> {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().replace('\\', "_");
    let mut failed = None;
    let written = write_atomically(path, |out| {
        pth::write(out, &stem, entries).map_err(|e| match e {
            PthError::Io(e) => e,
            other => {
                let message = other.to_string();
                failed = Some(other);
                std::io::Error::other(message)
            }
        })
    });
    match failed {
        Some(e) => Err(e.in_file(path)),
        None => written,
    }
}
