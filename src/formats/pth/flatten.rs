//! From nested Python values to a list of dotted names.

use super::globals::Global;
use super::pickle::{Object, Pickle, Value, View};
use super::state::{Budget, Format, Item, Plain, State};
use super::{MAX_DEPTH, MAX_TEXT, MAX_VALUES, PthError, shown};
use crate::formats::stored::{Storage, StoredTensor};

type Result<T> = std::result::Result<T, PthError>;

impl Pickle<'_> {
    /// The list of dotted names, given each storage's bytes in the order of `storages`.
    pub fn flatten(&self, format: Format, storages: &[Storage]) -> Result<State> {
        let Some(root) = self.names() else {
            // A whole model, pickled as the object that it was.
            if let Value::Unread(which) = self.root {
                return Err(PthError::Refused(self.name_of(which)));
            }
            return Err(PthError::NotACheckpoint(
                "it holds no dictionary of names. Save a model's state_dict()".into(),
            ));
        };
        let mut stored = 0;
        for claim in &self.storages {
            stored += u128::from(claim.bytes()?);
        }
        let mut flat =
            Flat { pickle: self, storages, entries: Vec::new(), budget: Budget::new(stored), values: 0, text: 0 };
        flat.visit(&mut String::new(), 0, root)?;
        let unread = flat.entries.iter().find_map(|(_, item)| match item {
            Item::Plain(Plain::Unread(name)) => Some(name.clone()),
            _ => None,
        });
        if let Some(name) = unread
            && !flat.entries.iter().any(|(_, item)| matches!(item, Item::Tensor(_)))
        {
            return Err(PthError::Refused(name));
        }
        State::new(format, flat.entries)
    }

    /// A name that is not on the allow-list.
    fn name_of(&self, which: usize) -> String {
        self.unknown.get(which).map(|unknown| unknown.name.clone()).unwrap_or_default()
    }
}

impl<'a> Pickle<'a> {
    fn is_dict(&self, value: Value<'a>) -> bool {
        matches!(value, Value::Object(id) if matches!(self.objects.get(id), Some(Object::Dict(_))))
    }

    /// The dictionary of names: the whole, or the only one in a list or tuple, as of (weights, epoch).
    fn names(&self) -> Option<Value<'a>> {
        if self.is_dict(self.root) {
            return Some(self.root);
        }
        let Value::Object(id) = self.root else { return None };
        let Object::Sequence(items) = self.objects.get(id)? else { return None };
        let mut dicts = items.iter().copied().filter(|item| self.is_dict(*item));
        dicts.next().filter(|_| dicts.next().is_none())
    }
}

/// The walk over the nested values. Its depth, the values it looks at and the text it collects are bounded, because
/// shared and circular references make them larger than the file.
struct Flat<'p, 'a> {
    pickle: &'p Pickle<'a>,
    storages: &'p [Storage],
    entries: Vec<(String, Item)>,
    budget: Budget,
    values: usize,
    text: usize,
}

impl<'a> Flat<'_, 'a> {
    fn visit(&mut self, path: &mut String, depth: usize, value: Value<'a>) -> Result<()> {
        self.values += 1;
        if self.values > MAX_VALUES {
            return Err(PthError::TooLarge(format!("it has more than {MAX_VALUES} values")));
        }
        if depth > MAX_DEPTH {
            return Err(PthError::TooLarge(format!(
                "`{}` is nested deeper than {MAX_DEPTH} levels (or contains itself)",
                shown(path)
            )));
        }
        let pickle = self.pickle;
        let plain = match value {
            Value::None => Plain::None,
            Value::Bool(b) => Plain::Bool(b),
            Value::Int(i) => Plain::Int(i),
            Value::Float(x) => Plain::Float(x),
            Value::Text(text) => {
                self.count(text.len())?;
                Plain::Text(text.to_owned())
            }
            Value::Bytes(bytes) => {
                self.count(bytes.len())?;
                Plain::Bytes(bytes.to_vec())
            }
            Value::Latin1(text) => {
                self.count(text.len())?;
                Plain::Bytes(text.chars().filter_map(|c| u8::try_from(u32::from(c)).ok()).collect())
            }
            Value::Global(Global::DtypeValue(dtype)) => Plain::Text(format!("torch.{}", dtype.name())),
            Value::Unread(which) => {
                let name = pickle.name_of(which);
                self.count(name.len())?;
                Plain::Unread(name)
            }
            // A class or function by name, or a number that nothing here could need.
            Value::Global(_) | Value::Useless => return Ok(()),
            Value::Storage(_) => {
                return Err(PthError::damaged(format!(
                    "`{}` is neither a tensor nor a number, string, list or dictionary",
                    shown(path)
                )));
            }
            Value::Object(id) => match pickle.objects.get(id) {
                Some(Object::Sequence(items)) => {
                    for (i, item) in items.iter().enumerate() {
                        self.child(path, depth, &i.to_string(), *item)?;
                    }
                    return Ok(());
                }
                Some(Object::Dict(dict)) => {
                    for (key, item) in &dict.items {
                        match key {
                            Value::Text(key) => self.child(path, depth, key, *item)?,
                            // An optimizer's state is numbered.
                            Value::Int(key) => self.child(path, depth, &key.to_string(), *item)?,
                            // No parameter is called by anything else.
                            _ => {}
                        }
                    }
                    return Ok(());
                }
                Some(Object::View(view)) => {
                    let item = Item::Tensor(self.tensor(path, view)?);
                    return self.push(path, item);
                }
                Some(Object::Blank(_) | Object::Moved) | None => {
                    return Err(PthError::Tensor { name: shown(path), message: "it is unfinished".into() });
                }
            },
        };
        self.push(path, Item::Plain(plain))
    }

    fn child(&mut self, path: &mut String, depth: usize, key: &str, value: Value<'a>) -> Result<()> {
        // Copying one long key again and again takes time, even where no entry comes of it.
        self.count(key.len())?;
        let length = path.len();
        if depth > 0 {
            path.push('.');
        }
        path.push_str(key);
        let result = self.visit(path, depth + 1, value);
        path.truncate(length);
        result
    }

    fn push(&mut self, path: &str, item: Item) -> Result<()> {
        self.count(path.len())?;
        self.entries.push((path.to_owned(), item));
        Ok(())
    }

    fn count(&mut self, bytes: usize) -> Result<()> {
        self.text = self.text.saturating_add(bytes);
        if self.text > MAX_TEXT {
            return Err(PthError::TooLarge(format!("its names and strings have more than {MAX_TEXT} bytes")));
        }
        Ok(())
    }

    fn tensor(&mut self, path: &str, view: &View) -> Result<StoredTensor> {
        let (Some(storage), Some(claim)) = (self.storages.get(view.storage), self.pickle.storages.get(view.storage))
        else {
            return Err(PthError::Tensor { name: shown(path), message: "it has no storage".into() });
        };
        let (shape, strides) = (view.shape.clone(), view.strides.clone());
        let tensor = StoredTensor::new(storage.clone(), claim.dtype, view.offset, shape, strides);
        self.budget.add(path, &tensor)?;
        Ok(tensor)
    }
}
