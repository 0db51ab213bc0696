//! Functions over plain numbers, of any library.

use super::function::Function;
use super::{Options, Report, check_function};
use crate::tensor::Tensor;

/// Return value of a plain function: one number, or several.
pub trait Numbers {
    /// All of them.
    fn numbers(self) -> Vec<f64>;
}

impl Numbers for f64 {
    fn numbers(self) -> Vec<f64> {
        vec![self]
    }
}

impl Numbers for Vec<f64> {
    fn numbers(self) -> Vec<f64> {
        self
    }
}

/// Compares the vector-Jacobian product of a plain function with finite differences.
///
/// `f` gets the numbers and returns its outputs (one `f64` or a vector) and a closure that turns a cotangent, one number
/// for each output, into the gradient of the numbers. For a function that computes in f32 inside, take
/// [`Options::single`].
///
/// ```
/// use parallax::gradcheck::{check_fn, Options};
/// let squares = |factor: f64| move |x: &[f64]| {
///     let x = x.to_vec();
///     let y: f64 = x.iter().map(|x| x * x).sum();
///     (y, move |g: &[f64]| x.iter().map(|x| factor * x * g[0]).collect())
/// };
/// assert!(check_fn(squares(2.0), &[1.0, -3.0], &Options::default()).failure().is_none());
/// assert!(check_fn(squares(2.1), &[1.0, -3.0], &Options::default()).failure().is_some());
/// ```
pub fn check_fn<Y: Numbers, V: FnOnce(&[f64]) -> Vec<f64>>(
    f: impl Fn(&[f64]) -> (Y, V),
    x: &[f64],
    options: &Options,
) -> Report {
    let (y, vjp) = f(x);
    let gradient = vjp(&vec![1.0; y.numbers().len()]).len();
    if gradient != x.len() {
        return Report::broken(format!("the gradient has {gradient} numbers, the input {}", x.len()));
    }
    check_function(&Plain { f, single: options.single }, &[Tensor::from_vec([x.len()], x.to_vec())], options)
}

struct Plain<F> {
    f: F,
    single: bool,
}

impl<Y: Numbers, V: FnOnce(&[f64]) -> Vec<f64>, F: Fn(&[f64]) -> (Y, V)> Function for Plain<F> {
    fn epsilon(&self) -> f64 {
        if self.single { f32::EPSILON.into() } else { f64::EPSILON }
    }

    fn round(&self, x: f64) -> f64 {
        if self.single { f64::from(x as f32) } else { x }
    }

    fn recorded(&self, inputs: &[Tensor<f64>]) -> Vec<(Tensor<f64>, bool)> {
        self.values(inputs).into_iter().map(|y| (y, true)).collect()
    }

    fn values(&self, inputs: &[Tensor<f64>]) -> Vec<Tensor<f64>> {
        let y = (self.f)(inputs[0].data()).0.numbers();
        vec![Tensor::from_vec([y.len()], y)]
    }

    fn pull(&self, inputs: &[Tensor<f64>], cotangents: &[Option<Tensor<f64>>]) -> Vec<Option<Tensor<f64>>> {
        let vjp = (self.f)(inputs[0].data()).1;
        let gradient = cotangents[0].as_ref().map(|c| vjp(c.data()));
        vec![gradient.map(|g| Tensor::from_vec([g.len()], g))]
    }
}
