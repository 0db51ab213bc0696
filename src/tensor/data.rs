//! `Tensor`: a shape and a shared, contiguous, row-major run of elements.

use std::fmt;
use std::sync::Arc;

use super::compiled::compiled;
use super::float::Float;
use super::pool::Buffer;
use super::shape::Shape;

/// An n-dimensional array: plain data, tracked by no tape. Cloning shares the memory; writing to shared memory copies.
///
/// ```
/// use parallax::tensor::Tensor;
/// let x = Tensor::from_vec([2, 3], vec![1.0f32, 2.0, 3.0, 4.0, 5.0, 6.0]);
/// assert_eq!(x.dims(), [2, 3]);
/// assert_eq!(x.reshape([3, 2]).data()[5], 6.0);
/// ```
#[derive(Clone)]
pub struct Tensor<T: Float> {
    shape: Shape,
    buffer: Arc<Buffer<T>>,
}

impl<T: Float> Tensor<T> {
    /// A tensor over the given elements, row-major.
    ///
    /// # Panics
    /// If their number is not that of the shape.
    #[track_caller]
    pub fn from_vec(shape: impl Into<Shape>, elements: Vec<T>) -> Self {
        Self::from_buffer(shape, elements.into())
    }

    /// A tensor over a pooled buffer.
    ///
    /// # Panics
    /// If its length is not that of the shape.
    #[track_caller]
    pub fn from_buffer(shape: impl Into<Shape>, buffer: Buffer<T>) -> Self {
        let shape = shape.into();
        assert_eq!(shape.len(), buffer.len(), "a tensor of shape {shape}");
        Tensor { shape, buffer: Arc::new(buffer) }
    }

    /// A tensor of unspecified values, which `fill` must write, every one.
    pub fn build(shape: impl Into<Shape>, fill: impl FnOnce(&mut [T])) -> Self {
        let shape = shape.into();
        let mut buffer = Buffer::stale(shape.len());
        fill(&mut buffer);
        Self::over(shape, buffer)
    }

    /// Not a part of [`build`](Tensor::build), which is compiled for every kernel.
    fn over(shape: Shape, buffer: Buffer<T>) -> Self {
        Tensor { shape, buffer: Arc::new(buffer) }
    }

    /// Concatenation of tensors of one shape `[n, ..]` along the first dimension.
    ///
    /// # Panics
    /// If there is none, if one is a scalar, or if their shapes differ.
    #[track_caller]
    pub fn stack(parts: &[&Self]) -> Self {
        let shape = *parts[0].shape();
        assert!(parts.iter().all(|p| *p.shape() == shape), "stacked tensors have one shape");
        Self::build(shape.with(0, parts.len() * shape.dims()[0]), |out| {
            let outs = out.chunks_exact_mut(shape.len().max(1));
            outs.zip(parts).for_each(|(out, part)| out.copy_from_slice(part.data()));
        })
    }

    /// A tensor with all elements `value`.
    pub fn full(shape: impl Into<Shape>, value: T) -> Self {
        let shape = shape.into();
        Tensor { shape, buffer: Arc::new(Buffer::filled(shape.len(), value)) }
    }

    /// A tensor of zeros.
    pub fn zeros(shape: impl Into<Shape>) -> Self {
        Self::full(shape, T::ZERO)
    }

    /// A single number, of shape `[]`.
    pub fn scalar(value: T) -> Self {
        Self::full([], value)
    }

    /// The shape.
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// The extents.
    pub fn dims(&self) -> &[usize] {
        self.shape.dims()
    }

    /// The number of elements.
    pub fn len(&self) -> usize {
        self.buffer.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.buffer.is_empty()
    }

    /// The elements, row-major.
    pub fn data(&self) -> &[T] {
        &self.buffer
    }

    /// The elements, mutable; shared memory is copied first.
    pub fn data_mut(&mut self) -> &mut [T] {
        let buffer: &mut Buffer<T> = Arc::make_mut(&mut self.buffer);
        buffer
    }

    /// Whether somebody else holds the same memory.
    pub fn is_shared(&self) -> bool {
        Arc::strong_count(&self.buffer) > 1
    }

    /// The same elements under another shape of as many elements; shares the memory.
    ///
    /// # Panics
    /// If the number of elements differs.
    #[track_caller]
    pub fn reshape(&self, shape: impl Into<Shape>) -> Self {
        let shape = shape.into();
        assert_eq!(shape.len(), self.len(), "reshape from {} to {shape}", self.shape);
        Tensor { shape, buffer: self.buffer.clone() }
    }

    /// The only element.
    ///
    /// # Panics
    /// If there is not exactly one.
    #[track_caller]
    pub fn item(&self) -> T {
        assert_eq!(self.len(), 1, "item() of a tensor of shape {}", self.shape);
        self.buffer[0]
    }

    /// The element at an index of one number per dimension.
    ///
    /// # Panics
    /// If the index is out of range or of another rank.
    #[track_caller]
    pub fn at(&self, index: &[usize]) -> T {
        assert!(
            index.len() == self.shape.rank() && index.iter().zip(self.dims()).all(|(i, d)| i < d),
            "no element {index:?} in a tensor of shape {}",
            self.shape
        );
        self.buffer[index.iter().zip(self.shape.strides()).map(|(i, s)| i * s).sum::<usize>()]
    }

    /// A tensor with `f` applied to each element.
    pub fn map(&self, f: impl Fn(T) -> T) -> Self {
        Self::build(self.shape, |out| out.iter_mut().zip(self.data()).for_each(|(o, &x)| *o = f(x)))
    }

    /// The dimensions in another order: dimension i of the result is dimension `order[i]` of this.
    ///
    /// # Panics
    /// If `order` is not a permutation of the dimensions.
    #[track_caller]
    pub fn permute(&self, order: &[usize]) -> Self {
        let rank = self.shape.rank();
        assert!(
            order.len() == rank && (0..rank).all(|i| order.contains(&i)),
            "{order:?} does not permute {}",
            self.shape
        );
        let dims: Vec<usize> = order.iter().map(|&i| self.dims()[i]).collect();
        let from = self.shape.strides();
        let shape = Shape::new(&dims);
        Self::build(shape, |out| {
            let mut index = vec![0; rank];
            for o in out {
                *o = self.buffer[index.iter().zip(order).map(|(i, &d)| i * from[d]).sum::<usize>()];
                for d in (0..rank).rev() {
                    index[d] += 1;
                    if index[d] < dims[d] {
                        break;
                    }
                    index[d] = 0;
                }
            }
        })
    }

    /// The same numbers in the other element type.
    pub fn cast<U: Float>(&self) -> Tensor<U> {
        Tensor::build(self.shape, |out| out.iter_mut().zip(self.data()).for_each(|(o, x)| *o = U::of(x.f64())))
    }

    /// Adds another tensor of the same shape in place.
    ///
    /// # Panics
    /// If the shapes differ.
    #[track_caller]
    pub fn add_assign(&mut self, other: &Tensor<T>) {
        assert_eq!(self.shape, other.shape, "add_assign");
        add(self.data_mut(), other.data());
    }

    /// Whether every element is finite.
    pub fn is_finite(&self) -> bool {
        is_finite(self.data())
    }

    /// Whether both have the same shape and the same bits.
    pub fn same_bits(&self, other: &Tensor<T>) -> bool {
        self.shape == other.shape && self.data().iter().zip(other.data()).all(|(a, b)| a.bits() == b.bits())
    }
}

compiled! {
    fn add<T>(sum: &mut [T], x: &[T]) {
        sum.iter_mut().zip(x).for_each(|(a, &b)| *a += b);
    }
}

compiled! {
    fn is_finite<T>(x: &[T]) -> bool {
        // x * 0 is 0 unless x is infinite or NaN; the sum has no branches, and vectorises.
        x.chunks(4096).all(|c| c.iter().map(|&x| x * T::ZERO).sum::<T>() == T::ZERO)
    }
}

impl<T: Float> fmt::Debug for Tensor<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const SHOWN: usize = 16;
        write!(f, "Tensor{} {:?}", self.shape, &self.data()[..self.len().min(SHOWN)])?;
        if self.len() > SHOWN { write!(f, "...") } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn writing_to_shared_memory_copies() {
        let a = Tensor::<f32>::zeros([3]);
        let mut b = a.clone();
        b.data_mut()[0] = 1.0;
        assert_eq!((a.data()[0], b.data()[0]), (0.0, 1.0));
    }

    #[test]
    fn permute_moves_elements_where_they_belong() {
        let x = Tensor::from_vec([2, 3, 4], (0..24).map(f64::from).collect());
        let y = x.permute(&[2, 0, 1]);
        assert_eq!(y.dims(), [4, 2, 3]);
        assert_eq!(y.at(&[3, 1, 2]), x.at(&[1, 2, 3]));
        assert!(y.permute(&[1, 2, 0]).same_bits(&x));
    }

    #[test]
    fn finiteness_sees_a_single_nan() {
        let mut x = Tensor::<f32>::zeros([10_000]);
        assert!(x.is_finite());
        x.data_mut()[9_999] = f32::INFINITY;
        assert!(!x.is_finite());
    }
}
