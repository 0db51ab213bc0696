//! Powers: of two tensors, and with a constant exponent.

use super::binary::{self, Binary};
use super::unary::{self, Unary};
use crate::ops::{Case, Input, apply1};
use crate::tensor::{Float, Var};

/// a^b. As IEEE 754 has it, anything to the power 0 is 1, and a negative number has only whole powers (else NaN).
///
/// At a = 0 the derivative by a is 1 for b = 1, 0 for b > 1 and b = 0, infinite below 1; the one by b is 0 for b >= 0 (for
/// b > 0 the limit of a^b ln a; 0^b has a jump at b = 0). The derivative by b is NaN where a is negative.
#[derive(Clone, Copy, Debug, Default)]
pub struct Pow;

impl binary::Function for Pow {
    const SAVES: bool = true;
    const A: [f64; 2] = [0.2, 1.0];
    #[inline(always)]
    fn f<T: Float>(a: T, b: T) -> T {
        a.powf(b)
    }
    /// b a^(b - 1); at b = 0 the power is constant, though a^-1 may be infinite.
    #[inline(always)]
    fn da<T: Float>(a: T, b: T) -> T {
        if b == T::ZERO { T::ZERO } else { b * a.powf(b - T::ONE) }
    }
    /// a^b ln a. Where the power vanishes faster than the logarithm grows, their product would be 0 times infinity.
    #[inline(always)]
    fn db<T: Float>(a: T, b: T) -> T {
        let vanishes = (a == T::ZERO && b >= T::ZERO) || (a == T::INFINITY && b < T::ZERO);
        if vanishes { T::ZERO } else { a.powf(b) * a.ln() }
    }
    fn own_cases() -> Vec<Case<Binary<Self>>> {
        let op = Binary(Pow);
        let a = |values: &[f64]| Input::values("a", [values.len()], values);
        let b = |values: &[f64]| Input::values("b", [values.len()], values);
        let whole = b(&[3.0, 2.0, -1.0, 1.0, 0.0]).constant("a negative number has only whole powers");
        vec![
            Case::new("of zero", op, [a(&[0.0; 4]), b(&[1.0, 2.0, 3.0, 4.0])]).ignores(1),
            Case::new("of negative numbers", op, [a(&[-2.0, -0.5, -1.5, -0.7, -3.0]), whole]),
            Case::new("to the power 0", op, [a(&[0.5, 2.0, 1.0]), b(&[0.0, 0.0, 0.0])]).ignores(0),
            Case::new("negative exponents", op, [Input::values("a", [2, 1], [0.5, 2.0]), b(&[-1.0, -1.5])]),
        ]
    }
}

/// x^e with a constant exponent. At x = 0 the derivative is 0 for e = 0 and e > 1, 1 for e = 1, and infinite below 1, as
/// that of the square root is; x^0 is 1 everywhere, and its derivative 0.
#[derive(Clone, Copy, Debug)]
pub struct Powf {
    /// The exponent.
    pub exponent: f64,
}

impl unary::Function for Powf {
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        x.powf(T::of(self.exponent))
    }
    /// e x^(e - 1).
    #[inline(always)]
    fn df<T: Float>(self, x: T) -> T {
        if self.exponent == 0.0 { T::ZERO } else { T::of(self.exponent) * x.powf(T::of(self.exponent - 1.0)) }
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        let op = |exponent| Unary(Powf { exponent });
        let around_zero = || Input::values("x", [5], [0.0, -1.5, 0.5, 2.0, -0.1]);
        vec![
            Case::new("a fraction", op(0.5), [Input::uniform("x", [3, 4, 5], 0.1, 3.0)]),
            Case::new("a negative exponent", op(-1.5), [Input::uniform("x", [3, 4], 0.4, 3.0)]),
            Case::new("a whole negative exponent", op(-1.0), [Input::uniform("x", [3, 4], -3.0, -0.5)]),
            Case::new("the square", op(2.0), [around_zero()]),
            Case::new("the cube", op(3.0), [around_zero()]),
            Case::new("the first power", op(1.0), [around_zero()]),
            Case::new("the power 0", op(0.0), [around_zero()]).flat(),
            Case::new("empty", op(2.0), [Input::random("x", [0, 3])]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// self^exponent, element by element; broadcasts.
    #[track_caller]
    pub fn pow(&self, exponent: &Self) -> Self {
        apply1(Binary(Pow), &[self, exponent])
    }
    /// x^exponent, element by element. Of any shape.
    pub fn powf(&self, exponent: f64) -> Self {
        apply1(Unary(Powf { exponent }), &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::{Tape, Tensor};

    #[test]
    fn derivatives_at_zero_and_at_infinity() {
        let inf = f64::INFINITY;
        // a, b, a^b, the derivative by a, the derivative by b.
        for (a, b, y, da, db) in [
            (0.0, 0.0, 1.0, 0.0, 0.0),
            (0.0, 0.5, 0.0, inf, 0.0),
            (0.0, 1.0, 0.0, 1.0, 0.0),
            (-0.0, 1.0, -0.0, 1.0, 0.0),
            (0.0, 2.5, 0.0, 0.0, 0.0),
            (0.0, -1.0, inf, -inf, -inf),
            (inf, -1.0, 0.0, 0.0, 0.0),
            (inf, 2.0, inf, inf, inf),
        ] {
            let tape = Tape::new();
            let (x, e) = (tape.leaf(Tensor::scalar(a)), tape.leaf(Tensor::scalar(b)));
            let power = x.pow(&e);
            assert_eq!(power.value().item(), y, "{a}^{b}");
            let gradients = power.backward();
            assert_eq!(gradients.get(&x).unwrap().item(), da, "{a}^{b} by a");
            assert_eq!(gradients.get(&e).unwrap().item(), db, "{a}^{b} by b");
        }
    }

    #[test]
    fn a_negative_number_has_a_gradient_and_its_exponent_has_none() {
        let tape = Tape::new();
        let (x, e) = (tape.leaf(Tensor::scalar(-2.0f32)), tape.leaf(Tensor::scalar(3.0)));
        let gradients = x.pow(&e).backward();
        assert_eq!(gradients.get(&x).unwrap().item(), 12.0);
        assert!(gradients.get(&e).unwrap().item().is_nan());
    }

    #[test]
    fn half_a_power_is_the_square_root_at_zero_too() {
        let tape = Tape::new();
        let (x, z) = (tape.leaf(Tensor::from_vec([3], vec![0.0, 4.0, -0.0f64])), Tensor::full([3], 1.0));
        let gradients = tape.backward(&[(&x.powf(0.5), z)]);
        assert_eq!(gradients.get(&x).unwrap().data(), [f64::INFINITY, 0.25, f64::INFINITY]);
        assert!(Var::constant(Tensor::scalar(-1.0f64)).powf(0.5).value().item().is_nan());
    }

    #[test]
    fn the_power_0_is_1_everywhere_and_flat() {
        let tape = Tape::new();
        let x = tape.leaf(Tensor::from_vec([4], vec![0.0f32, -2.0, f32::INFINITY, f32::NAN]));
        let y = x.powf(0.0);
        assert_eq!(y.value().data(), [1.0; 4]);
        assert_eq!(tape.backward(&[(&y, Tensor::full([4], 1.0))]).get(&x).unwrap().data(), [0.0; 4]);
    }

    #[test]
    fn nan_stays_nan_in_other_powers() {
        let nan = Var::constant(Tensor::scalar(f32::NAN));
        assert!(nan.powf(2.0).value().item().is_nan());
        assert!(nan.pow(&Var::constant(Tensor::scalar(0.5))).value().item().is_nan());
        assert!(Var::constant(Tensor::scalar(2.0f32)).pow(&nan).value().item().is_nan());
    }
}
