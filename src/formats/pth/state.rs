//! What a checkpoint holds: dotted names, each with a tensor or a plain value.

use std::collections::HashMap;

use super::{MAX_SHARING, PthError, SMALL, shown};
use crate::formats::StoredTensor;

/// The container a checkpoint came in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// A zip archive, since PyTorch 1.6.
    Zip,
    /// Pickles in a row, before.
    Legacy,
}

/// A value that is no tensor: a picture's height, an epoch, a setting.
#[derive(Clone, Debug, PartialEq)]
pub enum Plain {
    /// Python's `None`.
    None,
    /// A truth value.
    Bool(bool),
    /// An integer.
    Int(i128),
    /// A floating-point number.
    Float(f64),
    /// A string, or a class or device by its name (`torch.float32`, `cuda`).
    Text(String),
    /// Bytes.
    Bytes(Vec<u8>),
    /// What Python would make by calling this function or class, which is not done here.
    Unread(String),
}

/// One entry of a checkpoint.
#[derive(Clone, Debug)]
pub enum Item {
    /// A tensor.
    Tensor(StoredTensor),
    /// Anything else.
    Plain(Plain),
}

/// What a checkpoint holds, in the file's order. Nested dictionaries and lists are flattened:
/// `{"model": {"conv.weight": t}, "sizes": [3, 5]}` gives `model.conv.weight`, `sizes.0` and `sizes.1`.
#[derive(Clone, Debug)]
pub struct State {
    format: Format,
    entries: Vec<(String, Item)>,
    index: HashMap<String, usize>,
}

impl State {
    /// Takes the entries over; two with one name are an error.
    pub(super) fn new(format: Format, entries: Vec<(String, Item)>) -> Result<Self, PthError> {
        let mut index = HashMap::with_capacity(entries.len());
        for (i, (name, item)) in entries.iter().enumerate() {
            // A number or string that stands twice (`{"a.b": 1, "a": {"b": 2}}`) is nobody's weight.
            let first: Option<&usize> = index.get(name);
            match (first.map(|&first| &entries[first].1), item) {
                (Some(Item::Tensor(_)), Item::Tensor(_)) => return Err(PthError::Duplicate(shown(name))),
                (Some(Item::Tensor(_)) | Some(Item::Plain(_)), Item::Plain(_)) => {}
                (Some(Item::Plain(_)), Item::Tensor(_)) | (None, _) => {
                    index.insert(name.clone(), i);
                }
            }
        }
        Ok(State { format, entries, index })
    }

    /// The container it came in.
    pub fn format(&self) -> Format {
        self.format
    }

    /// All entries in the file's order.
    pub fn entries(&self) -> &[(String, Item)] {
        &self.entries
    }

    /// The entry of that dotted name.
    pub fn get(&self, name: &str) -> Option<&Item> {
        self.entries.get(*self.index.get(name)?).map(|(_, item)| item)
    }

    /// The tensors in the file's order.
    pub fn tensors(&self) -> impl Iterator<Item = (&str, &StoredTensor)> {
        self.entries.iter().filter_map(|(name, item)| match item {
            Item::Tensor(t) => Some((name.as_str(), t)),
            Item::Plain(_) => None,
        })
    }

    /// The values that are no tensors, in the file's order.
    pub fn plain(&self) -> impl Iterator<Item = (&str, &Plain)> {
        self.entries.iter().filter_map(|(name, item)| match item {
            Item::Plain(p) => Some((name.as_str(), p)),
            Item::Tensor(_) => None,
        })
    }

    /// The tensor of that dotted name.
    pub fn tensor(&self, name: &str) -> Option<&StoredTensor> {
        match self.get(name)? {
            Item::Tensor(t) => Some(t),
            Item::Plain(_) => None,
        }
    }

    /// The integer of that dotted name: a plain one, or an integer tensor's only element.
    pub fn int(&self, name: &str) -> Option<i64> {
        match self.get(name)? {
            Item::Tensor(t) => t.as_i64(),
            Item::Plain(Plain::Int(i)) => i64::try_from(*i).ok(),
            Item::Plain(_) => None,
        }
    }

    /// Takes `prefix` (`module.`, for example) off every name that begins with it; the other names stay. An error if
    /// two names become one.
    pub fn strip_prefix(self, prefix: &str) -> Result<State, PthError> {
        let strip = |(name, item): (String, Item)| match name.strip_prefix(prefix) {
            Some(rest) => (rest.to_owned(), item),
            None => (name, item),
        };
        State::new(self.format, self.entries.into_iter().map(strip).collect())
    }

    /// Only the entries whose names begin with `prefix` (`state_dict.`, for example), without it.
    pub fn under(self, prefix: &str) -> State {
        let keep = |(name, item): (String, Item)| Some((name.strip_prefix(prefix)?.to_owned(), item));
        let entries: Vec<_> = self.entries.into_iter().filter_map(keep).collect();
        let index = entries.iter().enumerate().map(|(i, (name, _))| (name.clone(), i)).collect();
        State { format: self.format, entries, index }
    }
}

/// Adds up what the tensors of one file would take, which can be more than is stored because they may share it.
pub(super) struct Budget {
    stored: u128,
    claimed: u128,
}

impl Budget {
    pub fn new(stored: u128) -> Self {
        Budget { stored, claimed: 0 }
    }

    /// Counts one more tensor.
    pub fn add(&mut self, name: &str, tensor: &StoredTensor) -> Result<(), PthError> {
        self.claimed = self.claimed.saturating_add(tensor.byte_len() as u128);
        if self.claimed > self.stored * MAX_SHARING + u128::from(SMALL) {
            return Err(PthError::TooLarge(format!(
                "up to `{}` the tensors claim {} bytes out of the {} that are stored",
                shown(name),
                self.claimed,
                self.stored
            )));
        }
        Ok(())
    }
}
