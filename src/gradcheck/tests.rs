//! The checker on functions that are wrong in every way it knows.

use std::cell::Cell;

use super::*;
use crate::ops::{Case, Checked, CustomOp, Input, Needs, Op, ShapeError, apply1};
use crate::tensor::{Float, GradSink, Shape, Upstream};

/// y = x^2 with a derivative of `factor` x, and what else may go wrong.
#[derive(Clone, Copy)]
struct Wrong {
    factor: f64,
    /// The element whose gradient is NaN.
    nan: Option<usize>,
}

impl CustomOp for Wrong {
    const NAME: &'static str = "wrong";
}

impl Checked for Wrong {
    fn cases() -> Vec<Case<Self>> {
        vec![Case::new("any", Wrong { factor: 2.0, nan: None }, [Input::random("x", [3])])]
    }
}

impl<T: Float> Op<T> for Wrong {
    type Saved = Tensor<T>;
    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        Ok(vec![inputs[0]])
    }
    fn forward(&self, x: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Tensor<T>) {
        (vec![x[0].map(|x| x * x)], x[0].clone())
    }
    fn backward(&self, x: Tensor<T>, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let mut g = upstream.only();
        g.data_mut().iter_mut().zip(x.data()).for_each(|(g, &x)| *g = *g * x * T::of(self.factor));
        if let Some(k) = self.nan {
            g.data_mut()[k] = T::NAN;
        }
        sink.give(0, g);
    }
}

/// Any function of one tensor to another of its shape, with a gradient written by hand.
#[derive(Clone, Copy)]
struct ByHand {
    f: fn(&[f64]) -> Vec<f64>,
    df: fn(&[f64], &[f64]) -> Vec<f64>,
}

impl CustomOp for ByHand {
    const NAME: &'static str = "by_hand";
}

impl Checked for ByHand {
    fn cases() -> Vec<Case<Self>> {
        let id = ByHand { f: |x| x.to_vec(), df: |_, g| g.to_vec() };
        vec![Case::new("any", id, [Input::random("x", [3])])]
    }
}

impl<T: Float> Op<T> for ByHand {
    type Saved = Vec<f64>;
    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        Ok(vec![inputs[0]])
    }
    fn forward(&self, x: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Vec<f64>) {
        let numbers: Vec<f64> = x[0].data().iter().map(|x| x.f64()).collect();
        (vec![Tensor::from_vec(*x[0].shape(), (self.f)(&numbers).into_iter().map(T::of).collect())], numbers)
    }
    fn backward(&self, x: Vec<f64>, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let numbers: Vec<f64> = g.data().iter().map(|g| g.f64()).collect();
        sink.give(0, Tensor::from_vec(*g.shape(), (self.df)(&x, &numbers).into_iter().map(T::of).collect()));
    }
}

fn x() -> Tensor<f64> {
    Tensor::from_vec([3], vec![0.5, -1.0, 2.0])
}

fn wrong(factor: f64) -> impl Fn(&[Var<f64>]) -> Vec<Var<f64>> {
    move |v| vec![apply1(Wrong { factor, nan: None }, &[&v[0]])]
}

fn failure(f: impl Fn(&[Var<f64>]) -> Vec<Var<f64>>, inputs: &[Tensor<f64>], options: &Options) -> String {
    check(f, inputs, options).failure().expect("a failure").to_string()
}

#[test]
fn a_right_gradient_passes_and_one_that_is_a_little_wrong_fails_in_every_way_of_asking() {
    let default = Options::default();
    let ways = [
        default.clone(),
        Options::five_point(),
        Options { cotangents: Cotangents::OneHot, ..default.clone() },
        Options { cotangents: Cotangents::Given(vec![x()]), ..default.clone() },
        Options { directions: Some(2), ..default.clone() },
        Options { tolerance: Tolerance::Elementwise { absolute: 1e-7, relative: 1e-7 }, ..default.clone() },
        Options { kinks: Kinks::Any, ..default },
    ];
    for options in &ways {
        let right = check(wrong(2.0), &[x()], options);
        assert!(right.failure().is_none(), "{options:?}\n{right}");
        let off = check(wrong(2.001), &[x()], options);
        assert!(off.failure().is_some_and(|why| why.contains("apart")), "{options:?}\n{off}");
    }
}

#[test]
fn the_report_names_the_worst_element_of_the_named_input_and_serialises() {
    let cotangents = Cotangents::Given(vec![Tensor::full([3], 1.0)]);
    let options = Options { names: vec!["depth".into()], cotangents, ..Options::default() };
    let options = Options { tolerance: Tolerance::Elementwise { absolute: 1e-3, relative: 0.0 }, ..options };
    let report = check(wrong(2.1), &[x()], &options);
    let text = report.to_string();
    assert!(text.contains("input 0 (depth)") && text.contains("WRONG"), "{text}");
    let json = serde_json::to_value(&report).expect("serialises");
    assert_eq!(json["inputs"][0]["worst"], 2);
    assert!((json["inputs"][0]["error"].as_f64().expect("a number") - 0.1 / 2.1).abs() < 1e-6, "{json}");
}

#[test]
fn the_taylor_remainder_tells_right_from_wrong_without_a_step() {
    let slope = |factor| taylor(wrong(factor), &[x()], &Options::default(), [1e-2, 1e-3]).expect("tracked");
    assert!((slope(2.0) - 2.0).abs() < 0.05 && slope(2.5) < 1.3, "{} {}", slope(2.0), slope(2.5));
}

#[test]
fn a_nan_in_a_gradient_fails() {
    let f = |v: &[Var<f64>]| vec![apply1(Wrong { factor: 2.0, nan: Some(1) }, &[&v[0]])];
    assert!(failure(f, &[x()], &Options::default()).contains("NaN"));
}

#[test]
fn a_nan_in_an_output_is_said_and_not_differentiated() {
    let why = failure(|v| vec![v[0].log()], &[x()], &Options::default());
    assert_eq!(why, "output 0, element 1 is NaN at these inputs: there is nothing to differentiate");
}

#[test]
fn a_function_that_returns_another_shape_the_second_time_is_found() {
    let calls = Cell::new(0);
    let f = |v: &[Var<f64>]| {
        calls.set(calls.get() + 1);
        vec![v[0].slice(0, 0..if calls.get() == 1 { 3 } else { 2 })]
    };
    assert!(failure(f, &[x()], &Options::default()).contains("when it is called again"));
}

#[test]
fn a_function_that_is_not_deterministic_is_found_unless_that_is_allowed() {
    let calls = Cell::new(0);
    let f = |v: &[Var<f64>]| {
        calls.set(calls.get() + 1);
        vec![v[0].square().affine(1.0, 1e-14 * (calls.get() % 2) as f64)]
    };
    assert!(failure(f, &[x()], &Options::default()).contains("differs from one call to the next"));
    let allowed = Options { nondeterminism: 1e-10, ..Options::default() };
    assert!(check(f, &[x()], &allowed).failure().is_none());
}

#[test]
fn a_gradient_that_is_not_deterministic_is_found() {
    let calls = Cell::new(0);
    let f = |v: &[Var<f64>]| {
        calls.set(calls.get() + 1);
        let nan = (calls.get() % 2 == 0).then_some(0);
        vec![apply1(Wrong { factor: 2.0, nan }, &[&v[0]])]
    };
    assert!(failure(f, &[x()], &Options::default()).contains("differs from one run to the next"));
}

#[test]
fn an_ignored_input_is_named_unless_it_was_declared() {
    let f = |v: &[Var<f64>]| vec![v[0].square(), v[1].affine(0.0, 1.0)];
    assert!(failure(f, &[x(), x()], &Options::default()).contains("input 1: every derivative is zero"));
    let declared = Options { ignored: vec![1], ..Options::default() };
    assert!(check(f, &[x(), x()], &declared).failure().is_none());
}

#[test]
fn nothing_checked_is_no_success() {
    let empty = Tensor::zeros([0, 3]);
    assert!(failure(wrong(2.0), &[empty], &Options::default()).contains("nothing was compared"));
    assert!(failure(wrong(2.0), &[x()], &Options { constant: vec![0], ..Options::default() }).contains("no output"));
    assert!(failure(|v| vec![v[0].detach()], &[x()], &Options::default()).contains("no output depends"));
    assert!(failure(|v| vec![v[0].affine(0.0, 1.0)], &[x()], &Options::default()).contains("every gradient is zero"));
}

#[test]
fn cotangents_of_another_shape_are_refused() {
    let options = Options { cotangents: Cotangents::Given(vec![Tensor::zeros([2])]), ..Options::default() };
    assert!(failure(wrong(2.0), &[x()], &options).contains("were given for outputs"));
}

#[test]
fn kinks_are_counted_reported_or_allowed_and_their_gradients_are_held_between_the_sides() {
    let zero = Tensor::from_vec([2], vec![0.0, 1.0]);
    let ones = Cotangents::Given(vec![Tensor::full([2], 1.0)]);
    let relu = |v: &[Var<f64>]| vec![v[0].relu()];
    assert!(
        failure(relu, std::slice::from_ref(&zero), &Options::default())
            .contains("1 elements at a kink, 0 were declared")
    );
    for kinks in [Kinks::Exactly(1), Kinks::Any] {
        let report = check(relu, std::slice::from_ref(&zero), &Options { kinks, ..Options::default() });
        assert!(report.failure().is_none() && report.kinks() == 1, "{report}");
    }
    let steep = ByHand { f: |x| x.iter().map(|x| x.max(0.0)).collect(), df: |x, g| slopes(x, g, 1.5) };
    let why = failure(
        |v| vec![apply1(steep, &[&v[0]])],
        &[zero],
        &Options { kinks: Kinks::Any, cotangents: ones, ..Options::default() },
    );
    assert_eq!(
        why,
        "input 0, element 0, at a kink: analytic 1.5e0 is not between 0e0 and 1e0, the one-sided derivatives"
    );
}

/// The derivative of relu, with one of its own at 0.
fn slopes(x: &[f64], g: &[f64], at_zero: f64) -> Vec<f64> {
    x.iter().zip(g).map(|(&x, &g)| if x == 0.0 { at_zero * g } else { f64::from(x > 0.0) * g }).collect()
}

#[test]
fn tied_elements_are_held_to_what_they_have_together() {
    // The maximum of three equal numbers; each of them alone stands on a kink.
    let tie = [Tensor::from_vec([3], vec![2.0; 3])];
    let any = Options { kinks: Kinks::Any, ..Options::default() };
    let peak = |x: &[f64]| vec![x.iter().copied().fold(f64::NEG_INFINITY, f64::max); 3];
    let share = |df| move |v: &[Var<f64>]| vec![apply1(ByHand { f: peak, df }, &[&v[0]])];
    let shared = check(share(|_, g| vec![g.iter().sum::<f64>() / 3.0; 3]), &tie, &any);
    assert!(shared.failure().is_none() && shared.ties == 1, "{shared}");
    // Each of them gets the whole gradient: each lies between its one-sided derivatives, but not their sum.
    let why = failure(share(|_, g| vec![g.iter().sum::<f64>(); 3]), &tie, &any);
    assert!(why.contains("the tied elements [(0, 0), (0, 1), (0, 2)]"), "{why}");
    // The right sum of wrong parts.
    let parts = |_: &[f64], g: &[f64]| [5.0, -4.0, 0.0].map(|part| part * g.iter().sum::<f64>()).to_vec();
    let why = failure(share(parts), &tie, &any);
    assert!(why.contains("at a kink"), "{why}");
}
