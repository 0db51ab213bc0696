//! Functions of two numbers, element by element, with broadcasting: trailing dimensions are aligned, and an extent of 1
//! stretches.

use super::{Case, Checked, Input, Needs, Op, Registered, ShapeError, apply1};
use crate::tensor::shape::MAX_RANK;
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var, parallel, simd};

/// A function of two numbers.
pub trait Function: Copy + Send + Sync + Default + 'static {
    /// Whether the derivatives depend on the arguments, which are then saved.
    const SAVES: bool;
    /// The value.
    fn f<T: Float>(a: T, b: T) -> T;
    /// The derivative by a.
    fn da<T: Float>(a: T, b: T) -> T;
    /// The derivative by b.
    fn db<T: Float>(a: T, b: T) -> T;
    /// Cases beyond those that all share: kinks and ties.
    fn own_cases() -> Vec<Case<Binary<Self>>> {
        Vec::new()
    }
}

/// Applies a function to every pair of elements.
#[derive(Clone, Copy, Debug, Default)]
pub struct Binary<F>(pub F);

/// Elements handed to a thread at a time.
const CHUNK: usize = 1 << 14;

/// How an operand lies under the result: the stride of each dimension, 0 where it is stretched.
#[derive(Clone, Copy)]
struct Stretch([usize; MAX_RANK]);

impl Stretch {
    fn of(operand: &Shape, result: &Shape) -> Self {
        let (own, missing) = (operand.strides(), result.rank() - operand.rank());
        let mut strides = [0; MAX_RANK];
        for d in missing..result.rank() {
            if operand.dims()[d - missing] == result.dims()[d] {
                strides[d] = own[d - missing];
            }
        }
        Stretch(strides)
    }
}

/// Calls `run(result, a, b)` with the offsets of every run along the last dimension.
fn for_each_run(shape: &Shape, a: Stretch, b: Stretch, mut run: impl FnMut(usize, usize, usize)) {
    let outer = shape.rank().saturating_sub(1);
    let mut index = [0; MAX_RANK];
    let (mut ia, mut ib) = (0, 0);
    for row in 0..if shape.is_empty() { 0 } else { shape.rows() } {
        run(row * shape.last(), ia, ib);
        for d in (0..outer).rev() {
            index[d] += 1;
            ia += a.0[d];
            ib += b.0[d];
            if index[d] < shape.dims()[d] {
                break;
            }
            ia -= index[d] * a.0[d];
            ib -= index[d] * b.0[d];
            index[d] = 0;
        }
    }
}

impl<F: Function> Binary<F> {
    fn same(shapes: [&Shape; 2]) -> bool {
        shapes[0] == shapes[1]
    }
}

impl<T: Float, F: Function> Op<T> for Binary<F>
where
    Binary<F>: Registered,
{
    /// Both operands, where the derivatives need them; else just their shapes.
    type Saved = (Option<[Tensor<T>; 2]>, [Shape; 2]);

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        inputs[0].broadcast(&inputs[1]).map(|s| vec![s]).ok_or_else(|| ShapeError::new("the shapes do not broadcast"))
    }

    fn algo(&self, inputs: &[Shape]) -> &'static str {
        if Self::same([&inputs[0], &inputs[1]]) { "same_shape" } else { "broadcast" }
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let [a, b] = [inputs[0], inputs[1]];
        let shape = a.shape().broadcast(b.shape()).expect("checked by the shape rule");
        let y = Tensor::build(shape, |out| {
            if Self::same([a.shape(), b.shape()]) {
                let work = out.len();
                parallel::for_each_chunk(out, CHUNK, work, |i, out| {
                    let (a, b) = (&a.data()[i * CHUNK..][..out.len()], &b.data()[i * CHUNK..][..out.len()]);
                    simd::dispatch(
                        #[inline(always)]
                        || out.iter_mut().zip(a.iter().zip(b)).for_each(|(y, (&a, &b))| *y = F::f(a, b)),
                    );
                });
                return;
            }
            let (sa, sb) = (Stretch::of(a.shape(), &shape), Stretch::of(b.shape(), &shape));
            let (n, last) = (shape.last(), shape.rank().max(1) - 1);
            for_each_run(&shape, sa, sb, |io, ia, ib| {
                let out = &mut out[io..io + n];
                match (sa.0[last], sb.0[last]) {
                    (0, 0) => out.fill(F::f(a.data()[ia], b.data()[ib])),
                    (0, _) => out.iter_mut().zip(&b.data()[ib..]).for_each(|(y, &b)| *y = F::f(a.data()[ia], b)),
                    (_, 0) => out.iter_mut().zip(&a.data()[ia..]).for_each(|(y, &a)| *y = F::f(a, b.data()[ib])),
                    _ => {
                        let operands = a.data()[ia..].iter().zip(&b.data()[ib..]);
                        out.iter_mut().zip(operands).for_each(|(y, (&a, &b))| *y = F::f(a, b));
                    }
                }
            });
        });
        let saved = (needs.any() && F::SAVES).then(|| [a.clone(), b.clone()]);
        (vec![y], (saved, [*a.shape(), *b.shape()]))
    }

    /// dL/da = sum over the stretched dimensions of dL/dy df/da, and the same for b.
    fn backward(&self, (saved, shapes): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let operands = saved.as_ref().map(|[a, b]| (a.data(), b.data()));
        // Functions whose derivatives are constant never look at their arguments.
        let pair = |ia: usize, ib: usize| operands.map_or((T::ZERO, T::ZERO), |(a, b)| (a[ia], b[ib]));
        for side in [0, 1] {
            let derivative = if side == 0 { F::da::<T> } else { F::db::<T> };
            if !F::SAVES && shapes[side] == *g.shape() && F::is_identity(side) {
                sink.give(side, g.clone());
                continue;
            }
            sink.accumulate(side, |out, accum| {
                if Self::same([&shapes[0], &shapes[1]]) {
                    let work = out.len();
                    parallel::for_each_chunk(out, CHUNK, work, |i, out| {
                        let first = i * CHUNK;
                        let g = &g.data()[first..first + out.len()];
                        let (a, b) =
                            operands.map_or((g, g), |(a, b)| (&a[first..first + g.len()], &b[first..first + g.len()]));
                        let terms = out.iter_mut().zip(g.iter().zip(a.iter().zip(b)));
                        simd::dispatch(
                            #[inline(always)]
                            || match (accum, side) {
                                (Accum::Replace, 0) => terms.for_each(|(d, (&g, (&a, &b)))| *d = g * F::da(a, b)),
                                (Accum::Replace, _) => terms.for_each(|(d, (&g, (&a, &b)))| *d = g * F::db(a, b)),
                                (Accum::Add, 0) => terms.for_each(|(d, (&g, (&a, &b)))| *d += g * F::da(a, b)),
                                (Accum::Add, _) => terms.for_each(|(d, (&g, (&a, &b)))| *d += g * F::db(a, b)),
                            },
                        );
                    });
                    return;
                }
                if accum == Accum::Replace {
                    out.fill(T::ZERO);
                }
                let shape = g.shape();
                let (sa, sb) = (Stretch::of(&shapes[0], shape), Stretch::of(&shapes[1], shape));
                let (n, last) = (shape.last(), shape.rank().max(1) - 1);
                let (step_a, step_b) = (sa.0[last], sb.0[last]);
                for_each_run(shape, sa, sb, |io, ia, ib| {
                    let (to, step) = if side == 0 { (ia, step_a) } else { (ib, step_b) };
                    let g = &g.data()[io..io + n];
                    if step == 0 {
                        let mut sum = T::ZERO;
                        for (k, &g) in g.iter().enumerate() {
                            let (a, b) = pair(ia + k * step_a, ib + k * step_b);
                            sum += g * derivative(a, b);
                        }
                        out[to] += sum;
                    } else {
                        for (k, (d, &g)) in out[to..to + n].iter_mut().zip(g).enumerate() {
                            let (a, b) = pair(ia + k * step_a, ib + k * step_b);
                            *d += g * derivative(a, b);
                        }
                    }
                });
            });
        }
    }
}

/// Whether a derivative is 1 everywhere, so that the gradient is the upstream one itself.
trait Identity {
    fn is_identity(side: usize) -> bool;
}

impl<F: Function> Identity for F {
    fn is_identity(side: usize) -> bool {
        !F::SAVES && if side == 0 { F::da(0.0f64, 0.0) == 1.0 } else { F::db(0.0f64, 0.0) == 1.0 }
    }
}

impl<F: Function> Checked for Binary<F> {
    fn cases() -> Vec<Case<Self>> {
        let op = Binary(F::default());
        // Positive denominators, and no ties between a and b: a in [-1, 1], b in [1.2, 2].
        let a = |shape: &[usize]| Input::random("a", shape);
        let b = |shape: &[usize]| Input::uniform("b", shape, 1.2, 2.0);
        let mut cases = vec![
            Case::new("same shape", op, [a(&[2, 3, 4]), b(&[2, 3, 4])]),
            Case::new("channels of b", op, [a(&[2, 3, 4]), b(&[4])]),
            Case::new("channels of a", op, [a(&[4]), b(&[2, 3, 4])]),
            Case::new("both stretched", op, [a(&[2, 1]), b(&[1, 3])]),
            Case::new("one per sample", op, [a(&[2, 3, 2, 2]), b(&[2, 1, 1, 1])]),
            Case::new("one per sample and channel", op, [a(&[2, 3, 2, 2]), b(&[2, 1, 1, 2])]),
            Case::new("one per pixel", op, [a(&[2, 3, 1, 1]), b(&[2, 3, 1, 5])]),
            Case::new("scalar", op, [a(&[]), b(&[3])]),
            Case::new("two scalars", op, [a(&[]), b(&[])]),
            Case::new("empty", op, [a(&[2, 0]), b(&[1, 1])]).flat(),
        ];
        cases.extend(F::own_cases());
        cases
    }
}

/// a + b.
#[derive(Clone, Copy, Debug, Default)]
pub struct Add;

impl Function for Add {
    const SAVES: bool = false;
    #[inline(always)]
    fn f<T: Float>(a: T, b: T) -> T {
        a + b
    }
    #[inline(always)]
    fn da<T: Float>(_: T, _: T) -> T {
        T::ONE
    }
    #[inline(always)]
    fn db<T: Float>(_: T, _: T) -> T {
        T::ONE
    }
}

/// a - b.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sub;

impl Function for Sub {
    const SAVES: bool = false;
    #[inline(always)]
    fn f<T: Float>(a: T, b: T) -> T {
        a - b
    }
    #[inline(always)]
    fn da<T: Float>(_: T, _: T) -> T {
        T::ONE
    }
    #[inline(always)]
    fn db<T: Float>(_: T, _: T) -> T {
        -T::ONE
    }
}

/// a b.
#[derive(Clone, Copy, Debug, Default)]
pub struct Mul;

impl Function for Mul {
    const SAVES: bool = true;
    #[inline(always)]
    fn f<T: Float>(a: T, b: T) -> T {
        a * b
    }
    #[inline(always)]
    fn da<T: Float>(_: T, b: T) -> T {
        b
    }
    #[inline(always)]
    fn db<T: Float>(a: T, _: T) -> T {
        a
    }
}

/// a / b.
#[derive(Clone, Copy, Debug, Default)]
pub struct Div;

impl Function for Div {
    const SAVES: bool = true;
    #[inline(always)]
    fn f<T: Float>(a: T, b: T) -> T {
        a / b
    }
    #[inline(always)]
    fn da<T: Float>(_: T, b: T) -> T {
        T::ONE / b
    }
    #[inline(always)]
    fn db<T: Float>(a: T, b: T) -> T {
        -a / (b * b)
    }
}

/// The larger of the two. At a tie each gets half of the gradient; NaN from either side stays NaN.
#[derive(Clone, Copy, Debug, Default)]
pub struct Maximum;

impl Function for Maximum {
    const SAVES: bool = true;
    #[inline(always)]
    fn f<T: Float>(a: T, b: T) -> T {
        a.max(b)
    }
    #[inline(always)]
    fn da<T: Float>(a: T, b: T) -> T {
        let rest = if a == b { T::of(0.5) } else { T::ZERO };
        if a > b { T::ONE } else { rest }
    }
    #[inline(always)]
    fn db<T: Float>(a: T, b: T) -> T {
        Self::da(b, a)
    }
    fn own_cases() -> Vec<Case<Binary<Self>>> {
        extreme_cases()
    }
}

/// The smaller of the two. At a tie each gets half of the gradient; NaN from either side stays NaN.
#[derive(Clone, Copy, Debug, Default)]
pub struct Minimum;

impl Function for Minimum {
    const SAVES: bool = true;
    #[inline(always)]
    fn f<T: Float>(a: T, b: T) -> T {
        a.min(b)
    }
    #[inline(always)]
    fn da<T: Float>(a: T, b: T) -> T {
        let rest = if a == b { T::of(0.5) } else { T::ZERO };
        if a < b { T::ONE } else { rest }
    }
    #[inline(always)]
    fn db<T: Float>(a: T, b: T) -> T {
        Self::da(b, a)
    }
    fn own_cases() -> Vec<Case<Binary<Self>>> {
        extreme_cases()
    }
}

/// Both orders, and a tie (a kink for either operand).
fn extreme_cases<F: Function>() -> Vec<Case<Binary<F>>> {
    let inputs = [Input::values("a", [3], [1.0, 2.0, 3.0]), Input::values("b", [3], [2.0, 1.0, 3.0])];
    vec![Case::new("both orders and a tie", Binary(F::default()), inputs).kinks(2)]
}

impl<T: Float> Var<T> {
    /// The larger of the two, element by element; broadcasts.
    #[track_caller]
    pub fn maximum(&self, other: &Self) -> Self {
        apply1(Binary(Maximum), &[self, other])
    }
    /// The smaller of the two, element by element; broadcasts.
    #[track_caller]
    pub fn minimum(&self, other: &Self) -> Self {
        apply1(Binary(Minimum), &[self, other])
    }
}

macro_rules! operator {
    ($trait:ident, $method:ident, $function:expr) => {
        impl<T: Float> std::ops::$trait<&Var<T>> for &Var<T> {
            type Output = Var<T>;
            #[track_caller]
            fn $method(self, other: &Var<T>) -> Var<T> {
                apply1(Binary($function), &[self, other])
            }
        }
        impl<T: Float> std::ops::$trait<Var<T>> for Var<T> {
            type Output = Var<T>;
            #[track_caller]
            fn $method(self, other: Var<T>) -> Var<T> {
                apply1(Binary($function), &[&self, &other])
            }
        }
        impl<T: Float> std::ops::$trait<&Var<T>> for Var<T> {
            type Output = Var<T>;
            #[track_caller]
            fn $method(self, other: &Var<T>) -> Var<T> {
                apply1(Binary($function), &[&self, other])
            }
        }
        impl<T: Float> std::ops::$trait<Var<T>> for &Var<T> {
            type Output = Var<T>;
            #[track_caller]
            fn $method(self, other: Var<T>) -> Var<T> {
                apply1(Binary($function), &[self, &other])
            }
        }
    };
}
operator!(Add, add, Add);
operator!(Sub, sub, Sub);
operator!(Mul, mul, Mul);
operator!(Div, div, Div);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[should_panic(expected = "add: the shapes do not broadcast (inputs [[2, 3], [2]])")]
    fn shapes_that_do_not_fit_are_named() {
        let a = Var::<f32>::constant(Tensor::zeros([2, 3]));
        let b = Var::constant(Tensor::zeros([2]));
        let _ = &a + &b;
    }

    #[test]
    fn extremes_keep_nan_from_either_side() {
        let a = Var::constant(Tensor::from_vec([2], vec![f32::NAN, 1.0]));
        let b = Var::constant(Tensor::from_vec([2], vec![1.0, f32::NAN]));
        for y in [a.maximum(&b), a.minimum(&b)] {
            assert!(y.value().data().iter().all(|x| x.is_nan()));
        }
    }
}
