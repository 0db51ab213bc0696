//! More activations, beside those in [`unary`](super::unary): smooth ones that are exact far out, and piecewise linear
//! ones. On a kink a derivative has the value of the outer side, as that of relu has.

use super::unary::{Function, Unary};
use crate::ops::{Case, Input, apply1};
use crate::tensor::{Float, Var};

/// Far out on both sides, where e^|x| would overflow; about 0; and 0.
fn far() -> [Input; 1] {
    [Input::values("x", [7], [-800.0, 800.0, 0.0, -40.0, 40.0, -1.0, 1.5])]
}

/// ln(1 + e^x).
#[derive(Clone, Copy, Debug)]
pub struct Softplus;

impl Function for Softplus {
    /// max(x, 0) + ln(1 + e^-|x|): the exponential never overflows, and is not lost beside 1.
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        x.max(T::ZERO) + (-x.abs()).exp().ln_1p()
    }
    /// sigmoid(x).
    #[inline(always)]
    fn df<T: Float>(self, x: T) -> T {
        x.sigmoid()
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![
            Case::new("around 0", Unary(Softplus), [Input::uniform("x", [3, 4, 5], -4.0, 4.0)]),
            Case::new("far out", Unary(Softplus), far()),
            Case::new("empty", Unary(Softplus), [Input::random("x", [0])]).flat(),
        ]
    }
}

/// ln(1 / (1 + e^-x)) = -softplus(-x).
#[derive(Clone, Copy, Debug)]
pub struct LogSigmoid;

impl Function for LogSigmoid {
    /// min(x, 0) - ln(1 + e^-|x|).
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        x.min(T::ZERO) - (-x.abs()).exp().ln_1p()
    }
    /// 1 - sigmoid(x) = sigmoid(-x).
    #[inline(always)]
    fn df<T: Float>(self, x: T) -> T {
        (-x).sigmoid()
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![
            Case::new("around 0", Unary(LogSigmoid), [Input::uniform("x", [3, 4, 5], -4.0, 4.0)]),
            Case::new("far out", Unary(LogSigmoid), far()),
            Case::new("empty", Unary(LogSigmoid), [Input::random("x", [0])]).flat(),
        ]
    }
}

/// x sigmoid(x) (Elfwing, Uchibe and Doya, 1702.03118; Swish in 1710.05941). Its limits at infinity are 0 and infinity.
#[derive(Clone, Copy, Debug)]
pub struct Silu;

impl Function for Silu {
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        let s = x.sigmoid();
        if s == T::ZERO { T::ZERO } else { x * s }
    }
    /// s (1 + x (1 - s)) with s = sigmoid(x), 1 - s = sigmoid(-x); 0 and 1 where s is, though x may be infinite.
    #[inline(always)]
    fn df<T: Float>(self, x: T) -> T {
        let (s, rest) = (x.sigmoid(), (-x).sigmoid());
        let bend = if rest == T::ZERO { T::ZERO } else { x * rest };
        if s == T::ZERO { T::ZERO } else { s * (T::ONE + bend) }
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![
            Case::new("around 0", Unary(Silu), [Input::uniform("x", [3, 4, 5], -4.0, 4.0)]),
            Case::new("exactly 0", Unary(Silu), [Input::values("x", [2], [0.0, -0.0])]),
            Case::new("far out", Unary(Silu), far()),
            Case::new("empty", Unary(Silu), [Input::random("x", [0])]).flat(),
        ]
    }
}

/// x where x >= 0, else slope x; the derivative at 0 is the slope. NaN stays NaN.
#[derive(Clone, Copy, Debug)]
pub struct LeakyRelu {
    /// The derivative of negative numbers.
    pub slope: f64,
}

impl Function for LeakyRelu {
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        if x < T::ZERO { x * T::of(self.slope) } else { x }
    }
    #[inline(always)]
    fn df<T: Float>(self, x: T) -> T {
        if x > T::ZERO { T::ONE } else { T::of(self.slope) }
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        let op = |slope| Unary(LeakyRelu { slope });
        vec![
            Case::new("both sides", op(0.2), [Input::away("x", [3, 4, 5], -2.0, 2.0, &[0.0])]),
            Case::new("exactly 0", op(0.2), [Input::values("x", [4], [0.0, -0.0, -1.0, 1.0])])
                .kinks(2)
                .promises(0, [0.2, 0.2, 0.2, 1.0]),
            Case::new("a negative slope", op(-0.5), [Input::away("x", [7], -2.0, 2.0, &[0.0])]),
            Case::new("empty", op(0.2), [Input::random("x", [0])]).flat(),
        ]
    }
}

/// x held within [0, 6]; the derivative at 0 and at 6 is 0. NaN stays NaN.
#[derive(Clone, Copy, Debug)]
pub struct Relu6;

impl Function for Relu6 {
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        x.max(T::ZERO).min(T::of(6.0))
    }
    #[inline(always)]
    fn df<T: Float>(self, x: T) -> T {
        if x > T::ZERO && x < T::of(6.0) { T::ONE } else { T::ZERO }
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![
            Case::new("three pieces", Unary(Relu6), [Input::away("x", [3, 4, 5], -3.0, 9.0, &[0.0, 6.0])]),
            Case::new("at the joints", Unary(Relu6), [Input::values("x", [3], [0.0, 6.0, 3.0])])
                .kinks(2)
                .promises(0, [0.0, 0.0, 1.0]),
            Case::new("all outside", Unary(Relu6), [Input::values("x", [3], [-800.0, 7.0, 800.0])]).flat(),
        ]
    }
}

/// clamp(x + 3, 0, 6) / 6 (Howard et al., 1905.02244); the derivative at -3 and at 3 is 0. NaN stays NaN.
#[derive(Clone, Copy, Debug)]
pub struct Hardsigmoid;

impl Function for Hardsigmoid {
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        (x + T::of(3.0)).max(T::ZERO).min(T::of(6.0)) * T::of(1.0 / 6.0)
    }
    #[inline(always)]
    fn df<T: Float>(self, x: T) -> T {
        if x > T::of(-3.0) && x < T::of(3.0) { T::of(1.0 / 6.0) } else { T::ZERO }
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![
            Case::new("three pieces", Unary(Hardsigmoid), [Input::away("x", [4, 4, 5], -5.0, 5.0, &[-3.0, 3.0])]),
            Case::new("at the joints", Unary(Hardsigmoid), [Input::values("x", [3], [-3.0, 3.0, 0.0])])
                .kinks(2)
                .promises(0, [0.0, 0.0, 1.0 / 6.0]),
            Case::new("all outside", Unary(Hardsigmoid), [Input::values("x", [3], [-800.0, 4.0, 800.0])]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// ln(1 + e^x), element by element. Of any shape.
    pub fn softplus(&self) -> Self {
        apply1(Unary(Softplus), &[self])
    }
    /// ln(sigmoid(x)), element by element. Of any shape.
    pub fn log_sigmoid(&self) -> Self {
        apply1(Unary(LogSigmoid), &[self])
    }
    /// x sigmoid(x), element by element. Of any shape.
    pub fn silu(&self) -> Self {
        apply1(Unary(Silu), &[self])
    }
    /// x where x >= 0, else slope x. Of any shape.
    pub fn leaky_relu(&self, slope: f64) -> Self {
        apply1(Unary(LeakyRelu { slope }), &[self])
    }
    /// x held within [0, 6]. Of any shape.
    pub fn relu6(&self) -> Self {
        apply1(Unary(Relu6), &[self])
    }
    /// clamp(x + 3, 0, 6) / 6. Of any shape.
    pub fn hardsigmoid(&self) -> Self {
        apply1(Unary(Hardsigmoid), &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::{Tape, Tensor};

    /// Value and derivative at a number.
    fn at<T: Float>(x: T, f: impl Fn(&Var<T>) -> Var<T>) -> (T, T) {
        let tape = Tape::new();
        let x = tape.leaf(Tensor::scalar(x));
        let y = f(&x);
        let value = y.value().item();
        (value, y.backward().get(&x).unwrap().item())
    }

    #[test]
    fn values_and_derivatives_at_zero() {
        let half = std::f64::consts::LN_2;
        assert_eq!(at(0.0, Var::softplus), (half, 0.5));
        assert_eq!(at(0.0, Var::log_sigmoid), (-half, 0.5));
        assert_eq!(at(0.0f64, Var::silu), (0.0, 0.5));
        assert_eq!(at(0.0f64, |x| x.leaky_relu(0.1)), (0.0, 0.1));
        assert_eq!(at(0.0f64, Var::relu6), (0.0, 0.0));
        assert_eq!(at(6.0f64, Var::relu6), (6.0, 0.0));
        assert_eq!(at(-3.0f64, Var::hardsigmoid), (0.0, 0.0));
        assert_eq!(at(3.0f64, Var::hardsigmoid), (1.0, 0.0));
        assert_eq!(at(0.0f64, Var::hardsigmoid), (0.5, 1.0 / 6.0));
    }

    #[test]
    fn far_out_nothing_overflows() {
        assert_eq!(at(800.0, Var::softplus), (800.0, 1.0));
        assert_eq!(at(-800.0, Var::softplus), (0.0, 0.0));
        assert_eq!(at(800.0, Var::log_sigmoid), (0.0, 0.0));
        assert_eq!(at(-800.0, Var::log_sigmoid), (-800.0, 1.0));
        assert_eq!(at(800.0, Var::silu), (800.0, 1.0));
        assert_eq!(at(-800.0, Var::silu), (0.0, 0.0));
        let inf = f32::INFINITY;
        assert_eq!(at(inf, Var::softplus), (inf, 1.0));
        assert_eq!(at(-inf, Var::softplus), (0.0, 0.0));
        assert_eq!(at(inf, Var::log_sigmoid), (0.0, 0.0));
        assert_eq!(at(-inf, Var::log_sigmoid), (-inf, 1.0));
        assert_eq!(at(inf, Var::silu), (inf, 1.0));
        assert_eq!(at(-inf, Var::silu), (0.0, 0.0));
    }

    #[test]
    fn small_tails_keep_their_digits() {
        for (x, y) in [(-30.0f64, (-30.0f64).exp()), (-36.0, (-36.0f64).exp())] {
            assert!((at(x, Var::softplus).0 / y - 1.0).abs() < 1e-12);
            assert!((at(-x, Var::log_sigmoid).0 / -y - 1.0).abs() < 1e-12);
            assert!((at(-x, Var::log_sigmoid).1 / y - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn nan_passes_through() {
        let nan = Var::constant(Tensor::scalar(f32::NAN));
        for y in [nan.softplus(), nan.log_sigmoid(), nan.silu(), nan.leaky_relu(0.1), nan.relu6(), nan.hardsigmoid()] {
            assert!(y.value().item().is_nan());
        }
    }
}
