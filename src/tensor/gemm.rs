//! Matrix products: the only file that multiplies with faer.
//!
//! faer is always called sequentially, on tiles whose bounds depend on shapes alone: its own parallel product changes
//! bits with the number of threads. Kernels parallelise over tiles instead.

use faer::linalg::matmul::matmul;
use faer::{MatMut, MatRef, Par};

use super::float::Float;

/// Whether a kernel overwrites its destination or adds to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Accum {
    /// Write: what was there is not read.
    Replace,
    /// Add to what is there.
    Add,
}

/// Matrix view: `rows` runs of `cols` elements, `row_stride` apart.
///
/// A range of channels of an image, one head of a token tensor, or a part of a concatenation is such a matrix where it
/// lies.
#[derive(Clone, Copy)]
pub struct Rows<'a, T> {
    /// The memory, from the first element on.
    pub data: &'a [T],
    /// Number of rows.
    pub rows: usize,
    /// Number of columns, contiguous.
    pub cols: usize,
    /// Elements from one row to the next.
    pub row_stride: usize,
}

/// Mutable matrix view.
pub struct RowsMut<'a, T> {
    /// The memory, from the first element on.
    pub data: &'a mut [T],
    /// Number of rows.
    pub rows: usize,
    /// Number of columns, contiguous.
    pub cols: usize,
    /// Elements from one row to the next.
    pub row_stride: usize,
}

impl<'a, T> Rows<'a, T> {
    /// A matrix without gaps.
    ///
    /// # Panics
    /// If `data` does not hold exactly `rows * cols` elements.
    #[track_caller]
    pub fn dense(data: &'a [T], rows: usize, cols: usize) -> Self {
        assert_eq!(data.len(), rows * cols, "a {rows}x{cols} matrix");
        Rows { data, rows, cols, row_stride: cols }
    }

    /// A range of columns of a matrix without gaps whose rows have `row_stride` elements.
    #[track_caller]
    pub fn columns(data: &'a [T], rows: usize, row_stride: usize, first: usize, cols: usize) -> Self {
        assert!(
            first + cols <= row_stride && data.len() >= rows * row_stride,
            "columns {first}..{} of {row_stride}",
            first + cols
        );
        Rows { data: if rows * cols == 0 { &[] } else { &data[first..] }, rows, cols, row_stride }
    }

    /// Some of the rows.
    ///
    /// # Panics
    /// If there are not as many.
    #[track_caller]
    pub fn rows(self, first: usize, count: usize) -> Self {
        assert!(first + count <= self.rows, "rows {first}..{} of {}", first + count, self.rows);
        let data = if count * self.cols == 0 { &[] } else { &self.data[first * self.row_stride..] };
        Rows { data, rows: count, ..self }
    }

    /// The transposed view, for a product.
    pub fn t(self) -> Operand<'a, T> {
        Operand { matrix: self, transposed: true }
    }
}

impl<'a, T> RowsMut<'a, T> {
    /// A matrix without gaps.
    ///
    /// # Panics
    /// If `data` does not hold exactly `rows * cols` elements.
    #[track_caller]
    pub fn dense(data: &'a mut [T], rows: usize, cols: usize) -> Self {
        assert_eq!(data.len(), rows * cols, "a {rows}x{cols} matrix");
        RowsMut { data, rows, cols, row_stride: cols }
    }

    /// A range of columns of a matrix without gaps whose rows have `row_stride` elements.
    #[track_caller]
    pub fn columns(data: &'a mut [T], rows: usize, row_stride: usize, first: usize, cols: usize) -> Self {
        assert!(
            first + cols <= row_stride && data.len() >= rows * row_stride,
            "columns {first}..{} of {row_stride}",
            first + cols
        );
        RowsMut { data: if rows * cols == 0 { &mut [] } else { &mut data[first..] }, rows, cols, row_stride }
    }
}

/// Operand of a matrix product: a matrix as it lies, or transposed.
#[derive(Clone, Copy)]
pub struct Operand<'a, T> {
    matrix: Rows<'a, T>,
    transposed: bool,
}

impl<'a, T> From<Rows<'a, T>> for Operand<'a, T> {
    fn from(matrix: Rows<'a, T>) -> Self {
        Operand { matrix, transposed: false }
    }
}

impl<T> Operand<'_, T> {
    fn shape(&self) -> (usize, usize) {
        let Rows { rows, cols, .. } = self.matrix;
        if self.transposed { (cols, rows) } else { (rows, cols) }
    }
}

/// `dst = alpha * lhs * rhs`, or `dst += ...`, on one thread.
///
/// A zero-sized inner dimension gives zeros (or adds nothing).
///
/// # Panics
/// If the shapes do not fit.
#[track_caller]
pub fn gemm<'a, T: Float>(
    dst: RowsMut<T>,
    accum: Accum,
    lhs: impl Into<Operand<'a, T>>,
    rhs: impl Into<Operand<'a, T>>,
    alpha: T,
) {
    let (lhs, rhs) = (lhs.into(), rhs.into());
    let ((m, k), (k2, n)) = (lhs.shape(), rhs.shape());
    assert!(k == k2 && (m, n) == (dst.rows, dst.cols), "gemm: {m}x{k} times {k2}x{n} into {}x{}", dst.rows, dst.cols);
    if m == 0 || n == 0 {
        return;
    }
    if k == 0 {
        if accum == Accum::Replace {
            for row in dst.data.chunks_mut(dst.row_stride).take(m) {
                row[..n].fill(T::ZERO);
            }
        }
        return;
    }
    T::gemm(dst, accum, lhs, rhs, alpha);
}

/// Element types whose product is implemented; part of [`Float`].
pub trait Gemm: Sized {
    #[doc(hidden)]
    fn gemm(dst: RowsMut<Self>, accum: Accum, lhs: Operand<Self>, rhs: Operand<Self>, alpha: Self);
}

/// The faer view of a matrix. Its constructor wants exactly `(rows - 1) * stride + cols` elements or more.
fn view<T>(m: Rows<'_, T>) -> MatRef<'_, T> {
    if m.rows == 1 {
        return MatRef::from_row_major_slice(&m.data[..m.cols], 1, m.cols);
    }
    MatRef::from_row_major_slice_with_stride(m.data, m.rows, m.cols, m.row_stride)
}

macro_rules! gemm_by_faer {
    ($($t:ty),*) => {$(
        impl Gemm for $t {
            fn gemm(dst: RowsMut<$t>, accum: Accum, lhs: Operand<$t>, rhs: Operand<$t>, alpha: $t) {
                let beta = match accum {
                    Accum::Replace => faer::Accum::Replace,
                    Accum::Add => faer::Accum::Add,
                };
                let (m, n) = (dst.rows, dst.cols);
                let out = if m == 1 {
                    MatMut::from_column_major_slice_mut(&mut dst.data[..n], n, 1).transpose_mut()
                } else {
                    // Through columns: faer 0.24's own row-major constructor of mutable views swaps the strides.
                    MatMut::from_column_major_slice_with_stride_mut(dst.data, n, m, dst.row_stride).transpose_mut()
                };
                let (l, r) = (view(lhs.matrix), view(rhs.matrix));
                let (l, r) = (
                    if lhs.transposed { l.transpose() } else { l.as_dyn_stride() },
                    if rhs.transposed { r.transpose() } else { r.as_dyn_stride() },
                );
                matmul(out, beta, l, r, alpha, Par::Seq);
            }
        }
    )*};
}
gemm_by_faer!(f32, f64);

#[cfg(test)]
mod tests {
    use super::*;

    fn naive(m: usize, k: usize, n: usize, a: &[f64], b: &[f64]) -> Vec<f64> {
        (0..m * n).map(|i| (0..k).map(|p| a[(i / n) * k + p] * b[p * n + i % n]).sum()).collect()
    }

    fn numbers(n: usize, seed: u64) -> Vec<f64> {
        (0..n as u64)
            .map(|i| ((i.wrapping_mul(2654435761).wrapping_add(seed * 97)) % 1000) as f64 / 500.0 - 1.0)
            .collect()
    }

    #[test]
    fn agrees_with_the_sum_it_stands_for_in_every_orientation() {
        for (m, k, n) in [(1, 1, 1), (1, 5, 3), (7, 1, 4), (5, 9, 1), (17, 33, 9), (64, 72, 8)] {
            let (a, b) = (numbers(m * k, 1), numbers(k * n, 2));
            let expected = naive(m, k, n, &a, &b);
            let at: Vec<f64> = (0..m * k).map(|i| a[(i % m) * k + i / m]).collect();
            let bt: Vec<f64> = (0..k * n).map(|i| b[(i % k) * n + i / k]).collect();
            let operands: [(Operand<f64>, Operand<f64>); 4] = [
                (Rows::dense(&a, m, k).into(), Rows::dense(&b, k, n).into()),
                (Rows::dense(&at, k, m).t(), Rows::dense(&b, k, n).into()),
                (Rows::dense(&a, m, k).into(), Rows::dense(&bt, n, k).t()),
                (Rows::dense(&at, k, m).t(), Rows::dense(&bt, n, k).t()),
            ];
            for (l, r) in operands {
                let mut c = vec![f64::NAN; m * n];
                gemm(RowsMut::dense(&mut c, m, n), Accum::Replace, l, r, 1.0);
                gemm(RowsMut::dense(&mut c, m, n), Accum::Add, l, r, 2.0);
                for (x, e) in c.iter().zip(&expected) {
                    assert!((x - 3.0 * e).abs() < 1e-12, "{m}x{k}x{n}: {x} for {}", 3.0 * e);
                }
            }
        }
    }

    #[test]
    fn agrees_with_matrixmultiply_in_f32() {
        let (m, k, n) = (37, 65, 19);
        let a: Vec<f32> = numbers(m * k, 3).iter().map(|&x| x as f32).collect();
        let b: Vec<f32> = numbers(k * n, 4).iter().map(|&x| x as f32).collect();
        let mut ours = vec![0.0f32; m * n];
        gemm(RowsMut::dense(&mut ours, m, n), Accum::Replace, Rows::dense(&a, m, k), Rows::dense(&b, k, n), 1.0);
        let theirs = crate::tensor::gemm_small::sgemm(m, k, n, &a, &b);
        for (x, y) in ours.iter().zip(&theirs) {
            assert!((x - y).abs() < 1e-4, "{x} {y}");
        }
    }

    #[test]
    fn strided_views_leave_the_rest_alone() {
        let a = numbers(4 * 6, 5);
        let b = numbers(3 * 2, 6);
        let mut c = vec![7.0; 4 * 5];
        gemm(
            RowsMut::columns(&mut c, 4, 5, 1, 2),
            Accum::Replace,
            Rows::columns(&a, 4, 6, 2, 3),
            Rows::dense(&b, 3, 2),
            1.0,
        );
        for i in 0..4 {
            assert_eq!((c[i * 5], c[i * 5 + 3], c[i * 5 + 4]), (7.0, 7.0, 7.0));
            let e: f64 = (0..3).map(|p| a[i * 6 + 2 + p] * b[p * 2 + 1]).sum();
            assert!((c[i * 5 + 2] - e).abs() < 1e-14);
        }
    }

    #[test]
    fn an_empty_inner_dimension_gives_zeros() {
        let mut c = vec![7.0; 6];
        gemm(RowsMut::dense(&mut c, 2, 3), Accum::Add, Rows::dense(&[], 2, 0), Rows::dense(&[], 0, 3), 1.0);
        assert_eq!(c, vec![7.0; 6]);
        gemm(RowsMut::dense(&mut c, 2, 3), Accum::Replace, Rows::dense(&[], 2, 0), Rows::dense(&[], 0, 3), 1.0);
        assert_eq!(c, vec![0.0; 6]);
    }
}
