//! What the checker can be asked besides functions in f64: ops from elsewhere, f32, models, plain closures, second
//! derivatives; and what it says of slopes that are too small to be seen.

use parallax::gradcheck::{Options, Tolerance, check, check_f32, check_fn, check_hvp, check_op, check_params, hvp};
use parallax::nn::{Builder, Context, Init, Layout, ParamId, Params};
use parallax::ops::{Case, Checked, CustomOp, Input, Needs, Op, ShapeError, apply1};
use parallax::random::Random;
use parallax::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var};

/// y = x^2, with one slip of several.
#[derive(Clone, Copy)]
struct Slip<const WHICH: usize>;

const NONE: usize = 0;
/// The gradient is twice too large in f32.
const TWICE_IN_F32: usize = 1;
/// The gradient is written over what is there.
const OVERWRITES: usize = 2;
/// Nothing is written where x is 0.
const SKIPS_ZEROS: usize = 3;
/// The gradient is twice too large in any type.
const TWICE: usize = 4;

impl<const WHICH: usize> CustomOp for Slip<WHICH> {
    const NAME: &'static str = "slip";
}

impl<const WHICH: usize> Checked for Slip<WHICH> {
    fn cases() -> Vec<Case<Self>> {
        vec![Case::new("a matrix", Slip, [Input::random("x", [3, 4])])]
    }
}

impl<T: Float, const WHICH: usize> Op<T> for Slip<WHICH> {
    type Saved = Tensor<T>;
    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        Ok(vec![inputs[0]])
    }
    fn forward(&self, x: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Tensor<T>) {
        let y = Tensor::build(*x[0].shape(), |out| {
            for (y, &x) in out.iter_mut().zip(x[0].data()) {
                if WHICH != SKIPS_ZEROS || x != T::ZERO {
                    *y = x * x;
                }
            }
        });
        (vec![y], x[0].clone())
    }
    fn backward(&self, x: Tensor<T>, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let is_single = T::EPSILON.f64() > 1e-10;
        let factor = T::of(if WHICH == TWICE || WHICH == TWICE_IN_F32 && is_single { 4.0 } else { 2.0 });
        let g = upstream.only();
        sink.accumulate(0, |out, accum| {
            for ((out, &x), &g) in out.iter_mut().zip(x.data()).zip(g.data()) {
                let own = factor * x * g;
                match accum {
                    Accum::Add if WHICH != OVERWRITES => *out += own,
                    _ => *out = own,
                }
            }
        });
    }
}

/// One test, because poisoned memory is a switch of the whole process.
#[test]
fn an_op_from_elsewhere_is_held_to_everything() {
    let right = check_op::<Slip<NONE>>();
    assert!(right.is_right() && right.cases == 1, "{right}");
    let found = [
        (check_op::<Slip<TWICE_IN_F32>>(), "single"),
        (check_op::<Slip<OVERWRITES>>(), "accumulation"),
        (check_op::<Slip<SKIPS_ZEROS>>(), "zeros"),
        (check_op::<Slip<TWICE>>(), "differences"),
    ];
    for (report, check) in found {
        assert!(!report.is_right() && report.to_string().contains("WRONG"), "{report}");
        assert!(report.complaints.iter().any(|c| c.check == check), "not by {check}:\n{report}");
    }
}

fn numbers(seed: u64, shape: impl Into<Shape>) -> Tensor<f64> {
    let mut random = Random::new(seed, 7);
    Tensor::build(shape.into(), |out| out.iter_mut().for_each(|x| *x = random.uniform(-1.0, 1.0)))
}

#[test]
fn functions_in_f32_are_checked_to_three_digits() {
    let draw = |seed| numbers(seed, [3, 4]).cast::<f32>();
    let options = Options::single();
    for seed in 0..50 {
        let inputs = [draw(seed), draw(seed + 100)];
        let right = check_f32(|v| vec![(&v[0] * &v[1]).sigmoid().softmax(1), v[0].exp()], &inputs, &options);
        assert!(right.failure().is_none(), "{right}");
        let squares = check_f32(|v| vec![(&v[0] * &v[1]).square().mean_all()], &inputs, &options);
        assert!(squares.failure().is_none(), "{squares}");
        let twice = |v: &[Var<f32>]| vec![apply1(Slip::<TWICE_IN_F32>, &[&(&v[0] * &v[1])])];
        let wrong = check_f32(twice, &inputs, &options);
        assert!(wrong.failure().is_some_and(|why| why.contains("apart")), "{wrong}");
    }
    let corner = Tensor::from_vec([2], vec![0.0f32, 1.0]);
    let report = check_f32(|v| vec![v[0].relu()], &[corner], &options);
    assert_eq!(report.kinks(), 1, "{report}");
}

/// Two layers, whose second reads its input through an op that may slip.
fn model() -> (Params<f64>, [ParamId; 4]) {
    let (mut params, mut random) = (Params::new(), Random::new(1, 0));
    let mut at = Builder::new(&mut params, &mut random);
    let ids = [
        at.param("first.weight", [3, 5], Layout::Linear, Init::FanIn(3)),
        at.param("first.bias", [5], Layout::Same, Init::Constant(0.0)),
        at.param("second.weight", [5, 2], Layout::Linear, Init::FanIn(5)),
        at.param("second.bias", [2], Layout::Same, Init::Constant(0.0)),
    ];
    (params, ids)
}

#[test]
fn the_parameters_of_a_model_are_checked_by_name() {
    let (params, [w1, b1, w2, b2]) = model();
    let x = Var::constant(numbers(3, [4, 3]));
    let y = |c: &Context<f64>, w2: &Var<f64>| {
        let hidden = x.linear(c.var(w1), Some(c.var(b1))).tanh();
        hidden.linear(w2, Some(c.var(b2))).affine(1.0, -0.1).square().mean_all()
    };
    for directions in [None, Some(2)] {
        let options = Options { directions, ..Options::default() };
        let report = check_params(&params, |c| y(c, c.var(w2)), &options);
        assert!(report.failure().is_none() && report.inputs.len() == 4, "{report}");
        assert_eq!(report.elements(), directions.map_or(15 + 5 + 10 + 2, |_| 2 + 2 + 2 + 2));
        let report = check_params(&params, |c| y(c, &apply1(Slip::<TWICE>, &[c.var(w2)])), &options);
        assert!(report.failure().is_some_and(|why| why.contains("second.weight")), "{report}");
        let report = check_params(&params, |c| y(c, &c.var(w2).detach()), &options);
        assert!(report.failure().is_some_and(|why| why.contains("second.weight")), "{report}");
    }
}

#[test]
fn hessian_vector_products_are_those_of_closed_forms_and_symmetric() {
    let options = Options::default();
    // x.Ax has the Hessian A + A^T.
    let a = numbers(1, [4, 4]);
    let f = |v: &[Var<f64>]| {
        let row = v[0].reshape([1, 4]);
        vec![(&row.matmul(&Var::constant(a.clone())) * &row).sum_all()]
    };
    let (x, v) = (numbers(2, [4]), numbers(3, [4]));
    let found = hvp(f, std::slice::from_ref(&x), std::slice::from_ref(&v), &options).expect("tracked");
    let product = found.inputs[0].as_ref().expect("tracked");
    for i in 0..4 {
        let exact: f64 = (0..4).map(|j| (a.data()[4 * i + j] + a.data()[4 * j + i]) * v.data()[j]).sum();
        assert!((product.data()[i] - exact).abs() <= 1e-8, "{} for {exact}", product.data()[i]);
    }
    // exp has itself.
    let found = hvp(|v| vec![v[0].exp()], std::slice::from_ref(&x), std::slice::from_ref(&v), &options);
    let found = found.expect("tracked");
    for ((h, x), v) in found.inputs[0].as_ref().expect("tracked").data().iter().zip(x.data()).zip(v.data()) {
        assert!((h - x.exp() * v).abs() < 1e-8 && found.error < 1e-6);
    }
    let two = [numbers(4, [3, 4]), numbers(5, [3, 4])];
    let g = |v: &[Var<f64>]| vec![(&v[0].sigmoid() * &v[1]).softmax(1).square()];
    assert_eq!(check_hvp(g, &two, &options), Ok(()));
    // A gradient of one factor that is not that of the other belongs to no function.
    let slip = |v: &[Var<f64>]| vec![&apply1(Slip::<TWICE>, &[&v[0]]) * &v[1].square()];
    assert!(check_hvp(slip, &two, &options).is_err_and(|why| why.contains("no function")));
    assert!(hvp(|v| vec![v[0].detach()], &two, &two, &options).is_none());
}

#[test]
fn a_small_slope_beside_a_huge_one_is_noted() {
    // The slip doubles the slope of the second number, which is a billionth of the first one's.
    let f = |v: &[Var<f64>]| {
        let small = apply1(Slip::<TWICE>, &[&v[0].slice(0, 1..2)]);
        vec![v[0].slice(0, 0..1).affine(1e9, 0.0), small]
    };
    let x = [Tensor::from_vec([2], vec![0.5, 0.7])];
    let report = check(f, &x, &Options::default());
    assert!(report.failure().is_none(), "{report}");
    let note = report.warnings.iter().find(|note| note.contains("Elementwise")).expect("a note");
    assert!(note.contains("1 derivatives are smaller") && note.contains("element 1"), "{note}");
    let elementwise =
        Options { tolerance: Tolerance::Elementwise { absolute: 1e-9, relative: 1e-6 }, ..Options::default() };
    let report = check(f, &x, &elementwise);
    assert!(report.failure().is_some_and(|why| why.contains("element 1")), "{report}");
    // Numbers of one size raise no note.
    let report = check(|v| vec![v[0].square()], &x, &Options::default());
    assert!(report.warnings.is_empty(), "{report}");
}

#[test]
fn plain_closures_are_checked() {
    let cosine = |slip: f64| {
        move |x: &[f64]| {
            let x = x.to_vec();
            let y: Vec<f64> = x.iter().map(|x| x.sin()).collect();
            (y, move |g: &[f64]| x.iter().zip(g).map(|(x, g)| (1.0 + slip) * x.cos() * g).collect::<Vec<f64>>())
        }
    };
    let x = [0.3, -1.2, 2.0];
    let options = Options::default();
    assert!(check_fn(cosine(0.0), &x, &options).failure().is_none());
    assert!(check_fn(cosine(1e-5), &x, &options).failure().is_some_and(|why| why.contains("apart")));
    let short = |x: &[f64]| (x[0], |_: &[f64]| vec![1.0]);
    assert!(check_fn(short, &x, &options).failure().is_some_and(|why| why.contains("1 numbers, the input 3")));
    // The same, computed in f32.
    let single = |slip: f32| {
        move |x: &[f64]| {
            let x: Vec<f32> = x.iter().map(|&x| x as f32).collect();
            let y: f32 = x.iter().map(|x| x.sin()).sum();
            let slopes = move |g: &[f64]| x.iter().map(|x| g[0] * f64::from((1.0 + slip) * x.cos())).collect();
            (f64::from(y), slopes)
        }
    };
    let report = check_fn(single(0.0), &x, &Options::single());
    assert!(report.failure().is_none(), "{report}");
    assert!(check_fn(single(0.02), &x, &Options::single()).failure().is_some());
}
