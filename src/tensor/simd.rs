//! Run-time choice of instruction set: the same code compiled for AVX-512, AVX2 and the baseline.
//!
//! A loop vectorises where it runs over zipped iterators (indexing leaves bounds checks in, and is ten times slower),
//! and fuses multiplications with additions only where `mul_add` says so.

use std::sync::LazyLock;

use pulp::Arch;

static ARCH: LazyLock<Arch> = LazyLock::new(Arch::new);

/// Runs `kernel` compiled for the best instruction set of this machine.
///
/// Write the closure as `#[inline(always)] || ...`, and mark the functions it calls the same way: what is not inlined
/// is compiled for the baseline.
#[inline(always)]
pub fn dispatch<R>(kernel: impl FnOnce() -> R) -> R {
    ARCH.dispatch(kernel)
}
