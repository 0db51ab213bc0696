//! Euclidean lengths, and vectors brought to length 1.

use super::axis_loops::Blocks;
use crate::ops::support::axes::dropped;
use crate::ops::support::put::put;
use crate::ops::support::sums::sum_of_pairs;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::pool::Buffer;
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var};

/// The Euclidean norm sqrt(sum x^2) over a run of dimensions `first..first + count`, which are dropped.
///
/// Squares are taken of x over the largest |x|: the squares of tiny numbers do not vanish, and those of huge ones do not
/// overflow. The gradient at the zero vector, where there is no derivative, is 0. An infinite element makes the norm
/// infinite, and its own gradient NaN; finite ones have gradient 0 under an infinite norm.
#[derive(Clone, Copy, Debug)]
pub struct Norm {
    /// The first dimension.
    pub first: usize,
    /// How many dimensions.
    pub count: usize,
}

/// The norm of every column of `x`, less the column's number (a mean, or 0).
pub(in crate::ops) fn lengths<T: Float>(x: &[T], blocks: Blocks, less: &[T]) -> Buffer<T> {
    let mut scale = blocks.fold(x, less, T::ZERO, |m, x, less| m.max((x - less).abs()));
    // Zeros stay zeros and an infinity an infinity over 1; over themselves they would be NaN.
    scale.iter_mut().for_each(|s| *s = if *s == T::ZERO || *s == T::INFINITY { T::ONE } else { *s });
    let columns: Vec<[T; 2]> = less.iter().zip(scale.iter()).map(|(&less, &s)| [less, s]).collect();
    let mut lengths = blocks.sum(x, &columns, |x, [less, s]| {
        let x = (x - less) / s;
        x * x
    });
    lengths.iter_mut().zip(scale.iter()).for_each(|(y, &s)| *y = s * y.sqrt());
    lengths
}

impl<T: Float> Op<T> for Norm {
    /// The input and the result.
    type Saved = Option<[Tensor<T>; 2]>;

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
        let y = Tensor::from_buffer(shape, lengths(x.data(), blocks, &Buffer::filled(blocks.columns(), T::ZERO)));
        let saved = needs.any().then(|| [x.clone(), y.clone()]);
        (vec![y], saved)
    }

    /// dx = dy x / y; 0 where y is.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let ([x, y], g) = (saved.expect("saved for the only input"), upstream.only());
        let blocks = Blocks::of(x.shape(), self.first, self.count);
        let columns: Vec<[T; 2]> = g.data().iter().zip(y.data()).map(|(&g, &y)| [g, y]).collect();
        sink.accumulate(0, |out, accum| {
            blocks.map(out, accum, x.data(), &columns, |x, [g, y]| if y == T::ZERO { T::ZERO } else { x / y * g });
        });
    }
}

impl Checked for Norm {
    fn cases() -> Vec<Case<Self>> {
        let op = |first, count| Norm { first, count };
        let x = || Input::random("x", [2, 3, 4, 5]);
        vec![
            Case::new("first dimension", op(0, 1), [Input::away("x", [2, 3, 2], -1.0, 1.0, &[0.0])]),
            Case::new("middle dimension", op(1, 1), [x()]),
            Case::new("last dimension", op(3, 1), [x()]),
            Case::new("height and width", op(1, 2), [x()]),
            Case::new("everything", op(0, 4), [x()]),
            Case::new("one element: its absolute value", op(1, 1), [Input::away("x", [3, 1], -1.0, 1.0, &[0.0])]),
            Case::new("the zero vector", op(1, 1), [Input::values("x", [3, 2], [0.0, 0.0, 3.0, -4.0, 1.0, 0.0])])
                .kinks(2)
                .promises(0, [0.0, 0.0, 0.6, -0.8, 1.0, 0.0]),
            Case::new("a zero column", op(0, 1), [Input::values("x", [2, 2], [0.0, 3.0, -0.0, 4.0])])
                .kinks(2)
                .promises(0, [0.0, 0.6, 0.0, 0.8]),
            Case::new("of nothing", op(0, 1), [Input::random("x", [0, 3])]).flat(),
            Case::new("empty rest", op(0, 1), [Input::random("x", [3, 0])]).flat(),
        ]
    }
}

/// `y = x / max(|x|, eps)` with the Euclidean norm of each row of x [.., C] (which takes no square that vanishes or
/// overflows). A row shorter than eps, or just as long, is divided by the constant eps, and so is its gradient.
/// Under an infinite norm finite elements become 0, and infinite ones NaN.
#[derive(Clone, Copy, Debug)]
pub struct L2Normalize {
    /// The least divisor.
    pub eps: f64,
}

impl L2Normalize {
    /// The rows of a shape, as blocks of one column.
    fn rows(shape: &Shape) -> Blocks {
        Blocks { outer: shape.rows(), run: shape.last(), inner: 1 }
    }

    /// What a row of a length is divided by, and whether that is its length.
    fn divisor<T: Float>(&self, length: T) -> (T, bool) {
        let eps = T::of(self.eps);
        if length <= eps { (eps, false) } else { (length, true) }
    }
}

impl<T: Float> Op<T> for L2Normalize {
    /// The result, and the norm of each row.
    type Saved = Option<(Tensor<T>, Buffer<T>)>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        if T::of(self.eps) <= T::ZERO || self.eps.is_nan() {
            return Err(ShapeError::new(format!("eps has to be above 0, and is {}", self.eps)));
        }
        if inputs[0].rank() == 0 {
            return Err(ShapeError::new("a scalar has no last axis"));
        }
        Ok(vec![inputs[0]])
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let x = inputs[0];
        let blocks = Self::rows(x.shape());
        let lengths = lengths(x.data(), blocks, &Buffer::filled(blocks.columns(), T::ZERO));
        let divisors: Vec<T> = lengths.iter().map(|&length| self.divisor(length).0).collect();
        let y = Tensor::build(*x.shape(), |out| {
            blocks.map(out, Accum::Replace, x.data(), &divisors, |x, d| x / d);
        });
        let saved = needs.any().then(|| (y.clone(), lengths));
        (vec![y], saved)
    }

    /// With d = |x|: dx = (dy - y (y . dy)) / d, the part of dy across the row. With d = eps: dx = dy / d.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let ((y, lengths), g) = (saved.expect("saved for the only input"), upstream.only());
        let blocks = Self::rows(y.shape());
        sink.accumulate(0, |out, accum| {
            blocks.for_each(
                out,
                0,
                #[inline(always)]
                |o, out, _| {
                    let [y, g] = [&y, &g].map(|t| &t.data()[o * blocks.run..][..blocks.run]);
                    let (d, free) = self.divisor(lengths[o]);
                    let along = if free { sum_of_pairs(y, g, |y, g| y * g) } else { T::ZERO };
                    put(accum, out.iter_mut().zip(y.iter().zip(g).map(|(&y, &g)| (g - y * along) / d)));
                },
            );
        });
    }
}

impl Checked for L2Normalize {
    fn cases() -> Vec<Case<Self>> {
        let op = |eps| L2Normalize { eps };
        let x = |shape: &[usize]| Input::random("x", shape);
        // Longer than 5, shorter, and just as long.
        let mixed = [6.0, -8.0, 0.3, 0.4, 3.0, 4.0];
        vec![
            Case::new("channels", op(1e-6), [x(&[2, 3, 2, 5])]),
            Case::new("a vector", op(1e-6), [x(&[7])]),
            Case::new("longer than the lanes of a sum", op(1e-6), [x(&[2, 37])]),
            Case::new("shorter than eps", op(8.0), [x(&[3, 4])]),
            Case::new("some shorter than eps", op(5.0), [Input::values("x", [2, 2], &mixed[..4])]),
            Case::new("just as long as eps", op(5.0), [Input::values("x", [3, 2], mixed)])
                .kinks(2)
                .promises(0, [0.112, 0.084, 0.2, 0.2, 0.2, 0.2]),
            Case::new("the zero vector", op(0.5), [Input::values("x", [2, 2], [0.0, 0.0, 3.0, -4.0])]),
            Case::new("one channel: its sign", op(1e-6), [Input::values("x", [2, 1], [2.0, -0.5])]).flat(),
            Case::new("no channels", op(1e-6), [x(&[3, 0])]).flat(),
            Case::new("no rows", op(1e-6), [x(&[0, 3])]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// The Euclidean norm over `count` dimensions from `first` on, which are dropped. The gradient at the zero vector is
    /// 0.
    ///
    /// # Panics
    /// If there are no such dimensions.
    #[track_caller]
    pub fn norm(&self, first: usize, count: usize) -> Self {
        apply1(Norm { first, count }, &[self])
    }

    /// x / max(|x|, eps), with the Euclidean norm of each row (the last axis) of x [.., C]; the shape stays.
    ///
    /// # Panics
    /// If `eps` is not above 0 (in f32: 1e-50 is not), or x is a scalar.
    #[track_caller]
    pub fn l2_normalize(&self, eps: f64) -> Self {
        apply1(L2Normalize { eps }, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    fn norm_and_gradient<T: Float>(x: [T; 2]) -> (T, Vec<T>) {
        let tape = Tape::new();
        let x = tape.leaf(Tensor::from_vec([2], x.to_vec()));
        let y = x.norm(0, 1);
        let value = y.value().item();
        (value, y.backward().get(&x).unwrap().data().to_vec())
    }

    #[test]
    fn tiny_and_huge_vectors_have_a_norm_and_a_direction() {
        for scale in [1e-200, 1.0, 1e200] {
            let (y, dx) = norm_and_gradient([3.0 * scale, -4.0 * scale]);
            assert!((y / scale - 5.0).abs() < 1e-14 && (dx[0] - 0.6).abs() < 1e-15 && (dx[1] + 0.8).abs() < 1e-15);
        }
        for scale in [1e-40f32, 1e-19, 1e19, 1e37] {
            let (y, dx) = norm_and_gradient([3.0 * scale, -4.0 * scale]);
            let close = |a: f32, b: f32| (a - b).abs() < 1e-4;
            assert!(close(y / scale, 5.0) && close(dx[0], 0.6) && close(dx[1], -0.8), "{scale:e}: {y:e} {dx:?}");
        }
    }

    #[test]
    fn the_zero_vector_has_gradient_0() {
        assert_eq!(norm_and_gradient([0.0, -0.0f64]), (0.0, vec![0.0, 0.0]));
        // The angle of a pose that does not turn: next to something else, 0 comes through.
        let tape = Tape::new();
        let x = tape.leaf(Tensor::<f32>::zeros([3]));
        let y = &x.norm(0, 1) + &x.sum_all();
        assert_eq!(y.backward().get(&x).unwrap().data(), [1.0; 3]);
    }

    #[test]
    fn infinity_and_nan_show() {
        let inf = f64::INFINITY;
        let (y, dx) = norm_and_gradient([inf, 1.0]);
        assert!(y == inf && dx[0].is_nan() && dx[1] == 0.0);
        assert!(norm_and_gradient([f64::NAN, 1.0]).0.is_nan() && norm_and_gradient([1.0, f64::NAN]).0.is_nan());
        assert!(norm_and_gradient([f64::NAN, inf]).0.is_nan());
    }

    #[test]
    fn rows_get_length_one_unless_they_are_shorter_than_eps() {
        let x = Tensor::from_vec([4, 2], vec![3.0f32, 4.0, 0.0, 0.0, 3e-20, 4e-20, 1e-13, 0.0]);
        let y = Var::constant(x).l2_normalize(1e-12);
        let exact = [0.6, 0.8, 0.0, 0.0, 3e-8, 4e-8, 0.1, 0.0];
        assert!(y.value().data().iter().zip(exact).all(|(y, e)| (y - e).abs() <= 1e-6 * e), "{y:?}", y = y.value());
        let nan = Var::constant(Tensor::from_vec([2], vec![f32::NAN, 1.0])).l2_normalize(1e-12);
        assert!(nan.value().data().iter().all(|x| x.is_nan()));
    }

    #[test]
    #[should_panic(expected = "l2_normalize: eps has to be above 0, and is 0")]
    fn eps_must_be_positive() {
        Var::<f32>::constant(Tensor::zeros([2])).l2_normalize(0.0);
    }
}
