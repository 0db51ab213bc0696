//! The two element types: `f32` to train in, `f64` to check in.

use std::fmt::{Debug, Display};
use std::iter::Sum;
use std::ops::{Add, AddAssign, Div, DivAssign, Mul, MulAssign, Neg, Sub, SubAssign};

use super::compiled::Signature;
use super::gemm::Gemm;
use super::pool::Pool;
use super::simd::Vector;

mod sealed {
    pub trait Sealed {}
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}

/// Element type of a tensor: `f32` or `f64`. Sealed, so that every kernel is checked for every type it runs in.
///
/// [`max`](Float::max) and [`min`](Float::min) propagate NaN, unlike the standard library's.
pub trait Float:
    sealed::Sealed
    + Gemm
    + Vector
    + Copy
    + Debug
    + Display
    + Default
    + PartialOrd
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + SubAssign
    + MulAssign
    + DivAssign
    + Sum
    + Send
    + Sync
    + 'static
{
    /// 0.
    const ZERO: Self;
    /// 1.
    const ONE: Self;
    /// Not a number.
    const NAN: Self;
    /// Positive infinity.
    const INFINITY: Self;
    /// The distance from 1 to the next number.
    const EPSILON: Self;

    /// The nearest value of this type.
    fn of(x: f64) -> Self;
    /// The value as `f64`, exactly.
    fn f64(self) -> f64;
    /// `self * a + b` with one rounding.
    fn mul_add(self, a: Self, b: Self) -> Self;
    /// e to this power. In `f32` a branch-free polynomial that vectorises, within a unit in the last place.
    fn exp(self) -> Self;
    /// e to this power, less 1, exact where `self` is small. In `f32` branch-free, so that it vectorises.
    fn exp_m1(self) -> Self;
    /// The natural logarithm.
    fn ln(self) -> Self;
    /// ln(1 + self), exact where `self` is small.
    fn ln_1p(self) -> Self;
    /// `self` to a power. As IEEE 754 has it, anything (NaN too) to the power 0 is 1, and 1 to any power is 1.
    fn powf(self, exponent: Self) -> Self;
    /// The square root.
    fn sqrt(self) -> Self;
    /// The sine.
    fn sin(self) -> Self;
    /// The cosine.
    fn cos(self) -> Self;
    /// The hyperbolic tangent.
    fn tanh(self) -> Self;
    /// The standard normal distribution function and its density, `[P(X <= self), e^(-self^2 / 2) / sqrt(2 pi)]`: both
    /// keep their relative accuracy down to where they underflow. In `f32` branch-free, so that it vectorises.
    fn normal(self) -> [Self; 2];
    /// The absolute value.
    fn abs(self) -> Self;
    /// The largest whole number that is not above.
    fn floor(self) -> Self;
    /// Whether it is neither infinite nor NaN.
    fn is_finite(self) -> bool;
    /// Whether it is NaN.
    fn is_nan(self) -> bool;
    /// The bits, widened: equal only for the same bits (NaN equals itself, 0 differs from -0).
    fn bits(self) -> u64;
    #[doc(hidden)]
    fn pool() -> &'static Pool<Self>;
    /// The function for this type, of the two for `f32` and `f64`.
    #[doc(hidden)]
    fn pick<S: Signature>(single: S::Of<f32>, double: S::Of<f64>) -> S::Of<Self>;

    /// The larger of two; NaN if either is.
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        if self > other || self.is_nan() { self } else { other }
    }

    /// The smaller of two; NaN if either is.
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        if self < other || self.is_nan() { self } else { other }
    }

    /// 1 / (1 + exp(-x)), without overflow at either end.
    #[inline(always)]
    fn sigmoid(self) -> Self {
        let e = (-self.abs()).exp();
        let positive = Self::ONE / (Self::ONE + e);
        if self >= Self::ZERO { positive } else { e * positive }
    }
}

/// x = n ln 2 + r with |r| <= ln 2 / 2, so that e^x = 2^n e^r; and p with e^r = 1 + r p, by a polynomial.
#[inline(always)]
fn reduced(x: f32) -> (i32, f32, f32) {
    // Adding 1.5 * 2^23 leaves the nearest whole number in the low bits of the mantissa.
    const MAGIC: f32 = 12_582_912.0;
    // Beyond these e^x is 0 or infinite anyway; NaN passes through both comparisons.
    let x = if x > 89.0 { 89.0 } else { x };
    let x = if x < -104.0 { -104.0 } else { x };
    let shifted = x.mul_add(std::f32::consts::LOG2_E, MAGIC);
    let n = shifted - MAGIC;
    // ln 2 in two parts, the first with few enough bits that n times it is exact.
    let r = n.mul_add(-0.693_359_4, x);
    let r = n.mul_add(2.121_944_4e-4, r);
    // Fitted to the least relative error of r p over the range of r, 1.3e-8; Taylor's are off by 1.2e-7 at its ends.
    let p = r.mul_add(1.394_649_6e-3, 8.366_611e-3);
    let p = p.mul_add(r, 4.166_628e-2);
    let p = p.mul_add(r, 0.166_665_43);
    let p = p.mul_add(r, 0.5);
    let p = p.mul_add(r, 1.0);
    (shifted.to_bits().wrapping_sub(MAGIC.to_bits()) as i32, r, p)
}

/// 2^k for k from -126 to 127; infinite for 128.
#[inline(always)]
fn power_of_2(k: i32) -> f32 {
    f32::from_bits((k.wrapping_add(127) as u32) << 23)
}

impl Float for f32 {
    const ZERO: f32 = 0.0;
    const ONE: f32 = 1.0;
    const NAN: f32 = f32::NAN;
    const INFINITY: f32 = f32::INFINITY;
    const EPSILON: f32 = f32::EPSILON;

    #[inline(always)]
    fn of(x: f64) -> f32 {
        x as f32
    }
    #[inline(always)]
    fn f64(self) -> f64 {
        self as f64
    }
    #[inline(always)]
    fn mul_add(self, a: f32, b: f32) -> f32 {
        f32::mul_add(self, a, b)
    }

    /// e^x = 2^n (1 + q), see `reduced`. 2^n is applied in two halves, which lets the result fall into the subnormals
    /// and to 0 by itself.
    #[inline(always)]
    fn exp(self) -> f32 {
        let (n, r, p) = reduced(self);
        let p = p.mul_add(r, 1.0);
        let half = n >> 1;
        p * power_of_2(half) * power_of_2(n.wrapping_sub(half))
    }
    /// With e^x = 2^n (1 + q) and n = h + k: 2^h (2^k q + (2^k - 2^-h)), where nothing overflows before the result
    /// does, and n = 0 leaves q alone.
    #[inline(always)]
    fn exp_m1(self) -> f32 {
        // From here on down it is -1.
        let x = if self < -20.0 { -20.0 } else { self };
        let (n, r, p) = reduced(x);
        let h = n >> 1;
        let k = n.wrapping_sub(h);
        let rest = power_of_2(k) - power_of_2(h.wrapping_neg());
        let m = (p * r).mul_add(power_of_2(k), rest) * power_of_2(h);
        // The sign of 0.
        if self == 0.0 { self } else { m }
    }
    #[inline(always)]
    fn ln(self) -> f32 {
        f32::ln(self)
    }
    #[inline(always)]
    fn ln_1p(self) -> f32 {
        f32::ln_1p(self)
    }
    #[inline(always)]
    fn powf(self, exponent: f32) -> f32 {
        f32::powf(self, exponent)
    }
    #[inline(always)]
    fn sqrt(self) -> f32 {
        f32::sqrt(self)
    }
    #[inline(always)]
    fn sin(self) -> f32 {
        f32::sin(self)
    }
    #[inline(always)]
    fn cos(self) -> f32 {
        f32::cos(self)
    }
    #[inline(always)]
    fn tanh(self) -> f32 {
        f32::tanh(self)
    }

    /// The tail is the density times a polynomial in t = 1 / (1 + 0.35 |x|), which was fitted to relative errors
    /// (4.4e-8 at the most). The rounding error of x^2 would be large in the exponent: it is taken back to first order.
    #[inline(always)]
    fn normal(self) -> [f32; 2] {
        // Beyond 20 the tail is 0; NaN passes through both comparisons.
        let x = if self > 20.0 { 20.0 } else { self };
        let x = if x < -20.0 { -20.0 } else { x };
        let square = x * x;
        let rounded_off = x.mul_add(x, -square);
        let e = Float::exp(-0.5 * square);
        let e = e.mul_add(-0.5 * rounded_off, e);
        let t = 1.0 / x.abs().mul_add(0.35, 1.0);
        let p = t.mul_add(-0.028_531_068, 0.141_272_23);
        let p = p.mul_add(t, -0.250_737_54);
        let p = p.mul_add(t, 0.154_166_3);
        let p = p.mul_add(t, -0.020_117_75);
        let p = p.mul_add(t, 0.104_427_52);
        let p = p.mul_add(t, 0.120_061_71);
        let p = p.mul_add(t, 0.139_836_05);
        let p = p.mul_add(t, 0.139_622_59);
        let tail = e * (t * p);
        [if x < 0.0 { tail } else { 1.0 - tail }, e * 0.398_942_3]
    }
    #[inline(always)]
    fn abs(self) -> f32 {
        f32::abs(self)
    }
    #[inline(always)]
    fn floor(self) -> f32 {
        f32::floor(self)
    }
    #[inline(always)]
    fn is_finite(self) -> bool {
        f32::is_finite(self)
    }
    #[inline(always)]
    fn is_nan(self) -> bool {
        f32::is_nan(self)
    }
    #[inline(always)]
    fn bits(self) -> u64 {
        self.to_bits() as u64
    }
    fn pool() -> &'static Pool<f32> {
        static POOL: Pool<f32> = Pool::new();
        &POOL
    }
    fn pick<S: Signature>(single: S::Of<f32>, _: S::Of<f64>) -> S::Of<f32> {
        single
    }
}

impl Float for f64 {
    const ZERO: f64 = 0.0;
    const ONE: f64 = 1.0;
    const NAN: f64 = f64::NAN;
    const INFINITY: f64 = f64::INFINITY;
    const EPSILON: f64 = f64::EPSILON;

    #[inline(always)]
    fn of(x: f64) -> f64 {
        x
    }
    #[inline(always)]
    fn f64(self) -> f64 {
        self
    }
    #[inline(always)]
    fn mul_add(self, a: f64, b: f64) -> f64 {
        f64::mul_add(self, a, b)
    }
    #[inline(always)]
    fn exp(self) -> f64 {
        f64::exp(self)
    }
    #[inline(always)]
    fn exp_m1(self) -> f64 {
        f64::exp_m1(self)
    }
    #[inline(always)]
    fn ln(self) -> f64 {
        f64::ln(self)
    }
    #[inline(always)]
    fn ln_1p(self) -> f64 {
        f64::ln_1p(self)
    }
    #[inline(always)]
    fn powf(self, exponent: f64) -> f64 {
        f64::powf(self, exponent)
    }
    #[inline(always)]
    fn sqrt(self) -> f64 {
        f64::sqrt(self)
    }
    #[inline(always)]
    fn sin(self) -> f64 {
        f64::sin(self)
    }
    #[inline(always)]
    fn cos(self) -> f64 {
        f64::cos(self)
    }
    #[inline(always)]
    fn tanh(self) -> f64 {
        f64::tanh(self)
    }
    #[inline(always)]
    fn normal(self) -> [f64; 2] {
        let tail = |x: f64| 0.5 * libm::erfc(x.abs() * std::f64::consts::FRAC_1_SQRT_2);
        let below = if self < 0.0 { tail(self) } else { 1.0 - tail(self) };
        [below, (-0.5 * self * self).exp() * 0.398_942_280_401_432_7]
    }
    #[inline(always)]
    fn abs(self) -> f64 {
        f64::abs(self)
    }
    #[inline(always)]
    fn floor(self) -> f64 {
        f64::floor(self)
    }
    #[inline(always)]
    fn is_finite(self) -> bool {
        f64::is_finite(self)
    }
    #[inline(always)]
    fn is_nan(self) -> bool {
        f64::is_nan(self)
    }
    #[inline(always)]
    fn bits(self) -> u64 {
        self.to_bits()
    }
    fn pool() -> &'static Pool<f64> {
        static POOL: Pool<f64> = Pool::new();
        &POOL
    }
    fn pick<S: Signature>(_: S::Of<f32>, double: S::Of<f64>) -> S::Of<f64> {
        double
    }
}

#[cfg(test)]
mod tests {
    use super::Float;

    #[test]
    fn exp_in_f32_is_within_two_units_in_the_last_place() {
        let mut x = -87.0f32;
        while x < 88.5 {
            let exact = (x as f64).exp();
            let error = (Float::exp(x) as f64 - exact).abs() / exact;
            assert!(error < 2.0 * f32::EPSILON as f64, "exp({x}): relative error {error:e}");
            x += 0.0137;
        }
        assert_eq!(Float::exp(-200.0f32), 0.0);
        assert_eq!(Float::exp(f32::NEG_INFINITY), 0.0);
        assert_eq!(Float::exp(200.0f32), f32::INFINITY);
        assert_eq!(Float::exp(0.0f32), 1.0);
        assert!(Float::exp(f32::NAN).is_nan());
        let subnormal = Float::exp(-95.0f32);
        assert!((subnormal as f64 / (-95.0f64).exp() - 1.0).abs() < 1e-3, "{subnormal:e}");
    }

    #[test]
    fn the_normal_distribution_in_f32_keeps_its_relative_accuracy_in_both_tails() {
        let mut worst = [0.0f64; 2];
        for i in -12_900..=12_900 {
            let x = i as f32 * 1e-3;
            for ((found, exact), worst) in x.normal().into_iter().zip((x as f64).normal()).zip(&mut worst) {
                *worst = worst.max((found as f64 - exact).abs() / exact);
            }
        }
        assert!(worst.iter().all(|&w| w < 4.0 * f32::EPSILON as f64), "{worst:?}");
        for x in [-20.0, -1e3, -3e38, f32::NEG_INFINITY] {
            assert_eq!(x.normal(), [0.0, 0.0]);
            assert_eq!((-x).normal(), [1.0, 0.0]);
        }
        assert!(f32::NAN.normal().iter().all(|x| x.is_nan()) && f64::NAN.normal().iter().all(|x| x.is_nan()));
        // From a table of the distribution: P(X <= -1.96), P(X <= 1), P(X <= -10).
        for (x, table) in
            [(-1.96f64, 0.024_997_895_148_220_4), (1.0, 0.841_344_746_068_542_9), (-10.0, 7.619_853_024_160_5e-24)]
        {
            assert!((x.normal()[0] / table - 1.0).abs() < 1e-12, "{x}: {:e}", x.normal()[0]);
        }
    }

    #[test]
    fn max_and_min_propagate_nan_from_either_side() {
        for (a, b) in [(f32::NAN, 1.0), (1.0, f32::NAN)] {
            assert!(Float::max(a, b).is_nan() && Float::min(a, b).is_nan());
        }
        assert_eq!((Float::max(1.0f64, 2.0), Float::min(1.0f64, 2.0)), (2.0, 1.0));
    }

    #[test]
    fn sigmoid_is_finite_at_both_ends() {
        assert_eq!(Float::sigmoid(-1000.0f64), 0.0);
        assert_eq!(Float::sigmoid(1000.0f64), 1.0);
        assert!(Float::sigmoid(f64::NAN).is_nan());
    }
}
