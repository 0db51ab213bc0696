//! Every op against PyTorch: values and every gradient, to 1e-10.

use parallax::ops::Conv2d;
use parallax::ops::image::grid_sample::GridPadding;
use parallax::ops::normalise::batch_norm::Activation;
use parallax::tensor::{Tape, Var};
use safetensors::SafeTensors;
use serde_json::Value;

use crate::reference::{Layout, cases, error, fixture, tensor};
use Layout::{Convolution, Depthwise, Image, Linear, Same, Transform};

/// Outputs and gradients in the file.
const COMPARED: usize = 210;

/// An op, from its inputs to its output.
type Run<'a> = dyn Fn(&[Var<f64>]) -> Var<f64> + 'a;

/// How a case runs here: the layouts of its inputs (those not listed are the same) and of its output, and the op.
struct Entry<'a> {
    inputs: &'static [Layout],
    output: Layout,
    run: Box<Run<'a>>,
}

fn entry<'a>(
    inputs: &'static [Layout],
    output: Layout,
    run: impl Fn(&[Var<f64>]) -> Var<f64> + 'a,
) -> Option<Entry<'a>> {
    Some(Entry { inputs, output, run: Box::new(run) })
}

fn number(attributes: &Value, name: &str) -> f64 {
    attributes[name].as_f64().unwrap_or_else(|| panic!("attribute {name}"))
}

fn pair(attributes: &Value, name: &str) -> [usize; 2] {
    [0, 1].map(|i| attributes[name][i].as_u64().unwrap_or_else(|| panic!("attribute {name}")) as usize)
}

/// The table: an op's name, and what it is here. `beside` gives a tensor that stands beside the inputs.
fn find<'a>(op: &str, a: &'a Value, beside: &'a dyn Fn(&str) -> Var<f64>) -> Option<Entry<'a>> {
    let whole = |name: &str| number(a, name) as usize;
    match op {
        // As many groups as channels, in all of the file's cases with more than two.
        "conv2d" if whole("groups") > 2 => entry(&[Image, Depthwise, Same], Image, |v| {
            v[0].depthwise_conv2d(&v[1], v.get(2), pair(a, "stride")[0], pair(a, "padding")[0])
        }),
        "conv2d" => {
            let (stride, padding, dilation) = (pair(a, "stride"), pair(a, "padding"), pair(a, "dilation"));
            let op = Conv2d { stride, padding, dilation, groups: whole("groups"), ..Conv2d::default() };
            entry(&[Image, Convolution, Same], Image, move |v| v[0].conv2d(&v[1], v.get(2), op))
        }
        "batch_norm" if a["training"] == true => {
            entry(&[Image], Image, |v| v[0].batch_norm(&v[1], &v[2], number(a, "eps"), Activation::None).0)
        }
        "batch_norm" => entry(&[Image], Image, |v| {
            let (mean, var) = (beside("running_mean"), beside("running_var"));
            v[0].batch_norm_eval(&v[1], &v[2], &mean, &var, number(a, "eps"), Activation::None)
        }),
        "layer_norm" => entry(&[], Same, |v| v[0].layer_norm(&v[1], &v[2], number(a, "eps"))),
        "softmax" => entry(&[], Same, move |v| v[0].softmax(whole("dim"))),
        "concat" => entry(&[], Same, move |v| Var::concat(&v.iter().collect::<Vec<_>>(), whole("dim"))),
        "slice" => entry(&[], Same, |v| {
            let ranges = a["ranges"].as_array().expect("ranges");
            (0..ranges.len()).fold(v[0].clone(), |x, axis| {
                let [from, to] = [0, 1].map(|i| ranges[axis][i].as_u64().expect("a bound") as usize);
                x.slice(axis, from..to)
            })
        }),
        "reflect_pad" => {
            entry(&[Image], Image, move |v| v[0].reflect_pad(["left", "right", "top", "bottom"].map(whole)))
        }
        "upsample_nearest" => entry(&[Image], Image, move |v| v[0].upsample_nearest(whole("scale"))),
        "resize_bilinear" => entry(&[Image], Image, |v| {
            let [height, width] = pair(a, "size");
            v[0].resize_bilinear(height, width, a["align_corners"] == true)
        }),
        "avg_pool" => entry(&[Image], Image, move |v| v[0].avg_pool2d(whole("kernel"), whole("stride"))),
        "max_pool" => {
            entry(&[Image], Image, move |v| v[0].max_pool2d(whole("kernel"), whole("stride"), whole("padding")))
        }
        "global_max_pool" => entry(&[Image], Image, |v| {
            let [b, _, _, c] = v[0].shape().nhwc().expect("an image");
            v[0].max(1, 2)[0].reshape([b, 1, 1, c])
        }),
        "transformer_block" => entry(TRANSFORMER, Same, |v| transformer_block(v, pair(a, "size"))),
        "linear" => entry(&[Same, Linear, Same], Same, |v| v[0].linear(&v[1], Some(&v[2]))),
        "matmul" => entry(&[], Same, |v| v[0].matmul(&v[1])),
        "relu" => entry(&[], Same, |v| v[0].relu()),
        "elu" => entry(&[], Same, |v| v[0].elu()),
        "gelu" => entry(&[], Same, |v| v[0].gelu()),
        "hardswish" => entry(&[], Same, |v| v[0].hardswish()),
        "sigmoid" => entry(&[], Same, |v| v[0].sigmoid()),
        "exp" => entry(&[], Same, |v| v[0].exp()),
        "abs" => entry(&[], Same, |v| v[0].abs()),
        "tanh" => entry(&[], Same, |v| v[0].tanh()),
        "log" => entry(&[], Same, |v| v[0].log()),
        "sqrt" => entry(&[], Same, |v| v[0].sqrt()),
        "reciprocal" => entry(&[], Same, |v| v[0].reciprocal()),
        "clamp" => entry(&[], Same, |v| v[0].clamp(number(a, "min"), number(a, "max"))),
        "mul" => entry(&[], Same, |v| &v[0] * &v[1]),
        "add" => entry(&[], Same, |v| &v[0] + &v[1]),
        "div" => entry(&[], Same, |v| &v[0] / &v[1]),
        "composite" => {
            assert_eq!(a["formula"], "x*x + sigmoid(x)*x");
            entry(&[], Same, |v| &(&v[0] * &v[0]) + &(&v[0].sigmoid() * &v[0]))
        }
        "mean" => {
            assert_eq!(a["dims"], serde_json::json!([2, 3]));
            entry(&[], Same, |v| v[0].mean(2, 2))
        }
        "sum" => entry(&[], Same, |v| v[0].sum(number(a, "dim") as usize, 1)),
        "max" => entry(&[], Same, |v| v[0].max(number(a, "dim") as usize, 1)[0].clone()),
        "min" => entry(&[], Same, |v| v[0].min(number(a, "dim") as usize, 1)[0].clone()),
        "grid_sample" => {
            let padding = match a["padding"].as_str() {
                Some("zeros") => GridPadding::Zeros,
                Some("border") => GridPadding::Border,
                Some("reflection") => GridPadding::Reflection,
                other => panic!("padding {other:?}"),
            };
            let corners = a["align_corners"].as_bool().expect("a boolean");
            entry(&[Image, Same], Image, move |v| v[0].grid_sample(&v[1], padding, corners))
        }
        "axis_angle_to_rotation" => entry(&[], Same, |v| v[0].axis_angle_to_rotation()),
        "pose_matrix" => entry(&[], Transform, |v| Var::pose_matrix(&v[0], &v[1], false)),
        "pose_matrix_inverse" => entry(&[], Transform, |v| Var::pose_matrix(&v[0], &v[1], true)),
        "disp_to_depth" => {
            entry(&[Image], Image, |v| v[0].disparity_to_depth(number(a, "min_depth"), number(a, "max_depth")))
        }
        "ssim" => entry(&[Image, Image], Image, |v| v[0].ssim_loss(&v[1])),
        "photometric" => entry(&[Image, Image], Image, |v| v[0].photometric(&v[1], 0.85)),
        "smoothness" => entry(&[Image, Image], Same, |v| v[0].smoothness(&v[1])),
        "warp" => {
            let k = |i: usize, j: usize| a["K"][i][j].as_f64().expect("a number");
            let camera = [k(0, 0), k(1, 1), k(0, 2), k(1, 2)];
            entry(&[Image, Image, Transform], Image, move |v| {
                v[0].warp(&v[1], &v[2], &vec![camera; v[0].dims()[0]], false)
            })
        }
        _ => None,
    }
}

/// The layouts of a transformer block's inputs, in the file's order.
const TRANSFORMER: &[Layout] = &[
    Same, Depthwise, Same, Depthwise, Same, Depthwise, Same, Depthwise, Same, Linear, Same, Linear, Same, Linear, Same,
    Linear, Same, Same, Same, Same, Same,
];

/// A transformer layer over tokens, from its inputs in the file's order.
fn transformer_block(v: &[Var<f64>], [h, w]: [usize; 2]) -> Var<f64> {
    let [b, n, c] = v[0].dims().try_into().expect("tokens");
    let image = v[0].reshape([b, h, w, c]);
    let x = (&image + image.depthwise_conv2d(&v[1], Some(&v[2]), 1, 1)).reshape([b, n, c]);
    let qkv = x.layer_norm(&v[17], &v[18], 1e-6).linear(&v[9], Some(&v[10]));
    let windows = [(3, 2, &v[3], &v[4]), (5, 3, &v[5], &v[6]), (7, 3, &v[7], &v[8])];
    let attention = qkv.factorised_attention(8) + qkv.conv_relative_position(h, w, 8, &windows);
    let x = &x + attention.linear(&v[11], Some(&v[12]));
    let hidden = x.layer_norm(&v[19], &v[20], 1e-6).linear(&v[13], Some(&v[14])).gelu();
    &x + hidden.linear(&v[15], Some(&v[16]))
}

#[test]
fn every_op_gives_the_reference_values_and_gradients() {
    let bytes = fixture("ops.safetensors");
    let file = SafeTensors::deserialize(&bytes).expect("a safetensors file");
    let (mut failures, mut compared) = (Vec::new(), 0);
    let mut worst = (0.0, String::new());
    for case in cases(&bytes) {
        let text = |field: &str| case[field].as_str().expect("text").to_owned();
        let (name, op) = (text("name"), text("op"));
        let beside = |what: &str| Var::constant(tensor(&file, &format!("{name}/{what}")));
        let entry = find(&op, &case["attrs"], &beside);
        let entry = entry.unwrap_or_else(|| panic!("{name}: no entry in the table for {op}"));
        let list = |field: &str| -> Vec<String> {
            let names = case[field].as_array().expect("a list").iter();
            names.map(|n| n.as_str().expect("text").to_owned()).collect()
        };
        let (inputs, gradients) = (list("inputs"), list("grads"));
        let layout = |i: usize| entry.inputs.get(i).copied().unwrap_or(Same);
        let tape = Tape::new();
        let vars: Vec<Var<f64>> = inputs
            .iter()
            .enumerate()
            .map(|(i, input)| {
                let value = layout(i).apply(&tensor(&file, &format!("{name}/in/{input}")));
                if gradients.contains(input) { tape.leaf(value) } else { Var::constant(value) }
            })
            .collect();
        let y = (entry.run)(&vars);
        let mut check = |what: String, ours, expected| {
            let error = error(ours, &expected);
            compared += 1;
            if error.is_nan() || error > worst.0 {
                worst = (error, what.clone());
            }
            if error.is_nan() || error > 1e-10 {
                failures.push(format!("{what}: error {error:.1e}"));
            }
        };
        check(format!("{name}/out/0"), y.value(), entry.output.apply(&tensor(&file, &format!("{name}/out/0"))));
        let cotangent = entry.output.apply(&tensor(&file, &format!("{name}/cot/0")));
        let found = tape.backward(&[(&y, cotangent)]);
        for input in &gradients {
            let i = inputs.iter().position(|n| n == input).expect("a gradient of an input");
            let what = format!("{name}/grad/{input}");
            let expected = layout(i).apply(&tensor(&file, &what));
            check(what, found.get(&vars[i]).expect("a gradient"), expected);
        }
    }
    println!("{compared} tensors compared; worst error {:.1e} ({})", worst.0, worst.1);
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
    assert_eq!(compared, COMPARED, "tensors compared");
}
