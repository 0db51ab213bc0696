//! Run-time choice of instruction set: the same code compiled for AVX-512, AVX2 and the baseline.
//!
//! A loop vectorises where it runs over zipped iterators (indexing leaves bounds checks in, and is ten times slower),
//! and fuses multiplications with additions only where `mul_add` says so.
//!
//! The environment variable `PARALLAX_SIMD`, read once, holds these kernels to a lower level than the machine has
//! (`avx512`, `avx2`, `scalar`): how a machine with AVX-512 checks what others run. It does not reach matrix products,
//! whose instruction set faer chooses by itself.

use std::sync::LazyLock;

use pulp::{Arch, Simd, WithSimd};

use crate::error::{Error, Result};

static ARCH: LazyLock<Arch> = LazyLock::new(|| chosen().unwrap_or_default());

/// The variable that holds kernels to a lower level.
const VARIABLE: &str = "PARALLAX_SIMD";

/// The level that the environment asks for, or the best of this machine.
fn chosen() -> Result<Arch> {
    match std::env::var(VARIABLE) {
        Ok(name) => named(&name),
        Err(_) => Ok(Arch::new()),
    }
}

fn named(name: &str) -> Result<Arch> {
    let best = Arch::new();
    let found = match (name, best) {
        ("scalar", _) => Some(Arch::Scalar),
        #[cfg(target_arch = "x86_64")]
        ("avx2", _) => pulp::x86::V3::try_new().map(Arch::V3),
        #[cfg(target_arch = "x86_64")]
        ("avx512", Arch::V4(_)) => Some(best),
        #[cfg(not(target_arch = "x86_64"))]
        ("avx2", _) => None,
        ("avx512", _) => None,
        _ => {
            return Err(Error::setting(
                VARIABLE,
                format!("avx512, avx2 or scalar, not {name:?}; unset: the best there is"),
            ));
        }
    };
    found.ok_or_else(|| Error::setting(VARIABLE, format!("this machine has no {name}: it has {}", label(best))))
}

fn label(arch: Arch) -> &'static str {
    match arch {
        Arch::Scalar => "scalar",
        #[cfg(target_arch = "x86_64")]
        Arch::V3(_) => "avx2",
        #[cfg(target_arch = "x86_64")]
        Arch::V4(_) => "avx512",
        _ => "simd",
    }
}

/// The instruction set that kernels run on: `avx512`, `avx2`, another machine's `simd`, or `scalar` (the baseline that
/// the program was compiled for).
///
/// # Errors
/// If `PARALLAX_SIMD` asks for one that there is not; kernels take the best there is in that case.
pub fn level() -> Result<&'static str> {
    chosen()?;
    Ok(label(*ARCH))
}

#[inline(always)]
fn up_to_avx512<K: WithSimd>(kernel: K) -> K::Output {
    ARCH.dispatch(kernel)
}

#[inline(always)]
#[cfg(target_arch = "x86_64")]
fn up_to_avx2<K: WithSimd>(kernel: K) -> K::Output {
    let avx2 = match *ARCH {
        Arch::V4(simd) => Some(*simd),
        Arch::V3(simd) => Some(simd),
        _ => None,
    };
    match avx2 {
        Some(simd) => Simd::vectorize(simd, kernel),
        None => Simd::vectorize(pulp::Scalar::new(), kernel),
    }
}

#[inline(always)]
#[cfg(not(target_arch = "x86_64"))]
fn up_to_avx2<K: WithSimd>(kernel: K) -> K::Output {
    ARCH.dispatch(kernel)
}

/// Copies a run, in whole vectors as far as they go: some runs are too short for a call to `memcpy`. To be called inside
/// [`Vector::dispatch`].
#[inline(always)]
pub(crate) fn copy_run<T: Copy>(to: &mut [T], from: &[T]) {
    let ((to, to_rest), (from, from_rest)) = (to.as_chunks_mut::<8>(), from.as_chunks::<8>());
    to.iter_mut().zip(from).for_each(|(t, f)| *t = *f);
    to_rest.iter_mut().zip(from_rest).for_each(|(t, f)| *t = *f);
}

/// Element types of which there are vectors, for the few kernels that keep vectors in registers across loops of their
/// own, which the compiler does not find by itself. Run one with [`Vector::dispatch_vector`].
pub trait Vector: Copy + 'static {
    /// A vector of the instruction set `S`.
    type V<S: Simd>: Copy;

    /// Runs a kernel of this element type compiled for the best instruction set that it is compiled for: in f32 the
    /// machine's, in f64 AVX2 at most. f64 is what gradients are checked in, and a third instance of each of its loops
    /// would take a tenth of the time that the crate takes to compile.
    ///
    /// Write the closure as `#[inline(always)] || ...`, and mark the functions it calls the same way: what is not inlined
    /// is compiled for the baseline, where `mul_add` is a call into a library.
    fn dispatch<R>(kernel: impl FnOnce() -> R) -> R;

    /// [`dispatch`](Vector::dispatch) for a kernel that is written in these vectors.
    fn dispatch_vector<K: WithSimd>(kernel: K) -> K::Output;

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
    /// The sum of a vector's elements.
    fn total<S: Simd>(simd: S, v: Self::V<S>) -> Self;
}

macro_rules! vector {
    ($t:ty, $dispatch:ident, $v:ident, $lanes:ident, $splat:ident, $load:ident, $store:ident, $add:ident, $fma:ident, $total:ident, $of:ident, $of_mut:ident) => {
        impl Vector for $t {
            type V<S: Simd> = S::$v;

            // `FnOnce`, and not what pulp makes of it: only of what is asked for as such is the closure itself the
            // function that is inlined, and not a shim around it.
            #[inline(always)]
            fn dispatch<R>(kernel: impl FnOnce() -> R) -> R {
                $dispatch(kernel)
            }

            #[inline(always)]
            fn dispatch_vector<K: WithSimd>(kernel: K) -> K::Output {
                $dispatch(kernel)
            }
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
            #[inline(always)]
            fn total<S: Simd>(simd: S, v: S::$v) -> $t {
                simd.$total(v)
            }
        }
    };
}

vector!(
    f32,
    up_to_avx512,
    f32s,
    F32_LANES,
    splat_f32s,
    partial_load_f32s,
    partial_store_f32s,
    add_f32s,
    mul_add_f32s,
    reduce_sum_f32s,
    as_simd_f32s,
    as_mut_simd_f32s
);
vector!(
    f64,
    up_to_avx2,
    f64s,
    F64_LANES,
    splat_f64s,
    partial_load_f64s,
    partial_store_f64s,
    add_f64s,
    mul_add_f64s,
    reduce_sum_f64s,
    as_simd_f64s,
    as_mut_simd_f64s
);

/// Elements in a vector of the best instruction set of this machine.
pub(crate) fn lanes<T: Vector>() -> usize {
    struct Lanes<T>(std::marker::PhantomData<T>);
    impl<T: Vector> WithSimd for Lanes<T> {
        type Output = usize;
        #[inline(always)]
        fn with_simd<S: Simd>(self, _: S) -> usize {
            T::lanes::<S>()
        }
    }
    T::dispatch_vector(Lanes::<T>(std::marker::PhantomData))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_level_is_asked_for_by_name() {
        assert_eq!(label(named("scalar").expect("every machine has it")), "scalar");
        let best = label(Arch::new());
        for name in ["avx2", "avx512"] {
            match named(name) {
                Ok(arch) => assert_eq!(label(arch), name),
                Err(e) => assert!(e.to_string().contains(best), "{e}"),
            }
        }
        assert!(named("sse9").is_err_and(|e| e.to_string().starts_with("PARALLAX_SIMD: avx512, avx2 or scalar")));
    }
}
