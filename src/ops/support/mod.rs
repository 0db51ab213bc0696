//! Shared by ops of several families: no op imports another op for a helper.

pub(in crate::ops) mod epilogue;
pub(in crate::ops) mod indices;
pub(in crate::ops) mod put;
