//! `apply`: the one function that runs an op and makes its node. Nothing else can, so nothing can cut the graph silently.

use std::time::Duration;

use super::op::{Needs, Op};
use crate::tensor::profile;
use crate::tensor::profile::{Entry, Work};
use crate::tensor::{Float, GradSink, Shape, Tape, Tensor, Upstream, Var};

/// Runs an op with one output (auxiliary ones are dropped).
///
/// # Panics
/// If the shapes do not fit, with the op's name and the shapes; or if two inputs are on different tapes.
#[track_caller]
pub fn apply1<T: Float, O: Op<T>>(op: O, inputs: &[&Var<T>]) -> Var<T> {
    apply(op, inputs).swap_remove(0)
}

/// Runs an op: checks shapes, computes, and records a node if any input is tracked.
///
/// # Panics
/// If the shapes do not fit, with the op's name and the shapes; or if two inputs are on different tapes.
#[track_caller]
pub fn apply<T: Float, O: Op<T>>(op: O, inputs: &[&Var<T>]) -> Vec<Var<T>> {
    let shapes: Vec<Shape> = inputs.iter().map(|v| *v.shape()).collect();
    let expected = match op.shape(&shapes) {
        Ok(expected) => expected,
        Err(why) => panic!("{}: {why} (inputs {shapes:?})", O::NAME),
    };
    let tape = common_tape::<T>(O::NAME, inputs);
    let needs = Needs(inputs.iter().map(|v| v.is_tracked()).collect());
    let values: Vec<&Tensor<T>> = inputs.iter().map(|v| v.value()).collect();

    let running = profile::begin_forward(|| entry::<T, O>(&op, &shapes, &expected, &needs));
    let (mut outputs, saved) = op.forward(&values, &needs);
    let place = profile::end_forward(running, &outputs);

    debug_assert!(outputs.iter().map(Tensor::shape).eq(&expected), "{}: the shape rule says {expected:?}", O::NAME);
    let auxiliary = outputs.split_off(outputs.len() - op.auxiliary());
    let mut vars = match tape {
        None => outputs.into_iter().map(Var::constant).collect(),
        Some(tape) => {
            let slots = inputs.iter().map(|v| v.slot()).collect();
            let backward = move |upstream: Upstream<T>, sink: &mut GradSink<'_, T>| {
                let running = profile::begin_backward(place);
                op.backward(saved, upstream, sink);
                profile::end_backward(running);
            };
            tape.record(slots, outputs, Box::new(backward))
        }
    };
    vars.extend(auxiliary.into_iter().map(Var::constant));
    vars
}

/// What is said of an op that is about to run.
fn entry<T: Float, O: Op<T>>(op: &O, inputs: &[Shape], outputs: &[Shape], needs: &Needs) -> Entry {
    let flops = op.flops(inputs);
    let [forward, backward] = op.traffic(inputs, outputs, needs).map(|elements| elements * size_of::<T>() as u64);
    // The gradients of both factors of a product cost as much as the product each; where only one is wanted, half.
    let factors = inputs.len().clamp(1, 2);
    let wanted = (0..factors).filter(|&i| needs.get(i)).count() as u64;
    let back = Work { flops: 2 * flops * wanted / factors as u64, bytes: if needs.any() { backward } else { 0 } };
    Entry {
        op: O::NAME,
        algo: op.algo(inputs),
        flops,
        bytes: forward,
        back,
        forward: Duration::ZERO,
        backward: Duration::ZERO,
        output: outputs.first().copied().unwrap_or_else(|| Shape::new(&[])),
        finite: true,
    }
}

#[track_caller]
fn common_tape<T: Float>(name: &str, inputs: &[&Var<T>]) -> Option<Tape<T>> {
    let mut tapes = inputs.iter().filter_map(|v| v.tape());
    let first = tapes.next()?;
    assert!(tapes.all(|t| t.is(first)), "{name}: the inputs are on different tapes");
    Some(first.clone())
}
