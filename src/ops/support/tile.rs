//! How much work a thread gets at a time.

use crate::tensor::regime;

/// Rows (of pixels, tokens or samples: each op says which) that are handed to a thread at a time.
///
/// The default is chosen by the op for the shapes it sees, about as much as stays in an inner cache. A gradient check
/// gives a small one, so that small inputs reach the edges of tiles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tile(usize);

impl Tile {
    /// Chosen by the op.
    pub const AUTO: Tile = Tile(0);

    /// So many rows; 0 leaves the choice to the op.
    pub const fn of(rows: usize) -> Self {
        Tile(rows)
    }

    /// As many times the rows; still chosen by the op if these are.
    pub(in crate::ops) fn times(self, factor: usize) -> Self {
        Tile(factor * self.0)
    }

    /// The rows: those given, or else those chosen.
    #[inline(always)]
    pub(in crate::ops) fn or(self, chosen: usize) -> usize {
        if self.0 > 0 { self.0 } else { regime::size(chosen) }
    }
}
