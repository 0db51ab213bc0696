//! Ops that move elements and compute nothing: reshape and permute.

use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var};

/// Reshape: the same elements, in the same order, under another shape. Shares the memory.
#[derive(Clone, Copy, Debug)]
pub struct Reshape {
    /// The new shape.
    pub to: Shape,
}

impl<T: Float> Op<T> for Reshape {
    type Saved = Shape;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        if inputs[0].len() != self.to.len() {
            return Err(ShapeError::new(format!("to {}: another number of elements", self.to)));
        }
        Ok(vec![self.to])
    }

    /// Nothing moves.
    fn traffic(&self, _: &[Shape], _: &[Shape], _: &Needs) -> [u64; 2] {
        [0; 2]
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Shape) {
        (vec![inputs[0].reshape(self.to)], *inputs[0].shape())
    }

    /// The gradient takes the old shape again.
    fn backward(&self, from: Shape, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        sink.give(0, upstream.only().reshape(from));
    }
}

impl Checked for Reshape {
    fn cases() -> Vec<Case<Self>> {
        vec![
            Case::new("image to tokens", Reshape { to: [2, 6, 4].into() }, [Input::random("x", [2, 2, 3, 4])]),
            Case::new("to a scalar", Reshape { to: [].into() }, [Input::random("x", [1, 1])]),
            Case::new("empty", Reshape { to: [0].into() }, [Input::random("x", [2, 0])]).flat(),
        ]
    }
}

/// Permutation of the dimensions: dimension i of the result is dimension `order[i]` of the input.
#[derive(Clone, Debug)]
pub struct Permute {
    /// The order.
    pub order: Vec<usize>,
}

impl<T: Float> Op<T> for Permute {
    type Saved = ();

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let rank = inputs[0].rank();
        if self.order.len() != rank || !(0..rank).all(|i| self.order.contains(&i)) {
            return Err(ShapeError::new(format!("{:?} is no order of the dimensions", self.order)));
        }
        let dims: Vec<usize> = self.order.iter().map(|&i| inputs[0].dims()[i]).collect();
        Ok(vec![Shape::new(&dims)])
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, ()) {
        (vec![inputs[0].permute(&self.order)], ())
    }

    /// The inverse order: dimension `order[i]` of the gradient is dimension i of the upstream one.
    fn backward(&self, _: (), upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let mut inverse = vec![0; self.order.len()];
        for (i, &d) in self.order.iter().enumerate() {
            inverse[d] = i;
        }
        sink.give(0, upstream.only().permute(&inverse));
    }
}

impl Checked for Permute {
    fn cases() -> Vec<Case<Self>> {
        vec![
            Case::new("a cycle", Permute { order: vec![2, 0, 1] }, [Input::random("x", [2, 3, 4])]),
            Case::new("NHWC to NCHW", Permute { order: vec![0, 3, 1, 2] }, [Input::random("x", [2, 3, 2, 5])]),
            Case::new("scalar", Permute { order: vec![] }, [Input::random("x", [])]),
        ]
    }
}

impl<T: Float> Var<T> {
    /// The same elements under another shape.
    #[track_caller]
    pub fn reshape(&self, to: impl Into<Shape>) -> Self {
        apply1(Reshape { to: to.into() }, &[self])
    }

    /// The dimensions in another order.
    #[track_caller]
    pub fn permute(&self, order: &[usize]) -> Self {
        apply1(Permute { order: order.to_vec() }, &[self])
    }
}
