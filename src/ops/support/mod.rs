//! What ops of several families share: no op imports another op for a helper.

pub(in crate::ops) mod axes;
pub(in crate::ops) mod epilogue;
pub(in crate::ops) mod indices;
pub(in crate::ops) mod put;
pub(in crate::ops) mod row_products;
pub(in crate::ops) mod squares;
pub(in crate::ops) mod sums;
pub(in crate::ops) mod tile;
pub(in crate::ops) mod weight_blocks;
