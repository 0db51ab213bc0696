//! Depth from the disparity that a sigmoid gives.

use crate::depth::inverse_depth_of_disparity;
use crate::ops::elementwise::unary::{Function, Unary};
use crate::ops::{Case, Input, apply1};
use crate::tensor::{Float, Var};

/// Depth of sigmoid disparity: `1 / (1/max + (1/min - 1/max) d)`. Disparity 0 is the greatest depth, 1 the least.
#[derive(Clone, Copy, Debug)]
pub struct DisparityToDepth {
    /// Depth of disparity 1, the least.
    pub min_depth: f64,
    /// Depth of disparity 0, the greatest.
    pub max_depth: f64,
}

impl DisparityToDepth {
    /// a and b of `1 / (a + b d)`.
    fn line<T: Float>(self) -> [T; 2] {
        inverse_depth_of_disparity(self.min_depth, self.max_depth).map(T::of)
    }
}

impl Function for DisparityToDepth {
    const FROM_RESULT: bool = true;
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        let [a, b] = self.line();
        T::ONE / x.mul_add(b, a)
    }
    /// -(1/min - 1/max) y^2.
    #[inline(always)]
    fn df<T: Float>(self, y: T) -> T {
        let [_, b] = self.line::<T>();
        y * y * -b
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        let op = |min_depth, max_depth| Unary(DisparityToDepth { min_depth, max_depth });
        vec![
            Case::new("street", op(0.1, 100.0), [Input::uniform("d", [2, 4, 5, 1], 0.05, 0.95)]),
            Case::new("a narrow range", op(2.0, 3.0), [Input::uniform("d", [2, 3, 4, 1], 0.0, 1.0)]),
        ]
    }
}

impl<T: Float> Var<T> {
    /// Depth `1 / (1/max + (1/min - 1/max) d)` of a disparity in [0, 1], in the units of the two bounds.
    pub fn disparity_to_depth(&self, min_depth: f64, max_depth: f64) -> Self {
        apply1(Unary(DisparityToDepth { min_depth, max_depth }), &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tensor;

    #[test]
    fn the_ends_are_the_bounds() {
        let d = Var::constant(Tensor::from_vec([2], vec![0.0f64, 1.0]));
        let depth = d.disparity_to_depth(0.1, 100.0).into_value();
        assert!((depth.data()[0] - 100.0).abs() < 1e-9 && (depth.data()[1] - 0.1).abs() < 1e-12);
    }
}
