//! The pickle machine: a stack and a memo. It runs no code, and knows only the names in `globals.rs`.
//!
//! Objects live in one list and refer to each other by position, so that neither building nor dropping them recurses;
//! an object may even contain itself (through the memo), which `flatten.rs` notices by the depth. Every instruction makes
//! at most one object, so the number of instructions bounds the memory.

use std::collections::HashMap;

use super::globals::{Global, global};
use super::{MAX_INSTRUCTIONS, MAX_PICKLE, MAX_RANK, PthError, shown};
use crate::formats::stored::Dtype;

type Result<T> = std::result::Result<T, PthError>;

/// What can lie on the stack. Strings stay in the file's bytes.
#[derive(Clone, Copy, Debug)]
pub(super) enum Value<'a> {
    None,
    Bool(bool),
    Int(i128),
    Float(f64),
    Text(&'a str),
    Bytes(&'a [u8]),
    /// Bytes written as a string with one character for each, as protocol 2 does.
    Latin1(&'a str),
    /// A value that is of no use here: an integer beyond 16 bytes.
    Useless,
    /// One of the names that are known.
    Global(Global),
    /// The position in `Pickle::storages`.
    Storage(usize),
    /// The position in `Pickle::objects`.
    Object(usize),
}

/// What has parts.
#[derive(Debug)]
pub(super) enum Object<'a> {
    /// A list or tuple.
    Sequence(Vec<Value<'a>>),
    Dict(Dict<'a>),
    View(View),
    /// A tensor that `__setstate__` will fill in, as PyTorch before 0.4 wrote them.
    Blank(Global),
    /// A list or dictionary whose parts another object took over. Copying them could be repeated at little cost to the
    /// file; `torch.save` writes such a list for one owner only.
    Moved,
}

#[derive(Debug)]
pub(super) struct Dict<'a> {
    pub items: Vec<(Value<'a>, Value<'a>)>,
    /// Whether BUILD adds to the items (`argparse.Namespace`); an OrderedDict's attributes (`_metadata`) are dropped.
    attributes_count: bool,
}

impl<'a> Dict<'a> {
    fn new(items: Vec<(Value<'a>, Value<'a>)>) -> Self {
        Dict { items, attributes_count: false }
    }
}

/// A tensor as claimed: a view of a storage, inside the length that the storage is said to have.
#[derive(Clone, Debug)]
pub(super) struct View {
    pub storage: usize,
    pub offset: usize,
    pub shape: Vec<usize>,
    pub strides: Vec<usize>,
}

/// A storage as claimed.
#[derive(Debug)]
pub(super) struct Claim<'a> {
    /// Its name: the entry `data/KEY` of an archive.
    pub key: &'a str,
    pub dtype: Dtype,
    /// The number of elements.
    pub numel: usize,
}

impl Claim<'_> {
    /// The length in bytes.
    pub fn bytes(&self) -> Result<u64> {
        (self.numel as u64)
            .checked_mul(self.dtype.size() as u64)
            .ok_or_else(|| PthError::damaged(format!("storage {} claims {} elements", shown(self.key), self.numel)))
    }
}

/// What one pickle built.
pub(super) struct Pickle<'a> {
    pub root: Value<'a>,
    pub objects: Vec<Object<'a>>,
    /// The storages its tensors refer to.
    pub storages: Vec<Claim<'a>>,
    /// Where it ended.
    pub length: usize,
}

/// Reads one pickle from the start of `bytes`; what follows it is left alone.
pub(super) fn read(bytes: &[u8]) -> Result<Pickle<'_>> {
    let limit = usize::try_from(MAX_PICKLE).unwrap_or(usize::MAX);
    let input = bytes.get(..limit).unwrap_or(bytes);
    let mut machine = Machine {
        input,
        at: 0,
        stack: Vec::new(),
        marks: Vec::new(),
        memo: HashMap::new(),
        objects: Vec::new(),
        storages: Vec::new(),
        keys: HashMap::new(),
        unknown: Vec::new(),
    };
    for _ in 0..MAX_INSTRUCTIONS {
        if let Some(root) = machine.step()? {
            let Machine { objects, storages, at, .. } = machine;
            return Ok(Pickle { root, objects, storages, length: at });
        }
    }
    Err(PthError::TooLarge(format!("its pickle has more than {MAX_INSTRUCTIONS} instructions")))
}

/// An integer in two's complement, little end first.
fn long<'a>(bytes: &[u8]) -> Value<'a> {
    let mut wide = [0; 16];
    let Some(low) = wide.get_mut(..bytes.len()) else { return Value::Useless };
    low.copy_from_slice(bytes);
    // The last byte's top bit fills the rest.
    if bytes.last().is_some_and(|b| b & 0x80 != 0) {
        wide[bytes.len()..].fill(0xff);
    }
    Value::Int(i128::from_le_bytes(wide))
}

struct Machine<'a> {
    input: &'a [u8],
    at: usize,
    stack: Vec<Value<'a>>,
    /// The heights of the stack at which a MARK was set.
    marks: Vec<usize>,
    memo: HashMap<u32, Value<'a>>,
    objects: Vec<Object<'a>>,
    storages: Vec<Claim<'a>>,
    /// The storages by key.
    keys: HashMap<&'a str, usize>,
    /// Names that are not on the allow-list: what a call of them is refused by.
    unknown: Vec<String>,
}

impl<'a> Machine<'a> {
    /// Runs one instruction. The result, once there is one.
    fn step(&mut self) -> Result<Option<Value<'a>>> {
        let opcode = self.byte()?;
        match opcode {
            // PROTO
            0x80 => {
                let protocol = self.byte()?;
                if !(2..=5).contains(&protocol) {
                    return Err(self.bad(format!("pickle protocol {protocol}, expected 2 to 5")));
                }
            }
            // FRAME: a hint for reading ahead.
            0x95 => {
                self.take(8)?;
            }
            // STOP
            b'.' => {
                let root = self.pop()?;
                if !self.stack.is_empty() || !self.marks.is_empty() {
                    return Err(self.bad("it ends with more than one value"));
                }
                return Ok(Some(root));
            }
            // MARK
            b'(' => self.marks.push(self.stack.len()),

            // NONE, NEWTRUE, NEWFALSE
            b'N' => self.stack.push(Value::None),
            0x88 => self.stack.push(Value::Bool(true)),
            0x89 => self.stack.push(Value::Bool(false)),
            // BININT, BININT1, BININT2, LONG1, BINFLOAT
            b'J' => {
                let bytes = self.array()?;
                self.stack.push(Value::Int(i128::from(i32::from_le_bytes(bytes))));
            }
            b'K' => {
                let byte = self.byte()?;
                self.stack.push(Value::Int(i128::from(byte)));
            }
            b'M' => {
                let bytes = self.array()?;
                self.stack.push(Value::Int(i128::from(u16::from_le_bytes(bytes))));
            }
            // LONG4 has the longer length.
            0x8a | 0x8b => {
                let length = self.length(if opcode == 0x8a { 1 } else { 4 })?;
                let bytes = self.take(length)?;
                self.stack.push(long(bytes));
            }
            b'G' => {
                let bytes = self.array()?;
                self.stack.push(Value::Float(f64::from_be_bytes(bytes)));
            }

            // BINUNICODE, SHORT_BINUNICODE, BINUNICODE8
            b'X' | 0x8c | 0x8d => {
                let length = self.length(match opcode {
                    b'X' => 4,
                    0x8c => 1,
                    _ => 8,
                })?;
                let bytes = self.take(length)?;
                let text = str::from_utf8(bytes).map_err(|_| self.bad("a string that is not UTF-8"))?;
                self.stack.push(Value::Text(text));
            }
            // SHORT_BINSTRING, BINSTRING: Python 2's strings, which may be names.
            b'U' | b'T' => {
                let length = self.length(if opcode == b'U' { 1 } else { 4 })?;
                let bytes = self.take(length)?;
                self.stack.push(str::from_utf8(bytes).map_or(Value::Bytes(bytes), Value::Text));
            }
            // SHORT_BINBYTES, BINBYTES, BINBYTES8
            b'C' | b'B' | 0x8e => {
                let length = self.length(match opcode {
                    b'C' => 1,
                    b'B' => 4,
                    _ => 8,
                })?;
                let bytes = self.take(length)?;
                self.stack.push(Value::Bytes(bytes));
            }

            // BYTEARRAY8
            0x96 => {
                let length = self.length(8)?;
                let bytes = self.take(length)?;
                self.stack.push(Value::Bytes(bytes));
            }

            // EMPTY_TUPLE, EMPTY_LIST, EMPTY_SET, EMPTY_DICT
            b')' | b']' | 0x8f => self.push_object(Object::Sequence(Vec::new())),
            b'}' => self.push_object(Object::Dict(Dict::new(Vec::new()))),
            // TUPLE, FROZENSET, TUPLE1, TUPLE2, TUPLE3
            b't' | 0x91 => {
                let items = self.pop_mark()?;
                self.push_object(Object::Sequence(items));
            }
            0x85..=0x87 => {
                let mut items = Vec::with_capacity(3);
                for _ in 0..opcode - 0x84 {
                    items.push(self.pop()?);
                }
                items.reverse();
                self.push_object(Object::Sequence(items));
            }
            // APPEND, APPENDS, ADDITEMS
            b'a' | b'e' | 0x90 => {
                let items = if opcode == b'a' { vec![self.pop()?] } else { self.pop_mark()? };
                match self.top_object()? {
                    Object::Sequence(list) => list.extend(items),
                    _ => return Err(self.bad("it appends to something that is not a list")),
                }
            }
            // SETITEM, SETITEMS
            b's' | b'u' => {
                let items = if opcode == b'u' {
                    self.pop_mark()?
                } else {
                    let value = self.pop()?;
                    vec![self.pop()?, value]
                };
                let (pairs, rest) = items.as_chunks::<2>();
                let complete = rest.is_empty();
                match self.top_object()? {
                    Object::Dict(dict) if complete => {
                        dict.items.extend(pairs.iter().map(|[key, value]| (*key, *value)))
                    }
                    _ => return Err(self.bad("it sets items of something that is not a dictionary")),
                }
            }

            // BINPUT, LONG_BINPUT, MEMOIZE
            b'q' | b'r' | 0x94 => {
                let slot = match opcode {
                    b'q' => u32::from(self.byte()?),
                    b'r' => u32::from_le_bytes(self.array()?),
                    _ => u32::try_from(self.memo.len()).unwrap_or(u32::MAX),
                };
                let value = self.top()?;
                self.memo.insert(slot, value);
            }
            // BINGET, LONG_BINGET
            b'h' | b'j' => {
                let slot = if opcode == b'h' { u32::from(self.byte()?) } else { u32::from_le_bytes(self.array()?) };
                match self.memo.get(&slot) {
                    Some(value) => self.stack.push(*value),
                    None => return Err(self.bad(format!("memo {slot} is read before it is set"))),
                }
            }

            // GLOBAL, and INST (never written by torch.save, but its name is worth telling)
            b'c' | b'i' => {
                let module = self.line()?;
                let name = self.line()?;
                let found = self.global(module, name);
                if opcode == b'i' {
                    // A call, of whatever it names.
                    return Err(match found {
                        Global::Unknown(which) => self.refused(which),
                        _ => self.bad("opcode INST, which torch.save does not write"),
                    });
                }
                self.stack.push(Value::Global(found));
            }
            // STACK_GLOBAL
            0x93 => match (self.pop()?, self.pop()?) {
                (Value::Text(name), Value::Text(module)) => {
                    let found = self.global(module, name);
                    self.stack.push(Value::Global(found));
                }
                _ => return Err(self.bad("a global whose name is not a string")),
            },
            // REDUCE, NEWOBJ, BUILD
            b'R' => {
                let (arguments, callee) = self.pop_call()?;
                let made = self.reduce(callee, arguments)?;
                self.stack.push(made);
            }
            0x81 => {
                let (arguments, class) = self.pop_call()?;
                match class {
                    Global::OrderedDict | Global::Dictionary if arguments.is_empty() => {
                        self.push_object(Object::Dict(Dict::new(Vec::new())))
                    }
                    Global::Namespace if arguments.is_empty() => {
                        self.push_object(Object::Dict(Dict { items: Vec::new(), attributes_count: true }));
                    }
                    Global::Parameter | Global::TensorClass if arguments.is_empty() => {
                        self.push_object(Object::Blank(class));
                    }
                    _ => return Err(self.bad(format!("it makes a new {class:?} from {} values", arguments.len()))),
                }
            }
            b'b' => self.build()?,
            // BINPERSID
            b'Q' => {
                let id = self.pop()?;
                let storage = self.storage(id)?;
                self.stack.push(Value::Storage(storage));
            }

            other => {
                return Err(self.bad(format!("opcode 0x{other:02x}, which torch.save does not write")));
            }
        }
        Ok(None)
    }

    /// An error at this place of the pickle.
    fn bad(&self, what: impl AsRef<str>) -> PthError {
        PthError::damaged(format!("its pickle, at byte {}: {}", self.at, what.as_ref()))
    }

    /// An error about the tensor that is being built. Its name is the dictionary key that lies below it.
    fn bad_tensor(&self, message: impl Into<String>) -> PthError {
        let name = match self.stack.last() {
            Some(Value::Text(name)) => shown(name),
            _ => "?".into(),
        };
        PthError::Tensor { name, message: message.into() }
    }

    fn take(&mut self, n: usize) -> Result<&'a [u8]> {
        let rest = self.input.get(self.at..).unwrap_or(&[]);
        let Some(bytes) = rest.get(..n) else {
            return Err(if self.input.len() as u64 >= MAX_PICKLE {
                PthError::TooLarge(format!("its pickle has {MAX_PICKLE} bytes or more"))
            } else {
                PthError::truncated(format!("its pickle ends at byte {}, inside a value", self.input.len()))
            });
        };
        self.at += n;
        Ok(bytes)
    }

    fn byte(&mut self) -> Result<u8> {
        let [byte] = self.array()?;
        Ok(byte)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N]> {
        let mut out = [0; N];
        out.copy_from_slice(self.take(N)?);
        Ok(out)
    }

    /// A length in 1, 4 or 8 bytes.
    fn length(&mut self, width: usize) -> Result<usize> {
        let mut wide = [0; 8];
        wide[..width].copy_from_slice(self.take(width)?);
        // What does not fit is beyond the end of the pickle in any case.
        Ok(usize::try_from(u64::from_le_bytes(wide)).unwrap_or(usize::MAX))
    }

    /// A line of a GLOBAL, without its end.
    fn line(&mut self) -> Result<&'a str> {
        let rest = self.input.get(self.at..).unwrap_or(&[]);
        let window = rest.get(..256).unwrap_or(rest);
        let Some(end) = window.iter().position(|&b| b == b'\n') else {
            return Err(self.bad("a global's name without an end"));
        };
        let line = self.take(end)?;
        self.take(1)?;
        str::from_utf8(line).map_err(|_| self.bad("a global's name that is not UTF-8"))
    }

    /// The lowest height of the stack that an instruction may reach down to.
    fn floor(&self) -> usize {
        self.marks.last().copied().unwrap_or(0)
    }

    fn pop(&mut self) -> Result<Value<'a>> {
        if self.stack.len() > self.floor()
            && let Some(value) = self.stack.pop()
        {
            return Ok(value);
        }
        Err(self.bad("it takes a value from an empty stack"))
    }

    fn top(&self) -> Result<Value<'a>> {
        match self.stack.last() {
            Some(value) if self.stack.len() > self.floor() => Ok(*value),
            _ => Err(self.bad("it reads a value from an empty stack")),
        }
    }

    fn pop_mark(&mut self) -> Result<Vec<Value<'a>>> {
        match self.marks.pop() {
            Some(height) if height <= self.stack.len() => Ok(self.stack.split_off(height)),
            _ => Err(self.bad("it goes back to a mark that was not set")),
        }
    }

    fn push_object(&mut self, object: Object<'a>) {
        self.stack.push(Value::Object(self.objects.len()));
        self.objects.push(object);
    }

    fn top_object(&mut self) -> Result<&mut Object<'a>> {
        if let Value::Object(id) = self.top()?
            && id < self.objects.len()
        {
            return Ok(&mut self.objects[id]);
        }
        Err(self.bad("it changes something that has no parts"))
    }

    /// The parts of a list or tuple.
    fn sequence(&self, value: Value<'a>) -> Option<&[Value<'a>]> {
        match value {
            Value::Object(id) => match self.objects.get(id)? {
                Object::Sequence(items) => Some(items),
                _ => None,
            },
            _ => None,
        }
    }

    /// The arguments of a call and the name that is called.
    fn pop_call(&mut self) -> Result<(Vec<Value<'a>>, Global)> {
        let arguments = self.pop()?;
        let callee = self.pop()?;
        let Value::Global(callee) = callee else {
            return Err(self.bad("it calls something that is not a name"));
        };
        if let Global::Unknown(which) = callee {
            return Err(self.refused(which));
        }
        match self.sequence(arguments) {
            Some(items) if items.len() <= 8 => Ok((items.to_vec(), callee)),
            Some(items) => Err(self.bad(format!("it calls {callee:?} with {} arguments", items.len()))),
            None => Err(self.bad(format!("it calls {callee:?} with something that is not a tuple"))),
        }
    }

    /// A name, known or not.
    fn global(&mut self, module: &str, name: &str) -> Global {
        global(module, name).unwrap_or_else(|| {
            self.unknown.push(shown(&format!("{module}.{name}")));
            Global::Unknown(self.unknown.len() - 1)
        })
    }

    /// The error of calling a name that is not on the allow-list.
    fn refused(&self, which: usize) -> PthError {
        PthError::Refused(self.unknown.get(which).cloned().unwrap_or_default())
    }

    /// What calling one of the known names gives.
    fn reduce(&mut self, callee: Global, arguments: Vec<Value<'a>>) -> Result<Value<'a>> {
        match (callee, arguments.as_slice()) {
            (Global::OrderedDict, []) => Ok(self.add(Object::Dict(Dict::new(Vec::new())))),
            // Python 2: a list of pairs.
            (Global::OrderedDict, [list]) => {
                let Some(Object::Sequence(taken)) = self.take_over(*list) else {
                    return Err(self.bad("an OrderedDict of something that is not a list"));
                };
                let mut items = Vec::with_capacity(taken.len());
                for pair in taken {
                    match self.sequence(pair) {
                        Some([key, value]) => items.push((*key, *value)),
                        _ => return Err(self.bad("an OrderedDict with an item that is not a pair")),
                    }
                }
                Ok(self.add(Object::Dict(Dict::new(items))))
            }
            // A Counter's only argument is a dictionary; a defaultdict's, what makes its defaults.
            (Global::Dictionary, [] | [Value::Global(_) | Value::None]) => {
                Ok(self.add(Object::Dict(Dict::new(Vec::new()))))
            }
            (Global::Dictionary, [items]) => match self.take_over(*items) {
                Some(Object::Dict(dict)) => Ok(self.add(Object::Dict(dict))),
                _ => Err(self.bad("a dictionary of something that is none")),
            },
            (Global::Row, []) => Ok(self.add(Object::Sequence(Vec::new()))),
            (Global::Row, [items]) if self.sequence(*items).is_some() => Ok(*items),
            (Global::ByteArray, []) => Ok(Value::Bytes(&[])),
            (
                Global::ByteArray,
                [bytes @ (Value::Bytes(_) | Value::Latin1(_) | Value::Text(_))] | [bytes, Value::Text(_)],
            ) => Ok(*bytes),
            (Global::Size, [sizes]) if self.sequence(*sizes).is_some() => Ok(*sizes),
            (Global::Device, [Value::Text(name)] | [Value::Text(name), Value::Int(_)]) => Ok(Value::Text(name)),
            (Global::Encode, [Value::Text(text), Value::Text("latin1" | "latin-1")]) => {
                if text.chars().all(|c| u32::from(c) < 256) {
                    Ok(Value::Latin1(text))
                } else {
                    Err(self.bad("bytes with a character beyond 255"))
                }
            }
            (Global::RebuildTensor, [storage, offset, shape, strides])
            | (Global::RebuildTensorV2, [storage, offset, shape, strides, _, _]) => {
                let view = self.view(*storage, *offset, *shape, *strides)?;
                Ok(self.add(Object::View(view)))
            }
            (Global::RebuildTensorV2, [storage, offset, shape, strides, _, _, metadata]) => {
                // It says that the numbers are negated or conjugated, when it says anything.
                let plain = match metadata {
                    Value::None => true,
                    Value::Object(id) => matches!(self.objects.get(*id), Some(Object::Dict(d)) if d.items.is_empty()),
                    _ => false,
                };
                if !plain {
                    return Err(
                        self.bad_tensor("it is stored with metadata (negated or conjugated), which is not read")
                    );
                }
                let view = self.view(*storage, *offset, *shape, *strides)?;
                Ok(self.add(Object::View(view)))
            }
            (Global::RebuildParameter, [tensor, _, _]) | (Global::Parameter, [tensor] | [tensor, _])
                if self.is_view(*tensor) =>
            {
                Ok(*tensor)
            }
            _ => Err(self.bad(format!("it calls {callee:?} with {} arguments that do not fit", arguments.len()))),
        }
    }

    fn add(&mut self, object: Object<'a>) -> Value<'a> {
        self.objects.push(object);
        Value::Object(self.objects.len() - 1)
    }

    /// The object itself, of which nothing is left in its place.
    fn take_over(&mut self, value: Value<'a>) -> Option<Object<'a>> {
        let Value::Object(id) = value else { return None };
        Some(std::mem::replace(self.objects.get_mut(id)?, Object::Moved))
    }

    fn is_view(&self, value: Value<'a>) -> bool {
        matches!(value, Value::Object(id) if matches!(self.objects.get(id), Some(Object::View(_))))
    }

    /// BUILD: gives an object its attributes.
    fn build(&mut self) -> Result<()> {
        let state = self.pop()?;
        let Value::Object(target) = self.top()? else {
            return Err(self.bad("it builds something that has no parts"));
        };
        let parts = self.sequence(state).map(|items| items.get(..8).unwrap_or(items).to_vec()).unwrap_or_default();
        let filled = match (self.objects.get(target), parts.as_slice()) {
            (Some(Object::Dict(dict)), _) if !dict.attributes_count => return Ok(()),
            (Some(Object::Dict(_)), _) => {
                let attributes = self.take_over(state);
                return match (self.objects.get_mut(target), attributes) {
                    (Some(Object::Dict(dict)), Some(Object::Dict(attributes))) => {
                        dict.items.extend(attributes.items);
                        Ok(())
                    }
                    _ => Err(self.bad("a Namespace of something that is not a dictionary")),
                };
            }
            (Some(Object::Blank(Global::TensorClass)), [storage, offset, shape, strides]) => {
                // The key that names the tensor lies below the tensor itself.
                let tensor = self.pop()?;
                let view = self.view(*storage, *offset, *shape, *strides)?;
                self.stack.push(tensor);
                view
            }
            (Some(Object::Blank(Global::Parameter)), [Value::Object(data), _, _, _, _]) => {
                match self.objects.get(*data) {
                    Some(Object::View(view)) => view.clone(),
                    _ => return Err(self.bad("a Parameter of something that is not a tensor")),
                }
            }
            _ => return Err(self.bad("it builds something that is neither a dictionary nor a tensor")),
        };
        if let Some(object) = self.objects.get_mut(target) {
            *object = Object::View(filled);
        }
        Ok(())
    }

    /// The storage that a persistent id names: ("storage", class, key, location, number of elements).
    fn storage(&mut self, id: Value<'a>) -> Result<usize> {
        let (class, key, numel) = match self.sequence(id) {
            Some([Value::Text("storage"), class, Value::Text(key), _, Value::Int(numel)])
            | Some([Value::Text("storage"), class, Value::Text(key), _, Value::Int(numel), Value::None]) => {
                (*class, *key, *numel)
            }
            Some([Value::Text("storage"), _, _, _, _, _]) => {
                return Err(PthError::Unsupported(
                    "it has views of storages, as PyTorch before 0.4 wrote them: load it in Python and save it again"
                        .into(),
                ));
            }
            _ => return Err(self.bad("a reference to something that is not a storage")),
        };
        let Value::Global(Global::Storage(dtype)) = class else {
            return Err(self.bad(format!("storage {} without a kind of numbers", shown(key))));
        };
        let numel =
            usize::try_from(numel).map_err(|_| self.bad(format!("storage {} of {numel} elements", shown(key))))?;
        if let Some(&known) = self.keys.get(key) {
            let first = &self.storages[known];
            if first.dtype != dtype || first.numel != numel {
                return Err(self.bad(format!(
                    "storage {} is first {} x {}, then {numel} x {}",
                    shown(key),
                    first.numel,
                    first.dtype.name(),
                    dtype.name()
                )));
            }
            return Ok(known);
        }
        self.keys.insert(key, self.storages.len());
        self.storages.push(Claim { key, dtype, numel });
        Ok(self.storages.len() - 1)
    }

    /// A tensor over a storage, if it stays inside.
    fn view(&self, storage: Value<'a>, offset: Value<'a>, shape: Value<'a>, strides: Value<'a>) -> Result<View> {
        let Value::Storage(storage) = storage else {
            return Err(self.bad_tensor("it has no storage"));
        };
        let Some(Claim { numel, .. }) = self.storages.get(storage) else {
            return Err(self.bad_tensor("it has no storage"));
        };
        let shape = self.sizes(shape, "shape")?;
        let mut strides = self.sizes(strides, "strides")?;
        let offset = self.size(offset, "offset")?;
        if shape.len() != strides.len() {
            let message = format!("shape {shape:?} and strides {strides:?} have different lengths");
            return Err(self.bad_tensor(message));
        }
        // The count without the zeros, so that no product of some dimensions overflows later.
        let count = shape.iter().try_fold(1_usize, |n, &d| n.checked_mul(d.max(1)));
        let mut last = Some(offset);
        for (&n, stride) in shape.iter().zip(&mut strides) {
            if n <= 1 {
                // Never used, and free to be anything.
                *stride = 0;
            }
            last = (n.saturating_sub(1)).checked_mul(*stride).and_then(|distance| distance.checked_add(last?));
        }
        let inside = shape.contains(&0) || last.is_some_and(|last| last < *numel);
        if count.is_none_or(|n| isize::try_from(n).is_err()) || !inside {
            return Err(self.bad_tensor(format!(
                "shape {shape:?} with strides {strides:?} from element {offset} is larger than the storage's {numel} \
                 elements"
            )));
        }
        Ok(View { storage, offset, shape, strides })
    }

    fn sizes(&self, value: Value<'a>, what: &str) -> Result<Vec<usize>> {
        match self.sequence(value) {
            Some(items) if items.len() <= MAX_RANK => items.iter().map(|item| self.size(*item, what)).collect(),
            Some(items) => Err(self.bad_tensor(format!("{} dimensions (at most {MAX_RANK})", items.len()))),
            None => Err(self.bad_tensor(format!("its {what} is not a tuple"))),
        }
    }

    fn size(&self, value: Value<'a>, what: &str) -> Result<usize> {
        match value {
            Value::Int(n) => usize::try_from(n).map_err(|_| self.bad_tensor(format!("its {what} contains {n}"))),
            _ => Err(self.bad_tensor(format!("its {what} contains something that is not an integer"))),
        }
    }
}

impl<'a> Pickle<'a> {
    /// The integer that this pickle is.
    pub fn int(&self) -> Option<i128> {
        match self.root {
            Value::Int(i) => Some(i),
            _ => None,
        }
    }

    /// What stands in this pickle, a dictionary, under a string.
    pub fn field(&self, name: &str) -> Option<Value<'a>> {
        let Value::Object(id) = self.root else { return None };
        let Object::Dict(dict) = self.objects.get(id)? else { return None };
        dict.items.iter().find(|(key, _)| matches!(key, Value::Text(k) if *k == name)).map(|(_, value)| *value)
    }

    /// The strings that this pickle, a list, consists of.
    pub fn texts(&self) -> Option<Vec<&'a str>> {
        let Value::Object(id) = self.root else { return None };
        let Object::Sequence(items) = self.objects.get(id)? else { return None };
        items.iter().map(|item| if let Value::Text(text) = item { Some(*text) } else { None }).collect()
    }
}
