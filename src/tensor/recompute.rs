//! Gradient checkpointing (Chen et al., 1604.06174): a part of a computation keeps its inputs alone, and runs once more in
//! the backward pass. That takes as much arithmetic again as its forward pass, and saves what its ops would have kept.

use super::data::Tensor;
use super::float::Float;
use super::gradients::{GradSink, Upstream};
use super::profile;
use super::tape::Tape;
use super::var::Var;

/// `f(inputs)`, recorded as one node that keeps `inputs`, whose backward pass computes `f` once more and reverses that.
///
/// `f` gets the inputs on a tape of its own, and depends on nothing else that is tracked; it must compute the same both
/// times. The value has the same bits as without; so have the gradients, but for the order of additions where an input
/// has several uses.
///
/// ```
/// use parallax::tensor::{Tape, Tensor, recompute};
/// let tape = Tape::new();
/// let x = tape.leaf(Tensor::from_vec([2], vec![1.0f64, 3.0]));
/// let y = recompute(&[&x], |v| (&v[0] * &v[0]).exp()).sum_all();
/// assert_eq!(tape.len(), 2, "the part, and the sum");
/// let expected = 2.0 * 3.0 * 9.0f64.exp();
/// assert!((y.backward().get(&x).unwrap().data()[1] / expected - 1.0).abs() < 1e-12);
/// ```
///
/// # Panics
/// If two inputs are on different tapes.
#[track_caller]
pub fn recompute<T: Float>(inputs: &[&Var<T>], f: impl Fn(&[Var<T>]) -> Var<T> + 'static) -> Var<T> {
    let Some(tape) = inputs.iter().find_map(|v| v.tape()).cloned() else {
        return f(&inputs.iter().map(|&v| v.clone()).collect::<Vec<_>>());
    };
    let slots: Vec<Option<usize>> =
        inputs.iter().map(|v| v.is_tracked().then(|| v.slot_on(&tape).expect("one tape"))).collect();
    let values: Vec<(Tensor<T>, bool)> = inputs.iter().map(|v| (v.value().clone(), v.is_tracked())).collect();
    // Over a tape that is thrown away: every kernel takes the path that it will take again.
    let value = profile::without_backward(|| f(&on(&Tape::new(), &values)).into_value());
    let backward = move |upstream: Upstream<T>, sink: &mut GradSink<'_, T>| {
        let again = Tape::new();
        let vars = on(&again, &values);
        let output = f(&vars);
        // An output that depends on no input has nothing to hand on.
        if !output.is_tracked() {
            return;
        }
        let mut gradients = again.backward(&[(&output, upstream.only())]);
        for (i, var) in vars.iter().enumerate().filter(|(_, var)| var.is_tracked()) {
            if let Some(gradient) = gradients.take(var) {
                sink.give(i, gradient);
            }
        }
    };
    tape.record(slots, vec![value], Box::new(backward)).swap_remove(0)
}

/// Values as variables: leaves of a tape, where they are tracked.
fn on<T: Float>(tape: &Tape<T>, values: &[(Tensor<T>, bool)]) -> Vec<Var<T>> {
    let var = |(value, tracked): &(Tensor<T>, bool)| match tracked {
        true => tape.leaf(value.clone()),
        false => Var::constant(value.clone()),
    };
    values.iter().map(var).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(seed: u64, shape: [usize; 2]) -> Tensor<f64> {
        let mut random = crate::random::Random::new(seed, 0);
        Tensor::build(shape, |out| out.iter_mut().for_each(|x| *x = random.uniform(-1.0, 1.0)))
    }

    /// Two layers over `x`, the first weight used twice; a constant among the inputs.
    fn part(v: &[Var<f64>]) -> Var<f64> {
        let [x, w, c] = v else { panic!("three inputs") };
        (x.matmul(w) + c).tanh().matmul(w).gelu()
    }

    #[test]
    fn a_part_that_runs_twice_has_the_gradients_of_one_that_runs_once() {
        let (x, w, c) = (numbers(1, [5, 4]), numbers(2, [4, 4]), numbers(3, [5, 4]));
        let run = |twice: bool| {
            let tape = Tape::new();
            let (x, w) = (tape.leaf(x.clone()), tape.leaf(w.clone()));
            let mut y = x.square();
            for _ in 0..3 {
                let inputs = [&y, &w, &Var::constant(c.clone())];
                y = if twice { recompute(&inputs, part) } else { part(&inputs.map(Clone::clone)) };
            }
            let y = y.sum_all();
            let ops = tape.len();
            let gradients = y.backward();
            (ops, y.into_value(), [&x, &w].map(|v| gradients.get(v).expect("used").clone()))
        };
        let (once, twice) = (run(false), run(true));
        assert_eq!((once.0, twice.0), (2 + 3 * 5, 2 + 3));
        assert!(once.1.same_bits(&twice.1));
        for (a, b) in once.2.iter().zip(&twice.2) {
            let scale = a.data().iter().fold(0.0f64, |m, x| m.max(x.abs()));
            assert!(scale > 0.0 && a.data().iter().zip(b.data()).all(|(a, b)| (a - b).abs() <= 1e-14 * scale));
        }
    }

    #[test]
    fn what_is_not_tracked_is_not_recorded() {
        let x = Var::constant(numbers(1, [2, 2]));
        assert!(!recompute(&[&x], |v| v[0].exp()).is_tracked());
        // An input that the part ignores has no gradient.
        let tape = Tape::new();
        let (a, b) = (tape.leaf(numbers(1, [2, 2])), tape.leaf(numbers(2, [2, 2])));
        let gradients = recompute(&[&a, &b], |v| v[0].exp()).sum_all().backward();
        assert!(gradients.get(&a).is_some() && gradients.get(&b).is_none());
        let tape = Tape::new();
        let a = tape.leaf(numbers(1, [2, 2]));
        let y = recompute(&[&a], |_| Var::constant(Tensor::full([2, 2], 1.0))) + &a;
        assert!(y.sum_all().backward().get(&a).expect("by the sum").data().iter().all(|&g| g == 1.0));
    }
}
