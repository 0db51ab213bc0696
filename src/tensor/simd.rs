//! Run-time choice of instruction set: the same code compiled for AVX-512, AVX2 and the baseline.
//!
//! A loop vectorises where it runs over zipped iterators (indexing leaves bounds checks in, and is ten times slower),
//! and fuses multiplications with additions only where `mul_add` says so.

use std::sync::LazyLock;

use pulp::{Arch, Simd, WithSimd};

static ARCH: LazyLock<Arch> = LazyLock::new(Arch::new);

/// Runs `kernel` compiled for the best instruction set of this machine.
///
/// Write the closure as `#[inline(always)] || ...`, and mark the functions it calls the same way: what is not inlined
/// is compiled for the baseline.
#[inline(always)]
pub fn dispatch<R>(kernel: impl FnOnce() -> R) -> R {
    ARCH.dispatch(kernel)
}

/// Copies a run, in whole vectors as far as they go: some runs are too short for a call to `memcpy`. To be called inside
/// [`dispatch`].
#[inline(always)]
pub(crate) fn copy_run<T: Copy>(to: &mut [T], from: &[T]) {
    let ((to, to_rest), (from, from_rest)) = (to.as_chunks_mut::<8>(), from.as_chunks::<8>());
    to.iter_mut().zip(from).for_each(|(t, f)| *t = *f);
    to_rest.iter_mut().zip(from_rest).for_each(|(t, f)| *t = *f);
}

/// Element types of which there are vectors, for the few kernels that keep vectors in registers across loops of their
/// own, which the compiler does not find by itself. Run one with [`dispatch_vector`].
pub trait Vector: Copy + 'static {
    /// A vector of the instruction set `S`.
    type V<S: Simd>: Copy;

    /// Elements in a vector.
    fn lanes<S: Simd>() -> usize;
    /// A vector of copies.
    fn splat<S: Simd>(simd: S, x: Self) -> Self::V<S>;
    /// The first elements of a slice that holds at least a vector of them.
    fn load<S: Simd>(simd: S, x: &[Self]) -> Self::V<S>;
    /// The elements of a slice that holds less than a vector of them, and zeros.
    fn load_part<S: Simd>(simd: S, x: &[Self]) -> Self::V<S>;
    /// Writes the first elements of a slice that holds at least a vector of them.
    fn store<S: Simd>(simd: S, out: &mut [Self], v: Self::V<S>);
    /// Writes a slice that holds less than a vector.
    fn store_part<S: Simd>(simd: S, out: &mut [Self], v: Self::V<S>);
    /// a + b.
    fn vector_add<S: Simd>(simd: S, a: Self::V<S>, b: Self::V<S>) -> Self::V<S>;
    /// a * b + c with one rounding.
    fn fma<S: Simd>(simd: S, a: Self::V<S>, b: Self::V<S>, c: Self::V<S>) -> Self::V<S>;
}

macro_rules! vector {
    ($t:ty, $v:ident, $lanes:ident, $splat:ident, $load:ident, $store:ident, $add:ident, $fma:ident, $of:ident, $of_mut:ident) => {
        impl Vector for $t {
            type V<S: Simd> = S::$v;

            #[inline(always)]
            fn lanes<S: Simd>() -> usize {
                S::$lanes
            }
            #[inline(always)]
            fn splat<S: Simd>(simd: S, x: $t) -> S::$v {
                simd.$splat(x)
            }
            #[inline(always)]
            fn load<S: Simd>(_: S, x: &[$t]) -> S::$v {
                S::$of(&x[..S::$lanes]).0[0]
            }
            #[inline(always)]
            fn load_part<S: Simd>(simd: S, x: &[$t]) -> S::$v {
                simd.$load(x)
            }
            #[inline(always)]
            fn store<S: Simd>(_: S, out: &mut [$t], v: S::$v) {
                S::$of_mut(&mut out[..S::$lanes]).0[0] = v;
            }
            #[inline(always)]
            fn store_part<S: Simd>(simd: S, out: &mut [$t], v: S::$v) {
                simd.$store(out, v);
            }
            #[inline(always)]
            fn vector_add<S: Simd>(simd: S, a: S::$v, b: S::$v) -> S::$v {
                simd.$add(a, b)
            }
            #[inline(always)]
            fn fma<S: Simd>(simd: S, a: S::$v, b: S::$v, c: S::$v) -> S::$v {
                simd.$fma(a, b, c)
            }
        }
    };
}

vector!(
    f32,
    f32s,
    F32_LANES,
    splat_f32s,
    partial_load_f32s,
    partial_store_f32s,
    add_f32s,
    mul_add_f32s,
    as_simd_f32s,
    as_mut_simd_f32s
);
vector!(
    f64,
    f64s,
    F64_LANES,
    splat_f64s,
    partial_load_f64s,
    partial_store_f64s,
    add_f64s,
    mul_add_f64s,
    as_simd_f64s,
    as_mut_simd_f64s
);

/// Runs a kernel that is written in [`Vector`]s with those of the best instruction set of this machine.
#[inline(always)]
pub fn dispatch_vector<K: WithSimd>(kernel: K) -> K::Output {
    ARCH.dispatch(kernel)
}
