//! matrixmultiply's product: an independent second opinion on faer's. It and `bf16` are the two files with `unsafe` code.
#![allow(unsafe_code)]

/// `a [m, k] * b [k, n]`, row-major, in f32.
///
/// # Panics
/// If a slice has another length than its shape says, or the result has more elements than memory has room for.
#[track_caller]
pub fn sgemm(m: usize, k: usize, n: usize, a: &[f32], b: &[f32]) -> Vec<f32> {
    // Checked products: one that wraps around would let the slices pass for matrices that they do not hold.
    let (size_a, size_b) = (m.checked_mul(k), k.checked_mul(n));
    let size_c = m.checked_mul(n).filter(|&size| size <= isize::MAX as usize / size_of::<f32>());
    let Some(size_c) = size_c else { panic!("sgemm: a result of {m}x{n} has more elements than memory has room for") };
    // Strides and extents reach the kernel as signed numbers.
    let extents = [m, k, n].iter().all(|&extent| extent <= isize::MAX as usize);
    assert!(
        extents && size_a == Some(a.len()) && size_b == Some(b.len()),
        "sgemm: {m}x{k} times {k}x{n} of {} and {} elements",
        a.len(),
        b.len()
    );
    let mut c = vec![0.0; size_c];
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

#[cfg(test)]
mod tests {
    use super::sgemm;

    #[test]
    fn extents_that_overflow_are_refused() {
        let huge = 1usize << 63;
        for [m, k, n] in
            [[huge, 2, 2], [2, huge, 2], [2, 2, huge], [huge, 0, huge], [1 << 32, 0, 1 << 32], [huge, 2, 0]]
        {
            assert!(std::panic::catch_unwind(|| sgemm(m, k, n, &[], &[])).is_err(), "{m} {k} {n}");
        }
        assert_eq!(sgemm(2, 0, 1, &[], &[]), [0.0, 0.0]);
        assert_eq!(sgemm(1, 2, 1, &[2.0, 3.0], &[4.0, 5.0]), [23.0]);
    }
}
