//! The format before PyTorch 1.6: five pickles in a row (a magic number, the protocol's version, the machine's
//! properties, the state, the list of the storages' keys), then for each key the number of elements in eight bytes and
//! the elements themselves, little-endian.

use std::collections::HashMap;
use std::sync::Arc;

use super::archive::big_endian;
use super::pickle::{self, Pickle, Value};
use super::state::{Format, State};
use super::{PthError, shown};
use crate::formats::stored::Storage;

const MAGIC: i128 = 0x1950_a86a_20f9_469c_fc6c;
const PROTOCOL: i128 = 1001;

/// An error unless a file that begins with these 512 bytes can be of this format.
pub(super) fn check(head: &[u8]) -> Result<(), PthError> {
    match next(head, &mut 0) {
        // The magic number would have fitted.
        Err(PthError::Truncated(_)) if head.len() >= 512 => Err(foreign_pickle()),
        first => expect_magic(first),
    }
}

/// The first pickle is the magic number.
fn expect_magic(first: Result<Pickle<'_>, PthError>) -> Result<(), PthError> {
    match first {
        Ok(pickle) if pickle.int() == Some(MAGIC) => Ok(()),
        Ok(_) => Err(foreign_pickle()),
        // An error here mostly means that the file is something else.
        Err(PthError::Damaged(why)) => Err(PthError::NotACheckpoint(why)),
        Err(other) => Err(other),
    }
}

fn foreign_pickle() -> PthError {
    PthError::NotACheckpoint("a pickle, but not one that torch.save wrote".into())
}

/// Reads a file of this format.
pub(super) fn read(bytes: Vec<u8>) -> Result<State, PthError> {
    let bytes = Arc::new(bytes);
    let mut at = 0;
    expect_magic(next(&bytes, &mut at))?;
    match next(&bytes, &mut at)?.int() {
        Some(PROTOCOL) => {}
        other => return Err(PthError::damaged(format!("protocol version {other:?}, expected {PROTOCOL}"))),
    }
    match next(&bytes, &mut at)?.field("little_endian") {
        Some(Value::Bool(true)) => {}
        Some(Value::Bool(false)) => return Err(big_endian()),
        _ => return Err(PthError::damaged("it does not say whether it is little-endian")),
    }
    let state = next(&bytes, &mut at)?;
    let keys = next(&bytes, &mut at)?;
    let keys = keys.texts().ok_or_else(|| PthError::damaged("its list of storages is not a list of strings"))?;

    let claims: HashMap<&str, usize> = state.storages.iter().enumerate().map(|(i, claim)| (claim.key, i)).collect();
    let mut storages: Vec<Option<Storage>> = vec![None; state.storages.len()];
    for key in keys {
        let Some((claim, slot)) = claims.get(key).and_then(|&i| Some((state.storages.get(i)?, storages.get_mut(i)?)))
        else {
            return Err(PthError::damaged(format!("it lists storage {}, which no tensor has", shown(key))));
        };
        if slot.is_some() {
            return Err(PthError::damaged(format!("it lists storage {} twice", shown(key))));
        }
        let rest = bytes.get(at..).unwrap_or(&[]);
        let cut = || PthError::truncated(format!("it ends inside storage {}", shown(key)));
        let (numel, rest) = rest.split_first_chunk::<8>().ok_or_else(cut)?;
        let numel = u64::from_le_bytes(*numel);
        if numel != claim.numel as u64 {
            return Err(PthError::damaged(format!(
                "storage {} has {numel} elements, expected {}",
                shown(key),
                claim.numel
            )));
        }
        let length = usize::try_from(claim.bytes()?).ok().filter(|n| *n <= rest.len()).ok_or_else(cut)?;
        at += 8;
        *slot = Some(Storage { bytes: Arc::clone(&bytes), range: at..at + length });
        at += length;
    }
    let mut found = Vec::with_capacity(storages.len());
    for (storage, claim) in storages.into_iter().zip(&state.storages) {
        found.push(storage.ok_or_else(|| PthError::damaged(format!("storage {} is missing", shown(claim.key))))?);
    }
    state.flatten(Format::Legacy, &found)
}

/// The pickle that begins at `at`, which moves behind it.
fn next<'b>(bytes: &'b [u8], at: &mut usize) -> Result<Pickle<'b>, PthError> {
    let pickle = pickle::read(bytes.get(*at..).unwrap_or(&[]))?;
    *at += pickle.length;
    Ok(pickle)
}
