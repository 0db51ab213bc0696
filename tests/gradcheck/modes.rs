//! The same cases in other circumstances, compared bit by bit with the first result: a poisoned pool, one and two
//! threads, subsets of tracked inputs; and f32 against f64.

use parallax::gradcheck::{cotangents, draw};
use parallax::ops::registry::{self, AnyCase};
use parallax::tensor::{Tape, Tensor, Var, parallel, pool};

/// Outputs, and the gradients of the tracked inputs.
type Outcome = (Vec<Tensor<f64>>, Vec<Option<Tensor<f64>>>);

fn run(case: &dyn AnyCase, inputs: &[Tensor<f64>], tracked: &[bool]) -> Outcome {
    let tape = Tape::new();
    let vars: Vec<Var<f64>> = inputs
        .iter()
        .zip(tracked)
        .map(|(x, &on)| if on { tape.leaf(x.clone()) } else { Var::constant(x.clone()) })
        .collect();
    let outputs = case.run(&vars.iter().collect::<Vec<_>>());
    let cotangents = cotangents(&outputs, 1);
    let seeds: Vec<_> = outputs.iter().zip(cotangents).filter_map(|(y, c)| Some((y, c?))).collect();
    let mut gradients = tape.backward(&seeds);
    let gradients = vars.iter().map(|v| gradients.take(v)).collect();
    (outputs.into_iter().map(Var::into_value).collect(), gradients)
}

fn differentiable(case: &dyn AnyCase) -> Vec<bool> {
    case.inputs().iter().map(|i| i.constant.is_none()).collect()
}

fn for_each_case(mut f: impl FnMut(&dyn AnyCase, &[Tensor<f64>], &str)) {
    for entry in registry::all() {
        for case in entry.cases() {
            let inputs = draw(case.as_ref(), 1);
            f(case.as_ref(), &inputs, &format!("{} [{}] \"{}\"", case.op(), case.algo(), case.name()));
        }
    }
}

fn assert_same(a: &Outcome, b: &Outcome, what: &str) {
    for (i, (x, y)) in a.0.iter().zip(&b.0).enumerate() {
        assert!(x.same_bits(y), "{what}: output {i} differs");
    }
    for (i, (x, y)) in a.1.iter().zip(&b.1).enumerate() {
        if let (Some(x), Some(y)) = (x, y) {
            assert!(x.same_bits(y), "{what}: the gradient of input {i} differs");
        }
    }
}

/// Poison is a switch of the whole process; the tests that turn it stand in one function.
#[test]
fn stale_memory_thread_counts_and_untracked_inputs_change_no_bit() {
    for_each_case(|case, inputs, what| {
        let all = differentiable(case);
        let first = run(case, inputs, &all);
        for threads in [1, 2] {
            let again = parallel::with_threads(threads, || run(case, inputs, &all));
            assert_same(&first, &again, &format!("{what} on {threads} threads"));
        }
        pool::set_poison(true);
        let poisoned = run(case, inputs, &all);
        pool::set_poison(false);
        assert_same(&first, &poisoned, &format!("{what} over a poisoned pool"));
        // Every subset of tracked inputs: the gradient of each must not depend on the company it keeps.
        for subset in 1..1usize << inputs.len().min(4) {
            let tracked: Vec<bool> =
                all.iter().enumerate().map(|(i, &d)| d && (i >= 4 || subset >> i & 1 == 1)).collect();
            if tracked.contains(&true) {
                let part = run(case, inputs, &tracked);
                assert_same(&first, &part, &format!("{what} with tracked inputs {tracked:?}"));
                for (i, (gradient, &on)) in part.1.iter().zip(&tracked).enumerate() {
                    assert_eq!(gradient.is_some(), on && first.1[i].is_some(), "{what}: gradient {i} with {tracked:?}");
                }
            }
        }
    });
}

/// Where every input has the same shape, the op applied to one value in all places: the gradient is the sum of those of
/// separate inputs with the same numbers.
#[test]
fn one_value_in_several_places_gets_the_sum_of_their_gradients() {
    let mut tried = 0;
    for_each_case(|case, inputs, what| {
        let all = differentiable(case);
        if inputs.len() < 2 || all.contains(&false) || inputs.iter().any(|x| x.shape() != inputs[0].shape()) {
            return;
        }
        tried += 1;
        let same = vec![inputs[1].clone(); inputs.len()];
        let apart = run(case, &same, &all).1;
        let tape = Tape::new();
        let x = tape.leaf(inputs[1].clone());
        let outputs = case.run(&vec![&x; inputs.len()]);
        let seeds: Vec<_> = outputs.iter().zip(cotangents(&outputs, 1)).filter_map(|(y, c)| Some((y, c?))).collect();
        let together = tape.backward(&seeds).take(&x).expect("a gradient");
        for (k, &g) in together.data().iter().enumerate() {
            let sum: f64 = apart.iter().flatten().map(|g| g.data()[k]).sum();
            assert!((g - sum).abs() <= 1e-12 * sum.abs().max(1.0), "{what}, element {k}: {g} for {sum}");
        }
    });
    assert!(tried >= 6, "only {tried} cases have inputs of one shape");
}

/// An input that two ops use gets the sum of both gradients: the second finds that of the first in place, and adds.
#[test]
fn a_value_used_twice_gets_both_gradients() {
    for_each_case(|case, inputs, what| {
        let all = differentiable(case);
        let once = run(case, inputs, &all).1;
        let tape = Tape::new();
        let leaf = |(x, &on): (&Tensor<f64>, &bool)| if on { tape.leaf(x.clone()) } else { x.clone().into() };
        let vars: Vec<Var<f64>> = inputs.iter().zip(&all).map(leaf).collect();
        let uses = [(); 2].map(|_| case.run(&vars.iter().collect::<Vec<_>>()));
        let seeds: Vec<_> = uses.iter().flat_map(|y| y.iter().zip(cotangents(y, 1))).collect();
        let seeds: Vec<_> = seeds.into_iter().filter_map(|(y, c)| Some((y, c?))).collect();
        let twice = tape.backward(&seeds);
        for (i, (v, once)) in vars.iter().zip(&once).enumerate() {
            let (Some(twice), Some(once)) = (twice.get(v), once) else { continue };
            let scale = once.data().iter().fold(0.0f64, |m, g| m.max(g.abs()));
            for (k, (&g, &h)) in twice.data().iter().zip(once.data()).enumerate() {
                let close = (g - 2.0 * h).abs() <= 1e-12 * scale;
                assert!(close, "{what}: the gradient of input {i}, element {k}: {g} for twice {h}");
            }
        }
    });
}

/// The f32 kernels, forward and backward, against f64 on the same (rounded) numbers.
#[test]
fn f32_follows_f64() {
    for_each_case(|case, inputs, what| {
        let all = differentiable(case);
        let single: Vec<Tensor<f32>> = inputs.iter().map(Tensor::cast).collect();
        let rounded: Vec<Tensor<f64>> = single.iter().map(Tensor::cast).collect();
        let double = run(case, &rounded, &all);
        let tape = Tape::new();
        let vars: Vec<Var<f32>> = single
            .iter()
            .zip(&all)
            .map(|(x, &on)| if on { tape.leaf(x.clone()) } else { Var::constant(x.clone()) })
            .collect();
        let outputs = case.run_f32(&vars.iter().collect::<Vec<_>>());
        for (i, (y, exact)) in outputs.iter().zip(&double.0).enumerate() {
            assert_close(y.value(), exact, &format!("{what}: output {i}"));
        }
        let tape64 = Tape::new();
        let vars64: Vec<Var<f64>> = rounded
            .iter()
            .zip(&all)
            .map(|(x, &on)| if on { tape64.leaf(x.clone()) } else { x.clone().into() })
            .collect();
        let seeds64 = cotangents(&case.run(&vars64.iter().collect::<Vec<_>>()), 1);
        let seeds: Vec<_> = outputs.iter().zip(&seeds64).filter_map(|(y, c)| Some((y, c.as_ref()?.cast()))).collect();
        let gradients = tape.backward(&seeds);
        for (i, (v, exact)) in vars.iter().zip(&double.1).enumerate() {
            if let (Some(g), Some(exact)) = (gradients.get(v), exact) {
                assert_close(g, exact, &format!("{what}: the gradient of input {i}"));
            }
        }
    });
}

fn assert_close(single: &Tensor<f32>, double: &Tensor<f64>, what: &str) {
    let finite = |x: f64| if x.is_finite() { x.abs() } else { 0.0 };
    let scale = double.data().iter().fold(1e-3, |m: f64, &x| m.max(finite(x)));
    for (k, (&x, &y)) in single.data().iter().zip(double.data()).enumerate() {
        let close = (x as f64 - y).abs() <= 1e-4 * scale || (x as f64 == y) || (x.is_nan() && y.is_nan());
        assert!(close, "{what}, element {k}: {x} in f32, {y} in f64 (scale {scale:e})");
    }
}
