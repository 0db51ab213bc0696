//! How to write an op of your own, and what the checker says of it: once right, once with a slip in its derivative.
//!
//! cargo run --release --example check_your_own_op

use parallax::gradcheck::{Cotangents, Options, check, check_case, taylor};
use parallax::ops::registry::Entry;
use parallax::ops::{Case, Checked, CustomOp, Input, Needs, Op, ShapeError, apply1};
use parallax::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var};

/// y = x^3, whose derivative is `factor` x^2: 3 is right.
#[derive(Clone)]
struct Cube<const FACTOR: usize>;

impl<const FACTOR: usize> CustomOp for Cube<FACTOR> {
    const NAME: &'static str = "cube";
}

impl<T: Float, const FACTOR: usize> Op<T> for Cube<FACTOR> {
    /// The input.
    type Saved = Tensor<T>;

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        Ok(vec![inputs[0]])
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Tensor<T>) {
        let x = inputs[0];
        let y = Tensor::from_vec(*x.shape(), x.data().iter().map(|&x| x * x * x).collect());
        (vec![y], x.clone())
    }

    fn backward(&self, x: Tensor<T>, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let factor = T::of(FACTOR as f64);
        let gradient = x.data().iter().zip(upstream.only().data()).map(|(&x, &g)| factor * x * x * g).collect();
        sink.give(0, Tensor::from_vec(*x.shape(), gradient));
    }
}

/// Without cases an op does not build.
impl<const FACTOR: usize> Checked for Cube<FACTOR> {
    fn cases() -> Vec<Case<Self>> {
        vec![Case::new("a matrix", Cube, [Input::random("x", [3, 4])])]
    }
}

fn main() {
    // The cases that stand with the op.
    for (what, entry) in [("right", Entry::of::<Cube<3>>()), ("wrong", Entry::of::<Cube<2>>())] {
        for case in entry.cases() {
            println!("{what}: {}\n", check_case(case.as_ref(), 1));
        }
    }

    // Any function of variables, without an op of its own.
    const STEPS: [f64; 2] = [1e-2, 1e-3];
    let f = |v: &[Var<f64>]| vec![apply1(Cube::<3>, &[&v[0]]).sigmoid() * &v[1]];
    let g = |v: &[Var<f64>]| vec![apply1(Cube::<2>, &[&v[0]]).sigmoid() * &v[1]];
    let inputs = [Tensor::from_vec([2], vec![0.5, -1.5]), Tensor::from_vec([2], vec![2.0, 3.0])];
    let names = vec!["x".to_string(), "factor".to_string()];
    let options = Options { names, ..Options::default() };
    let report = check(f, &inputs, &options);
    println!("composed: {report}\n");
    assert!(report.failure().is_none());

    // The whole Jacobian, an output at a time; and without a step: the remainder falls with the square of the distance
    // where the gradient is right, and with the distance itself where it is wrong.
    let jacobian = check(f, &inputs, &Options { cotangents: Cotangents::OneHot, ..options.clone() });
    assert!(jacobian.failure().is_none());
    for (what, slope) in
        [("right", taylor(f, &inputs, &options, STEPS)), ("wrong", taylor(g, &inputs, &options, STEPS))]
    {
        println!("{what}: slope of the Taylor remainder {:.2}", slope.expect("the output is tracked"));
    }

    // It does not take silence for success.
    let forgetful = check(|v: &[Var<f64>]| vec![v[0].detach() * &v[1]], &inputs, &options);
    println!("\na detached factor: {}", forgetful.failure().expect("it is noticed"));
}
