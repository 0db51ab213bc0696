//! Functions of one number, element by element: each is a line for its value and a line for its derivative.

use crate::ops::support::put::put;
use crate::ops::{Case, Checked, Input, Needs, Op, Registered, ShapeError, apply1};
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel, regime};

/// A function of one number.
pub trait Function: Copy + Send + Sync + 'static {
    /// Whether the derivative is computed from the result (which is there anyway) and not from the argument.
    const FROM_RESULT: bool = false;
    /// The value.
    fn f<T: Float>(self, x: T) -> T;
    /// The derivative, from the argument, or from the result if [`FROM_RESULT`](Function::FROM_RESULT).
    fn df<T: Float>(self, x: T) -> T;
    /// The derivative, from the argument in any case.
    #[inline(always)]
    fn slope<T: Float>(self, x: T) -> T {
        if Self::FROM_RESULT { self.df(self.f(x)) } else { self.df(x) }
    }
    /// Gradient-check cases.
    fn cases() -> Vec<Case<Unary<Self>>>;
}

/// Applies a function to every element.
#[derive(Clone, Copy, Debug)]
pub struct Unary<F>(pub F);

/// Elements handed to a thread at a time.
const CHUNK: usize = 1 << 14;

impl<T: Float, F: Function> Op<T> for Unary<F>
where
    Unary<F>: Registered,
{
    type Saved = Option<Tensor<T>>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        Ok(vec![inputs[0]])
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let (f, x) = (self.0, inputs[0]);
        let y = Tensor::build(*x.shape(), |out| {
            let (chunk, work) = (regime::size(CHUNK), 4 * out.len());
            parallel::for_each_chunk(out, chunk, work, |i, out| {
                let x = &x.data()[i * chunk..][..out.len()];
                T::dispatch(
                    #[inline(always)]
                    || out.iter_mut().zip(x).for_each(|(y, &x)| *y = f.f(x)),
                );
            });
        });
        let saved = needs.any().then(|| if F::FROM_RESULT { y.clone() } else { x.clone() });
        (vec![y], saved)
    }

    /// dL/dx = dL/dy f'(x).
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let (f, g, s) = (self.0, upstream.only(), saved.expect("saved for the only input"));
        sink.accumulate(0, |out, accum| {
            let (chunk, work) = (regime::size(CHUNK), 4 * out.len());
            parallel::for_each_chunk(out, chunk, work, |i, out| {
                let (g, s) = (&g.data()[i * chunk..][..out.len()], &s.data()[i * chunk..][..out.len()]);
                let terms = out.iter_mut().zip(g.iter().zip(s));
                T::dispatch(
                    #[inline(always)]
                    || put(accum, terms.map(|(d, (&g, &s))| (d, g * f.df(s)))),
                );
            });
        });
    }
}

impl<F: Function> Checked for Unary<F> {
    fn cases() -> Vec<Case<Self>> {
        F::cases()
    }
}

/// max(x, 0); 0 at the kink. NaN stays NaN.
#[derive(Clone, Copy, Debug)]
pub struct Relu;

impl Function for Relu {
    const FROM_RESULT: bool = true;
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        if x < T::ZERO { T::ZERO } else { x }
    }
    #[inline(always)]
    fn df<T: Float>(self, y: T) -> T {
        if y > T::ZERO { T::ONE } else { T::ZERO }
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![
            Case::new("both sides", Unary(Relu), [Input::away("x", [3, 4, 5], -2.0, 2.0, &[0.0])]),
            Case::new("exactly 0", Unary(Relu), [Input::values("x", [3], [0.0, -1.0, 1.0])])
                .kinks(1)
                .promises(0, [0.0, 0.0, 1.0]),
        ]
    }
}

/// x where x > 0, else e^x - 1.
#[derive(Clone, Copy, Debug)]
pub struct Elu;

impl Function for Elu {
    const FROM_RESULT: bool = true;
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        // e^x - 1 is taken of min(x, 0): of a large positive x it would overflow in the branch not chosen.
        let negative = if x > T::ZERO { T::ZERO } else { x }.exp_m1();
        if x > T::ZERO { x } else { negative }
    }
    /// 1, or e^x = y + 1.
    #[inline(always)]
    fn df<T: Float>(self, y: T) -> T {
        if y > T::ZERO { T::ONE } else { y + T::ONE }
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![
            Case::new("both sides", Unary(Elu), [Input::uniform("x", [3, 4, 5], -3.0, 3.0)]),
            Case::new("large and zero", Unary(Elu), [Input::values("x", [4], [800.0, 50.0, -40.0, 1e-3])]),
            Case::new("exactly 0", Unary(Elu), [Input::values("x", [2], [0.0, 1.0])]).tolerance(
                1e-5,
                "the second derivative jumps at 0, where central differences are off by a quarter step",
            ),
        ]
    }
}

/// x Phi(x), with Phi the standard normal distribution function (Hendrycks and Gimpel, 1606.08415).
#[derive(Clone, Copy, Debug)]
pub struct Gelu;

impl Function for Gelu {
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        let [below, _] = x.normal();
        // Not infinity times 0.
        if below == T::ZERO { below } else { x * below }
    }
    /// Phi(x) + x phi(x), phi the normal density.
    #[inline(always)]
    fn df<T: Float>(self, x: T) -> T {
        let [below, density] = x.normal();
        below + if density == T::ZERO { density } else { x * density }
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![
            Case::new("around 0", Unary(Gelu), [Input::uniform("x", [3, 4, 5], -4.0, 4.0)]),
            Case::new("far out", Unary(Gelu), [Input::values("x", [4], [-20.0, 20.0, 0.0, -7.5])]),
        ]
    }
}

/// x clamp(x + 3, 0, 6) / 6 (Howard et al., 1905.02244); the derivative is 0 at -3 and 1 at 3.
#[derive(Clone, Copy, Debug)]
pub struct Hardswish;

impl Function for Hardswish {
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        let gate = (x + T::of(3.0)).max(T::ZERO).min(T::of(6.0));
        // The gate first: 6 x overflows where the result does not. And not minus infinity times 0.
        x.max(T::of(-3.0)) * (gate * T::of(1.0 / 6.0))
    }
    #[inline(always)]
    fn df<T: Float>(self, x: T) -> T {
        let middle = (x + x + T::of(3.0)) * T::of(1.0 / 6.0);
        let right = if x >= T::of(3.0) { T::ONE } else { middle };
        if x <= T::of(-3.0) { T::ZERO } else { right }
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![
            Case::new("three pieces", Unary(Hardswish), [Input::away("x", [4, 4, 5], -5.0, 5.0, &[-3.0, 3.0])]),
            Case::new("at the joints", Unary(Hardswish), [Input::values("x", [3], [-3.0, 3.0, 0.0])])
                .kinks(2)
                .promises(0, [0.0, 1.0, 0.5]),
        ]
    }
}

/// 1 / (1 + e^-x).
#[derive(Clone, Copy, Debug)]
pub struct Sigmoid;

impl Function for Sigmoid {
    const FROM_RESULT: bool = true;
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        x.sigmoid()
    }
    /// y (1 - y).
    #[inline(always)]
    fn df<T: Float>(self, y: T) -> T {
        y * (T::ONE - y)
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![
            Case::new("around 0", Unary(Sigmoid), [Input::uniform("x", [3, 4, 5], -4.0, 4.0)]),
            Case::new("far out", Unary(Sigmoid), [Input::values("x", [4], [-90.0, -800.0, 90.0, 0.0])]),
        ]
    }
}

/// The hyperbolic tangent.
#[derive(Clone, Copy, Debug)]
pub struct Tanh;

impl Function for Tanh {
    const FROM_RESULT: bool = true;
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        x.tanh()
    }
    /// 1 - y^2.
    #[inline(always)]
    fn df<T: Float>(self, y: T) -> T {
        T::ONE - y * y
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![Case::new("around 0", Unary(Tanh), [Input::uniform("x", [3, 4, 5], -3.0, 3.0)])]
    }
}

/// e^x.
#[derive(Clone, Copy, Debug)]
pub struct Exp;

impl Function for Exp {
    const FROM_RESULT: bool = true;
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        x.exp()
    }
    #[inline(always)]
    fn df<T: Float>(self, y: T) -> T {
        y
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![Case::new("around 0", Unary(Exp), [Input::uniform("x", [3, 4, 5], -3.0, 3.0)])]
    }
}

/// The natural logarithm.
#[derive(Clone, Copy, Debug)]
pub struct Log;

impl Function for Log {
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        x.ln()
    }
    #[inline(always)]
    fn df<T: Float>(self, x: T) -> T {
        T::ONE / x
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![Case::new("positive", Unary(Log), [Input::uniform("x", [3, 4, 5], 0.1, 3.0)])]
    }
}

/// The square root.
#[derive(Clone, Copy, Debug)]
pub struct Sqrt;

impl Function for Sqrt {
    const FROM_RESULT: bool = true;
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        x.sqrt()
    }
    /// 1 / (2 y).
    #[inline(always)]
    fn df<T: Float>(self, y: T) -> T {
        T::of(0.5) / y
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![Case::new("positive", Unary(Sqrt), [Input::uniform("x", [3, 4, 5], 0.1, 3.0)])]
    }
}

/// |x|; the derivative at 0 is 0.
#[derive(Clone, Copy, Debug)]
pub struct Abs;

impl Function for Abs {
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        x.abs()
    }
    #[inline(always)]
    fn df<T: Float>(self, x: T) -> T {
        let negative = if x < T::ZERO { -T::ONE } else { T::ZERO };
        if x > T::ZERO { T::ONE } else { negative }
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![
            Case::new("both sides", Unary(Abs), [Input::away("x", [3, 4, 5], -2.0, 2.0, &[0.0])]),
            Case::new("exactly 0", Unary(Abs), [Input::values("x", [3], [0.0, -1.0, 1.0])])
                .kinks(1)
                .promises(0, [0.0, -1.0, 1.0]),
        ]
    }
}

/// 1 / x.
#[derive(Clone, Copy, Debug)]
pub struct Reciprocal;

impl Function for Reciprocal {
    const FROM_RESULT: bool = true;
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        T::ONE / x
    }
    /// -y^2.
    #[inline(always)]
    fn df<T: Float>(self, y: T) -> T {
        -(y * y)
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![
            Case::new("positive", Unary(Reciprocal), [Input::uniform("x", [3, 4], 0.5, 3.0)]),
            Case::new("negative", Unary(Reciprocal), [Input::uniform("x", [5], -3.0, -0.5)]),
        ]
    }
}

/// x^2.
#[derive(Clone, Copy, Debug)]
pub struct Square;

impl Function for Square {
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        x * x
    }
    #[inline(always)]
    fn df<T: Float>(self, x: T) -> T {
        x + x
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        vec![Case::new("both sides", Unary(Square), [Input::random("x", [3, 4, 5])])]
    }
}

/// x held within [low, high]; the derivative is 1 inside and on the bounds, 0 outside. NaN stays NaN.
#[derive(Clone, Copy, Debug)]
pub struct Clamp {
    /// The least result.
    pub low: f64,
    /// The greatest result.
    pub high: f64,
}

impl Function for Clamp {
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        x.max(T::of(self.low)).min(T::of(self.high))
    }
    #[inline(always)]
    fn df<T: Float>(self, x: T) -> T {
        let below = if x < T::of(self.low) { T::ZERO } else { T::ONE };
        if x > T::of(self.high) { T::ZERO } else { below }
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        let op = Unary(Clamp { low: -0.5, high: 1.0 });
        vec![
            Case::new("three pieces", op, [Input::away("x", [3, 4, 5], -2.0, 2.0, &[-0.5, 1.0])]),
            Case::new("on the bounds", op, [Input::values("x", [3], [-0.5, 1.0, 0.0])])
                .kinks(2)
                .promises(0, [1.0, 1.0, 1.0]),
            Case::new("all outside", op, [Input::uniform("x", [4], 2.0, 3.0)]).flat(),
        ]
    }
}

/// scale x + shift.
#[derive(Clone, Copy, Debug)]
pub struct Affine {
    /// The factor.
    pub scale: f64,
    /// The summand.
    pub shift: f64,
}

impl Function for Affine {
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        x.mul_add(T::of(self.scale), T::of(self.shift))
    }
    #[inline(always)]
    fn df<T: Float>(self, _: T) -> T {
        T::of(self.scale)
    }
    fn cases() -> Vec<Case<Unary<Self>>> {
        let op = Unary(Affine { scale: -2.5, shift: 0.75 });
        vec![
            Case::new("both sides", op, [Input::random("x", [3, 4, 5])]),
            Case::new("longer than a thread's chunk", op, [Input::random("x", [7])]),
            Case::new("empty", op, [Input::random("x", [0, 3])]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// max(x, 0).
    pub fn relu(&self) -> Self {
        apply1(Unary(Relu), &[self])
    }
    /// x where x > 0, else e^x - 1.
    pub fn elu(&self) -> Self {
        apply1(Unary(Elu), &[self])
    }
    /// The Gaussian error linear unit, erf form.
    pub fn gelu(&self) -> Self {
        apply1(Unary(Gelu), &[self])
    }
    /// x clamp(x + 3, 0, 6) / 6.
    pub fn hardswish(&self) -> Self {
        apply1(Unary(Hardswish), &[self])
    }
    /// 1 / (1 + e^-x).
    pub fn sigmoid(&self) -> Self {
        apply1(Unary(Sigmoid), &[self])
    }
    /// The hyperbolic tangent.
    pub fn tanh(&self) -> Self {
        apply1(Unary(Tanh), &[self])
    }
    /// e^x.
    pub fn exp(&self) -> Self {
        apply1(Unary(Exp), &[self])
    }
    /// The natural logarithm.
    pub fn log(&self) -> Self {
        apply1(Unary(Log), &[self])
    }
    /// The square root.
    pub fn sqrt(&self) -> Self {
        apply1(Unary(Sqrt), &[self])
    }
    /// |x|.
    pub fn abs(&self) -> Self {
        apply1(Unary(Abs), &[self])
    }
    /// 1 / x.
    pub fn reciprocal(&self) -> Self {
        apply1(Unary(Reciprocal), &[self])
    }
    /// x^2.
    pub fn square(&self) -> Self {
        apply1(Unary(Square), &[self])
    }
    /// x held within [low, high].
    pub fn clamp(&self, low: f64, high: f64) -> Self {
        apply1(Unary(Clamp { low, high }), &[self])
    }
    /// scale x + shift.
    pub fn affine(&self, scale: f64, shift: f64) -> Self {
        apply1(Unary(Affine { scale, shift }), &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Over the whole range of f32, against f64: within some units in the last place of the value, and of 1 for the
    /// derivative (which has a zero, where nothing relative can be promised).
    #[test]
    fn gelu_is_exact_to_a_few_units_over_the_whole_range_of_f32() {
        let positive = (0..=0x7f7f_ffffu32).step_by(262_147).map(f32::from_bits);
        let (mut value, mut slope) = (0.0f64, 0.0f64);
        for x in positive.flat_map(|x| [x, -x]) {
            let (y, d) = (Gelu.f(x), Gelu.df(x));
            let (exact, exact_slope) = (Gelu.f(f64::from(x)), Gelu.df(f64::from(x)));
            assert!(y.is_finite() && d.is_finite(), "{x:e}: {y:e}, {d:e}");
            // Below the smallest normal number there are no relative digits.
            let unit = f64::from(f32::EPSILON) * exact.abs().max(f64::from(f32::MIN_POSITIVE));
            value = value.max((f64::from(y) - exact).abs() / unit);
            slope = slope.max((f64::from(d) - exact_slope).abs() / f64::from(f32::EPSILON));
        }
        assert!(value < 8.0 && slope < 3.0, "{value} and {slope} units");
        for x in [-1000.0f32, -3e38, f32::NEG_INFINITY] {
            assert_eq!((Gelu.f(x), Gelu.df(x)), (0.0, 0.0), "{x:e}");
            assert_eq!((Gelu.f(-x), Gelu.df(-x)), (-x, 1.0), "{:e}", -x);
        }
    }

    #[test]
    fn nan_passes_through_every_comparison() {
        let nan = Var::constant(Tensor::from_vec([1], vec![f32::NAN]));
        for y in [nan.relu(), nan.elu(), nan.hardswish(), nan.clamp(0.0, 1.0), nan.abs(), nan.sigmoid(), nan.gelu()] {
            assert!(y.value().item().is_nan());
        }
    }
}
