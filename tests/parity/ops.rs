//! Every op against PyTorch: values and every gradient, to 1e-10.

use parallax::ops::grid_sample::GridPadding;
use parallax::tensor::{Tape, Var};
use safetensors::SafeTensors;
use serde_json::Value;

use crate::reference::{Layout, cases, error, fixture, tensor};
use Layout::{Image, Linear, Same, Transform};

/// Ops of the file that this crate does not have yet.
const PENDING: &[&str] = &[
    "conv2d",
    "batch_norm",
    "layer_norm",
    "softmax",
    "concat",
    "slice",
    "reflect_pad",
    "upsample_nearest",
    "resize_bilinear",
    "avg_pool",
    "max_pool",
    "global_max_pool",
    "transformer_block",
];

/// How a case runs here: the layouts of its inputs (those not listed are the same) and of its output, and the op.
struct Entry<'a> {
    inputs: &'static [Layout],
    output: Layout,
    run: Box<dyn Fn(&[Var<f64>]) -> Var<f64> + 'a>,
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

/// The table: an op's name, and what it is here.
fn find<'a>(op: &str, a: &'a Value) -> Option<Entry<'a>> {
    match op {
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

#[test]
fn every_op_gives_the_reference_values_and_gradients() {
    let bytes = fixture("ops.safetensors");
    let file = SafeTensors::deserialize(&bytes).expect("a safetensors file");
    let (mut failures, mut compared, mut pending) = (Vec::new(), 0, 0);
    let mut worst = (0.0, String::new());
    for case in cases(&bytes) {
        let text = |field: &str| case[field].as_str().expect("text").to_owned();
        let (name, op) = (text("name"), text("op"));
        let Some(entry) = find(&op, &case["attrs"]) else {
            assert!(PENDING.contains(&op.as_str()), "{name}: no entry in the table for {op}");
            pending += 1;
            continue;
        };
        assert!(!PENDING.contains(&op.as_str()), "{op} has an entry in the table and is listed as pending");
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
            if !(error <= worst.0) {
                worst = (error, what.clone());
            }
            if !(error <= 1e-10) {
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
    println!("{compared} tensors compared, {pending} cases pending; worst error {:.1e} ({})", worst.0, worst.1);
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
    assert!(compared >= 91, "only {compared} tensors compared");
}
