//! One of two values, element by element, as a condition says ("where").

use crate::ops::support::put::put;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel, regime};

/// `yes` where the condition is not 0 (NaN is not), else `no`; all three of one shape. The condition is not
/// differentiated.
///
/// The side that is not taken gets a gradient of exactly 0, whatever it holds. That 0 still meets the derivative of what
/// *made* the side: `log(0)` in a dead branch has 0 times infinity, which is NaN. There the argument has to be made safe
/// first, by a `select` of its own.
#[derive(Clone, Copy, Debug)]
pub struct Select;

/// Elements handed to a thread at a time.
const CHUNK: usize = 1 << 14;

impl<T: Float> Op<T> for Select {
    /// The condition.
    type Saved = Option<Tensor<T>>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        if inputs.iter().any(|s| *s != inputs[0]) {
            return Err(ShapeError::new("expected a condition and two values, all of one shape"));
        }
        Ok(vec![inputs[0]])
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let [condition, yes, no] = [inputs[0], inputs[1], inputs[2]];
        let y = Tensor::build(*condition.shape(), |out| {
            let (chunk, work) = (regime::size(CHUNK), out.len());
            parallel::for_each_chunk(out, chunk, work, |i, out| {
                let part = |x: &'_ Tensor<T>| i * chunk..(i * chunk + chunk).min(x.len());
                let (c, a, b) = (&condition.data()[part(condition)], &yes.data()[part(yes)], &no.data()[part(no)]);
                T::dispatch(
                    #[inline(always)]
                    || {
                        let values = c.iter().zip(a.iter().zip(b));
                        out.iter_mut()
                            .zip(values)
                            .for_each(|(y, (&c, (&a, &b)))| *y = if c != T::ZERO { a } else { b });
                    },
                );
            });
        });
        (vec![y], needs.any().then(|| condition.clone()))
    }

    /// The side that was taken gets the gradient, the other 0: chosen, not multiplied by 0.
    fn backward(&self, saved: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let (condition, g) = (saved.expect("saved for a wanted gradient"), upstream.only());
        for (side, taken) in [(1, true), (2, false)] {
            sink.accumulate(side, |out, accum| {
                let (chunk, work) = (regime::size(CHUNK), out.len());
                parallel::for_each_chunk(out, chunk, work, |i, out| {
                    let c = &condition.data()[i * chunk..][..out.len()];
                    let g = &g.data()[i * chunk..][..out.len()];
                    let terms = out.iter_mut().zip(c.iter().zip(g));
                    let share = |c: T, g: T| if (c != T::ZERO) == taken { g } else { T::ZERO };
                    T::dispatch(
                        #[inline(always)]
                        || put(accum, terms.map(|(d, (&c, &g))| (d, share(c, g)))),
                    );
                });
            });
        }
    }
}

impl Checked for Select {
    fn cases() -> Vec<Case<Self>> {
        let condition = |shape: &[usize], values: &[f64]| {
            Input::values("condition", shape, values).constant("a choice, not a quantity")
        };
        let sides = |shape: &[usize]| [Input::random("yes", shape), Input::random("no", shape)];
        let case = |name, shape: &[usize], values: &[f64]| {
            let [yes, no] = sides(shape);
            Case::new(name, Select, [condition(shape, values), yes, no])
        };
        let mixed: Vec<f64> = (0..2 * 3 * 2 * 2).map(|i| [0.0, 1.0, -2.5, 0.0, 1e-30][i % 5]).collect();
        let (nan, inf) = (f64::NAN, f64::INFINITY);
        let dead = [
            condition(&[4], &[1.0, 0.0, 1.0, 0.0]),
            Input::values("yes", [4], [0.5, nan, -2.0, -inf]),
            Input::values("no", [4], [inf, -1.0, nan, 3.0]),
        ];
        vec![
            case("mixed", &[2, 3, 2, 2], &mixed),
            case("both zeros", &[4], &[0.0, -0.0, 1.0, f64::NAN]),
            Case::new("infinite or NaN where not chosen", Select, dead),
            case("all yes", &[2, 2], &[1.0; 4]).ignores(2),
            case("all no", &[2, 2], &[0.0; 4]).ignores(1),
            case("a scalar", &[], &[1.0]).ignores(2),
            case("empty", &[3, 0], &[]).flat(),
        ]
    }
}

impl<T: Float> Var<T> {
    /// `yes` where `condition` is not 0, else `no`, element by element; all of one shape. The side that is not taken
    /// gets a gradient of exactly 0.
    ///
    /// # Panics
    /// If the shapes differ.
    #[track_caller]
    pub fn select(condition: &Tensor<T>, yes: &Self, no: &Self) -> Self {
        apply1(Select, &[&Var::constant(condition.clone()), yes, no])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    #[test]
    fn what_is_not_taken_changes_nothing_even_if_it_is_not_finite() {
        let tape = Tape::new();
        let condition = Tensor::from_vec([4], vec![1.0, 0.0, 1.0, 0.0f64]);
        let yes = tape.leaf(Tensor::from_vec([4], vec![1.0, f64::NAN, 2.0, f64::INFINITY]));
        let no = tape.leaf(Tensor::from_vec([4], vec![f64::INFINITY, 3.0, f64::NAN, 4.0]));
        let y = Var::select(&condition, &yes, &no);
        assert_eq!(y.value().data(), [1.0, 3.0, 2.0, 4.0]);
        let gradients = tape.backward(&[(&y, Tensor::from_vec([4], vec![0.5, 0.25, -1.0, f64::NAN]))]);
        assert_eq!(gradients.get(&yes).unwrap().data(), [0.5, 0.0, -1.0, 0.0]);
        let no = gradients.get(&no).unwrap().data();
        assert_eq!(no[..3], [0.0, 0.25, 0.0]);
        assert!(no[3].is_nan());
    }

    /// The square root below 0, made safe: selected twice, first the argument and then the result.
    #[test]
    fn a_dead_branch_with_a_safe_argument_has_a_finite_gradient() {
        let tape = Tape::new();
        let x = tape.leaf(Tensor::from_vec([3], vec![4.0f64, 0.0, -1.0]));
        let positive = x.value().map(|x| if x > 0.0 { 1.0 } else { 0.0 });
        let (one, zero) = (Var::constant(Tensor::full([3], 1.0)), Var::constant(Tensor::zeros([3])));
        let root = Var::select(&positive, &Var::select(&positive, &x, &one).sqrt(), &zero);
        assert_eq!(root.value().data(), [2.0, 0.0, 0.0]);
        assert_eq!(root.sum_all().backward().get(&x).unwrap().data(), [0.25, 0.0, 0.0]);
    }

    #[test]
    #[should_panic(expected = "select: expected a condition and two values, all of one shape (inputs [[2], [2], [3]])")]
    fn shapes_must_be_the_same() {
        let x = Var::<f32>::constant(Tensor::zeros([2]));
        Var::select(x.value(), &x, &Var::constant(Tensor::zeros([3])));
    }
}
