//! Variances and standard deviations along dimensions.

use super::axis_loops::Blocks;
use super::norm::lengths;
use crate::ops::support::axes::dropped;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::pool::Buffer;
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var};

/// `sum (x - mean)^2 / (n - correction)` over a run of dimensions `first..first + count` of n elements, which are
/// dropped; or its square root, the standard deviation. Two passes: the mean first.
///
/// The gradient of the standard deviation of equal elements, where there is no derivative, is 0.
#[derive(Clone, Copy, Debug)]
pub struct Variance {
    /// The first dimension.
    pub first: usize,
    /// How many dimensions.
    pub count: usize,
    /// 0 for the mean of the squares, 1 for the estimate without bias from a sample (Bessel).
    pub correction: usize,
    /// Whether the square root is taken.
    pub root: bool,
}

/// What the backward pass needs.
pub struct Saved<T: Float> {
    x: Tensor<T>,
    mean: Buffer<T>,
    y: Tensor<T>,
}

impl Variance {
    fn blocks(&self, shape: &Shape) -> Blocks {
        Blocks::of(shape, self.first, self.count)
    }
}

/// The mean of every column: its first element and the mean of what the others are more. Of equal elements it is exact.
fn means<T: Float>(x: &[T], blocks: Blocks) -> Buffer<T> {
    let first: Vec<T> = x.chunks(blocks.len().max(1)).flat_map(|block| &block[..blocks.inner]).copied().collect();
    let mut mean = blocks.sum(x, &first, |x, first| x - first);
    let n = T::of(blocks.run as f64);
    mean.iter_mut().zip(first).for_each(|(m, first)| *m = first + *m / n);
    mean
}

impl<T: Float> Op<T> for Variance {
    type Saved = Option<Saved<T>>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let shapes = dropped(&inputs[0], self.first, self.count)?;
        let n = self.blocks(&inputs[0]).run;
        if n <= self.correction {
            return Err(ShapeError::new(format!("{n} elements have no variance with correction {}", self.correction)));
        }
        Ok(shapes)
    }

    fn algo(&self, inputs: &[Shape]) -> &'static str {
        match (self.root, self.blocks(&inputs[0]).inner) {
            (false, 1) => "last_axis",
            (false, _) => "inner_axis",
            (true, 1) => "std_last_axis",
            (true, _) => "std_inner_axis",
        }
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let x = inputs[0];
        let blocks = self.blocks(x.shape());
        let shape = dropped(x.shape(), self.first, self.count).expect("checked by the shape rule")[0];
        let mean = means(x.data(), blocks);
        let n = T::of((blocks.run - self.correction) as f64);
        let mut y = match self.root {
            false => blocks.sum(x.data(), &mean, |x, mean| (x - mean) * (x - mean)),
            true => lengths(x.data(), blocks, &mean),
        };
        let divisor = if self.root { n.sqrt() } else { n };
        y.iter_mut().for_each(|y| *y /= divisor);
        let y = Tensor::from_buffer(shape, y);
        let saved = needs.any().then(|| Saved { x: x.clone(), mean, y: y.clone() });
        (vec![y], saved)
    }

    /// The variance: dx = dy 2 (x - mean) / (n - correction); what x does through the mean cancels, since the deviations
    /// sum to 0. Its root: dx = dy (x - mean) / y / (n - correction), 0 where y is.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let (Saved { x, mean, y }, g) = (saved.expect("saved for the only input"), upstream.only());
        let blocks = self.blocks(x.shape());
        let n = T::of((blocks.run - self.correction) as f64);
        let columns = mean.iter().zip(g.data().iter().zip(y.data()));
        let columns: Vec<[T; 3]> = match self.root {
            false => columns.map(|(&mean, (&g, _))| [mean, T::ONE, (g + g) / n]).collect(),
            true => columns
                .map(|(&mean, (&g, &y))| if y == T::ZERO { [mean, T::ONE, T::ZERO] } else { [mean, y, g / n] })
                .collect(),
        };
        sink.accumulate(0, |out, accum| {
            blocks.map(out, accum, x.data(), &columns, |x, [mean, unit, factor]| (x - mean) / unit * factor);
        });
    }
}

impl Checked for Variance {
    fn cases() -> Vec<Case<Self>> {
        let x = || Input::random("x", [2, 3, 4, 5]);
        let mut cases = Vec::new();
        for root in [false, true] {
            let op = |first, count, correction| Variance { first, count, correction, root };
            cases.extend([
                Case::new("first dimension", op(0, 1, 0), [Input::random("x", [4, 3, 2])]),
                Case::new("middle dimension", op(2, 1, 1), [x()]),
                Case::new("last dimension", op(3, 1, 0), [x()]),
                Case::new("last dimension, corrected", op(3, 1, 1), [x()]),
                Case::new("height and width", op(1, 2, 1), [x()]),
                Case::new("everything", op(0, 4, 1), [x()]),
                Case::new("empty rest", op(0, 1, 1), [Input::random("x", [3, 0])]).flat(),
                Case::new("far from zero", op(0, 1, 0), [Input::uniform("x", [6], 9.0, 11.0)]),
            ]);
        }
        let std = |first, count, correction| Variance { first, count, correction, root: true };
        let variance = Variance { root: false, ..std(1, 1, 0) };
        let values = [0.1, 0.1, 0.1, 1.0, -2.0, 0.5];
        // (x - mean) / 2 std, of deviations 7, -11 and 4 sixths.
        let slope = 0.5 / 93f64.sqrt();
        let slopes = [0.0, 0.0, 0.0, 7.0 * slope, -11.0 * slope, 4.0 * slope];
        cases.extend([
            Case::new("equal elements", variance, [Input::values("x", [2, 3], values)]),
            Case::new("one element", variance, [Input::random("x", [3, 1])]).flat(),
            Case::new("std of equal elements", std(1, 1, 1), [Input::values("x", [2, 3], values)])
                .kinks(3)
                .promises(0, slopes),
            Case::new("std of one element", std(1, 1, 0), [Input::random("x", [3, 1])]).flat(),
        ]);
        cases
    }
}

impl<T: Float> Var<T> {
    /// The variance over `count` dimensions from `first` on, which are dropped: sum (x - mean)^2 / (n - correction).
    ///
    /// # Panics
    /// If there are no such dimensions, or no more than `correction` elements in them.
    #[track_caller]
    pub fn variance(&self, first: usize, count: usize, correction: usize) -> Self {
        apply1(Variance { first, count, correction, root: false }, &[self])
    }

    /// The standard deviation, the square root of the [`variance`](Var::variance). Its gradient is 0 where all elements
    /// are equal.
    ///
    /// # Panics
    /// If there are no such dimensions, or no more than `correction` elements in them.
    #[track_caller]
    pub fn std(&self, first: usize, count: usize, correction: usize) -> Self {
        apply1(Variance { first, count, correction, root: true }, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    #[test]
    fn values_with_and_without_correction() {
        let x = Var::constant(Tensor::from_vec([2, 4], vec![1.0f64, 2.0, 3.0, 4.0, 1e9 + 1.0, 1e9 + 2.0, 1e9, 1e9]));
        assert_eq!(x.variance(1, 1, 0).value().data(), [1.25, 0.6875]);
        assert_eq!(x.variance(1, 1, 1).value().data()[0], 5.0 / 3.0);
        assert!((x.std(1, 1, 0).value().data()[0] - 1.25f64.sqrt()).abs() < 1e-15);
    }

    /// A third of 0.1 three times is not 0.1: a mean taken that way would leave a deviation, and a direction to it.
    #[test]
    fn the_std_of_equal_elements_is_0_and_so_is_its_gradient() {
        for value in [0.1f32, 1e-30, 3e30, 0.0] {
            let tape = Tape::new();
            let x = tape.leaf(Tensor::full([3, 7], value));
            for y in [x.std(1, 1, 1), x.std(0, 1, 0)] {
                assert!(y.value().data().iter().all(|&y| y == 0.0));
            }
            let y = x.std(0, 2, 1);
            assert_eq!(y.backward().get(&x).unwrap().data(), [0.0; 21]);
        }
        let tape = Tape::new();
        let x = tape.leaf(Tensor::full([3], 0.1f64));
        assert_eq!(x.std(0, 1, 0).backward().get(&x).unwrap().data(), [0.0; 3]);
    }

    #[test]
    fn the_std_of_tiny_deviations_does_not_vanish() {
        let tape = Tape::new();
        let x = tape.leaf(Tensor::from_vec([2], vec![1e-30f32, -1e-30]));
        let y = x.std(0, 1, 0);
        assert!((y.value().item() / 1e-30 - 1.0).abs() < 1e-6);
        assert_eq!(y.backward().get(&x).unwrap().data(), [0.5, -0.5]);
    }

    #[test]
    fn nan_and_infinity_make_nan() {
        for bad in [f32::NAN, f32::INFINITY] {
            for x in [[bad, 1.0], [1.0, bad]] {
                let x = Var::constant(Tensor::from_vec([2], x.to_vec()));
                assert!(x.variance(0, 1, 0).value().item().is_nan() && x.std(0, 1, 0).value().item().is_nan());
            }
        }
    }

    #[test]
    #[should_panic(expected = "variance: 1 elements have no variance with correction 1 (inputs [[3, 1]])")]
    fn one_element_has_no_corrected_variance() {
        Var::<f32>::constant(Tensor::zeros([3, 1])).std(1, 1, 1);
    }
}
