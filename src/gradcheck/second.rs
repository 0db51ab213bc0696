//! Second derivatives: products of the Hessian with a direction, by central differences of analytic gradients.

use super::Options;
use super::function::{Function, OfVars};
use crate::random::{Random, Stream};
use crate::tensor::{Tensor, Var};

/// Hessian-vector product, by differences of gradients.
#[derive(Clone, Debug)]
pub struct Hvp {
    /// For every input; `None` for constants.
    pub inputs: Vec<Option<Tensor<f64>>>,
    /// How far any of the numbers may be off: what a step of half the length changes, and rounding.
    pub error: f64,
}

impl Hvp {
    /// The scalar product with another direction, over the inputs that are differentiated.
    pub fn dot(&self, direction: &[Tensor<f64>]) -> f64 {
        let products = self.inputs.iter().zip(direction).filter_map(|(h, d)| Some(dot(h.as_ref()?, d)));
        products.sum()
    }
}

fn dot(a: &Tensor<f64>, b: &Tensor<f64>) -> f64 {
    a.data().iter().zip(b.data()).map(|(a, b)| a * b).sum()
}

/// The Hessian of the sum of all outputs of `f`, times a direction (one tensor an input; those of constants are not
/// read): central differences of its gradients, with two steps and their extrapolation. `None` if no output is tracked.
///
/// ```
/// use parallax::gradcheck::{hvp, Options};
/// use parallax::tensor::Tensor;
/// let x = Tensor::from_vec([2], vec![1.0, -2.0]);
/// let v = Tensor::from_vec([2], vec![0.5, 3.0]);
/// let product = hvp(|v| vec![&v[0].square() * &v[0]], &[x], &[v], &Options::default()).unwrap();
/// // The second derivative of x^3 is 6 x.
/// let found = product.inputs[0].as_ref().unwrap();
/// assert!((found.data()[0] - 3.0).abs() < 1e-8 && (found.data()[1] + 36.0).abs() < 1e-8);
/// ```
///
/// # Panics
/// If there is not one direction an input, of its shape.
#[track_caller]
pub fn hvp(
    f: impl Fn(&[Var<f64>]) -> Vec<Var<f64>>,
    inputs: &[Tensor<f64>],
    direction: &[Tensor<f64>],
    options: &Options,
) -> Option<Hvp> {
    let shapes = |all: &[Tensor<f64>]| all.iter().map(|x| *x.shape()).collect::<Vec<_>>();
    assert_eq!(shapes(inputs), shapes(direction), "one direction for each input");
    let tracked = options.tracked(inputs.len());
    let f = OfVars::new(f, &tracked);
    let outputs = f.recorded(inputs);
    if !outputs.iter().any(|(_, tracked)| *tracked) {
        return None;
    }
    let ones: Vec<_> = outputs.iter().map(|(y, tracked)| tracked.then(|| Tensor::full(*y.shape(), 1.0))).collect();
    let largest = |which: &[Tensor<f64>]| {
        let numbers = tracked.iter().flat_map(|&i| which[i].data());
        numbers.filter(|x| x.is_finite()).fold(0.0, |m: f64, x| m.max(x.abs()))
    };
    let h = options.step * largest(inputs).max(1.0) / largest(direction).max(f64::MIN_POSITIVE);
    let gradients = |h: f64| {
        let mut moved = inputs.to_vec();
        for &i in &tracked {
            moved[i].data_mut().iter_mut().zip(direction[i].data()).for_each(|(x, d)| *x += h * d);
        }
        f.pull(&moved, &ones)
    };
    let steps = [h, 0.5 * h];
    let [long, short] = steps.map(|h| [gradients(h), gradients(-h)]);
    let mut error = 0.0f64;
    let product = |i: usize| {
        let [la, lb, sa, sb] = [&long[0], &long[1], &short[0], &short[1]].map(|all| all[i].as_ref());
        let (la, lb, sa, sb) = (la?, lb?, sa?, sb?);
        let each = |k: usize| {
            let coarse = (la.data()[k] - lb.data()[k]) / (2.0 * steps[0]);
            let fine = (sa.data()[k] - sb.data()[k]) / (2.0 * steps[1]);
            let noise = f64::EPSILON * sa.data()[k].abs().max(sb.data()[k].abs()) / steps[1];
            error = error.max((fine - coarse).abs() / 3.0 + noise);
            fine + (fine - coarse) / 3.0
        };
        Some(Tensor::from_vec(*la.shape(), (0..la.len()).map(each).collect()))
    };
    let products = (0..inputs.len()).map(product).collect();
    Some(Hvp { inputs: products, error })
}

/// Whether the Hessian that the gradients of `f` imply is symmetric, along two random directions u and v: u.Hv and v.Hu
/// are the same number. Where they are not, the gradients are those of no function.
///
/// # Errors
/// What is wrong, if the two are further apart than 1e-6 of their size and what the differences may be off.
pub fn check_hvp(
    f: impl Fn(&[Var<f64>]) -> Vec<Var<f64>>,
    inputs: &[Tensor<f64>],
    options: &Options,
) -> Result<(), String> {
    let mut random = Random::of(options.seed, Stream::TaylorDirections);
    let mut draw = || -> Vec<Tensor<f64>> {
        let mut each = |x: &Tensor<f64>| Tensor::build(*x.shape(), |d| d.iter_mut().for_each(|d| *d = random.normal()));
        inputs.iter().map(&mut each).collect()
    };
    let (u, v) = (draw(), draw());
    let product =
        |d: &[Tensor<f64>]| hvp(&f, inputs, d, options).ok_or("no output depends on any input by a recorded op");
    let (hu, hv) = (product(&u)?, product(&v)?);
    let tracked = options.tracked(inputs.len());
    let norm = |d: &[Tensor<f64>]| tracked.iter().map(|&i| dot(&d[i], &d[i])).sum::<f64>().sqrt();
    let size = |h: &Hvp| h.inputs.iter().flatten().map(|h| dot(h, h)).sum::<f64>().sqrt();
    let (one, other) = (hv.dot(&u), hu.dot(&v));
    let count = tracked.iter().map(|&i| inputs[i].len()).sum::<usize>() as f64;
    let off = count.sqrt() * (hv.error * norm(&u) + hu.error * norm(&v));
    let allowed = 1e-6 * (norm(&u) * size(&hv)).max(norm(&v) * size(&hu)) + 4.0 * off;
    // NaN is not within anything.
    if (one - other).abs() <= allowed {
        return Ok(());
    }
    Err(format!("u.Hv is {one:e}, v.Hu {other:e}: the gradients are those of no function"))
}
