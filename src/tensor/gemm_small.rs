//! matrixmultiply's product: an independent second opinion on faer's, and the one place with `unsafe` code.
#![allow(unsafe_code)]

/// `a [m, k] * b [k, n]`, row-major, in f32.
///
/// # Panics
/// If a slice has another length than its shape says.
#[track_caller]
pub fn sgemm(m: usize, k: usize, n: usize, a: &[f32], b: &[f32]) -> Vec<f32> {
    assert!(
        a.len() == m * k && b.len() == k * n,
        "sgemm: {m}x{k} times {k}x{n} of {} and {} elements",
        a.len(),
        b.len()
    );
    let mut c = vec![0.0; m * n];
    let (k_stride, n_stride) = (k as isize, n as isize);
    // SAFETY: the three slices hold exactly the row-major matrices that the extents and strides describe (asserted
    // above, and by construction of `c`), and `c` is borrowed by nobody else.
    unsafe {
        matrixmultiply::sgemm(
            m,
            k,
            n,
            1.0,
            a.as_ptr(),
            k_stride,
            1,
            b.as_ptr(),
            n_stride,
            1,
            0.0,
            c.as_mut_ptr(),
            n_stride,
            1,
        );
    }
    c
}
