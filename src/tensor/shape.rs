//! Shapes: up to six extents, row-major, the last one contiguous.

use std::fmt;

/// The largest number of dimensions a tensor can have.
pub const MAX_RANK: usize = 6;

/// The extents of a tensor, outermost first. A scalar has rank 0 and one element.
///
/// Images are `[batch, height, width, channels]`; tokens `[batch, height * width, channels]`.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct Shape {
    dims: [usize; MAX_RANK],
    rank: u8,
}

impl Shape {
    /// A shape with the given extents.
    ///
    /// # Panics
    /// If there are more than [`MAX_RANK`], or more elements than memory has addresses.
    #[track_caller]
    pub fn new(dims: &[usize]) -> Self {
        assert!(dims.len() <= MAX_RANK, "a tensor has at most {MAX_RANK} dimensions, not {}", dims.len());
        let mut all = [1; MAX_RANK];
        all[..dims.len()].copy_from_slice(dims);
        Shape { dims: all, rank: dims.len() as u8 }.counted()
    }

    /// This shape, whose elements and strides are known not to overflow: an extent of 0 does not excuse the others.
    #[track_caller]
    fn counted(self) -> Self {
        let product = self.dims().iter().try_fold(1usize, |product, &d| product.checked_mul(d.max(1)));
        assert!(
            product.is_some_and(|n| n <= isize::MAX as usize / 8),
            "a tensor of shape {self} has more elements than memory has room for"
        );
        self
    }

    /// The extents.
    pub fn dims(&self) -> &[usize] {
        &self.dims[..self.rank as usize]
    }

    /// Number of dimensions.
    pub fn rank(&self) -> usize {
        self.rank as usize
    }

    /// Number of elements: the product of the extents, 1 for a scalar.
    pub fn len(&self) -> usize {
        self.dims().iter().product()
    }

    /// Whether an extent is 0.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The extent of the last dimension (1 for a scalar): channels, in images and tokens.
    pub fn last(&self) -> usize {
        self.dims().last().copied().unwrap_or(1)
    }

    /// The product of all extents but the last: the rows of the matrix this tensor is to a GEMM.
    pub fn rows(&self) -> usize {
        if self.rank == 0 { 1 } else { self.dims[..self.rank() - 1].iter().product() }
    }

    /// The extents as `[batch, height, width, channels]`, where the rank is 4.
    pub fn nhwc(&self) -> Option<[usize; 4]> {
        self.dims().try_into().ok()
    }

    /// Elements between neighbours along each dimension.
    pub fn strides(&self) -> [usize; MAX_RANK] {
        let mut strides = [1; MAX_RANK];
        for i in (0..self.rank().saturating_sub(1)).rev() {
            strides[i] = strides[i + 1] * self.dims[i + 1];
        }
        strides
    }

    /// The same shape with dimension `axis` set to `extent`.
    ///
    /// # Panics
    /// If `axis` is out of range, or there are more elements than memory has addresses.
    #[track_caller]
    pub fn with(&self, axis: usize, extent: usize) -> Self {
        assert!(axis < self.rank(), "no dimension {axis} in a tensor of shape {self}");
        let mut shape = *self;
        shape.dims[axis] = extent;
        shape.counted()
    }

    /// The same shape without dimension `axis`.
    ///
    /// # Panics
    /// If `axis` is out of range.
    #[track_caller]
    pub fn without(&self, axis: usize) -> Self {
        assert!(axis < self.rank(), "no dimension {axis} in a tensor of shape {self}");
        let dims: Vec<usize> = self.dims().iter().enumerate().filter(|&(i, _)| i != axis).map(|(_, &d)| d).collect();
        Shape::new(&dims)
    }

    /// The shape two operands take together under broadcasting (trailing dimensions aligned, 1 stretches),
    /// or `None` where they do not fit.
    pub fn broadcast(&self, other: &Shape) -> Option<Shape> {
        let rank = self.rank().max(other.rank());
        let mut dims = [1; MAX_RANK];
        for (i, d) in dims.iter_mut().enumerate().take(rank) {
            let a = (i + self.rank()).checked_sub(rank).map_or(1, |k| self.dims[k]);
            let b = (i + other.rank()).checked_sub(rank).map_or(1, |k| other.dims[k]);
            *d = match (a, b) {
                (a, b) if a == b => a,
                (1, b) => b,
                (a, 1) => a,
                _ => return None,
            };
        }
        Some(Shape { dims, rank: rank as u8 }.counted())
    }
}

impl fmt::Display for Shape {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", self.dims())
    }
}

impl fmt::Debug for Shape {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", self.dims())
    }
}

impl From<&[usize]> for Shape {
    fn from(dims: &[usize]) -> Self {
        Shape::new(dims)
    }
}

impl From<&Vec<usize>> for Shape {
    fn from(dims: &Vec<usize>) -> Self {
        Shape::new(dims)
    }
}

impl<const N: usize> From<[usize; N]> for Shape {
    fn from(dims: [usize; N]) -> Self {
        Shape::new(&dims)
    }
}

impl<const N: usize> From<&[usize; N]> for Shape {
    fn from(dims: &[usize; N]) -> Self {
        Shape::new(dims)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_elements_than_memory_has_room_for_are_refused() {
        let huge = 1usize << 63;
        for dims in [&[huge, 2][..], &[huge, 0], &[0, huge, huge], &[1 << 31, 1 << 31, 1 << 31]] {
            assert!(std::panic::catch_unwind(|| Shape::new(dims)).is_err(), "{dims:?}");
        }
        assert!(std::panic::catch_unwind(|| Shape::new(&[1 << 40, 1]).with(1, 1 << 40)).is_err());
        let wide = [Shape::new(&[1 << 40, 1]), Shape::new(&[1, 1 << 40])];
        assert!(std::panic::catch_unwind(|| wide[0].broadcast(&wide[1])).is_err());
        assert!(std::panic::catch_unwind(|| crate::tensor::Tensor::<f32>::from_vec([huge, 2], vec![])).is_err());
    }

    #[test]
    fn a_scalar_has_one_element_and_no_dimension() {
        let s = Shape::new(&[]);
        assert_eq!((s.len(), s.rank(), s.last(), s.rows()), (1, 0, 1, 1));
    }

    #[test]
    fn strides_are_row_major() {
        assert_eq!(&Shape::new(&[2, 3, 4]).strides()[..3], &[12, 4, 1]);
    }

    #[test]
    fn broadcasting_aligns_trailing_dimensions() {
        let a = Shape::new(&[2, 3, 1]);
        assert_eq!(a.broadcast(&Shape::new(&[4])), Some(Shape::new(&[2, 3, 4])));
        assert_eq!(a.broadcast(&Shape::new(&[2, 4])), None);
        assert_eq!(a.broadcast(&Shape::new(&[0])), Some(Shape::new(&[2, 3, 0])));
    }
}
