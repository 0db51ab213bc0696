//! The pickle machine: a stack and a memo. It runs no code, and knows only the names in `globals.rs`.
//!
//! Objects live in one list and refer to each other by position, so that neither building nor dropping them recurses;
//! an object may even contain itself (through the memo), which `flatten.rs` notices by the depth. Every instruction makes
//! at most one object, so the number of instructions bounds the memory.

use std::collections::HashMap;

use super::globals::{Global, global, runs_programs};
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
    /// What calling a name that is not known would give: its number in `Pickle::unknown`. Nothing is called; whatever
    /// Python would do with the result is passed over.
    Unread(usize),
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

/// A name that is not on the allow-list.
#[derive(Debug)]
pub(super) struct Unknown {
    /// Module and name, fit to be shown.
    pub name: String,
    /// Whether calling it could run a program.
    runs: bool,
}

/// What one pickle built.
pub(super) struct Pickle<'a> {
    pub root: Value<'a>,
    pub objects: Vec<Object<'a>>,
    /// The storages its tensors refer to.
    pub storages: Vec<Claim<'a>>,
    /// The names it mentions that are not on the allow-list.
    pub unknown: Vec<Unknown>,
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
            let Machine { objects, storages, unknown, at, .. } = machine;
            return Ok(Pickle { root, objects, storages, unknown, length: at });
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
    unknown: Vec<Unknown>,
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
            b'N' | 0x88 | 0x89 | b'J' | b'K' | b'M' | 0x8a | 0x8b | b'G' => {
                let number = self.number(opcode)?;
                self.stack.push(number);
            }
            b'X' | 0x8c | 0x8d | b'U' | b'T' | b'C' | b'B' | 0x8e | 0x96 => {
                let text = self.text(opcode)?;
                self.stack.push(text);
            }
            b')' | b']' | 0x8f | b'}' | b't' | 0x91 | 0x85..=0x87 => self.container(opcode)?,
            b'a' | b'e' | 0x90 | b's' | b'u' => self.fill(opcode)?,
            b'q' | b'r' | 0x94 | b'h' | b'j' => self.remember(opcode)?,
            b'c' | b'i' | 0x93 => self.name(opcode)?,
            b'R' | 0x81 | b'b' | b'Q' => self.call(opcode)?,
            other => {
                return Err(self.bad(format!("opcode 0x{other:02x}, which torch.save does not write")));
            }
        }
        Ok(None)
    }

    /// NONE, NEWTRUE, NEWFALSE, BININT, BININT1, BININT2, LONG1, LONG4, BINFLOAT: a value that is a number or like one.
    fn number(&mut self, opcode: u8) -> Result<Value<'a>> {
        Ok(match opcode {
            b'N' => Value::None,
            0x88 => Value::Bool(true),
            0x89 => Value::Bool(false),
            b'J' => Value::Int(i128::from(i32::from_le_bytes(self.array()?))),
            b'K' => Value::Int(i128::from(self.byte()?)),
            b'M' => Value::Int(i128::from(u16::from_le_bytes(self.array()?))),
            0x8a | 0x8b => {
                let length = self.length(if opcode == 0x8a { 1 } else { 4 })?;
                long(self.take(length)?)
            }
            _ => Value::Float(f64::from_be_bytes(self.array()?)),
        })
    }

    /// The strings (BINUNICODE, SHORT_BINUNICODE, BINUNICODE8), Python 2's strings, which may be names (SHORT_BINSTRING,
    /// BINSTRING), and the bytes (SHORT_BINBYTES, BINBYTES, BINBYTES8, BYTEARRAY8).
    fn text(&mut self, opcode: u8) -> Result<Value<'a>> {
        let length = self.length(match opcode {
            0x8c | b'U' | b'C' => 1,
            b'X' | b'T' | b'B' => 4,
            _ => 8,
        })?;
        let bytes = self.take(length)?;
        match opcode {
            b'X' | 0x8c | 0x8d => {
                str::from_utf8(bytes).map(Value::Text).map_err(|_| self.bad("a string that is not UTF-8"))
            }
            b'U' | b'T' => Ok(str::from_utf8(bytes).map_or(Value::Bytes(bytes), Value::Text)),
            _ => Ok(Value::Bytes(bytes)),
        }
    }

    /// EMPTY_TUPLE, EMPTY_LIST, EMPTY_SET, EMPTY_DICT, and what takes its parts from the stack: TUPLE, FROZENSET, TUPLE1,
    /// TUPLE2, TUPLE3.
    fn container(&mut self, opcode: u8) -> Result<()> {
        let object = match opcode {
            b')' | b']' | 0x8f => Object::Sequence(Vec::new()),
            b'}' => Object::Dict(Dict::new(Vec::new())),
            b't' | 0x91 => Object::Sequence(self.pop_mark()?),
            _ => {
                let mut items = Vec::with_capacity(3);
                for _ in 0..opcode - 0x84 {
                    items.push(self.pop()?);
                }
                items.reverse();
                Object::Sequence(items)
            }
        };
        self.push_object(object);
        Ok(())
    }

    /// APPEND, APPENDS, ADDITEMS; SETITEM, SETITEMS: parts added to the object on top of the stack.
    fn fill(&mut self, opcode: u8) -> Result<()> {
        let items = match opcode {
            b'a' => vec![self.pop()?],
            b's' => {
                let value = self.pop()?;
                vec![self.pop()?, value]
            }
            _ => self.pop_mark()?,
        };
        if let Value::Unread(_) = self.top()? {
            return Ok(());
        }
        if matches!(opcode, b'a' | b'e' | 0x90) {
            return match self.top_object()? {
                Object::Sequence(list) => {
                    list.extend(items);
                    Ok(())
                }
                _ => Err(self.bad("it appends to something that is not a list")),
            };
        }
        let (pairs, rest) = items.as_chunks::<2>();
        match self.top_object()? {
            Object::Dict(dict) if rest.is_empty() => {
                dict.items.extend(pairs.iter().map(|[key, value]| (*key, *value)));
                Ok(())
            }
            _ => Err(self.bad("it sets items of something that is not a dictionary")),
        }
    }

    /// BINPUT, LONG_BINPUT, MEMOIZE; BINGET, LONG_BINGET: into the memo and out of it.
    fn remember(&mut self, opcode: u8) -> Result<()> {
        let slot = match opcode {
            b'q' | b'h' => u32::from(self.byte()?),
            b'r' | b'j' => u32::from_le_bytes(self.array()?),
            _ => u32::try_from(self.memo.len()).unwrap_or(u32::MAX),
        };
        if matches!(opcode, b'h' | b'j') {
            let Some(value) = self.memo.get(&slot) else {
                return Err(self.bad(format!("memo {slot} is read before it is set")));
            };
            self.stack.push(*value);
        } else {
            let value = self.top()?;
            self.memo.insert(slot, value);
        }
        Ok(())
    }

    /// GLOBAL, STACK_GLOBAL: a name; INST: a call of one, never written by torch.save, but its name is worth telling.
    fn name(&mut self, opcode: u8) -> Result<()> {
        let (module, name) = if opcode == 0x93 {
            match (self.pop()?, self.pop()?) {
                (Value::Text(name), Value::Text(module)) => (module, name),
                _ => return Err(self.bad("a global whose name is not a string")),
            }
        } else {
            (self.line()?, self.line()?)
        };
        let found = self.global(module, name);
        if opcode == b'i' {
            return Err(match found {
                Global::Unknown(which) => PthError::Refused(self.unknown[which].name.clone()),
                _ => self.bad("opcode INST, which torch.save does not write"),
            });
        }
        self.stack.push(Value::Global(found));
        Ok(())
    }

    /// REDUCE, NEWOBJ, BUILD, BINPERSID: what Python would make by a call.
    fn call(&mut self, opcode: u8) -> Result<()> {
        let made = match opcode {
            b'R' | 0x81 => {
                let arguments = self.pop()?;
                let callee = self.pop()?;
                let Value::Global(callee) = callee else {
                    return Err(self.bad("it calls something that is not a name"));
                };
                if let Global::Unknown(which) = callee {
                    self.unread(which)?
                } else {
                    let arguments = self.arguments(callee, arguments)?;
                    if opcode == b'R' { self.reduce(callee, arguments)? } else { self.instance(callee, &arguments)? }
                }
            }
            b'b' => return self.build(),
            _ => {
                let id = self.pop()?;
                self.storage(id)?
            }
        };
        self.stack.push(made);
        Ok(())
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

    /// The arguments of a call of a known name.
    fn arguments(&self, callee: Global, arguments: Value<'a>) -> Result<Vec<Value<'a>>> {
        match self.sequence(arguments) {
            Some(items) if items.len() <= 8 => Ok(items.to_vec()),
            Some(items) => Err(self.bad(format!("it calls {callee:?} with {} arguments", items.len()))),
            None => Err(self.bad(format!("it calls {callee:?} with something that is not a tuple"))),
        }
    }

    /// A name, known or not.
    fn global(&mut self, module: &str, name: &str) -> Global {
        global(module, name).unwrap_or_else(|| {
            let runs = runs_programs(module, name);
            self.unknown.push(Unknown { name: shown(&format!("{module}.{name}")), runs });
            Global::Unknown(self.unknown.len() - 1)
        })
    }

    /// Stands for what calling a name that is not on the allow-list would give. A call that could run a program has no
    /// place beside weights, so the file is refused.
    fn unread(&self, which: usize) -> Result<Value<'a>> {
        match self.unknown.get(which) {
            Some(Unknown { runs: false, .. }) => Ok(Value::Unread(which)),
            unknown => Err(PthError::Refused(unknown.map(|u| u.name.clone()).unwrap_or_default())),
        }
    }

    /// A new, empty instance of one of the known classes.
    fn instance(&mut self, class: Global, arguments: &[Value<'a>]) -> Result<Value<'a>> {
        let object = match class {
            Global::OrderedDict | Global::Dictionary if arguments.is_empty() => Object::Dict(Dict::new(Vec::new())),
            Global::Namespace if arguments.is_empty() => {
                Object::Dict(Dict { items: Vec::new(), attributes_count: true })
            }
            Global::Parameter | Global::TensorClass if arguments.is_empty() => Object::Blank(class),
            _ => return Err(self.bad(format!("it makes a new {class:?} from {} values", arguments.len()))),
        };
        Ok(self.add(object))
    }

    /// What calling one of the known names gives.
    fn reduce(&mut self, callee: Global, arguments: Vec<Value<'a>>) -> Result<Value<'a>> {
        match (callee, arguments.as_slice()) {
            (Global::OrderedDict, [list]) => self.ordered(*list),
            // A defaultdict's argument is what makes its defaults.
            (Global::OrderedDict, []) | (Global::Dictionary, [] | [Value::Global(_) | Value::None]) => {
                Ok(self.add(Object::Dict(Dict::new(Vec::new()))))
            }
            // A Counter's is a dictionary.
            (Global::Dictionary, [items]) => match self.take_over(*items) {
                Some(Object::Dict(dict)) => Ok(self.add(Object::Dict(dict))),
                _ => Err(self.bad("a dictionary of something that is none")),
            },
            (Global::Row, []) => Ok(self.add(Object::Sequence(Vec::new()))),
            (Global::Row | Global::Size, [items]) if self.sequence(*items).is_some() => Ok(*items),
            (Global::ByteArray, []) => Ok(Value::Bytes(&[])),
            (
                Global::ByteArray,
                [bytes @ (Value::Bytes(_) | Value::Latin1(_) | Value::Text(_))] | [bytes, Value::Text(_)],
            ) => Ok(*bytes),
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
                self.tensor(*storage, *offset, *shape, *strides)
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
                self.tensor(*storage, *offset, *shape, *strides)
            }
            (Global::RebuildParameter, [tensor, _, _]) | (Global::Parameter, [tensor] | [tensor, _])
                if self.is_view(*tensor) || matches!(tensor, Value::Unread(_)) =>
            {
                Ok(*tensor)
            }
            _ => Err(self.bad(format!("it calls {callee:?} with {} arguments that do not fit", arguments.len()))),
        }
    }

    /// An OrderedDict as Python 2 writes it: from a list of pairs.
    fn ordered(&mut self, list: Value<'a>) -> Result<Value<'a>> {
        let Some(Object::Sequence(taken)) = self.take_over(list) else {
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

    /// A tensor over a storage; unread, if the storage's kind of numbers is not known.
    fn tensor(
        &mut self,
        storage: Value<'a>,
        offset: Value<'a>,
        shape: Value<'a>,
        strides: Value<'a>,
    ) -> Result<Value<'a>> {
        if let Value::Unread(which) = storage {
            return Ok(Value::Unread(which));
        }
        let view = self.view(storage, offset, shape, strides)?;
        Ok(self.add(Object::View(view)))
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
        let target = match self.top()? {
            Value::Object(target) => target,
            Value::Unread(_) => return Ok(()),
            _ => return Err(self.bad("it builds something that has no parts")),
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
    fn storage(&mut self, id: Value<'a>) -> Result<Value<'a>> {
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
        let dtype = match class {
            Value::Global(Global::Storage(dtype)) => dtype,
            // Numbers of another kind: complex ones, quantised ones.
            Value::Global(Global::Unknown(which)) => return self.unread(which),
            _ => return Err(self.bad(format!("storage {} without a kind of numbers", shown(key)))),
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
            return Ok(Value::Storage(known));
        }
        self.keys.insert(key, self.storages.len());
        self.storages.push(Claim { key, dtype, numel });
        Ok(Value::Storage(self.storages.len() - 1))
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
