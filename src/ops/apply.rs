//! `apply`: the one function that runs an op and makes its node. Nothing else can, so nothing can cut the graph silently.

use std::time::Duration;

use super::op::{Needs, Op, ShapeError};
use crate::tensor::profile::{self, Entry, Work};
use crate::tensor::regime;
use crate::tensor::tape::Backward;
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
    match op.run(inputs) {
        Ok(outputs) => outputs,
        Err(why) => panic!("{why}"),
    }
}

/// [`apply`] without its panics: the code that is compiled for every op and element type, which is why it is short.
pub(super) fn execute<T: Float, O: Op<T>>(op: O, inputs: &[&Var<T>]) -> Result<Vec<Var<T>>, String> {
    node(O::NAME, &op, inputs)
}

/// What making a node takes of an op, whatever it saves.
trait Node<T: Float> {
    fn outputs(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError>;
    fn auxiliary(&self) -> usize;
    fn algo(&self, inputs: &[Shape]) -> &'static str;
    fn entry(&self, inputs: &[Shape], outputs: &[Shape], needs: &Needs) -> Entry;
    fn compute(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Option<Backward<T>>);
}

impl<T: Float, O: Op<T>> Node<T> for O {
    fn outputs(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        self.shape(inputs)
    }
    fn auxiliary(&self) -> usize {
        Op::auxiliary(self)
    }
    fn algo(&self, inputs: &[Shape]) -> &'static str {
        Op::algo(self, inputs)
    }
    fn entry(&self, inputs: &[Shape], outputs: &[Shape], needs: &Needs) -> Entry {
        let (flops, traffic) = (self.flops(inputs), self.traffic(inputs, outputs, needs));
        let traffic = traffic.map(|elements| elements * size_of::<T>() as u64);
        entry((O::NAME, Op::algo(self, inputs)), [inputs, outputs], needs, flops, traffic)
    }
    fn compute(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Option<Backward<T>>) {
        let (outputs, saved) = self.forward(inputs, needs);
        if !needs.any() {
            return (outputs, None);
        }
        let op = self.clone();
        (outputs, Some(Box::new(move |upstream, sink| op.backward(saved, upstream, sink))))
    }
}

fn node<T: Float>(name: &'static str, op: &dyn Node<T>, inputs: &[&Var<T>]) -> Result<Vec<Var<T>>, String> {
    let shapes: Vec<Shape> = inputs.iter().map(|v| *v.shape()).collect();
    let expected = op.outputs(&shapes).map_err(|why| format!("{name}: {why} (inputs {shapes:?})"))?;
    let tape = common_tape::<T>(name, inputs)?;
    let needs = Needs(inputs.iter().map(|v| v.is_tracked()).collect());
    let values: Vec<&Tensor<T>> = inputs.iter().map(|v| v.value()).collect();

    let running = profile::begin_forward(|| op.entry(&shapes, &expected, &needs));
    #[cfg(mutants)]
    regime::mutants::runs_in::<T>();
    let label = regime::label(|| (name, op.algo(&shapes)));
    let (mut outputs, backward) = regime::of_op(label, || op.compute(&values, &needs));
    let place = profile::end_forward(running, &outputs);

    debug_assert!(outputs.iter().map(Tensor::shape).eq(&expected), "{name}: the shape rule says {expected:?}");
    let auxiliary = outputs.split_off(outputs.len() - op.auxiliary());
    let mut vars = match (tape, backward) {
        (Some(tape), Some(backward)) => {
            let slots = inputs.iter().map(|v| v.slot()).collect();
            let timed = move |upstream: Upstream<T>, sink: &mut GradSink<'_, T>| {
                let running = profile::begin_backward(place);
                #[cfg(mutants)]
                regime::mutants::runs_in::<T>();
                regime::of_op(label, || backward(upstream, sink));
                profile::end_backward(running);
            };
            tape.record(slots, outputs, Box::new(timed))
        }
        _ => outputs.into_iter().map(Var::constant).collect(),
    };
    vars.extend(auxiliary.into_iter().map(Var::constant));
    Ok(vars)
}

/// What is said of an op (its name and kernel path) that is about to run, from its arithmetic and its traffic in bytes,
/// forward and backward.
fn entry(
    (op, algo): (&'static str, &'static str),
    [inputs, outputs]: [&[Shape]; 2],
    needs: &Needs,
    flops: u64,
    [forward, backward]: [u64; 2],
) -> Entry {
    // The gradients of both factors of a product cost as much as the product each; where only one is wanted, half.
    let factors = inputs.len().clamp(1, 2);
    let wanted = (0..factors).filter(|&i| needs.get(i)).count() as u64;
    let back = Work { flops: 2 * flops * wanted / factors as u64, bytes: if needs.any() { backward } else { 0 } };
    Entry {
        op,
        algo,
        flops,
        bytes: forward,
        back,
        forward: Duration::ZERO,
        backward: Duration::ZERO,
        output: outputs.first().copied().unwrap_or_else(|| Shape::new(&[])),
        finite: true,
    }
}

fn common_tape<T: Float>(name: &str, inputs: &[&Var<T>]) -> Result<Option<Tape<T>>, String> {
    let mut tapes = inputs.iter().filter_map(|v| v.tape());
    let Some(first) = tapes.next() else { return Ok(None) };
    if !tapes.all(|t| t.is(first)) {
        return Err(format!("{name}: the inputs are on different tapes"));
    }
    Ok(Some(first.clone()))
}
