//! Running sums and products along an axis.

use super::axis_loops::Blocks;
use crate::ops::support::put::put;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var};

/// The running sum: y_k = x_0 + .. + x_k along an axis.
#[derive(Clone, Copy, Debug)]
pub struct CumSum {
    /// The axis.
    pub axis: usize,
}

/// The running product: y_k = x_0 .. x_k along an axis.
#[derive(Clone, Copy, Debug)]
pub struct CumProd {
    /// The axis.
    pub axis: usize,
}

/// The shape stays.
fn same(inputs: &[Shape], axis: usize) -> Result<Vec<Shape>, ShapeError> {
    if axis >= inputs[0].rank() {
        return Err(ShapeError::new(format!("no dimension {axis}")));
    }
    Ok(vec![inputs[0]])
}

/// y_k = f(y_(k - 1), x_k), with y_(-1) = `start`.
fn scan<T: Float>(x: &Tensor<T>, axis: usize, start: T, f: impl Fn(T, T) -> T + Sync + Send) -> Tensor<T> {
    let blocks = Blocks::of(x.shape(), axis, 1);
    let (len, inner) = (blocks.len(), blocks.inner);
    Tensor::build(*x.shape(), |out| {
        blocks.for_each(
            out,
            inner,
            #[inline(always)]
            |o, out, running| {
                running.fill(start);
                for (out, x) in out.chunks_exact_mut(inner).zip(x.data()[o * len..][..len].chunks_exact(inner)) {
                    running.iter_mut().zip(x).for_each(|(r, &x)| *r = f(*r, x));
                    out.copy_from_slice(running);
                }
            },
        );
    })
}

/// Adds x to running sums, and what rounding takes from them to `lost`: the sum and what it lost together have the digits
/// of both, however long the run is (Knuth's two-sum).
#[inline(always)]
fn add_without_loss<T: Float>(sums: &mut [T], lost: &mut [T], x: &[T]) {
    for ((sum, lost), &x) in sums.iter_mut().zip(lost).zip(x) {
        let next = *sum + x;
        let taken = next - *sum;
        *lost += (*sum - (next - taken)) + (x - taken);
        *sum = next;
    }
}

/// The running sums: an infinite one has lost nothing.
#[inline(always)]
fn together<T: Float>(sum: T, lost: T) -> T {
    if lost.is_finite() { sum + lost } else { sum }
}

impl<T: Float> Op<T> for CumSum {
    /// The shape of the input.
    type Saved = Shape;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        same(inputs, self.axis)
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let x = inputs[0];
        let blocks = Blocks::of(x.shape(), self.axis, 1);
        let y = Tensor::build(*x.shape(), |out| {
            blocks.for_each(
                out,
                2 * blocks.inner,
                #[inline(always)]
                |o, out, scratch| {
                    scratch.fill(T::ZERO);
                    let (sums, lost) = scratch.split_at_mut(blocks.inner);
                    for (out, x) in out.chunks_exact_mut(blocks.inner).zip(blocks.rows(o, x.data())) {
                        add_without_loss(sums, lost, x);
                        out.iter_mut().zip(sums.iter().zip(lost.iter())).for_each(|(y, (&s, &l))| *y = together(s, l));
                    }
                },
            );
        });
        (vec![y], *x.shape())
    }

    /// x_k is in y_k and all that follow: dx_k = dy_k + dx_(k + 1), from the end.
    fn backward(&self, shape: Shape, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let blocks = Blocks::of(&shape, self.axis, 1);
        sink.accumulate(0, |out, accum| {
            blocks.for_each(
                out,
                2 * blocks.inner,
                #[inline(always)]
                |o, out, scratch| {
                    scratch.fill(T::ZERO);
                    let (sums, lost) = scratch.split_at_mut(blocks.inner);
                    for (out, g) in out.chunks_exact_mut(blocks.inner).zip(blocks.rows(o, g.data())).rev() {
                        add_without_loss(sums, lost, g);
                        let rest = sums.iter().zip(lost.iter()).map(|(&s, &l)| together(s, l));
                        put(accum, out.iter_mut().zip(rest));
                    }
                },
            );
        });
    }
}

impl<T: Float> Op<T> for CumProd {
    /// The input and the result.
    type Saved = Option<[Tensor<T>; 2]>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        same(inputs, self.axis)
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let y = scan(inputs[0], self.axis, T::ONE, |product, x| product * x);
        let saved = needs.any().then(|| [inputs[0].clone(), y.clone()]);
        (vec![y], saved)
    }

    /// From y_k = y_(k - 1) x_k: with s_k = dy_k + x_(k + 1) s_(k + 1), what reaches y_k from the end,
    /// dx_k = y_(k - 1) s_k. Nothing is divided by, so that zeros are right.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let ([x, y], g) = (saved.expect("saved for the only input"), upstream.only());
        let blocks = Blocks::of(x.shape(), self.axis, 1);
        let (len, inner) = (blocks.len(), blocks.inner);
        sink.accumulate(0, |out, accum| {
            blocks.for_each(
                out,
                inner,
                #[inline(always)]
                |o, out, later| {
                    let [x, y, g] = [&x, &y, &g].map(|t| &t.data()[o * len..][..len]);
                    later.fill(T::ZERO);
                    for k in (0..blocks.run).rev() {
                        let row = k * inner..(k + 1) * inner;
                        let (out, x) = (&mut out[row.clone()], &x[row.clone()]);
                        later.iter_mut().zip(&g[row.clone()]).for_each(|(s, &g)| *s += g);
                        if k == 0 {
                            put(accum, out.iter_mut().zip(later.iter().copied()));
                        } else {
                            let before = &y[row.start - inner..row.start];
                            put(accum, out.iter_mut().zip(before.iter().zip(&*later).map(|(&y, &s)| y * s)));
                        }
                        later.iter_mut().zip(x).for_each(|(s, &x)| *s *= x);
                    }
                },
            );
        });
    }
}

/// Every axis, and one or no element along it.
fn cases<O>(op: fn(usize) -> O) -> Vec<Case<O>> {
    let x = || Input::uniform("x", [2, 3, 4, 5], 0.5, 1.5);
    vec![
        Case::new("first axis", op(0), [x()]),
        Case::new("middle axis", op(1), [x()]),
        Case::new("last axis", op(3), [x()]),
        Case::new("a vector", op(0), [Input::random("x", [7])]),
        Case::new("one element", op(1), [Input::random("x", [3, 1, 2])]),
        Case::new("nothing along the axis", op(0), [Input::random("x", [0, 3])]).flat(),
        Case::new("empty rest", op(0), [Input::random("x", [3, 0])]).flat(),
    ]
}

impl Checked for CumSum {
    fn cases() -> Vec<Case<Self>> {
        cases(|axis| CumSum { axis })
    }
}

impl Checked for CumProd {
    fn cases() -> Vec<Case<Self>> {
        let op = |axis| CumProd { axis };
        // No zero, one in the middle, two; at the ends.
        let rows = [2.0, -1.5, 0.5, 3.0, 0.0, -2.0, 0.0, 1.5, 0.0];
        let mut cases = cases(op);
        cases.extend([
            Case::new("zeros in rows", op(1), [Input::values("x", [3, 3], rows)]),
            Case::new("zeros in columns", op(0), [Input::values("x", [3, 3], rows)]),
            Case::new("a single zero", op(0), [Input::values("x", [1], [0.0])]),
        ]);
        cases
    }
}

impl<T: Float> Var<T> {
    /// The sum of all elements up to each one along an axis; the shape stays.
    ///
    /// # Panics
    /// If there is no such axis.
    #[track_caller]
    pub fn cumsum(&self, axis: usize) -> Self {
        apply1(CumSum { axis }, &[self])
    }

    /// The product of all elements up to each one along an axis; the shape stays.
    ///
    /// # Panics
    /// If there is no such axis.
    #[track_caller]
    pub fn cumprod(&self, axis: usize) -> Self {
        apply1(CumProd { axis }, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    #[test]
    fn they_run_along_their_axis() {
        let x = Var::constant(Tensor::from_vec([2, 3], vec![1.0f32, 2.0, 3.0, 4.0, 5.0, 6.0]));
        assert_eq!(x.cumsum(0).value().data(), [1.0, 2.0, 3.0, 5.0, 7.0, 9.0]);
        assert_eq!(x.cumsum(1).value().data(), [1.0, 3.0, 6.0, 4.0, 9.0, 15.0]);
        assert_eq!(x.cumprod(0).value().data(), [1.0, 2.0, 3.0, 4.0, 10.0, 18.0]);
        assert_eq!(x.cumprod(1).value().data(), [1.0, 2.0, 6.0, 4.0, 20.0, 120.0]);
    }

    #[test]
    fn a_product_with_zeros_has_the_derivatives_that_the_sums_of_products_have() {
        // L = y_0 + .. + y_3, written out: x0 + x0 x1 + x0 x1 x2 + x0 x1 x2 x3.
        for x in [[2.0, 0.0, 3.0, 4.0], [2.0, 0.0, 0.0, 4.0], [0.0, 5.0, 3.0, 0.0]] {
            let [a, b, c, d] = x;
            let exact = [1.0 + b + b * c + b * c * d, a + a * c + a * c * d, a * b + a * b * d, a * b * c];
            let tape = Tape::new();
            let x = tape.leaf(Tensor::from_vec([4], x.to_vec()));
            assert_eq!(x.cumprod(0).sum_all().backward().get(&x).unwrap().data(), exact);
        }
    }

    #[test]
    #[should_panic(expected = "cumprod: no dimension 1 (inputs [[2]])")]
    fn the_axis_must_be_there() {
        Var::<f32>::constant(Tensor::zeros([2])).cumprod(1);
    }
}
