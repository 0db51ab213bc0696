//! Checks in f32, in which training runs: all that need no finite differences.

use super::cotangents;
use super::outcome::{Outcome, distance, leaves, outcome, same};
use super::suite::{Subject, poisoned};
use crate::tensor::{Tape, Tensor, Var, parallel};

/// Largest error of a sum of gradients in f32, of the largest number in it.
const ROUNDING: f64 = 1e-4;

/// Repetition, subsets of tracked inputs, threads, memory full of NaN, accumulation, one value as two inputs.
pub(super) fn all_the_same_in_f32(s: &Subject) -> Result<(), String> {
    let inputs: Vec<Tensor<f32>> = s.inputs.iter().map(Tensor::cast).collect();
    let outputs = s.case.run(&leaves(&Tape::new(), &s.inputs, &s.all).iter().collect::<Vec<_>>());
    let seeds: Vec<Option<Tensor<f32>>> =
        cotangents(&outputs, s.seed()).iter().map(|c| c.as_ref().map(Tensor::cast)).collect();
    let of = |inputs: &[Tensor<f32>], tracked: &[bool], before: Option<&[Tensor<f32>]>| -> Outcome<f32> {
        let run = |vars: &[&Var<f32>]| s.case.run_f32(vars);
        outcome(&run, inputs, tracked, &|_| seeds.clone(), before)
    };
    let first = of(&inputs, &s.all, None);
    let again = |what: &str, other: Outcome<f32>| same(&first, &other).map_err(|why| format!("in f32, {what}: {why}"));
    again("a second time", of(&inputs, &s.all, None))?;
    for threads in [1, 2, 3] {
        again(&format!("{threads} threads"), parallel::with_threads(threads, || of(&inputs, &s.all, None)))?;
    }
    again("over memory full of NaN", poisoned(|| of(&inputs, &s.all, None)))?;
    for subset in 1..1usize << s.inputs.len().min(4) {
        let tracked: Vec<bool> =
            s.all.iter().enumerate().map(|(i, &d)| d && (i >= 4 || subset >> i & 1 == 1)).collect();
        if tracked.contains(&true) {
            again(&format!("{tracked:?} tracked"), of(&inputs, &tracked, None))?;
        }
    }
    adds_to_what_is_there(s, &inputs, &first, &of)?;
    adds_up_over_two_places(s, &inputs, &of, &seeds)
}

/// How an op is run on some inputs, of which some are tracked, onto gradients that are there.
type Runs<'a> = &'a dyn Fn(&[Tensor<f32>], &[bool], Option<&[Tensor<f32>]>) -> Outcome<f32>;

fn adds_to_what_is_there(s: &Subject, inputs: &[Tensor<f32>], first: &Outcome<f32>, of: Runs) -> Result<(), String> {
    let before: Vec<Tensor<f32>> = inputs.iter().map(|x| Tensor::full(*x.shape(), 3.0)).collect();
    let added = of(inputs, &s.all, Some(&before));
    for (i, (sum, alone)) in added.1.iter().zip(&first.1).enumerate() {
        let (Some(sum), Some(alone)) = (sum, alone) else { continue };
        let expected = Tensor::from_vec(*alone.shape(), alone.data().iter().map(|g| g + 3.0).collect());
        let off = distance([sum].into_iter(), [&expected].into_iter());
        if off > ROUNDING {
            return Err(format!("in f32, the gradient of input {i} is off by {off:e} where another was before"));
        }
    }
    Ok(())
}

fn adds_up_over_two_places(
    s: &Subject,
    inputs: &[Tensor<f32>],
    of: Runs,
    seeds: &[Option<Tensor<f32>>],
) -> Result<(), String> {
    for (i, j) in (1..inputs.len()).flat_map(|j| (0..j).map(move |i| (i, j))) {
        if !(s.all[i] && s.all[j]) || inputs[i].shape() != inputs[j].shape() {
            continue;
        }
        let mut numbers = inputs.to_vec();
        numbers[i] = numbers[j].clone();
        let apart = of(&numbers, &s.all, None).1;
        let tape = Tape::new();
        let mut vars = leaves(&tape, &numbers, &s.all);
        vars[i] = vars[j].clone();
        let outputs = s.case.run_f32(&vars.iter().collect::<Vec<_>>());
        let all: Vec<_> = outputs.iter().zip(seeds).filter_map(|(y, c)| Some((y, c.clone()?))).collect();
        let Some(together) = tape.backward(&all).take(&vars[j]) else { continue };
        let sum = |k: usize| [i, j].iter().filter_map(|&i| apart[i].as_ref()).map(|g| g.data()[k]).sum::<f32>();
        let expected = Tensor::from_vec(*together.shape(), (0..together.len()).map(sum).collect());
        let off = distance([&together].into_iter(), [&expected].into_iter());
        if off > ROUNDING {
            return Err(format!("in f32, one value as inputs {i} and {j}: off by {off:e}"));
        }
    }
    Ok(())
}
