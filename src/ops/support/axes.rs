//! Dimensions by number: what an op along some of them asks of a shape.

use crate::ops::ShapeError;
use crate::tensor::Shape;

/// A shape cut in three: what stands before the reduced dimensions, they themselves, and what comes after.
pub(in crate::ops) fn cut(shape: &Shape, first: usize, count: usize) -> [usize; 3] {
    let d = shape.dims();
    [d[..first].iter().product(), d[first..first + count].iter().product(), d[first + count..].iter().product()]
}

/// The shape without the run of dimensions.
pub(in crate::ops) fn dropped(shape: &Shape, first: usize, count: usize) -> Result<Vec<Shape>, ShapeError> {
    if first + count > shape.rank() {
        return Err(ShapeError::new(format!("no dimensions {first}..{}", first + count)));
    }
    let d = shape.dims();
    Ok(vec![Shape::new(&[&d[..first], &d[first + count..]].concat())])
}
