//! Products along dimensions.

use super::axis_loops::Blocks;
use crate::ops::support::axes::dropped;
use crate::ops::support::put::put;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var};

/// The product over a run of dimensions `first..first + count`, which are dropped. Of nothing it is 1.
#[derive(Clone, Copy, Debug)]
pub struct Prod {
    /// The first dimension.
    pub first: usize,
    /// How many dimensions.
    pub count: usize,
}

impl<T: Float> Op<T> for Prod {
    /// The input.
    type Saved = Option<Tensor<T>>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        dropped(&inputs[0], self.first, self.count)
    }

    fn algo(&self, inputs: &[Shape]) -> &'static str {
        Blocks::of(&inputs[0], self.first, self.count).algo()
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let x = inputs[0];
        let blocks = Blocks::of(x.shape(), self.first, self.count);
        let shape = dropped(x.shape(), self.first, self.count).expect("checked by the shape rule")[0];
        let y = blocks.fold(x.data(), &vec![(); blocks.columns()], T::ONE, |y, x, ()| y * x);
        (vec![Tensor::from_buffer(shape, y)], needs.any().then(|| x.clone()))
    }

    /// dx_k = dy (product of those before k) (product of those after k): nothing is divided by, so that zeros are right.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let (x, g) = (saved.expect("saved for the only input"), upstream.only());
        let blocks = Blocks::of(x.shape(), self.first, self.count);
        let (len, inner) = (blocks.len(), blocks.inner);
        sink.accumulate(0, |out, accum| {
            blocks.for_each(
                out,
                len + inner,
                #[inline(always)]
                |o, out, scratch| {
                    let x = &x.data()[o * len..][..len];
                    let (after, before) = scratch.split_at_mut(len);
                    after[len - inner..].fill(T::ONE);
                    for k in (0..blocks.run - 1).rev() {
                        let (this, next) = after[k * inner..].split_at_mut(inner);
                        let terms = next.iter().zip(&x[(k + 1) * inner..]);
                        this.iter_mut().zip(terms).for_each(|(p, (&next, &x))| *p = next * x);
                    }
                    before.copy_from_slice(&g.data()[o * inner..][..inner]);
                    let rows = x.chunks_exact(inner).zip(after.chunks_exact(inner));
                    for (out, (x, after)) in out.chunks_exact_mut(inner).zip(rows) {
                        put(accum, out.iter_mut().zip(before.iter().zip(after).map(|(&b, &a)| b * a)));
                        before.iter_mut().zip(x).for_each(|(b, &x)| *b *= x);
                    }
                },
            );
        });
    }
}

impl Checked for Prod {
    fn cases() -> Vec<Case<Self>> {
        let op = |first, count| Prod { first, count };
        let x = || Input::uniform("x", [2, 3, 4, 5], 0.5, 1.5);
        let rows = |values: [f64; 9]| Input::values("x", [3, 3], values);
        vec![
            Case::new("first dimension", op(0, 1), [x()]),
            Case::new("middle dimension", op(1, 1), [x()]),
            Case::new("last dimension", op(3, 1), [x()]),
            Case::new("height and width", op(1, 2), [x()]),
            Case::new("the last two", op(2, 2), [x()]),
            Case::new("everything", op(0, 3), [Input::uniform("x", [2, 3, 2], -1.5, 1.5)]),
            Case::new("no dimension", op(1, 0), [x()]),
            // A row without a zero, with one and with two; columns with one.
            Case::new("zeros in rows", op(1, 1), [rows([2.0, -1.5, 0.5, 3.0, 0.0, -2.0, 0.0, 1.5, 0.0])]),
            Case::new("zeros in columns", op(0, 1), [rows([2.0, 0.0, 0.0, 3.0, 0.5, -2.0, 1.0, 1.5, 0.0])]),
            Case::new("a single zero", op(0, 1), [Input::values("x", [1], [0.0])]),
            Case::new("one element", op(1, 1), [Input::random("x", [3, 1, 2])]),
            Case::new("of nothing", op(0, 1), [Input::random("x", [0, 3])]).flat(),
            Case::new("empty rest", op(0, 1), [Input::random("x", [3, 0])]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// The product over `count` dimensions from `first` on, which are dropped. Of nothing it is 1.
    ///
    /// # Panics
    /// If there are no such dimensions.
    #[track_caller]
    pub fn prod(&self, first: usize, count: usize) -> Self {
        apply1(Prod { first, count }, &[self])
    }

    /// The product of everything, a scalar.
    pub fn prod_all(&self) -> Self {
        self.prod(0, self.shape().rank())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    #[test]
    fn one_zero_has_the_product_of_the_others_as_derivative_and_two_have_none() {
        for (x, y, dx) in [
            ([2.0, 3.0, 4.0f32], 24.0, [12.0, 8.0, 6.0]),
            ([2.0, 0.0, 4.0], 0.0, [0.0, 8.0, 0.0]),
            ([0.0, 0.0, 4.0], 0.0, [0.0, 0.0, 0.0]),
            ([0.0, 3.0, -0.0], 0.0, [0.0, 0.0, 0.0]),
        ] {
            let tape = Tape::new();
            let x = tape.leaf(Tensor::from_vec([3], x.to_vec()));
            let product = x.prod_all();
            assert_eq!(product.value().item(), y);
            assert_eq!(product.backward().get(&x).unwrap().data(), dx);
        }
    }

    #[test]
    fn the_product_of_nothing_is_1() {
        let y = Var::constant(Tensor::<f64>::zeros([2, 0, 3])).prod(1, 1);
        assert_eq!((y.dims(), y.value().data()), (&[2, 3][..], &[1.0; 6][..]));
    }

    #[test]
    #[should_panic(expected = "prod: no dimensions 1..3 (inputs [[2, 3]])")]
    fn the_dimensions_must_be_there() {
        Var::<f32>::constant(Tensor::zeros([2, 3])).prod(1, 2);
    }
}
