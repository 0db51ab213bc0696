//! The Python names that mean something here. Each stands for something that is made here; none is run.

use crate::formats::stored::Dtype;

/// A name that a pickle mentions, and what it stands for here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Global {
    OrderedDict,
    /// Settings of a training script (DeiT and its descendants save them): no more than a dictionary.
    Namespace,
    Size,
    Device,
    /// `_codecs.encode`: bytes in protocol 2.
    Encode,
    /// `collections.Counter` and `defaultdict`: dictionaries with a habit that does not matter here.
    Dictionary,
    /// `set`, `frozenset`, `list`, `tuple`: parts in a row.
    Row,
    /// `bytearray`.
    ByteArray,
    /// Any other name, by its number in the machine's list. It may stand somewhere as a value and be called: both are
    /// passed over.
    Unknown(usize),
    RebuildTensor,
    RebuildTensorV2,
    RebuildParameter,
    Parameter,
    Storage(Dtype),
    TensorClass,
    /// A dtype that is stored as a value, `torch.float32`.
    DtypeValue(Dtype),
}

/// The allow-list; nothing for a name that is not on it.
pub(super) fn global(module: &str, name: &str) -> Option<Global> {
    match (module, name) {
        ("collections", "OrderedDict") => Some(Global::OrderedDict),
        ("collections", "Counter" | "defaultdict") => Some(Global::Dictionary),
        ("builtins" | "__builtin__", "set" | "frozenset" | "list" | "tuple") => Some(Global::Row),
        ("builtins" | "__builtin__", "bytearray") => Some(Global::ByteArray),
        ("builtins" | "__builtin__", "dict") => Some(Global::Dictionary),
        ("argparse", "Namespace") => Some(Global::Namespace),
        ("torch", "Size") => Some(Global::Size),
        ("torch", "device") => Some(Global::Device),
        ("_codecs", "encode") => Some(Global::Encode),
        ("torch._utils", "_rebuild_tensor") => Some(Global::RebuildTensor),
        ("torch._utils", "_rebuild_tensor_v2") => Some(Global::RebuildTensorV2),
        ("torch._utils", "_rebuild_parameter") => Some(Global::RebuildParameter),
        ("torch.nn.parameter", "Parameter") => Some(Global::Parameter),
        ("torch" | "torch.cuda", _) => {
            if let Some(dtype) = name.strip_suffix("Storage").and_then(class_dtype) {
                Some(Global::Storage(dtype))
            } else if name.strip_suffix("Tensor").and_then(class_dtype).is_some() {
                Some(Global::TensorClass)
            } else {
                dtype_by_name(name).map(Global::DtypeValue)
            }
        }
        _ => None,
    }
}

/// Whether calling that name could run a program or code. Nothing would be run here either, but whoever put such a call
/// into a file of weights meant harm.
pub(super) fn runs_programs(module: &str, name: &str) -> bool {
    const MODULES: [&str; 24] = [
        "asyncio",
        "bdb",
        "code",
        "commands",
        "ctypes",
        "importlib",
        "multiprocessing",
        "nt",
        "operator",
        "os",
        "pdb",
        "pip",
        "pkgutil",
        "posix",
        "pty",
        "runpy",
        "shutil",
        "socket",
        "subprocess",
        "sys",
        "timeit",
        "torch.hub",
        "urllib",
        "webbrowser",
    ];
    const BUILTINS: [&str; 12] = [
        "__import__",
        "apply",
        "breakpoint",
        "compile",
        "delattr",
        "eval",
        "exec",
        "execfile",
        "getattr",
        "input",
        "open",
        "setattr",
    ];
    let under = |root: &str| module.strip_prefix(root).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'));
    match module {
        "builtins" | "__builtin__" => BUILTINS.contains(&name.split('.').next().unwrap_or(name)),
        "torch" => matches!(name, "load" | "compile"),
        _ => MODULES.iter().any(|root| under(root)),
    }
}

/// The number in `FloatStorage` or `FloatTensor`.
fn class_dtype(class: &str) -> Option<Dtype> {
    Some(match class {
        "Double" => Dtype::F64,
        "Float" => Dtype::F32,
        "Half" => Dtype::F16,
        "BFloat16" => Dtype::BF16,
        "Long" => Dtype::I64,
        "Int" => Dtype::I32,
        "Short" => Dtype::I16,
        "Char" => Dtype::I8,
        "Byte" => Dtype::U8,
        "Bool" => Dtype::Bool,
        _ => return None,
    })
}

fn dtype_by_name(name: &str) -> Option<Dtype> {
    use Dtype::*;
    [F64, F32, F16, BF16, I64, I32, I16, I8, U8, Bool].into_iter().find(|d| d.name() == name)
}
