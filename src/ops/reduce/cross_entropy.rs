//! Cross-entropy between logits and class numbers.

use super::axis_loops::Blocks;
use super::log_sum_exp::{log_sums, maxima};
use crate::ops::support::put::put;
use crate::ops::support::sums::pairwise_sum;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::pool::Buffer;
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var};

/// `-ln softmax(x)[target]` of each row of the logits x [.., C] with target [..], the number of a class: the mean over
/// rows, or the sum; a scalar. The softmax is not formed: a row's loss is `max - x[target] + ln sum e^(x - max)`.
///
/// A row with a negative target is ignored, whatever it holds: it adds nothing, does not count in the mean, and gets a
/// gradient of exactly 0. Where all rows are ignored (or there is none) the loss is 0, the mean too. A row of minus
/// infinities, or one with a NaN or a plus infinity, makes the loss NaN.
///
/// Targets are numbers of the element type: f32 names the classes up to 2^24.
#[derive(Clone, Copy, Debug)]
pub struct CrossEntropy {
    /// Whether the mean over the rows that count is taken, and not the sum.
    pub mean: bool,
}

/// What the backward pass needs: the logits, maximum and logarithm of the sum of each row, and the targets.
pub struct Saved<T: Float> {
    x: Tensor<T>,
    max: Buffer<T>,
    log_sum: Buffer<T>,
    targets: Vec<Option<usize>>,
}

/// The rows of the logits, as blocks of one column.
fn rows(shape: &Shape) -> Blocks {
    Blocks { outer: shape.rows(), run: shape.last(), inner: 1 }
}

/// The class of each row; `None` where it is ignored.
///
/// # Panics
/// If a number is not negative and not a class.
fn classes<T: Float>(targets: &Tensor<T>, classes: usize) -> Vec<Option<usize>> {
    let class = |(row, t): (usize, &T)| {
        if *t < T::ZERO {
            return None;
        }
        let class = t.f64() as usize;
        // NaN becomes 0 as a whole number, and 1.5 becomes 1.
        let whole = class < classes && class as f64 == t.f64();
        assert!(whole, "cross_entropy: target {t} of row {row} is not one of the {classes} classes from 0 on");
        Some(class)
    };
    targets.data().iter().enumerate().map(class).collect()
}

impl CrossEntropy {
    /// What a row's loss counts in the result.
    fn share<T: Float>(&self, targets: &[Option<usize>]) -> T {
        let counted = targets.iter().flatten().count();
        if self.mean && counted > 0 { T::ONE / T::of(counted as f64) } else { T::ONE }
    }
}

impl<T: Float> Op<T> for CrossEntropy {
    type Saved = Option<Saved<T>>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        match inputs[0].dims().split_last() {
            Some((&c, rows)) if c > 0 && inputs[1].dims() == rows => Ok(vec![Shape::new(&[])]),
            _ => Err(ShapeError::new("expected logits [.., C] with C > 0 and targets [..]")),
        }
    }

    fn algo(&self, _: &[Shape]) -> &'static str {
        if self.mean { "mean" } else { "sum" }
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let (x, blocks) = (inputs[0], rows(inputs[0].shape()));
        let targets = classes(inputs[1], blocks.run);
        let max = maxima(x.data(), blocks);
        let log_sum = log_sums(x.data(), blocks, &max);
        let loss = |(row, target): (usize, &Option<usize>)| {
            target.map_or(T::ZERO, |t| (max[row] - x.data()[row * blocks.run + t]) + log_sum[row])
        };
        let losses: Vec<T> = targets.iter().enumerate().map(loss).collect();
        let y = Tensor::scalar(pairwise_sum(&losses) * self.share(&targets));
        (vec![y], needs.any().then(|| Saved { x: x.clone(), max, log_sum, targets }))
    }

    /// dx = dy (softmax(x) - 1 at the target), over the number of rows that count for the mean; 0 in rows that do not.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let Saved { x, max, log_sum, targets } = saved.expect("saved for a wanted gradient");
        let blocks = rows(x.shape());
        let share = upstream.only().item() * self.share(&targets);
        sink.accumulate(0, |out, accum| {
            blocks.for_each(
                out,
                0,
                #[inline(always)]
                |row, out, _| {
                    let x = &x.data()[row * blocks.run..][..blocks.run];
                    let (max, log) = (max[row], log_sum[row]);
                    match targets[row] {
                        Some(target) => {
                            put(accum, out.iter_mut().zip(x.iter().map(|&x| ((x - max) - log).exp() * share)));
                            out[target] -= share;
                        }
                        None => put(accum, out.iter_mut().zip(x.iter().map(|_| T::ZERO))),
                    }
                },
            );
        });
    }
}

impl Checked for CrossEntropy {
    fn cases() -> Vec<Case<Self>> {
        let x = |shape: &[usize]| Input::uniform("logits", shape, -3.0, 3.0);
        let targets = |shape: &[usize], values: &[f64]| {
            Input::values("targets", shape, values).constant("the numbers of classes")
        };
        let mut cases = Vec::new();
        for mean in [false, true] {
            let op = CrossEntropy { mean };
            cases.extend([
                Case::new("tokens", op, [x(&[2, 3, 5]), targets(&[2, 3], &[0.0, 4.0, 2.0, 2.0, 1.0, 3.0])]),
                Case::new("an image", op, [x(&[1, 2, 2, 3]), targets(&[1, 2, 2], &[0.0, 2.0, 1.0, 1.0])]),
                Case::new("one row", op, [x(&[7]), targets(&[], &[6.0])]),
                Case::new("some rows ignored", op, [x(&[4, 3]), targets(&[4], &[-1.0, 2.0, -100.0, 0.0])]),
                Case::new("all rows ignored", op, [x(&[2, 3]), targets(&[2], &[-1.0, -1.0])]).flat(),
                Case::new(
                    "two classes, one far above",
                    op,
                    [
                        Input::values("logits", [3, 2], [0.0, 50.0, 50.0, 0.0, 0.0, 0.0]),
                        targets(&[3], &[0.0, 0.0, 1.0]),
                    ],
                ),
                Case::new("one class", op, [x(&[3, 1]), targets(&[3], &[0.0; 3])]).flat(),
                Case::new("no rows", op, [x(&[0, 3]), targets(&[0], &[])]).flat(),
            ]);
        }
        cases
    }
}

impl<T: Float> Var<T> {
    /// The mean cross-entropy of logits [.., C] (these) and targets [..], the numbers of classes; a scalar. Rows with a
    /// negative target are ignored; if all are, the loss is 0.
    ///
    /// # Panics
    /// If the shapes do not fit, or a target is neither negative nor a class.
    #[track_caller]
    pub fn cross_entropy(&self, targets: &Tensor<T>) -> Self {
        apply1(CrossEntropy { mean: true }, &[self, &Var::constant(targets.clone())])
    }

    /// The same, summed over the rows.
    ///
    /// # Panics
    /// If the shapes do not fit, or a target is neither negative nor a class.
    #[track_caller]
    pub fn cross_entropy_sum(&self, targets: &Tensor<T>) -> Self {
        apply1(CrossEntropy { mean: false }, &[self, &Var::constant(targets.clone())])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    fn tensor(shape: &[usize], values: &[f64]) -> Tensor<f64> {
        Tensor::from_vec(shape, values.to_vec())
    }

    #[test]
    fn it_is_the_log_softmax_at_the_target() {
        let x = Var::constant(tensor(&[2, 3], &[1.0, 2.0, 0.5, -1.0, 4.0, 3.0]));
        let log = x.log_softmax(1);
        let exact = -(log.value().at(&[0, 2]) + log.value().at(&[1, 1]));
        let targets = tensor(&[2], &[2.0, 1.0]);
        assert!((x.cross_entropy_sum(&targets).value().item() - exact).abs() < 1e-14);
        assert!((x.cross_entropy(&targets).value().item() - exact / 2.0).abs() < 1e-14);
    }

    #[test]
    fn ignored_rows_add_nothing_whatever_they_hold() {
        let tape = Tape::new();
        let bad = [f64::NAN, f64::INFINITY];
        let x = tape.leaf(tensor(&[3, 2], &[bad[0], bad[1], 0.0, 0.0, bad[1], bad[0]]));
        let loss = x.cross_entropy(&tensor(&[3], &[-1.0, 0.0, -100.0]));
        assert!((loss.value().item() - std::f64::consts::LN_2).abs() < 1e-15);
        assert_eq!(loss.backward().get(&x).unwrap().data(), [0.0, 0.0, -0.5, 0.5, 0.0, 0.0]);
    }

    #[test]
    fn where_all_rows_are_ignored_the_loss_is_0_and_so_is_the_gradient() {
        for sum in [false, true] {
            let tape = Tape::new();
            let x = tape.leaf(tensor(&[2, 2], &[1.0, 2.0, f64::NAN, 4.0]));
            let targets = tensor(&[2], &[-1.0, -1.0]);
            let loss = if sum { x.cross_entropy_sum(&targets) } else { x.cross_entropy(&targets) };
            assert_eq!(loss.value().item(), 0.0);
            assert_eq!(loss.backward().get(&x).unwrap().data(), [0.0; 4]);
        }
        let nothing = Var::constant(tensor(&[0, 2], &[])).cross_entropy(&tensor(&[0], &[]));
        assert_eq!(nothing.value().item(), 0.0);
    }

    #[test]
    fn a_class_of_probability_0_costs_infinity_and_a_row_of_them_is_nan() {
        let low = f64::NEG_INFINITY;
        let at = |x: [f64; 2], target: f64| {
            let tape = Tape::new();
            let x = tape.leaf(tensor(&[2], &x));
            let loss = x.cross_entropy(&Tensor::scalar(target));
            let value = loss.value().item();
            (value, loss.backward().get(&x).unwrap().data().to_vec())
        };
        assert_eq!(at([0.0, low], 0.0), (0.0, vec![0.0, 0.0]));
        assert_eq!(at([0.0, low], 1.0), (f64::INFINITY, vec![1.0, -1.0]));
        assert_eq!(at([1e300, -1e300], 0.0), (0.0, vec![0.0, 0.0]));
        for x in [[low, low], [f64::NAN, 0.0], [0.0, f64::NAN], [f64::INFINITY, 0.0]] {
            assert!(at(x, 0.0).0.is_nan() && at(x, 1.0).0.is_nan());
        }
    }

    fn with_target(target: f32) {
        Var::<f32>::constant(Tensor::zeros([1, 3])).cross_entropy(&Tensor::from_vec([1], vec![target]));
    }

    #[test]
    #[should_panic(expected = "cross_entropy: target 3 of row 0 is not one of the 3 classes from 0 on")]
    fn a_target_must_be_a_class() {
        with_target(3.0);
    }

    #[test]
    #[should_panic(expected = "cross_entropy: target 0.5 of row 0 is not one of the 3 classes")]
    fn a_target_must_be_whole() {
        with_target(0.5);
    }

    #[test]
    #[should_panic(expected = "cross_entropy: target NaN of row 0 is not one of the 3 classes")]
    fn a_target_must_be_a_number() {
        with_target(f32::NAN);
    }

    #[test]
    #[should_panic(expected = "expected logits [.., C] with C > 0 and targets [..] (inputs [[2, 3], [3]])")]
    fn a_row_has_one_target() {
        Var::<f32>::constant(Tensor::zeros([2, 3])).cross_entropy(&Tensor::zeros([3]));
    }
}
