//! Functions of two numbers, element by element, with broadcasting: trailing dimensions are aligned, and an extent of 1
//! stretches.

use crate::ops::support::put::{begin_sum, put};
use crate::ops::{Case, Checked, Input, Needs, Op, Registered, ShapeError, apply1};
use crate::tensor::shape::MAX_RANK;
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel, regime};

/// A function of two numbers.
pub trait Function: Copy + Send + Sync + Default + 'static {
    /// Whether the derivatives depend on the arguments, which are then saved.
    const SAVES: bool;
    /// The range of a in the cases that all functions share; that of b is [1.2, 2]. A function that chooses between
    /// them has it there too, and may choose one operand throughout a small case.
    const A: [f64; 2] = [-1.0, 1.0];
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
#[inline(always)]
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

/// A broadcast cut along the first dimension of the result: slices that can be computed side by side.
struct Slices {
    /// How many.
    count: usize,
    /// The shape of the result in one.
    shape: Shape,
    /// Elements of the result in one.
    result: usize,
    /// Elements of each operand from one to the next; 0 where it is stretched.
    operands: [usize; 2],
    /// How each operand lies in one.
    strides: [Stretch; 2],
    /// Elements of a run along the last dimension, and each operand's step in it.
    run: usize,
    steps: [usize; 2],
}

impl Slices {
    fn of(operands: [&Shape; 2], result: &Shape) -> Self {
        let strides = operands.map(|o| Stretch::of(o, result));
        if result.rank() < 2 {
            let steps = strides.map(|s| s.0[0] * result.rank());
            let run = result.len();
            return Slices {
                count: 1,
                shape: *result,
                result: run,
                operands: operands.map(|o| o.len()),
                strides,
                run,
                steps,
            };
        }
        let shape = result.without(0);
        let last = shape.rank() - 1;
        let inner = strides.map(|s| {
            let mut inner = [0; MAX_RANK];
            inner[..=last].copy_from_slice(&s.0[1..last + 2]);
            Stretch(inner)
        });
        Slices {
            count: result.dims()[0],
            shape,
            result: shape.len(),
            operands: strides.map(|s| s.0[0]),
            strides: inner,
            run: shape.last(),
            steps: inner.map(|s| s.0[last]),
        }
    }

    /// Adds the gradient of one operand (`side`) in one slice, with its derivative `by(a, b)`; constant derivatives need
    /// no operands.
    #[inline(always)]
    fn gradient<T: Float>(
        &self,
        side: usize,
        out: &mut [T],
        g: &[T],
        operands: Option<[&[T]; 2]>,
        by: impl Fn(T, T) -> T,
    ) {
        let n = self.run;
        let ([a, b], saved) = (operands.unwrap_or([g, g]), operands.is_some());
        for_each_run(&self.shape, self.strides[0], self.strides[1], |io, ia, ib| {
            let to = [ia, ib][side];
            let g = &g[io..io + n];
            // Without saved operands the arguments are not looked at: any slice of the right length will do.
            let (ia, ib) = if saved { (ia, ib) } else { (0, 0) };
            let (one_a, one_b) = (a[ia], b[ib]);
            let (many_a, many_b) = if saved { (&a[ia..], &b[ib..]) } else { (g, g) };
            if self.steps[side] == 0 {
                let mut sum = T::ZERO;
                match self.steps {
                    [0, 0] => g.iter().for_each(|&g| sum += g * by(one_a, one_b)),
                    [0, _] => g.iter().zip(many_b).for_each(|(&g, &b)| sum += g * by(one_a, b)),
                    _ => g.iter().zip(many_a).for_each(|(&g, &a)| sum += g * by(a, one_b)),
                }
                out[to] += sum;
                return;
            }
            let terms = out[to..to + n].iter_mut().zip(g);
            match self.steps {
                [0, _] => terms.zip(many_b).for_each(|((d, &g), &b)| *d += g * by(one_a, b)),
                [_, 0] => terms.zip(many_a).for_each(|((d, &g), &a)| *d += g * by(a, one_b)),
                _ => terms.zip(many_a.iter().zip(many_b)).for_each(|((d, &g), (&a, &b))| *d += g * by(a, b)),
            }
        });
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
                let (chunk, work) = (regime::size(CHUNK), out.len());
                parallel::for_each_chunk(out, chunk, work, |i, out| {
                    let (a, b) = (&a.data()[i * chunk..][..out.len()], &b.data()[i * chunk..][..out.len()]);
                    T::dispatch(
                        #[inline(always)]
                        || out.iter_mut().zip(a.iter().zip(b)).for_each(|(y, (&a, &b))| *y = F::f(a, b)),
                    );
                });
                return;
            }
            let slices = Slices::of([a.shape(), b.shape()], &shape);
            let work = out.len();
            parallel::for_each_unit(out, slices.result, work, |i, out| {
                let (a, b) = (&a.data()[i * slices.operands[0]..], &b.data()[i * slices.operands[1]..]);
                T::dispatch(
                    #[inline(always)]
                    || {
                        for_each_run(&slices.shape, slices.strides[0], slices.strides[1], |io, ia, ib| {
                            let out = &mut out[io..io + slices.run];
                            match slices.steps {
                                [0, 0] => out.fill(F::f(a[ia], b[ib])),
                                [0, _] => out.iter_mut().zip(&b[ib..]).for_each(|(y, &b)| *y = F::f(a[ia], b)),
                                [_, 0] => out.iter_mut().zip(&a[ia..]).for_each(|(y, &a)| *y = F::f(a, b[ib])),
                                _ => {
                                    let operands = a[ia..].iter().zip(&b[ib..]);
                                    out.iter_mut().zip(operands).for_each(|(y, (&a, &b))| *y = F::f(a, b));
                                }
                            }
                        })
                    },
                );
            });
        });
        let saved = (needs.any() && F::SAVES).then(|| [a.clone(), b.clone()]);
        (vec![y], (saved, [*a.shape(), *b.shape()]))
    }

    /// dL/da = sum over the stretched dimensions of dL/dy df/da, and the same for b.
    fn backward(&self, (saved, shapes): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let operands = saved.as_ref().map(|[a, b]| (a.data(), b.data()));
        for side in [0, 1] {
            if !F::SAVES && shapes[side] == *g.shape() && F::is_identity(side) {
                sink.give(side, g.clone());
                continue;
            }
            sink.accumulate(side, |out, accum| {
                if Self::same([&shapes[0], &shapes[1]]) {
                    let (chunk, work) = (regime::size(CHUNK), out.len());
                    parallel::for_each_chunk(out, chunk, work, |i, out| {
                        let first = i * chunk;
                        let g = &g.data()[first..first + out.len()];
                        let (a, b) =
                            operands.map_or((g, g), |(a, b)| (&a[first..first + g.len()], &b[first..first + g.len()]));
                        let terms = out.iter_mut().zip(g.iter().zip(a.iter().zip(b)));
                        T::dispatch(
                            #[inline(always)]
                            || match side {
                                0 => put(accum, terms.map(|(d, (&g, (&a, &b)))| (d, g * F::da(a, b)))),
                                _ => put(accum, terms.map(|(d, (&g, (&a, &b)))| (d, g * F::db(a, b)))),
                            },
                        );
                    });
                    return;
                }
                let slices = Slices::of([&shapes[0], &shapes[1]], g.shape());
                // A slice of the gradient belongs to one thread, unless all slices meet in it.
                let own = slices.operands[side];
                let (per_thread, repeats) = if own > 0 { (own, 1) } else { (out.len(), slices.count) };
                let work = 2 * g.len();
                parallel::for_each_unit(out, per_thread, work, |first, out| {
                    begin_sum(out, accum);
                    for i in first * repeats..(first + 1) * repeats {
                        let g = &g.data()[i * slices.result..][..slices.result];
                        let [first_a, first_b] = slices.operands.map(|own| i * own);
                        let operands = operands.map(|(a, b)| [&a[first_a..], &b[first_b..]]);
                        T::dispatch(
                            #[inline(always)]
                            || match side {
                                0 => slices.gradient(0, out, g, operands, F::da),
                                _ => slices.gradient(1, out, g, operands, F::db),
                            },
                        );
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
        // Positive denominators: b in [1.2, 2].
        let free = |input: Input| if F::A[1] > 1.2 { input.ignored() } else { input };
        let a = |shape: &[usize]| free(Input::uniform("a", shape, F::A[0], F::A[1]));
        let b = |shape: &[usize]| free(Input::uniform("b", shape, 1.2, 2.0));
        let mut cases = vec![
            Case::new("same shape", op, [a(&[2, 3, 4]), b(&[2, 3, 4])]),
            Case::new("channels of b", op, [a(&[2, 3, 4]), b(&[4])]),
            Case::new("channels of a", op, [a(&[4]), b(&[2, 3, 4])]),
            Case::new("both stretched", op, [a(&[2, 1]), b(&[1, 3])]),
            Case::new("one per sample", op, [a(&[2, 3, 2, 2]), b(&[2, 1, 1, 1])]),
            Case::new("one per sample and channel", op, [a(&[2, 3, 2, 2]), b(&[2, 1, 1, 2])]),
            Case::new("one per pixel", op, [a(&[2, 3, 1, 1]), b(&[2, 3, 1, 5])]),
            Case::new("three samples, stretched", op, [a(&[3, 1, 2]), b(&[3, 2, 1])]),
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
    const A: [f64; 2] = [1.2, 2.0];
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
        extreme_cases([0.0, 1.0, 0.5])
    }
}

/// The smaller of the two. At a tie each gets half of the gradient; NaN from either side stays NaN.
#[derive(Clone, Copy, Debug, Default)]
pub struct Minimum;

impl Function for Minimum {
    const SAVES: bool = true;
    const A: [f64; 2] = [1.2, 2.0];
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
        extreme_cases([1.0, 0.0, 0.5])
    }
}

/// Both orders, and a tie (a kink for either operand).
fn extreme_cases<F: Function>(promise: [f64; 3]) -> Vec<Case<Binary<F>>> {
    let inputs = [Input::values("a", [3], [1.0, 2.0, 3.0]), Input::values("b", [3], [2.0, 1.0, 3.0])];
    vec![Case::new("both orders and a tie", Binary(F::default()), inputs).kinks(2).promises(0, promise)]
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
