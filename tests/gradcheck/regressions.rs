//! Regressions: gradients that were wrong in public libraries, each with the input that exposed it.
//!
//! A test is named after the report. `holds` compares with finite differences, `gradients` are for cotangents of one.

use parallax::gradcheck::{Kinks, Options, check};
use parallax::ops::Conv2d;
use parallax::ops::conv::transpose::ConvTranspose2d;
use parallax::ops::image::grid_sample::GridPadding;
use parallax::ops::normalise::batch_norm::Activation;
use parallax::optim::clip_norm;
use parallax::random::Random;
use parallax::tensor::{Shape, Tape, Tensor, Var};

use crate::catalogue::Regression;

type V = Var<f64>;

/// Numbers in [-1, 1], drawn for the shape.
fn random(shape: impl Into<Shape>) -> Tensor<f64> {
    let shape = shape.into();
    let mut random = Random::new(shape.len() as u64, 0x2E6);
    Tensor::build(shape, |out| out.iter_mut().for_each(|x| *x = random.uniform(-1.0, 1.0)))
}

fn values<const N: usize>(values: [f64; N]) -> Tensor<f64> {
    Tensor::from_vec([N], values.to_vec())
}

fn constant(x: &Tensor<f64>) -> V {
    Var::constant(x.clone())
}

/// The gradients agree with finite differences.
#[track_caller]
fn holds(inputs: &[Tensor<f64>], f: impl Fn(&[V]) -> V) {
    holds_with(&Options::default(), inputs, f);
}

#[track_caller]
fn holds_with(options: &Options, inputs: &[Tensor<f64>], f: impl Fn(&[V]) -> V) {
    let report = check(|v| vec![f(v)], inputs, options);
    assert!(report.failure().is_none(), "{report}");
}

/// Kinks and ties are held between their sides, and in sum.
#[track_caller]
fn holds_at_kinks(inputs: &[Tensor<f64>], f: impl Fn(&[V]) -> V) {
    holds_with(&Options { kinks: Kinks::Any, ..Options::default() }, inputs, f);
}

/// The gradients of the sum of an output.
fn gradients(inputs: &[Tensor<f64>], f: impl Fn(&[V]) -> V) -> Vec<Vec<f64>> {
    let tape = Tape::new();
    let vars: Vec<V> = inputs.iter().map(|x| tape.leaf(x.clone())).collect();
    let y = f(&vars);
    let all = tape.backward(&[(&y, Tensor::full(*y.shape(), 1.0))]);
    vars.iter().map(|v| all.get(v).map_or_else(Vec::new, |g| g.data().to_vec())).collect()
}

#[track_caller]
fn finite(inputs: &[Tensor<f64>], f: impl Fn(&[V]) -> V) -> Vec<Vec<f64>> {
    let found = gradients(inputs, f);
    assert!(found.iter().flatten().all(|g| g.is_finite()), "{found:?}");
    found
}

macro_rules! regressions {
    ($($row:literal $test:ident, $op:literal, $bug:literal, $link:literal: $body:block)*) => {
        $(#[doc = $bug] #[doc = ""] #[doc = concat!("<", $link, ">")] #[test] fn $test() $body)*

        /// All of them, for the catalogue.
        pub const REGRESSIONS: &[Regression] = &[
            $(Regression { row: $row, test: stringify!($test), op: $op, bug: $bug, link: $link }),*
        ];
    };
}

regressions! {
    1 candle_3507_upsample_overwrites, "upsample_nearest",
    "candle: overwrites the gradient of another use",
    "https://github.com/huggingface/candle/pull/3507": {
        holds(&[random([1, 2, 3, 2])], |v| v[0].upsample_nearest(2).sum_all() * v[0].square().sum_all());
    }

    2 candle_max_pool2d_scaled_by_the_mask, "max_pool2d",
    "candle: a unique maximum gets a quarter, four tied ones four times too much",
    "https://github.com/huggingface/candle/blob/main/candle-core/src/backprop.rs": {
        let x = Tensor::from_vec([1, 2, 2, 1], vec![1.0, 4.0, 2.0, 3.0]);
        assert_eq!(gradients(&[x], |v| v[0].max_pool2d(2, 2, 0))[0], [0.0, 1.0, 0.0, 0.0]);
        let tie = Tensor::full([1, 2, 2, 1], 1.0);
        assert_eq!(gradients(&[tie], |v| v[0].max_pool2d(2, 2, 0))[0].iter().sum::<f64>(), 1.0);
    }

    3 candle_max_and_min_give_all_to_every_tied_element, "max, min",
    "candle: every tied element gets the whole gradient",
    "https://github.com/huggingface/candle/blob/main/candle-core/src/backprop.rs": {
        for ties in [2, 3, 4] {
            let x = [Tensor::full([ties], 0.0)];
            for f in [|v: &[V]| v[0].max(0, 1)[0].clone(), |v: &[V]| v[0].min(0, 1)[0].clone()] {
                assert_eq!(gradients(&x, f)[0].iter().sum::<f64>(), 1.0);
                holds_at_kinks(&x, f);
            }
        }
    }

    4 candle_211_div_and_sqrt, "div, sqrt",
    "candle: the sign of the divisor, and the argument in place of the root",
    "https://github.com/huggingface/candle/pull/211": {
        holds(&[random([3]), values([1.5, -2.0, 0.7])], |v| &v[0] / &v[1]);
        holds(&[values([0.25, 4.0])], |v| v[0].sqrt());
    }

    5 candle_534_minimum_and_maximum_of_two, "minimum, maximum",
    "candle: the second operand subtracted, ties counted twice",
    "https://github.com/huggingface/candle/pull/534": {
        let (a, b) = (values([1.0, 2.0, 3.0]), values([2.0, 1.0, 3.0]));
        assert_eq!(gradients(&[a.clone(), b.clone()], |v| v[0].maximum(&v[1])), [[0.0, 1.0, 0.5], [1.0, 0.0, 0.5]]);
        assert_eq!(gradients(&[a, b], |v| v[0].minimum(&v[1])), [[1.0, 0.0, 0.5], [0.0, 1.0, 0.5]]);
    }

    6 candle_1212_conv2d_weight_larger_than_the_kernel, "conv2d",
    "candle: a weight gradient of the wrong size where the stride leaves a rest",
    "https://github.com/huggingface/candle/issues/1212": {
        let op = Conv2d::padded(3).strided(2);
        holds(&[random([1, 8, 10, 2]), random([7, 7, 2, 1])], |v| v[0].conv2d(&v[1], None, op));
    }

    7 candle_2083_silu_at_zero, "silu",
    "candle: 0/0 at 0",
    "https://github.com/huggingface/candle/pull/2083": {
        assert_eq!(gradients(&[values([0.0])], |v| v[0].silu()), [[0.5]]);
        holds(&[values([0.0, -1.0, 2.0])], |v| v[0].silu());
    }

    8 candle_2114_sigmoid_far_below, "sigmoid",
    "candle: NaN for large negative arguments",
    "https://github.com/huggingface/candle/pull/2114": {
        finite(&[values([-100.0, -800.0, -1e300])], |v| v[0].sigmoid());
    }

    9 candle_2328_elu_far_above, "elu",
    "candle: zero times the exponential of a large number",
    "https://github.com/huggingface/candle/pull/2328": {
        assert_eq!(finite(&[values([100.0, 800.0])], |v| v[0].elu()), [[1.0, 1.0]]);
    }

    10 candle_2337_conv_transpose2d_stride_for_dilation, "conv_transpose2d",
    "candle: stride and dilation swapped",
    "https://github.com/huggingface/candle/pull/2337": {
        let op = ConvTranspose2d { stride: [2, 3], ..ConvTranspose2d::default() };
        holds(&[random([1, 3, 2, 2]), random([2, 3, 3, 2])], |v| v[0].conv_transpose2d(&v[1], None, op));
    }

    11 candle_3735_conv2d_of_a_permuted_weight, "conv2d",
    "candle: a wrong offset into weights that are a view",
    "https://github.com/huggingface/candle/issues/3735": {
        let weight = |w: &V| w.slice(0, 1..3).permute(&[1, 2, 3, 0]);
        holds(&[random([1, 4, 4, 2]), random([4, 3, 3, 2])], |v| v[0].conv2d(&weight(&v[1]), None, Conv2d::padded(1)));
    }

    12 candle_3756_matmul_of_nothing, "matmul",
    "candle: matrices without rows, columns or depth",
    "https://github.com/huggingface/candle/pull/3756": {
        for [m, k, n] in [[0, 2, 3], [2, 0, 3], [2, 3, 0]] {
            let found = gradients(&[random([m, k]), random([k, n])], |v| v[0].matmul(&v[1]));
            assert_eq!((found[0].len(), found[1].len()), (m * k, k * n));
            assert!(found.iter().flatten().all(|g| *g == 0.0));
        }
    }

    13 burn_181_broadcast_dimensions_not_summed, "add, sub, mul, div",
    "burn: the gradient of a stretched operand keeps the stretched shape",
    "https://github.com/tracel-ai/burn/issues/181": {
        let (a, b) = (random([2, 1]), values([1.5, 2.0, -1.2]).reshape([1, 3]));
        holds(&[a.clone(), b.clone()], |v| &v[0] + &v[1]);
        holds(&[a.clone(), b.clone()], |v| &v[0] * &v[1]);
        holds(&[a, b], |v| &v[0] / &v[1]);
    }

    14 burn_248_conv_bias_ignores_upstream, "conv2d",
    "burn: the bias gets a constant, whatever the loss",
    "https://github.com/tracel-ai/burn/pull/248": {
        let inputs = [random([2, 3, 4, 1]), random([3, 3, 1, 2]), random([2])];
        holds(&inputs, |v| v[0].conv2d(&v[1], Some(&v[2]), Conv2d::padded(1)).square());
    }

    15 burn_402_concat_along_an_inner_axis, "concat",
    "burn: wrong along any but the first dimension",
    "https://github.com/tracel-ai/burn/pull/402": {
        holds(&[random([2, 3, 2]), random([2, 1, 2])], |v| Var::concat(&[&v[0], &v[1]], 1));
    }

    16 burn_4069_concat_with_constants, "concat",
    "burn: parts misaligned where some are not tracked",
    "https://github.com/tracel-ai/burn/pull/4069": {
        let still = random([2, 2]);
        holds(&[random([2, 1]), random([2, 3])], |v| Var::concat(&[&v[0], &constant(&still), &v[1]], 1));
    }

    17 burn_1140_sigmoid_at_minus_90, "sigmoid",
    "burn: NaN at -90",
    "https://github.com/tracel-ai/burn/pull/1140": {
        let found = finite(&[values([-90.0])], |v| v[0].sigmoid());
        assert!(found[0][0] >= 0.0 && found[0][0] < 1e-38);
    }

    18 burn_1225_pow_with_one_side_tracked, "pow",
    "burn: nothing saved where base or exponent is constant",
    "https://github.com/tracel-ai/burn/pull/1225": {
        let (base, exponent) = (values([0.5, 2.0, 3.0]), values([2.0, -1.5, 0.5]));
        holds(std::slice::from_ref(&base), |v| v[0].pow(&constant(&exponent)));
        holds(std::slice::from_ref(&exponent), |v| constant(&base).pow(&v[0]));
        holds(&[base.clone(), exponent.clone()], |v| v[0].pow(&v[1]));
    }

    19 burn_2249_abs_at_zero, "abs",
    "burn: x over its absolute value",
    "https://github.com/tracel-ai/burn/pull/2249": {
        assert_eq!(gradients(&[values([0.0, -0.0, -2.0])], |v| v[0].abs()), [[0.0, 0.0, -1.0]]);
    }

    20 burn_2777_repeat_of_more_than_one, "repeat",
    "burn: sums the whole dimension, not the repeats",
    "https://github.com/tracel-ai/burn/pull/2777": {
        holds(&[random([2, 3, 2])], |v| v[0].repeat(1, 4).square());
    }

    21 burn_3521_conv2d_groups_modulo, "conv2d",
    "burn: the group of an output channel taken modulo groups",
    "https://github.com/tracel-ai/burn/pull/3521": {
        let op = Conv2d { groups: 2, ..Conv2d::padded(1) };
        holds(&[random([1, 3, 4, 4]), random([3, 3, 2, 6])], |v| v[0].conv2d(&v[1], None, op));
    }

    22 burn_3555_scattered_on_the_last_axis, "max, min, sort, top_k",
    "burn: the gradient of an inner axis lands on the last",
    "https://github.com/tracel-ai/burn/pull/3555": {
        let x = [random([3, 2, 4])];
        for axis in 0..3 {
            holds(&x, |v| v[0].max(axis, 1)[0].clone());
            holds(&x, |v| v[0].min(axis, 1)[0].clone());
            holds(&x, |v| v[0].sort(axis, true)[0].square());
            holds(&x, |v| v[0].top_k(axis, 2, false)[0].square());
        }
    }

    23 burn_4063_scatter_of_other_sizes, "scatter_add",
    "burn: the gradient of the values, with three different sizes",
    "https://github.com/tracel-ai/burn/issues/4063": {
        let index = Tensor::from_vec([2, 2], vec![3.0, 0.0, 0.0, 3.0]);
        let options = Options { kinks: Kinks::Any, ..Options::default() };
        holds_with(&options, &[random([4, 3]), random([2, 2])], |v| {
            v[0].scatter_add(0, &constant(&index), &v[1]).square()
        });
    }

    24 burn_4069_cross_product_sign, "cross",
    "burn: operands in the wrong order for the second gradient",
    "https://github.com/tracel-ai/burn/pull/4069": {
        holds(&[random([2, 3]), values([0.3, -0.8, 0.5, 0.9, 0.1, -0.4]).reshape([2, 3])], |v| v[0].cross(&v[1]));
    }

    25 burn_4466_one_dilation_for_both_directions, "conv2d",
    "burn: a pooling window dilated in one direction only",
    "https://github.com/tracel-ai/burn/pull/4466": {
        // Pooling windows are not dilated here; convolutions are.
        let op = Conv2d { dilation: [1, 2], ..Conv2d::default() };
        holds(&[random([1, 4, 6, 1]), random([2, 3, 1, 2])], |v| v[0].conv2d(&v[1], None, op));
    }

    26 burn_4806_conv_tail_of_1603, "conv2d",
    "burn: the tail of a strided input gets no gradient",
    "https://github.com/tracel-ai/burn/pull/4806": {
        let op = Conv2d { stride: [1, 4], ..Conv2d::default() };
        let found = gradients(&[random([1, 1, 1603, 1]), Tensor::full([1, 4, 1, 1], 1.0)], |v| v[0].conv2d(&v[1], None, op));
        assert!(found[0][..1600].iter().all(|g| *g == 1.0) && found[0][1600..] == [0.0; 3]);
    }

    27 burn_4916_conv_transpose2d_output_padding, "conv_transpose2d",
    "burn: an input gradient of the wrong size",
    "https://github.com/tracel-ai/burn/pull/4916": {
        let op = ConvTranspose2d { stride: [2, 3], output_padding: [1, 2], padding: [1, 0], ..ConvTranspose2d::default() };
        holds(&[random([1, 2, 3, 1]), random([3, 2, 2, 1])], |v| v[0].conv_transpose2d(&v[1], None, op));
    }

    28 burn_4591_pointwise_conv2d_of_a_slice, "conv2d",
    "burn: strided channels taken for contiguous ones where the image is a pixel",
    "https://github.com/tracel-ai/burn/pull/4591": {
        holds(&[random([2, 1, 1, 5]), random([1, 1, 3, 2])], |v| {
            v[0].slice(3, 1..4).conv2d(&v[1], None, Conv2d::default())
        });
    }

    29 burn_3864_cumprod_with_a_zero, "cumprod",
    "burn: divides by the input",
    "https://github.com/tracel-ai/burn/issues/3864": {
        for x in [values([2.0, 0.0, 3.0, -1.5]), values([0.0, 2.0, 0.0, 3.0])] {
            holds(&[x], |v| v[0].cumprod(0));
        }
    }

    30 burn_5533_prod_with_zeros, "prod",
    "burn: divides by the input",
    "https://github.com/tracel-ai/burn/issues/5533": {
        assert_eq!(gradients(&[values([2.0, 0.0, 3.0])], |v| v[0].prod_all()), [[0.0, 6.0, 0.0]]);
        assert_eq!(gradients(&[values([2.0, 0.0, 0.0])], |v| v[0].prod_all()), [[0.0; 3]]);
    }

    31 burn_5604_avg_pool2d_with_a_rest, "avg_pool2d",
    "burn: forward divides by the clipped window, backward by the whole",
    "https://github.com/tracel-ai/burn/issues/5604": {
        let found = gradients(&[random([1, 2, 5, 1])], |v| v[0].avg_pool2d(2, 2));
        assert_eq!(found[0], [0.25, 0.25, 0.25, 0.25, 0.0, 0.25, 0.25, 0.25, 0.25, 0.0]);
    }

    32 burn_1739_scatter_with_repeated_indices, "scatter_add, index_select",
    "burn: both gradients wrong where an index repeats",
    "https://github.com/tracel-ai/burn/pull/1739": {
        let index = values([1.0, 1.0, 0.0]);
        holds(&[random([3]), values([0.4, -0.2, 0.9])], |v| v[0].scatter_add(0, &constant(&index), &v[1]).square());
        holds(&[random([2, 2])], |v| v[0].index_select(0, &constant(&index)).square());
    }

    33 burn_695_second_backward_pass, "tape",
    "burn: the second backward pass adds to the first",
    "https://github.com/tracel-ai/burn/pull/695": {
        let x = values([3.0]);
        assert_eq!(gradients(std::slice::from_ref(&x), |v| v[0].square()), [[6.0]]);
        assert_eq!(gradients(std::slice::from_ref(&x), |v| v[0].square()), [[6.0]]);
        // One tape is reversed once: what it saved is gone.
        let tape = Tape::new();
        let y = tape.leaf(x).square();
        y.backward();
        assert!(std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| y.backward())).is_err());
    }

    34 burn_2186_layer_norm_eps_outside_the_root, "layer_norm",
    "burn: eps added to the deviation, not to the variance",
    "https://github.com/tracel-ai/burn/pull/2186": {
        let (x, one, zero) = (values([0.1, -0.1]), Tensor::full([2], 1.0), Tensor::zeros([2]));
        let y = constant(&x).layer_norm(&constant(&one), &constant(&zero), 0.5).into_value();
        assert!((y.data()[0] - 0.1 / (0.01f64 + 0.5).sqrt()).abs() < 1e-12);
        holds(&[x, one, values([0.5, -0.5])], |v| v[0].layer_norm(&v[1], &v[2], 0.5));
    }

    36 dfdx_380_signed_zeros_tie, "max",
    "dfdx: -0 and 0 compared by their bits",
    "https://github.com/coreylowman/dfdx/pull/380": {
        for x in [values([-0.0, 0.0]), values([0.0, -0.0])] {
            assert_eq!(gradients(std::slice::from_ref(&x), |v| v[0].max(0, 1)[0].clone()), [[1.0, 0.0]]);
            holds_at_kinks(&[x], |v| v[0].max(0, 1)[0].clone());
        }
    }

    37 dfdx_658_conv_transpose2d_stride, "conv_transpose2d",
    "dfdx: the stride of the patches",
    "https://github.com/coreylowman/dfdx/pull/658": {
        let op = ConvTranspose2d { stride: [2, 2], padding: [1, 1], ..ConvTranspose2d::default() };
        holds(&[random([2, 3, 4, 2]), random([3, 3, 3, 2])], |v| v[0].conv_transpose2d(&v[1], None, op));
    }

    39 pytorch_2421_norm_of_zero, "norm, axis_angle_to_rotation",
    "PyTorch: NaN at the zero vector",
    "https://github.com/pytorch/pytorch/issues/2421": {
        assert_eq!(gradients(&[Tensor::zeros([3])], |v| v[0].norm(0, 1)), [[0.0; 3]]);
        // Where poses start: the rotation by no angle.
        holds(&[Tensor::zeros([2, 3])], |v| v[0].axis_angle_to_rotation());
    }

    40 pytorch_3264_normalize_zeros, "l2_normalize",
    "PyTorch: NaN for a vector of zeros",
    "https://github.com/pytorch/pytorch/issues/3264": {
        finite(&[Tensor::zeros([2, 3])], |v| v[0].l2_normalize(1e-12));
    }

    41 pytorch_4320_std_of_a_constant, "std",
    "PyTorch: NaN where nothing varies",
    "https://github.com/pytorch/pytorch/issues/4320": {
        assert_eq!(finite(&[Tensor::full([4], 2.5)], |v| v[0].std(0, 1, 1)), [[0.0; 4]]);
    }

    42 pytorch_27134_pow_of_zero, "pow",
    "PyTorch: the derivative by the exponent is NaN at base 0",
    "https://github.com/pytorch/pytorch/issues/27134": {
        let found = finite(&[values([0.0, 0.0]), values([2.0, 1.0])], |v| v[0].pow(&v[1]));
        assert_eq!(found, [[0.0, 1.0], [0.0, 0.0]]);
    }

    43 pytorch_773_prod_with_a_zero, "prod",
    "PyTorch: NaN, later a wrong shape",
    "https://github.com/pytorch/pytorch/issues/773": {
        assert_eq!(gradients(&[Tensor::zeros([1])], |v| v[0].prod_all()), [[1.0]]);
        holds(&[values([0.0, 2.0, 0.5, -1.0]).reshape([2, 2])], |v| v[0].prod(0, 1));
        holds(&[values([0.0, 2.0, 0.5, -1.0]).reshape([2, 2])], |v| v[0].prod(1, 1));
    }

    44 pytorch_23925_grid_sample_on_the_border, "grid_sample",
    "PyTorch: the gradient of zero padding at the last pixel",
    "https://github.com/pytorch/pytorch/issues/23925": {
        let x = Tensor::from_vec([1, 1, 3, 1], vec![1.0, 4.0, 8.0]);
        let grid = Tensor::from_vec([1, 1, 2, 2], vec![1.0, 0.0, -1.0, 0.0]);
        for padding in [GridPadding::Border, GridPadding::Reflection] {
            let found = gradients(&[x.clone(), grid.clone()], |v| v[0].grid_sample(&v[1], padding, true));
            assert_eq!(found[1], [0.0; 4], "{padding:?}: held at the border, as documented");
        }
    }

    45 pytorch_42616_grid_sample_far_away, "grid_sample",
    "PyTorch: a crash at infinite coordinates",
    "https://github.com/pytorch/pytorch/issues/42616": {
        let far = [f64::INFINITY, f64::NEG_INFINITY, 2.5e38, -2.5e38];
        for size in [[1, 1, 1, 1], [1, 1, 4, 1], [1, 4, 1, 1]] {
            for padding in [GridPadding::Zeros, GridPadding::Border] {
                for align in [false, true] {
                    let grid = Tensor::from_vec([1, 2, 1, 2], far.to_vec());
                    finite(&[random(size), grid], |v| v[0].grid_sample(&v[1], padding, align));
                }
            }
        }
    }

    46 pytorch_1631_gather_repeated, "gather, index_select",
    "PyTorch: the last of several equal indices wins",
    "https://github.com/pytorch/pytorch/issues/1631": {
        let index = Tensor::from_vec([2, 3], vec![0.0, 0.0, 1.0, 1.0, 1.0, 1.0]);
        let found = gradients(&[random([2, 2])], |v| v[0].gather(1, &constant(&index)));
        assert_eq!(found, [[2.0, 1.0, 0.0, 3.0]]);
    }

    47 pytorch_188843_scatter_index_smaller_than_the_values, "scatter_add",
    "PyTorch: values that the index does not reach get a gradient",
    "https://github.com/pytorch/pytorch/pull/188843": {
        let index = Tensor::from_vec([1, 2], vec![2.0, 0.0]);
        let found = gradients(&[random([3, 2]), random([2, 2])], |v| v[0].scatter_add(0, &constant(&index), &v[1]));
        assert_eq!(found[1], [1.0, 1.0, 0.0, 0.0]);
    }

    48 pytorch_56734_maximum_at_equality, "maximum",
    "PyTorch: not split between equal operands",
    "https://github.com/pytorch/pytorch/issues/56734": {
        let x = values([1.0]);
        assert_eq!(gradients(&[x.clone(), x.clone()], |v| v[0].maximum(&v[1])), [[0.5], [0.5]]);
        assert_eq!(gradients(&[x], |v| v[0].maximum(&v[0])), [[1.0]]);
    }

    49 pytorch_147801_hardswish_at_three, "hardswish",
    "PyTorch: the middle piece reaches one point too far",
    "https://github.com/pytorch/pytorch/issues/147801": {
        assert_eq!(gradients(&[values([-3.0, 3.0])], |v| v[0].hardswish()), [[0.0, 1.0]]);
        holds(&[values([-3.001, -2.999, 2.999, 3.001])], |v| v[0].hardswish());
    }

    50 pytorch_51408_hardsigmoid_below, "hardsigmoid",
    "PyTorch: a slope where it is flat",
    "https://github.com/pytorch/pytorch/issues/51408": {
        assert_eq!(gradients(&[values([-3.5, -100.0, 3.5])], |v| v[0].hardsigmoid()), [[0.0; 3]]);
    }

    51 pytorch_25101_conv2d_five_by_three, "conv2d",
    "PyTorch (oneDNN): input gradient with window 5, stride 3, padding 1 on 32x32",
    "https://github.com/pytorch/pytorch/issues/25101": {
        let op = Conv2d::padded(1).strided(3);
        let options = Options { directions: Some(40), ..Options::default() };
        holds_with(&options, &[random([1, 32, 32, 1]), random([5, 5, 1, 2])], |v| v[0].conv2d(&v[1], None, op));
    }

    52 pytorch_16018_conv2d_of_an_expanded_weight_in_f32, "conv2d",
    "PyTorch (oneDNN): wrong with an expanded weight, and in f32 alone",
    "https://github.com/pytorch/pytorch/issues/16018": {
        let (x, w) = (random([1, 4, 5, 2]), random([1, 1, 2, 3]));
        let f64s = gradients(&[x.clone(), w.clone()], |v| v[0].conv2d(&v[1].repeat(0, 3), None, Conv2d::default()));
        let tape = Tape::<f32>::new();
        let (x, w) = (tape.leaf(x.cast()), tape.leaf(w.cast()));
        let found = x.conv2d(&w.repeat(0, 3), None, Conv2d::default()).sum_all().backward();
        for (v, exact) in [(&x, &f64s[0]), (&w, &f64s[1])] {
            let found = found.get(v).expect("a gradient").data();
            assert!(found.iter().zip(exact).all(|(a, b)| (*a as f64 - b).abs() < 1e-5), "{found:?} {exact:?}");
        }
    }

    53 pytorch_708_conv2d_with_a_sliced_cotangent, "conv2d",
    "PyTorch: an upstream gradient that is a view",
    "https://github.com/pytorch/pytorch/pull/708": {
        holds(&[random([2, 4, 5, 2]), random([3, 3, 2, 4])], |v| {
            v[0].conv2d(&v[1], None, Conv2d::padded(1)).slice(3, 1..3).permute(&[3, 0, 2, 1])
        });
    }

    56 pytorch_100793_reflect_pad_overlapping, "reflect_pad",
    "PyTorch inductor: wrong where the mirror images overlap",
    "https://github.com/pytorch/pytorch/issues/100793": {
        // Paddings are not negative here: a crop is a slice.
        holds(&[random([1, 7, 4, 1])], |v| v[0].slice(2, 1..4).reflect_pad([2, 0, 6, 6]));
    }

    57 pytorch_36820_max_pool_of_other_height_and_width, "max_pool2d",
    "PyTorch: height and width swapped in a call",
    "https://github.com/pytorch/pytorch/pull/36820": {
        holds(&[random([2, 5, 11, 3])], |v| v[0].max_pool2d(3, 2, 1));
    }

    58 pytorch_97135_resize_by_a_fraction, "resize_bilinear",
    "PyTorch: pixels that were used get no gradient at scale 1.25",
    "https://github.com/pytorch/pytorch/issues/97135": {
        // Nearest neighbours are of whole factors here; the bilinear resize takes any.
        let found = gradients(&[random([1, 4, 4, 1])], |v| v[0].resize_bilinear(5, 5, false));
        assert!(found[0].iter().all(|g| *g > 0.0) && (found[0].iter().sum::<f64>() - 25.0).abs() < 1e-12);
        holds(&[random([1, 4, 4, 1])], |v| v[0].resize_bilinear(5, 5, false));
    }

    59 pytorch_13669_scalar_minus_vector, "sub",
    "PyTorch: a scalar operand counted twice in a trace",
    "https://github.com/pytorch/pytorch/issues/13669": {
        holds(&[random([]), random([5])], |v| (&v[0] - &v[1]).square());
    }

    60 pytorch_68425_where_with_infinities_not_chosen, "select",
    "PyTorch: NaN from the branch that was not chosen",
    "https://github.com/pytorch/pytorch/issues/68425": {
        let choice = values([1.0, 1.0, 0.0]);
        let inputs = [values([0.5, 1.0, -1.0]), values([f64::INFINITY, f64::NAN, 2.0])];
        let found = finite(&inputs, |v| Var::select(&choice, &v[0], &v[1]));
        assert_eq!(found, [[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
        // A function that has no value in the branch not taken needs its argument chosen before.
        let log = |v: &[V]| Var::select(&choice, &v[0], &Var::constant(Tensor::full([3], 1.0))).log();
        finite(&inputs[..1], log);
    }

    65 jax_2140_log_sigmoid_at_zero, "log_sigmoid",
    "JAX: 0 where it is a half",
    "https://github.com/jax-ml/jax/issues/2140": {
        assert_eq!(gradients(&[values([0.0])], |v| v[0].log_sigmoid()), [[0.5]]);
        finite(&[values([-800.0, 800.0])], |v| v[0].log_sigmoid());
    }

    66 jax_7240_conv_of_an_empty_batch, "conv2d",
    "JAX: wrong where a dimension is 0",
    "https://github.com/jax-ml/jax/pull/7240": {
        let found = gradients(&[random([0, 4, 4, 2]), random([3, 3, 2, 3])], |v| v[0].conv2d(&v[1], None, Conv2d::padded(1)));
        assert!(found[0].is_empty() && found[1].len() == 54 && found[1].iter().all(|g| *g == 0.0));
    }

    67 jax_939_norm_of_zero_and_log_sum_exp, "norm, log_sum_exp",
    "JAX: NaN for a row of zeros under fast-math",
    "https://github.com/jax-ml/jax/issues/939": {
        finite(&[Tensor::zeros([2, 3])], |v| v[0].norm(1, 1).log_sum_exp(0));
    }

    68 tensorflow_12071_norm_of_tiny_numbers, "norm",
    "TensorFlow: infinite at 1e-19, where the square underflows",
    "https://github.com/tensorflow/tensorflow/issues/12071": {
        let tape = Tape::<f32>::new();
        for tiny in [1e-19f32, 1e-30] {
            let x = tape.leaf(Tensor::from_vec([2], vec![3.0 * tiny, 4.0 * tiny]));
            assert!((x.norm(0, 1).value().item() / (5.0 * tiny) - 1.0).abs() < 1e-6);
        }
        let x = Tape::new().leaf(Tensor::from_vec([2], vec![3e-19f32, 4e-19]));
        let found = x.norm(0, 1).backward();
        let found = found.get(&x).expect("a gradient").data();
        assert!((found[0] - 0.6).abs() < 1e-6 && (found[1] - 0.8).abs() < 1e-6, "{found:?}");
    }

    69 tensorflow_22048_clip_of_zero_gradients, "optim",
    "TensorFlow: NaN from clipping a gradient of zeros",
    "https://github.com/tensorflow/tensorflow/issues/22048": {
        let mut all = [Some(Tensor::<f64>::zeros([3]))];
        assert_eq!(clip_norm(&mut all, 1.0), 0.0);
        assert_eq!(all[0].as_ref().expect("kept").data(), [0.0; 3]);
    }

    70 tensorflow_3862_cumprod_with_zeros, "cumprod",
    "TensorFlow: NaN after a zero",
    "https://github.com/tensorflow/tensorflow/issues/3862": {
        let x = Tensor::from_vec([2, 3], vec![1.0, 0.0, 2.0, 0.0, 0.0, 3.0]);
        holds_with(&Options { ignored: vec![0], ..Options::default() }, &[x], |v| v[0].cumprod(1));
    }

    71 tensorflow_50400_ssim_of_flat_patches, "ssim_loss",
    "TensorFlow: NaN where nothing varies",
    "https://github.com/tensorflow/tensorflow/issues/50400": {
        let flat = |value| Tensor::full([1, 4, 4, 1], value);
        finite(&[flat(0.5), flat(0.5)], |v| v[0].ssim_loss(&v[1]));
        finite(&[flat(0.0), flat(0.0)], |v| v[0].ssim_loss(&v[1]));
    }

    72 tensorflow_40122_max_pool_of_five_by_five, "max_pool2d",
    "TensorFlow (MKL): a rest and ties together",
    "https://github.com/tensorflow/tensorflow/issues/40122": {
        let x = Tensor::from_vec([1, 5, 5, 1], (0..25).map(|i| f64::from(i % 3)).collect());
        let found = gradients(std::slice::from_ref(&x), |v| v[0].max_pool2d(2, 2, 0));
        assert_eq!(found[0].iter().sum::<f64>(), 4.0);
        holds_at_kinks(&[x], |v| v[0].max_pool2d(2, 2, 0));
    }

    73 mxnet_18563_max_of_equal_numbers, "max",
    "MXNet: one for every tied element",
    "https://github.com/apache/mxnet/issues/18563": {
        let found = gradients(&[Tensor::full([2, 3], 7.0)], |v| v[0].max(0, 2)[0].clone());
        assert_eq!(found, [[1.0, 0.0, 0.0, 0.0, 0.0, 0.0]]);
    }

    74 mxnet_18499_batch_norm_used_twice, "batch_norm",
    "MXNet: scale and shift do not accumulate",
    "https://github.com/apache/mxnet/issues/18499": {
        let normalise = |v: &[V]| v[0].batch_norm(&v[1], &v[2], 1e-3, Activation::None).0;
        holds(&[random([5, 2]), values([0.8, 1.2]), values([0.1, -0.3])], |v| {
            normalise(v) * normalise(&[v[0].square(), v[1].clone(), v[2].clone()])
        });
    }

    75 mxnet_1053_batch_norm_of_few_samples, "batch_norm",
    "MXNet: a term too many, hidden by a large batch",
    "https://github.com/apache/mxnet/issues/1053": {
        for rows in [2, 3] {
            holds(&[random([rows, 2]), values([0.8, 1.2]), values([0.1, -0.3])], |v| {
                v[0].batch_norm(&v[1], &v[2], 1e-2, Activation::None).0
            });
        }
    }

    76 mxnet_18209_batch_norm_in_evaluation, "batch_norm_eval",
    "MXNet: the gradient of evaluation on another device",
    "https://github.com/apache/mxnet/issues/18209": {
        let (mean, variance) = (values([0.2, -0.1]), values([0.5, 2.0]));
        holds(&[random([5, 2]), values([0.8, 1.2]), values([0.1, -0.3])], |v| {
            v[0].batch_norm_eval(&v[1], &v[2], &constant(&mean), &constant(&variance), 1e-3, Activation::None)
        });
    }

    77 mxnet_19817_take_with_repeats, "index_select",
    "MXNet: garbage where an index repeats",
    "https://github.com/apache/mxnet/issues/19817": {
        let index = values([2.0, 0.0, 2.0, 2.0]);
        let found = gradients(&[random([4, 2])], |v| v[0].index_select(0, &constant(&index)));
        assert_eq!(found, [[1.0, 1.0, 0.0, 0.0, 3.0, 3.0, 0.0, 0.0]]);
    }

    78 mxnet_4609_normalisation_with_one_eps, "l2_normalize",
    "MXNet: eps inside the root forward, outside backward",
    "https://github.com/apache/mxnet/pull/4609": {
        holds(&[random([2, 3])], |v| v[0].l2_normalize(0.1));
        holds(&[random([2, 3])], |v| v[0].l2_normalize(10.0));
    }

    79 mlx_3800_conv2d_groups_with_a_stride, "conv2d",
    "MLX: the input gradient of groups with a stride",
    "https://github.com/ml-explore/mlx/pull/3800": {
        let op = Conv2d { groups: 2, stride: [2, 2], ..Conv2d::padded(1) };
        holds(&[random([1, 5, 6, 4]), random([3, 3, 2, 4])], |v| v[0].conv2d(&v[1], None, op));
    }

    80 mlx_2184_conv2d_two_by_two_in_groups, "conv2d",
    "MLX: a weight gradient of the wrong shape",
    "https://github.com/ml-explore/mlx/issues/2184": {
        let op = Conv2d { groups: 2, stride: [2, 2], ..Conv2d::default() };
        for size in [4, 5, 7] {
            holds(&[random([1, size, size, 2]), random([2, 2, 1, 4])], |v| v[0].conv2d(&v[1], None, op));
        }
    }

    81 mlx_4444_slice_of_one_element, "slice",
    "MLX: the gradient of one element spread over the span",
    "https://github.com/ml-explore/mlx/issues/4444": {
        assert_eq!(gradients(&[random([4])], |v| v[0].slice(0, 2..3)), [[0.0, 0.0, 1.0, 0.0]]);
    }

    82 tinygrad_18028_relu6_and_hardswish_at_their_kinks, "relu6, hardswish",
    "tinygrad: a half at 6, five quarters at 3",
    "https://github.com/tinygrad/tinygrad/pull/18028": {
        let found = gradients(&[values([6.0, 0.0, 7.0, 5.0])], |v| v[0].relu6());
        assert!([0.0, 1.0].contains(&found[0][0]) && [0.0, 1.0].contains(&found[0][1]), "{found:?}");
        assert_eq!(found[0][2..], [0.0, 1.0]);
        assert_eq!(gradients(&[values([3.0, 40.0])], |v| v[0].hardswish()), [[1.0, 1.0]]);
    }

    83 nnlib_205_max_pool_of_overlapping_windows, "max_pool2d",
    "NNlib: of overlapping windows one gives its gradient",
    "https://github.com/FluxML/NNlib.jl/issues/205": {
        let x = Tensor::from_vec([1, 3, 3, 1], vec![0.0, 0.0, 0.0, 0.0, 9.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(gradients(&[x], |v| v[0].max_pool2d(2, 1, 0))[0][4], 4.0);
    }

    84 flaggems_5392_layer_norm_of_rank_three, "layer_norm",
    "FlagGems: takes its input for a matrix",
    "https://github.com/flagos-ai/FlagGems/issues/5392": {
        let inputs = [random([2, 3, 4, 5]), values([0.5, 1.0, 1.5, -1.0, 2.0]), random([5])];
        holds(&inputs, |v| v[0].layer_norm(&v[1], &v[2], 1e-2));
    }

    85 flaggems_5218_resize_with_aligned_corners, "resize_bilinear",
    "FlagGems: terms dropped from 2 to 10 with aligned corners",
    "https://github.com/flagos-ai/FlagGems/issues/5218": {
        holds(&[random([1, 2, 2, 1])], |v| v[0].resize_bilinear(10, 10, true));
        let found = gradients(&[random([1, 1, 2, 1])], |v| v[0].resize_bilinear(1, 10, true));
        assert!((found[0][0] - 5.0).abs() < 1e-12 && (found[0][1] - 5.0).abs() < 1e-12);
    }

    86 onnxruntime_7217_ties_of_more_than_one, "maximum, minimum, max, min",
    "ONNX Runtime: tied gradients that sum to more than one",
    "https://github.com/microsoft/onnxruntime/pull/7217": {
        let x = values([2.0, 2.0]);
        for f in [|v: &[V]| v[0].maximum(&v[1]), |v: &[V]| v[0].minimum(&v[1])] {
            let found = gradients(&[x.clone(), x.clone()], f);
            assert_eq!(found.iter().flatten().sum::<f64>(), 2.0, "two outputs");
            holds_at_kinks(&[x.clone(), x.clone()], f);
        }
    }

    87 neon_169_product_with_its_own_transpose, "matmul",
    "neon: the gradient of the transposed use is lost",
    "https://github.com/NervanaSystems/neon/issues/169": {
        holds(&[random([2, 3])], |v| v[0].matmul(&v[0].permute(&[1, 0])));
    }

    90 warp_202_a_variable_by_another_name, "tape",
    "warp: a copied variable gets no gradient",
    "https://github.com/NVIDIA/warp/issues/202": {
        assert_eq!(gradients(&[values([3.0])], |v| {
            let alias = v[0].clone();
            &alias + &v[0]
        }), [[2.0]]);
    }

    91 transformer_engine_1557_attention_queries, "factorised_attention",
    "Transformer Engine: the gradient of the queries",
    "https://github.com/NVIDIA/TransformerEngine/issues/1557": {
        holds(&[random([2, 5, 12])], |v| v[0].factorised_attention(2));
    }

    92 needle_6_conv2d_with_a_rest, "conv2d",
    "needle: a shape error where the stride leaves a rest",
    "https://github.com/PKUFlyingPig/CMU10-714/issues/6": {
        for size in 3..9 {
            let op = Conv2d { stride: [2, 3], ..Conv2d::default() };
            holds(&[random([1, size, size + 1, 1]), random([3, 2, 1, 2])], |v| v[0].conv2d(&v[1], None, op));
        }
    }

    93 stan_3031_root_of_zero_by_either_name, "powf, sqrt",
    "Stan: two conventions for the root of zero",
    "https://github.com/stan-dev/math/issues/3031": {
        let zero = values([0.0]);
        let (root, power) = (gradients(std::slice::from_ref(&zero), |v| v[0].sqrt()), gradients(&[zero], |v| v[0].powf(0.5)));
        assert_eq!(root, [[f64::INFINITY]]);
        assert_eq!(power, root);
    }
}
