//! The checker on smooth functions: it raises no alarm at a right gradient, wherever it is asked, and lets no wrong one
//! pass for it.

use parallax::gradcheck::{Kinks, Options, Report, check};
use parallax::ops::{Case, Checked, CustomOp, Input, Needs, Op, ShapeError, apply1};
use parallax::random::Random;
use parallax::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var};

type V = Var<f64>;

/// y = x, with a gradient that is multiplied by a factor, in one element or in all.
#[derive(Clone, Copy)]
struct Planted {
    factor: f64,
    only: Option<usize>,
}

impl CustomOp for Planted {
    const NAME: &'static str = "planted";
}

impl Checked for Planted {
    fn cases() -> Vec<Case<Self>> {
        vec![Case::new("any", Planted { factor: 1.0, only: None }, [Input::random("x", [3])])]
    }
}

impl<T: Float> Op<T> for Planted {
    type Saved = ();
    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        Ok(vec![inputs[0]])
    }
    fn forward(&self, x: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, ()) {
        (vec![x[0].clone()], ())
    }
    fn backward(&self, _: (), upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let mut g = upstream.only();
        for (k, g) in g.data_mut().iter_mut().enumerate() {
            *g *= T::of(if self.only.is_none_or(|only| only == k) { self.factor } else { 1.0 });
        }
        sink.give(0, g);
    }
}

/// A random smooth function of three inputs, and where it is asked.
struct Composition {
    inputs: Vec<Tensor<f64>>,
    steps: Vec<(usize, usize, usize)>,
    last: usize,
}

const LENGTH: usize = 3;
const KINDS: usize = 17;

impl Composition {
    fn draw(seed: u64) -> Self {
        let mut random = Random::new(seed, 0x500);
        let inputs = (0..3).map(|_| {
            let scale = [0.0, 0.0, 1e-8, 1e-5, 1e-3, 1e-2, 1.0, 1.0, 1.0, 5.0][random.below(10)];
            let numbers = (0..LENGTH).map(|_| scale * random.uniform(-1.0, 1.0)).collect();
            Tensor::from_vec([LENGTH], numbers)
        });
        let inputs = inputs.collect();
        let count = 1 + random.below(5);
        let steps = (0..count).map(|step| {
            let values = 3 + step;
            // The last value is always taken, so that nothing is built in vain.
            let first = if step == 0 { random.below(3) } else { values - 1 };
            (random.below(KINDS), first, random.below(values))
        });
        let steps = steps.collect();
        Composition { inputs, steps, last: random.below(4) }
    }

    fn run(&self, inputs: &[V]) -> Vec<V> {
        let mut values = inputs.to_vec();
        for &(kind, a, b) in &self.steps {
            let (x, y) = (&values[a], &values[b]);
            // One is added where numbers must stay positive; tanh keeps the others from running away.
            let positive = || x.square().affine(1.0, 1e-2);
            values.push(match kind {
                0 => x.square(),
                1 => x.sigmoid(),
                2 => x.tanh(),
                3 => x.tanh().exp(),
                4 => x.softplus(),
                5 => x.silu(),
                6 => x.gelu(),
                7 => positive().log(),
                8 => positive().sqrt(),
                9 => positive().reciprocal(),
                10 => x * y,
                11 => x + y,
                12 => x - y,
                13 => (x - y).square(),
                14 => x.affine(100.0, 0.0).sigmoid(),
                15 => x.softmax(0),
                _ => x.affine(3.0, -0.5) * &y.sigmoid(),
            });
        }
        let y = values.last().expect("there are inputs");
        vec![match self.last {
            0 => y.clone(),
            1 => y.square().sum_all(),
            2 => y.affine(1.0, -0.25).square().mean_all(),
            _ => y.square(),
        }]
    }

    /// Every input that the function does not read is rightly ignored.
    fn options(&self) -> Options {
        Options { ignored: vec![0, 1, 2], ..Options::default() }
    }

    fn report(&self, options: &Options, planted: Planted) -> Report {
        check(|v| self.run(&v.iter().map(|v| apply1(planted, &[v])).collect::<Vec<_>>()), &self.inputs, options)
    }
}

const RIGHT: Planted = Planted { factor: 1.0, only: None };

#[test]
fn five_hundred_smooth_compositions_raise_no_alarm() {
    let mut alarms = Vec::new();
    for five_point in [false, true] {
        let before = alarms.len();
        for seed in 0..500 {
            let f = Composition::draw(seed);
            let mut options = f.options();
            if five_point {
                options = Options { ignored: options.ignored, ..Options::five_point() };
            }
            let report = f.report(&options, RIGHT);
            let vacuous = report.failure().is_some_and(|why| why.contains("every gradient is zero"));
            if report.failure().is_some() && !vacuous {
                alarms.push(format!("seed {seed}, {:?} {:?}\n{report}", f.steps, f.last));
            }
        }
        println!("five points {five_point}: {} false alarms of 500", alarms.len() - before);
    }
    assert!(alarms.is_empty(), "{}", alarms[..alarms.len().min(8)].join("\n"));
}

#[test]
fn what_is_planted_is_found() {
    let options = |f: &Composition| Options { kinks: Kinks::Any, ..f.options() };
    let functions: Vec<_> = (1000..1200).map(Composition::draw).collect();
    for (exponent, all_least, one_least) in LEAST {
        let factor = 1.0 + 10f64.powi(exponent);
        let (mut all, mut one, mut of) = (0, 0, 0);
        for f in &functions {
            let right = f.report(&options(f), RIGHT);
            // Where nothing has a slope nothing can be multiplied.
            if right.inputs.iter().flatten().all(|r| r.scale == 0.0) {
                continue;
            }
            of += 1;
            // An alarm that is raised at the right gradient as well finds nothing.
            if right.failure().is_none() {
                let found = |only| f.report(&options(f), Planted { factor, only }).failure().is_some();
                all += usize::from(found(None));
                one += usize::from(found(Some(1)));
            }
        }
        println!("1e{exponent}: found {all} of {of} in all elements, {one} in one");
        assert!(all >= all_least && one >= one_least, "1e{exponent}: {all} and {one}");
    }
}

/// The exponent of the relative error; how many must be found with it in every element, and in one.
/// A single step of 6e-6 finds 134, 132, 130, 130, 130, 130 and 133, 132, 128, 126, 121, 112: no more than it judges right
/// without.
const LEAST: [(i32, usize, usize); 6] =
    [(-1, 150, 150), (-2, 148, 148), (-3, 148, 145), (-4, 146, 142), (-5, 143, 131), (-6, 140, 120)];

#[track_caller]
fn assert_right(numbers: &[f64], f: impl Fn(&V) -> V) {
    let x = Tensor::from_vec([numbers.len()], numbers.to_vec());
    for options in [Options::default(), Options::five_point()] {
        let report = check(|v| vec![f(&v[0])], std::slice::from_ref(&x), &options);
        assert!(report.failure().is_none() && report.kinks() == 0, "{options:?}\n{report}");
        // The same with its sign changed is wrong, also where any kink is allowed.
        if report.inputs[0].as_ref().is_some_and(|r| r.scale > 0.0) {
            let options = Options { kinks: Kinks::Any, ..options };
            let planted = Planted { factor: -1.0, only: None };
            let report = check(|v| vec![f(&apply1(planted, &[&v[0]]))], std::slice::from_ref(&x), &options);
            assert!(report.failure().is_some_and(|why| why.contains("apart")), "{options:?}\n{report}");
        }
    }
}

#[test]
fn near_stationary_points_there_is_no_kink() {
    for x in [1e-8, 1e-6, 1e-4, 0.0, -1e-8] {
        assert_right(&[x], |x| x.square());
        assert_right(&[0.5 + x], |x| x.affine(1.0, -0.5).square());
    }
    assert_right(&[1e-5, -3e-4, 2e-6], |x| x.square().sum_all());
    assert_right(&[0.0, 0.0, 0.0], |x| x.square().sum_all());
}

#[test]
fn near_the_edge_of_the_domain_steps_get_shorter() {
    for x in [1e-2, 1e-3, 1e-5, 1e-8] {
        assert_right(&[x], |x| x.log());
        assert_right(&[x], |x| x.reciprocal());
        assert_right(&[x], |x| x.sqrt());
    }
}

#[test]
fn where_a_function_is_steep_five_points_are_no_worse() {
    assert_right(&[25.0], |x| x.exp());
    assert_right(&[0.01], |x| x.log());
    assert_right(&[0.0, 1e-3, -2e-3, 5e-3], |x| x.affine(1000.0, 0.0).sigmoid());
}

#[test]
fn a_layer_of_zeros_under_a_squared_loss_is_right() {
    let x = Tensor::from_vec([2, 3], vec![0.5, -1.0, 2.0, 0.3, 0.7, -0.2]);
    let (w, b) = (Tensor::zeros([3, 2]), Tensor::zeros([2]));
    let f = |v: &[V]| {
        let y = &v[0].matmul(&v[1]) + &v[2];
        vec![y.affine(1.0, -0.3).square().mean_all()]
    };
    let decay = |v: &[V]| vec![&f(v)[0] + &v[2].square().sum_all()];
    for options in [Options::default(), Options::five_point()] {
        let report = check(f, &[x.clone(), w.clone(), b.clone()], &options);
        assert!(report.failure().is_none(), "{report}");
        assert!(report.warnings.iter().any(|why| why.contains("every derivative is zero here")), "{report}");
        let report = check(decay, &[x.clone(), w.clone(), b.clone()], &options);
        assert!(report.failure().is_none(), "{report}");
    }
}
