//! Regimes: windows of every geometry, ranks 0 to 5 with extents 0 and 1, indices in any order, by property tests that
//! shrink to the smallest example; and f32 against f64 over every remainder of a vector register.

use std::collections::BTreeMap;

use parallax::gradcheck::{Kinks, Options, check, draw};
use parallax::ops::Conv2d;
use parallax::ops::case::{Fill, Input};
use parallax::ops::conv::transpose::ConvTranspose2d;
use parallax::ops::registry::{self, AnyCase};
use parallax::random::Random;
use parallax::tensor::{Shape, Tape, Tensor, Var};
use proptest::prelude::*;

type V = Var<f64>;

/// Different numbers, evenly spaced in [-1, 1], in random order: nothing ties.
fn distinct(shape: impl Into<Shape>, seed: u64) -> Tensor<f64> {
    let shape = shape.into();
    let n = shape.len() as f64;
    let mut all: Vec<f64> = (0..shape.len()).map(|i| 2.0 * (i as f64 + 0.5) / n - 1.0).collect();
    Random::new(seed, 0x2E6).shuffle(&mut all);
    Tensor::from_vec(shape, all)
}

/// Checks along a few directions of each input. Inputs that are too small to matter may be ignored, and nothing at all
/// may be left of an empty one.
fn holds(inputs: &[Tensor<f64>], f: impl Fn(&[V]) -> V) -> Result<(), TestCaseError> {
    let outputs = f(&inputs.iter().cloned().map(Var::constant).collect::<Vec<_>>()).value().len();
    let empty = outputs == 0 || inputs.iter().all(Tensor::is_empty);
    let options = Options {
        directions: Some(5),
        ignored: (0..inputs.len()).filter(|&i| inputs[i].is_empty() || empty).collect(),
        flat: empty,
        ..Options::default()
    };
    let report = check(|v| vec![f(v)], inputs, &options);
    prop_assert!(report.failure().is_none(), "{}", report);
    Ok(())
}

fn pair(low: usize, high: usize) -> impl Strategy<Value = [usize; 2]> {
    [low..=high, low..=high]
}

/// Whether a window, dilated, fits into an image with its padding.
fn fits(size: [usize; 2], kernel: [usize; 2], padding: [usize; 2], dilation: [usize; 2]) -> bool {
    (0..2).all(|d| size[d] + 2 * padding[d] > dilation[d] * (kernel[d] - 1))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn conv2d_of_any_geometry(
        size in pair(1, 7), kernel in pair(1, 4), stride in pair(1, 4), padding in pair(0, 3), dilation in pair(1, 3),
        groups in 1usize..=3, inner in 1usize..=2, outer in 1usize..=3, batch in 1usize..=2,
    ) {
        prop_assume!(fits(size, kernel, padding, dilation));
        let op = Conv2d { stride, padding, dilation, groups, ..Conv2d::default() };
        let x = distinct([batch, size[0], size[1], groups * inner], 1);
        let w = distinct([kernel[0], kernel[1], inner, groups * outer], 2);
        let b = distinct([groups * outer], 3);
        // A window that meets nothing but padding has no gradient to show.
        let tape = Tape::new();
        let y = tape.leaf(x.clone()).conv2d(&tape.leaf(w.clone()), None, op);
        prop_assume!(y.value().data().iter().any(|y| *y != 0.0));
        holds(&[x, w, b], |v| v[0].conv2d(&v[1], Some(&v[2]), op))?;
    }

    #[test]
    fn conv_transpose2d_of_any_geometry(
        size in pair(1, 5), kernel in pair(1, 3), stride in pair(1, 3), padding in pair(0, 2), dilation in pair(1, 3),
        extra in pair(0, 2), groups in 1usize..=2, inner in 1usize..=2, outer in 1usize..=2,
    ) {
        let out = |d: usize| (size[d] - 1) * stride[d] + dilation[d] * (kernel[d] - 1) + extra[d] + 1;
        prop_assume!((0..2).all(|d| extra[d] < stride[d].max(dilation[d]) && out(d) > 2 * padding[d]));
        let op = ConvTranspose2d { stride, padding, dilation, output_padding: extra, groups, tile: parallax::ops::Tile::AUTO };
        let x = distinct([1, size[0], size[1], groups * inner], 1);
        let w = distinct([kernel[0], kernel[1], outer, groups * inner], 2);
        let tape = Tape::new();
        let y = tape.leaf(x.clone()).conv_transpose2d(&tape.leaf(w.clone()), None, op);
        prop_assume!(y.value().data().iter().any(|y| *y != 0.0));
        holds(&[x, w], |v| v[0].conv_transpose2d(&v[1], None, op))?;
    }

    #[test]
    fn depthwise_conv2d_of_any_geometry(
        size in pair(1, 8), kernel in pair(1, 5), stride in 1usize..=3, padding in 0usize..=3, channels in 1usize..=20,
    ) {
        prop_assume!(fits(size, kernel, [padding; 2], [1; 2]));
        let x = distinct([1, size[0], size[1], channels], 1);
        let w = distinct([kernel[0], kernel[1], channels], 2);
        let op = |v: &[V]| v[0].depthwise_conv2d(&v[1], None, stride, padding);
        let y = op(&[x.clone().into(), w.clone().into()]);
        prop_assume!(y.value().data().iter().any(|y| *y != 0.0));
        holds(&[x, w], op)?;
    }

    #[test]
    fn pooling_of_any_geometry(
        size in pair(1, 9), kernel in 1usize..=4, stride in 1usize..=5, padding in 0usize..=2, channels in 1usize..=3,
    ) {
        prop_assume!(2 * padding <= kernel && size[0].min(size[1]) + 2 * padding >= kernel);
        let x = [distinct([2, size[0], size[1], channels], 1)];
        holds(&x, |v| v[0].max_pool2d(kernel, stride, padding))?;
        if size[0].min(size[1]) >= kernel {
            holds(&x, |v| v[0].avg_pool2d(kernel, stride))?;
        }
    }

    #[test]
    fn resizing_between_any_sizes(from in pair(1, 7), to in pair(1, 9), align in any::<bool>()) {
        holds(&[distinct([1, from[0], from[1], 2], 1)], |v| v[0].resize_bilinear(to[0], to[1], align))?;
    }

    #[test]
    fn broadcasting_of_any_two_shapes(
        dims in prop::collection::vec(0usize..=3, 0..=5), left in any::<u8>(), right in any::<u8>(), cut in 0usize..=5,
    ) {
        let stretched = |mask: u8| -> Vec<usize> {
            dims.iter().enumerate().map(|(i, &d)| if mask >> i & 1 == 1 { 1 } else { d }).collect()
        };
        let (a, b) = (stretched(left), stretched(right));
        let b = b[cut.min(b.len())..].to_vec();
        let divisor = distinct(&b, 2).map(|x| 1.5 + 0.4 * x);
        for f in [|v: &[V]| &v[0] + &v[1], |v: &[V]| &v[0] * &v[1], |v: &[V]| &v[0] / &v[1]] {
            holds(&[distinct(&a, 1).map(|x| x + 2.0), divisor.clone()], f)?;
        }
    }

    #[test]
    fn reductions_of_any_dimensions(dims in prop::collection::vec(1usize..=3, 0..=5), at in any::<(usize, usize)>()) {
        let first = at.0 % (dims.len() + 1);
        let count = at.1 % (dims.len() - first + 1);
        let x = [distinct(&dims, 1).map(|x| x + 1.7)];
        holds(&x, |v| v[0].sum(first, count).square())?;
        holds(&x, |v| v[0].mean(first, count).square())?;
        holds(&x, |v| v[0].max(first, count)[0].clone())?;
        holds(&x, |v| v[0].min(first, count)[0].clone())?;
        holds(&x, |v| v[0].prod(first, count))?;
        holds(&x, |v| v[0].norm(first, count))?;
    }

    #[test]
    fn indices_in_any_order(index in prop::collection::vec(0usize..4, 0..=7), axis in 0usize..3) {
        let dims = [4, 4, 4];
        let chosen = Tensor::from_vec([index.len()], index.iter().map(|&i| i as f64).collect());
        let tape = Tape::new();
        let x = tape.leaf(distinct(dims, 1));
        let y = x.index_select(axis, &Var::constant(chosen));
        let found = tape.backward(&[(&y, Tensor::full(*y.shape(), 1.0))]);
        let found = found.get(&x).expect("a gradient");
        // Every element gets as many as its index was chosen.
        for (k, &g) in found.data().iter().enumerate() {
            let i = k / [16, 4, 1][axis] % 4;
            prop_assert_eq!(g, index.iter().filter(|&&j| j == i).count() as f64);
        }
    }

    #[test]
    fn reflected_borders_of_any_width(size in pair(2, 5), pad in [0usize..=4, 0..=4, 0..=4, 0..=4]) {
        prop_assume!(pad[0].max(pad[1]) < size[1] && pad[2].max(pad[3]) < size[0]);
        holds(&[distinct([1, size[0], size[1], 2], 1)], |v| v[0].reflect_pad(pad))?;
    }

    #[test]
    fn places_on_and_beyond_the_border(x in -2.5f64..2.5, y in -2.5f64..2.5, align in any::<bool>(), size in pair(1, 4)) {
        use parallax::ops::image::grid_sample::GridPadding;
        let grid = Tensor::from_vec([1, 1, 1, 2], vec![x, y]);
        for padding in [GridPadding::Zeros, GridPadding::Border, GridPadding::Reflection] {
            let image = distinct([1, size[0], size[1], 1], 1);
            let options = Options { kinks: Kinks::Any, ignored: vec![0, 1], ..Options::default() };
            let report = check(|v| vec![v[0].grid_sample(&v[1], padding, align)], &[image, grid.clone()], &options);
            let nothing = report.failure().is_some_and(|why| why.starts_with("every gradient is zero"));
            prop_assert!(report.failure().is_none() || nothing, "{:?}: {}", padding, report);
        }
    }
}

/// The condition of one output: how far it moves when every input moves by a relative rounding error of one.
fn condition(case: &dyn AnyCase, inputs: &[Tensor<f64>], output: usize, element: usize) -> f64 {
    let tape = Tape::new();
    let vars: Vec<V> = inputs.iter().map(|x| tape.leaf(x.clone())).collect();
    let y = case.run(&vars.iter().collect::<Vec<_>>()).swap_remove(output);
    let mut hot = Tensor::zeros(*y.shape());
    hot.data_mut()[element] = 1.0;
    let gradients = tape.backward(&[(&y, hot)]);
    let terms = |(v, x): (&V, &Tensor<f64>)| {
        gradients.get(v).map_or(0.0, |g| g.data().iter().zip(x.data()).map(|(g, x)| (g * x).abs()).sum())
    };
    vars.iter().zip(inputs).map(terms).sum::<f64>() + y.value().data()[element].abs()
}

/// Every op in f32 against f64 with its innermost extent from 1 to 67, which covers every remainder of a vector of 4, 8
/// or 16 lanes and more than one whole one. The error allowed is the op's own condition times some roundings.
#[test]
fn single_precision_follows_over_every_vector_remainder() {
    let mut lengths: BTreeMap<&str, usize> = BTreeMap::new();
    let mut worst: BTreeMap<&str, f64> = BTreeMap::new();
    let mut failures = Vec::new();
    for entry in registry::all() {
        let mut paths = BTreeMap::new();
        for case in entry.cases() {
            *paths.entry(case.algo()).or_insert(0) += 1;
            // A few cases of each kernel path.
            if paths[case.algo()] > 3 || case.flat() {
                continue;
            }
            let sources = 0..case.inputs().len();
            for (n, source) in (1..=67).flat_map(|n| sources.clone().map(move |source| (n, source))) {
                let Some(inputs) = widened(case.as_ref(), source, n) else { continue };
                *lengths.entry(entry.name).or_default() += 1;
                let single: Vec<Var<f32>> = inputs.iter().map(|x| Var::constant(x.cast())).collect();
                let found = case.run_f32(&single.iter().collect::<Vec<_>>());
                let double: Vec<V> = inputs.iter().cloned().map(Var::constant).collect();
                let exact = case.run(&double.iter().collect::<Vec<_>>());
                for o in 0..exact.len() - case.auxiliary() {
                    let (found, exact) = (found[o].value().data(), exact[o].value().data());
                    // The last elements are those of the remainder; one in the middle stands for the others.
                    for k in [exact.len().wrapping_sub(1), exact.len().wrapping_sub(2), exact.len() / 2] {
                        let Some(&y) = exact.get(k).filter(|y| y.is_finite()) else { continue };
                        let own = condition(case.as_ref(), &inputs, o, k);
                        let own = if LOOSE.iter().any(|(op, _)| *op == entry.name) { own.max(1.0) } else { own };
                        let allowed = f64::from(f32::EPSILON) * own.max(1e-30);
                        let roundings = (f64::from(found[k]) - y).abs() / allowed;
                        let most = worst.entry(entry.name).or_default();
                        *most = most.max(roundings);
                        if roundings.is_nan() || roundings > ROUNDINGS {
                            failures.push(format!(
                                "{} [{}] \"{}\", extent {n}, element {k}: {} for {y}, {roundings:.1} roundings",
                                case.op(),
                                case.algo(),
                                case.name(),
                                found[k]
                            ));
                        }
                    }
                }
            }
        }
    }
    for (op, count) in &lengths {
        println!("{op:28} {count:4} sizes, at most {:6.2} roundings", worst.get(op).copied().unwrap_or(0.0));
    }
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
    for entry in registry::all() {
        let (count, fixed) = (lengths.get(entry.name).copied().unwrap_or(0), FIXED.iter().any(|f| f.0 == entry.name));
        // Indices and choices that are given do not fit the smallest extents.
        assert!((count < 65) == fixed, "{} was widened to {count} sizes", entry.name);
    }
}

/// Ops that cannot be widened to every extent, and why.
const FIXED: [(&str, &str); 5] = [
    ("axis_angle_to_rotation", "three numbers"),
    ("pose_matrix", "three numbers"),
    ("cross", "three numbers"),
    ("reshape", "moves nothing"),
    ("conv_relative_position", "three inputs widen together by the same factor: its cases have several widths"),
];

/// Ops whose error is in units of 1, and why.
const LOOSE: [(&str, &str); 1] =
    [("gelu", "the distribution function is 1 + erf: below -3 little is left of it, and the roundings of 1 stay")];

/// The error of an output in f32, in units of its condition times the machine epsilon.
const ROUNDINGS: f64 = 16.0;

/// The inputs of a case with the innermost extent of one of them changed to `n` wherever it occurs as an innermost one
/// (channels in of the first, channels out of the weights), rounded to f32; `None` if the op does not take them.
fn widened(case: &dyn AnyCase, source: usize, n: usize) -> Option<Vec<Tensor<f64>>> {
    let first = case.inputs()[source].shape;
    if case.inputs()[..source].iter().any(|input| input.shape.last() == first.last()) {
        // Another input has been the source of the same change.
        return None;
    }
    let given = |input: &Input| matches!(input.fill, Fill::Values(_));
    if n < first.last() && case.inputs().iter().any(|input| given(input) && input.constant.is_some()) {
        // Indices would point outside.
        return None;
    }
    let mut inputs = case.inputs().to_vec();
    for input in &mut inputs {
        let rank = input.shape.rank();
        if rank > 0 && input.shape.last() == first.last() {
            input.shape = input.shape.with(rank - 1, n);
            // Given numbers are given again and again.
            if let Fill::Values(values) = &mut input.fill {
                if values.is_empty() || case.kinks() > 0 || values.iter().any(|x| !x.is_finite()) {
                    return None;
                }
                *values = values.iter().copied().cycle().take(input.shape.len()).collect();
            }
        }
    }
    let shapes: Vec<Shape> = inputs.iter().map(|i| i.shape).collect();
    case.outputs(&shapes).ok()?;
    let mut random = Random::new(n as u64, 0xF32);
    let drawn = inputs.iter().map(|i| i.draw(&mut random));
    Some(drawn.map(|x| x.cast::<f32>().cast()).collect())
}

/// What the inputs of a case are drawn from does not depend on when: the suite compares runs bit by bit.
#[test]
fn cases_draw_the_same_numbers_every_time() {
    for case in registry::all().iter().flat_map(|e| e.cases()) {
        for (a, b) in draw(case.as_ref(), 3).iter().zip(&draw(case.as_ref(), 3)) {
            assert!(a.same_bits(b), "{}", case.op());
        }
    }
}
