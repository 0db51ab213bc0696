//! Sums, means and extremes along dimensions.

use crate::ops::support::axes::{cut, dropped};
use crate::ops::support::indices::countable;
use crate::ops::support::put::{begin_sum, put};
use crate::ops::support::sums::sum_rows;
use crate::ops::{Case, Checked, Input, Needs, Op, Registered, ShapeError, apply, apply1};
use crate::tensor::pool::Buffer;
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel, regime};

/// The sum over a run of dimensions `first..first + count`, times a factor (one over their size makes a mean).
/// The dimensions are dropped.
#[derive(Clone, Copy, Debug)]
pub struct Sum {
    /// The first dimension.
    pub first: usize,
    /// How many dimensions.
    pub count: usize,
    /// Whether the result is divided by the number of summands.
    pub mean: bool,
}

impl Sum {
    fn factor<T: Float>(&self, n: usize) -> T {
        if self.mean { T::ONE / T::of(n as f64) } else { T::ONE }
    }
}

impl<T: Float> Op<T> for Sum {
    type Saved = Shape;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        dropped(&inputs[0], self.first, self.count)
    }

    fn algo(&self, _: &[Shape]) -> &'static str {
        if self.mean { "mean" } else { "sum" }
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let x = inputs[0];
        let [_, n, inner] = cut(x.shape(), self.first, self.count);
        let shape = dropped(x.shape(), self.first, self.count).expect("checked by the shape rule")[0];
        let factor = self.factor::<T>(n);
        let y = Tensor::build(shape, |out| {
            if n == 0 {
                return out.fill(T::ZERO * factor);
            }
            sum_each(out, x.data(), n, inner);
            out.iter_mut().for_each(|y| *y *= factor);
        });
        (vec![y], *x.shape())
    }

    /// Every summand gets the gradient of its sum.
    fn backward(&self, shape: Shape, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let [_, n, inner] = cut(&shape, self.first, self.count);
        let factor = self.factor::<T>(n);
        sink.accumulate(0, |out, accum| {
            if out.is_empty() {
                return;
            }
            let (work, tile) = (2 * out.len(), regime::size((CHUNK / inner).max(1)));
            let pieces = out.chunks_mut(n * inner).zip(g.data().chunks(inner));
            let pieces = pieces.flat_map(|(out, g)| out.chunks_mut(tile * inner).map(move |out| (out, g)));
            parallel::for_each_piece(pieces, work, |(out, g)| {
                T::dispatch(
                    #[inline(always)]
                    || {
                        for out in out.chunks_mut(inner) {
                            let terms = out.iter_mut().zip(g);
                            put(accum, terms.map(|(d, &g)| (d, g * factor)));
                        }
                    },
                );
            });
        });
    }
}

/// Elements handed to a thread at a time, about.
const CHUNK: usize = 1 << 14;
/// Rows of one sum that are worth a thread of their own.
const LONG: usize = 1 << 10;
/// Partial sums of long ones: a number that does not depend on the threads.
const PARTS: usize = 8;

/// The sum of every `n` rows of `inner` numbers.
fn sum_each<T: Float>(out: &mut [T], x: &[T], n: usize, inner: usize) {
    let (inner, work) = (inner.max(1), x.len());
    if n < regime::size(LONG) {
        return parallel::for_each_unit(out, inner, work, |i, out| sum_rows(out, &x[i * n * inner..][..n * inner]));
    }
    let step = n.div_ceil(PARTS);
    let mut parts = Buffer::stale(out.len() * PARTS);
    parallel::for_each_unit(&mut parts, inner, work, |i, part| {
        let (from, to) = ((i % PARTS * step).min(n), ((i % PARTS + 1) * step).min(n));
        sum_rows(part, &x[(i / PARTS * n + from) * inner..(i / PARTS * n + to) * inner]);
    });
    for (out, parts) in out.chunks_mut(inner).zip(parts.chunks(PARTS * inner)) {
        sum_rows(out, parts);
    }
}

impl Checked for Sum {
    fn cases() -> Vec<Case<Self>> {
        let x = || Input::random("x", [2, 3, 4, 5]);
        let mut cases = Vec::new();
        for mean in [false, true] {
            let sum = |first, count| Sum { first, count, mean };
            cases.extend([
                Case::new("everything", sum(0, 4), [x()]),
                Case::new("height and width", sum(1, 2), [x()]),
                Case::new("batch", sum(0, 1), [x()]),
                Case::new("channels", sum(3, 1), [x()]),
                Case::new("nothing", sum(1, 0), [x()]),
                Case::new("many rows", sum(0, 1), [Input::random("x", [150, 2])]),
                Case::new("a long run", sum(0, 1), [Input::random("x", [600])]),
                Case::new("a run in parts", sum(1, 1), [Input::random("x", [2, 1030])]),
                Case::new("rows in parts", sum(0, 1), [Input::random("x", [1026, 2])]),
                Case::new("empty rest", sum(0, 1), [Input::random("x", [3, 0])]).flat(),
            ]);
        }
        cases.push(
            Case::new("of nothing", Sum { first: 0, count: 1, mean: false }, [Input::random("x", [0, 3])]).flat(),
        );
        cases
    }
}

/// Which extreme.
pub trait Side: Copy + Default + Send + Sync + 'static {
    /// Whether `a` is further out than `b`.
    fn beyond<T: Float>(a: T, b: T) -> bool;
}

/// The largest.
#[derive(Clone, Copy, Debug, Default)]
pub struct Max;
impl Side for Max {
    #[inline(always)]
    fn beyond<T: Float>(a: T, b: T) -> bool {
        a > b
    }
}

/// The smallest.
#[derive(Clone, Copy, Debug, Default)]
pub struct Min;
impl Side for Min {
    #[inline(always)]
    fn beyond<T: Float>(a: T, b: T) -> bool {
        a < b
    }
}

/// The largest or smallest element over a run of dimensions, which are dropped, and (auxiliary) its index in the run.
///
/// Of several equal ones the first gets the gradient, all of it. A NaN wins.
#[derive(Clone, Copy, Debug)]
pub struct Extreme<S> {
    /// The first dimension.
    pub first: usize,
    /// How many dimensions.
    pub count: usize,
    /// Which extreme.
    pub side: S,
}

impl<T: Float, S: Side> Op<T> for Extreme<S>
where
    Extreme<S>: Registered,
{
    /// The index of the extreme of each run, and the shape of the input.
    type Saved = (Tensor<T>, Shape);

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let shape = dropped(&inputs[0], self.first, self.count)?[0];
        let run = cut(&inputs[0], self.first, self.count)[1];
        if run == 0 {
            return Err(ShapeError::new("nothing has no extreme"));
        }
        countable::<T>(run)?;
        Ok(vec![shape, shape])
    }

    fn auxiliary(&self) -> usize {
        1
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let x = inputs[0];
        let [_, n, inner] = cut(x.shape(), self.first, self.count);
        let shape = dropped(x.shape(), self.first, self.count).expect("checked by the shape rule")[0];
        let mut index = Tensor::<T>::zeros(shape);
        let at = index.data_mut();
        let y = Tensor::build(shape, |out| {
            for (o, out) in out.chunks_mut(inner.max(1)).enumerate() {
                let x = &x.data()[o * n * inner..(o + 1) * n * inner];
                let at = &mut at[o * inner..(o + 1) * inner];
                out.copy_from_slice(&x[..inner]);
                for (k, row) in x.chunks_exact(inner).enumerate().skip(1) {
                    for ((best, at), &x) in out.iter_mut().zip(at.iter_mut()).zip(row) {
                        if S::beyond(x, *best) || (x.is_nan() && !best.is_nan()) {
                            *best = x;
                            *at = T::of(k as f64);
                        }
                    }
                }
            }
        });
        (vec![y, index.clone()], (index, *x.shape()))
    }

    /// The extreme gets the gradient, the others nothing.
    fn backward(&self, (index, shape): Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let [_, n, inner] = cut(&shape, self.first, self.count);
        sink.accumulate(0, |out, accum| {
            begin_sum(out, accum);
            for (i, (&g, k)) in g.data().iter().zip(index.data()).enumerate() {
                out[((i / inner) * n + k.f64() as usize) * inner + i % inner] += g;
            }
        });
    }
}

impl<S: Side> Checked for Extreme<S> {
    fn cases() -> Vec<Case<Self>> {
        let op = |first, count| Extreme { first, count, side: S::default() };
        let x = || Input::distinct("x", [2, 3, 4, 5]);
        vec![
            Case::new("first dimension", op(0, 1), [x()]),
            Case::new("middle dimension", op(1, 1), [x()]),
            Case::new("last dimension", op(3, 1), [x()]),
            Case::new("height and width", op(1, 2), [x()]),
            Case::new("everything", op(0, 4), [x()]),
            Case::new("one element", op(0, 1), [Input::random("x", [1, 3])]),
            Case::new("a tie", op(0, 1), [Input::values("x", [3], [2.0, 2.0, 2.0])])
                .kinks(3)
                .promises(0, [1.0, 0.0, 0.0]),
        ]
    }
}

impl<T: Float> Var<T> {
    /// The sum over `count` dimensions from `first` on, which are dropped.
    #[track_caller]
    pub fn sum(&self, first: usize, count: usize) -> Self {
        apply1(Sum { first, count, mean: false }, &[self])
    }

    /// The mean over `count` dimensions from `first` on, which are dropped.
    #[track_caller]
    pub fn mean(&self, first: usize, count: usize) -> Self {
        apply1(Sum { first, count, mean: true }, &[self])
    }

    /// The sum of everything, a scalar.
    pub fn sum_all(&self) -> Self {
        self.sum(0, self.shape().rank())
    }

    /// The mean of everything, a scalar.
    pub fn mean_all(&self) -> Self {
        self.mean(0, self.shape().rank())
    }

    /// The largest element over `count` dimensions from `first` on, and its index among them (as numbers).
    #[track_caller]
    pub fn max(&self, first: usize, count: usize) -> [Self; 2] {
        apply(Extreme { first, count, side: Max }, &[self]).try_into().ok().expect("two outputs")
    }

    /// The smallest element over `count` dimensions from `first` on, and its index among them (as numbers).
    #[track_caller]
    pub fn min(&self, first: usize, count: usize) -> [Self; 2] {
        apply(Extreme { first, count, side: Min }, &[self]).try_into().ok().expect("two outputs")
    }
}
