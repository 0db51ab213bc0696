//! One type for whatever is read: decoders are generic, and would be compiled again for each kind of file.

use std::io::{BufRead, Seek};

/// A file, or bytes in memory.
pub(crate) trait Source: BufRead + Seek {}

impl<R: BufRead + Seek> Source for R {}
