//! Tensors of files, put beside a model's parameters: what fits, what is missing, what nobody asked for.

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;

use serde::Serialize;

use super::params::{ParamId, Params};
use crate::error::{Error, Result};
use crate::formats::StoredTensor;
use crate::formats::pth::shown;
use crate::tensor::{Float, Tensor};

/// Tensor of a file, with the name of the parameter that it is meant for.
#[derive(Clone, Debug)]
pub struct Named {
    /// The parameter's name, any of its names.
    pub name: String,
    /// The name in the file.
    pub origin: String,
    /// The file.
    pub file: Arc<PathBuf>,
    /// Shape and numbers, in PyTorch's layout.
    pub tensor: StoredTensor,
}

/// A tensor whose shape is not the parameter's, both in PyTorch's layout.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Mismatch {
    /// The parameter's own name.
    pub name: String,
    /// The file's shape.
    pub theirs: Vec<usize>,
    /// The parameter's shape.
    pub ours: Vec<usize>,
}

/// A tensor that is passed over, because no model has a use for it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Skipped {
    /// The name in the file.
    pub name: String,
    /// Kind of tensor, in the plural, for messages.
    pub what: &'static str,
}

/// Report of loading weights: what matched, what is missing, what was not expected.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Report {
    /// Parameters that a tensor fits, under their own names.
    pub matched: Vec<String>,
    /// Parameters that no tensor is meant for.
    pub missing: Vec<String>,
    /// Tensors that are meant for no parameter, under the file's names.
    pub unexpected: Vec<String>,
    /// Tensors of another shape than the parameter's.
    pub mismatched: Vec<Mismatch>,
    /// Tensors that no model has a use for.
    pub skipped: Vec<Skipped>,
    /// Networks that the files have nothing of, where that is allowed.
    pub absent: Vec<String>,
}

impl Report {
    /// What keeps the tensors from being exactly the model's, on one line; `None` if nothing does.
    pub fn problem(&self) -> Option<String> {
        let mismatched: Vec<String> = self.mismatched.iter().map(Mismatch::to_string).collect();
        let parts = [(&self.missing, "missing"), (&self.unexpected, "unexpected"), (&mismatched, "of another shape")];
        let said: Vec<String> = parts
            .iter()
            .filter(|(names, _)| !names.is_empty())
            .map(|(names, what)| format!("{} {what} ({})", names.len(), some(names, 3)))
            .collect();
        (!said.is_empty()).then(|| said.join(", "))
    }
}

impl fmt::Display for Mismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} is {:?}, expected {:?}", self.name, self.theirs, self.ours)
    }
}

/// The first few of a list.
fn some(names: &[String], most: usize) -> String {
    let mut text = names[..names.len().min(most)].join(", ");
    if names.len() > most {
        text += &format!(" and {} more", names.len() - most);
    }
    text
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mismatched: Vec<String> = self.mismatched.iter().map(Mismatch::to_string).collect();
        write!(f, "matched     {}", self.matched.len())?;
        for (what, names) in [("missing", &self.missing), ("unexpected", &self.unexpected), ("mismatched", &mismatched)]
        {
            write!(f, "\n{what:11} {}", names.len())?;
            if !names.is_empty() {
                write!(f, ": {}", some(names, 8))?;
            }
        }
        let mut kinds: Vec<&str> = self.skipped.iter().map(|s| s.what).collect();
        kinds.sort_unstable();
        kinds.dedup();
        for what in kinds {
            let names: Vec<String> = self.skipped.iter().filter(|s| s.what == what).map(|s| s.name.clone()).collect();
            write!(f, "\nskipped     {} {what}: {}", names.len(), some(&names, 2))?;
        }
        if !self.absent.is_empty() {
            write!(f, "\nnot there   {}", self.absent.join(", "))?;
        }
        Ok(())
    }
}

/// Tensors that fit a model's parameters, and the report on all of them.
pub struct Fit<T: Float> {
    /// What fits and what does not.
    pub report: Report,
    values: Vec<(ParamId, Tensor<T>)>,
}

impl<T: Float> Fit<T> {
    /// Puts the tensors that fit into the parameters, the very ones that they were compared with.
    pub fn put_into(self, params: &mut Params<T>) {
        for (id, value) in self.values {
            params.set(id, value);
        }
    }
}

/// Compares tensors with a model's parameters. Nothing is changed yet.
///
/// A parameter may be there under several names, and in several files.
///
/// # Errors
/// Where there is no telling what is meant: a tensor that fits in shape but holds integers, NaN or infinities; two
/// tensors for one parameter that differ.
pub fn fit<T: Float>(params: &Params<T>, tensors: &[Named]) -> Result<Fit<T>> {
    let mut report = Report::default();
    let mut values = Vec::new();
    let mut candidates: Vec<Vec<&Named>> = vec![Vec::new(); params.len()];
    for tensor in tensors {
        match params.find(&tensor.name) {
            Some(id) => candidates[id.index()].push(tensor),
            None => report.unexpected.push(shown(&tensor.origin)),
        }
    }
    for ((id, p), candidates) in params.iter().zip(&candidates) {
        let Some((first, others)) = candidates.split_first() else {
            report.missing.push(p.name().to_owned());
            continue;
        };
        let ours = p.layout.exported(p.value.dims());
        if let Some(wrong) = candidates.iter().find(|c| c.tensor.shape() != ours) {
            let theirs = wrong.tensor.shape().to_vec();
            report.mismatched.push(Mismatch { name: p.name().to_owned(), theirs, ours });
            continue;
        }
        let numbers = first.numbers::<T>()?;
        for other in others {
            let theirs = other.numbers::<T>()?;
            if let Some(i) = (0..numbers.len()).find(|&i| numbers[i] != theirs[i]) {
                return Err(first.differs_from(other, i, (numbers[i].f64(), theirs[i].f64())));
            }
        }
        let value = p.layout.import(&Tensor::from_vec(&ours[..], numbers)).expect("the shape was compared");
        values.push((id, value));
        report.matched.push(p.name().to_owned());
    }
    Ok(Fit { report, values })
}

impl Named {
    /// The numbers in row-major order, all of them finite.
    fn numbers<T: Float>(&self) -> Result<Vec<T>> {
        let name = shown(&self.origin);
        let Some(numbers) = self.tensor.to_f64() else {
            let found = self.tensor.dtype().name();
            return Err(Error::file(&*self.file, format!("{name} holds {found}: floating point was expected")));
        };
        let numbers: Vec<T> = numbers.into_iter().map(T::of).collect();
        if let Some(i) = numbers.iter().position(|x| !x.f64().is_finite()) {
            let message =
                format!("{name} holds {} (element {i} of {}): these weights are broken", numbers[i], numbers.len());
            return Err(Error::file(&*self.file, message));
        }
        Ok(numbers)
    }

    fn differs_from(&self, other: &Named, element: usize, values: (f64, f64)) -> Error {
        let (name, theirs) = (shown(&self.origin), shown(&other.origin));
        let place = if self.file == other.file { String::new() } else { format!(" of {}", other.file.display()) };
        let message = format!(
            "{name} and {theirs}{place} are one tensor under two names, but differ ({} and {} at element {element}): \
             leave out what is not meant",
            values.0, values.1
        );
        Error::file(&*self.file, message)
    }
}
