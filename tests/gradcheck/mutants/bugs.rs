//! The planted bugs, by class. Where one was found in the wild, its line says where; the catalogue has the links.

use parallax::ops::conv::transpose::ConvTranspose2d;
use parallax::ops::conv::upsampled::UpsampledConv2d;
use parallax::ops::elementwise::activation::LeakyRelu;
use parallax::ops::elementwise::dropout::Dropout;
use parallax::ops::elementwise::unary::Unary;
use parallax::ops::image::grid_sample::{GridPadding, GridSample};
use parallax::ops::image::pool2d::{AvgPool2d, MaxPool2d};
use parallax::ops::image::reflect_pad::ReflectPad;
use parallax::ops::movement::concat::Concat;
use parallax::ops::movement::index_select::IndexSelect;
use parallax::ops::movement::repeat::Repeat;
use parallax::ops::movement::shape_ops::Permute;
use parallax::ops::movement::slice::Slice;
use parallax::ops::normalise::batch_norm::BatchNorm;
use parallax::ops::normalise::layer_norm::LayerNorm;
use parallax::ops::reduce::cumulative::CumSum;
use parallax::ops::reduce::norm::L2Normalize;
use parallax::ops::reduce::softmax::Softmax;
use parallax::ops::reduce::sum::{Extreme, Max, Sum};
use parallax::ops::reduce::variance::Variance;
use parallax::ops::{Conv2d, apply};
use parallax::tensor::{Shape, Tensor, Var, parallel};

use super::HandOver::{OntoStale, Overwriting, Right};
use super::{Backward, Gradients, HandOver, Mutant};

/// The classes, in order.
pub const CLASSES: [&str; 15] = [
    "arguments",
    "axis",
    "border",
    "cotangent",
    "extreme",
    "fan-out",
    "groups",
    "kink",
    "layout",
    "rounding",
    "scale",
    "sign",
    "subset",
    "term",
    "zero",
];

const fn bug(
    class: &'static str,
    op: &'static str,
    name: &'static str,
    gradients: fn(&Backward) -> Gradients,
) -> Mutant {
    handed(Right, class, op, name, gradients)
}

const fn handed(
    hand_over: HandOver,
    class: &'static str,
    op: &'static str,
    name: &'static str,
    gradients: fn(&Backward) -> Gradients,
) -> Mutant {
    Mutant { name, op, class, hand_over, gradients }
}

pub static ALL: &[Mutant] = &[
    // Asymmetric arguments: height and width, stride and dilation taken for one another.
    bug("arguments", "conv2d", "height and width swapped", |b| {
        let op = b.op::<Conv2d>();
        let turned = |[h, w]: [usize; 2]| [w, h];
        let (stride, padding, dilation) = (turned(op.stride), turned(op.padding), turned(op.dilation));
        b.of(b.inputs, &b.upstream, |v| apply(Conv2d { stride, padding, dilation, ..*op }, v))
    }),
    bug("arguments", "matmul", "a square factor not transposed", |b| {
        let square = b.x(0).dims().iter().rev().take(2).all(|d| *d == b.x(0).shape().last());
        if square { b.at(&[transposed(b.x(0)), b.x(1).clone()], &b.upstream) } else { product_kept_as_it_lies(b) }
    }),
    bug("arguments", "grid_sample", "the extents of x and y swapped in the slope", |b| {
        let [_, h, w, _] = b.x(0).shape().nhwc().expect("an image");
        b.changed(1, |d| {
            let factor = (h.max(2) - 1) as f64 / (w.max(2) - 1) as f64;
            d.data_mut().chunks_exact_mut(2).for_each(|xy| (xy[0], xy[1]) = (xy[0] * factor, xy[1] / factor));
        })
    }),
    bug("arguments", "conv_transpose2d", "stride and dilation swapped", |b| {
        let op = *b.op::<ConvTranspose2d>();
        b.of(b.inputs, &b.upstream, |v| apply(ConvTranspose2d { stride: op.dilation, dilation: op.stride, ..op }, v))
    }),
    bug("arguments", "variance", "the correction ignored", |b| {
        let Variance { first, count, correction, .. } = *b.op::<Variance>();
        let n = b.x(0).dims()[first..first + count].iter().product::<usize>() as f64;
        scaled(b, 0, (n - correction as f64) / n)
    }),
    // Axis: the last one always (burn 3555), the first dimension for all (FlagGems 5392).
    bug("axis", "max", "scattered along the last axis", |b| {
        let Extreme { count, .. } = *b.op::<Extreme<Max>>();
        let rank = b.x(0).shape().rank();
        if count != 1 || rank < 2 {
            return b.right();
        }
        b.changed(0, |d| {
            let right: Vec<f64> = d.data().iter().copied().filter(|g| *g != 0.0).collect();
            let each = (d.len() / right.len().max(1)).max(1);
            d.data_mut().fill(0.0);
            d.data_mut().chunks_mut(each).zip(right).for_each(|(run, g)| run[0] = g);
        })
    }),
    bug("axis", "concat", "cut along the last axis", |b| {
        let mut from = 0;
        let mut parts = b.right();
        for (part, x) in parts.iter_mut().zip(b.inputs) {
            if let Some(part) = part {
                part.data_mut().copy_from_slice(&b.g().data()[from..from + x.len()]);
            }
            from += x.len();
        }
        parts
    }),
    bug("axis", "layer_norm", "only the first matrix", |b| {
        let rows = b.x(0).dims().iter().rev().skip(1).take(1).product::<usize>();
        b.changed(0, |d| {
            let first = rows * d.shape().last();
            d.data_mut().iter_mut().skip(first).for_each(|d| *d = 0.0);
        })
    }),
    bug("axis", "permute", "the order instead of its inverse", |b| {
        let order = b.op::<Permute>().order.clone();
        b.changed(0, |d| *d = b.g().permute(&order).reshape(*d.shape()))
    }),
    bug("axis", "softmax", "sums along the last axis", |b| {
        let Softmax { axis } = *b.op::<Softmax>();
        let last = b.x(0).shape().rank() - 1;
        if axis == last { b.right() } else { b.of(b.inputs, &b.upstream, |v| apply(Softmax { axis: last }, v)) }
    }),
    bug("axis", "sort", "the order not undone", |b| b.changed(0, |d| *d = b.g().clone())),
    bug("axis", "flip", "not turned back", |b| b.changed(0, |d| *d = b.g().clone())),
    bug("axis", "repeat", "summed over the whole dimension", |b| {
        let Repeat { axis, .. } = *b.op::<Repeat>();
        b.changed(0, |d| {
            let inner: usize = d.dims()[axis + 1..].iter().product();
            let run = d.dims()[axis] * inner;
            for d in d.data_mut().chunks_exact_mut(run.max(1)) {
                for i in 0..inner {
                    let sum: f64 = d.iter().skip(i).step_by(inner).sum();
                    d.iter_mut().skip(i).step_by(inner).for_each(|d| *d = sum);
                }
            }
        })
    }),
    bug("axis", "cumsum", "summed forwards", |b| {
        let CumSum { axis } = *b.op::<CumSum>();
        b.changed(0, |d| *d = Var::constant(b.g().clone()).cumsum(axis).into_value())
    }),
    // Borders and remainders.
    bug("border", "conv2d", "the tail of a strided image dropped", |b| {
        let [_, h, w, c] = b.x(0).shape().nhwc().expect("an image");
        if b.op::<Conv2d>().stride[0] == 1 {
            return b.right();
        }
        b.changed(0, |d| d.data_mut().chunks_exact_mut(h * w * c).for_each(|image| image[(h - 1) * w * c..].fill(0.0)))
    }),
    bug("border", "grid_sample", "the border takes the gradient of zero padding", |b| {
        let op = *b.op::<GridSample>();
        if op.padding != GridPadding::Border {
            return b.right();
        }
        b.of(b.inputs, &b.upstream, |v| apply(GridSample { padding: GridPadding::Zeros, ..op }, v))
    }),
    bug("border", "reflect_pad", "what the mirror shows is dropped", |b| {
        let ReflectPad { left, top, .. } = *b.op::<ReflectPad>();
        let [_, h, w, _] = b.x(0).shape().nhwc().expect("an image");
        b.changed(0, |d| {
            let g = Var::constant(b.g().clone());
            *d = g.slice(1, top..top + h).slice(2, left..left + w).into_value();
        })
    }),
    bug("border", "resize_bilinear", "the last row dropped", |b| {
        let [_, h, w, c] = b.x(0).shape().nhwc().expect("an image");
        b.changed(0, |d| {
            let images = d.data_mut().chunks_exact_mut((h * w * c).max(1));
            images.for_each(|image| image[(h - 1) * w * c..].fill(0.0));
        })
    }),
    bug("border", "avg_pool2d", "divided by the stride's window", |b| {
        let AvgPool2d { kernel, stride } = *b.op::<AvgPool2d>();
        scaled(b, 0, (kernel * kernel) as f64 / (stride * stride) as f64)
    }),
    bug("border", "max_pool2d", "of overlapping windows the last one only", |b| {
        b.changed(0, |d| {
            let right = d.clone();
            d.data_mut().fill(0.0);
            winners(b, |at, g| d.data_mut()[at[0]] = g);
            assert_eq!(d.shape(), right.shape());
        })
    }),
    bug("border", "depthwise_conv2d", "the window not turned", |b| {
        let mut inputs = b.inputs.to_vec();
        let channels = inputs[1].shape().last();
        inputs[1] = turned(&inputs[1], channels);
        keep(b, 0, b.at(&inputs, &b.upstream))
    }),
    bug("border", "upsampled_conv2d", "as if zeros lay beyond the edge", |b| {
        let UpsampledConv2d { parts, activation, .. } = *b.op::<UpsampledConv2d>();
        if b.x(parts + 1).dims()[0] == 1 {
            return b.right();
        }
        b.of(b.inputs, &b.upstream, |v| {
            let large = v[0].upsample_nearest(2);
            let inputs: Vec<_> = [&large].into_iter().chain(v[1..].iter().copied()).collect();
            apply(Conv2d { parts: parts + 1, activation, ..Conv2d::padded(1) }, &inputs)
        })
    }),
    bug("border", "slice", "one element spread over the span", |b| {
        let Slice { axis, start, end, .. } = *b.op::<Slice>();
        if end - start != 1 {
            return b.right();
        }
        b.changed(0, |d| {
            let inner: usize = d.dims()[axis + 1..].iter().product();
            let run = d.dims()[axis] * inner;
            for (d, g) in d.data_mut().chunks_exact_mut(run).zip(b.g().data().chunks_exact(inner)) {
                d.chunks_exact_mut(inner).for_each(|d| d.copy_from_slice(g));
            }
        })
    }),
    bug("border", "conv_transpose2d", "the last row dropped", |b| {
        let [_, h, w, c] = b.x(0).shape().nhwc().expect("an image");
        b.changed(0, |d| {
            let images = d.data_mut().chunks_exact_mut((h * w * c).max(1));
            images.for_each(|image| image[(h - 1) * w * c..].fill(0.0));
        })
    }),
    bug("border", "scatter_add", "values that the index does not reach", |b| {
        let first = b.g().data().first().copied().unwrap_or(0.0);
        b.changed(2, |d| d.data_mut().iter_mut().filter(|d| **d == 0.0).for_each(|d| *d = first))
    }),
    // The upstream gradient ignored, in whole or in part.
    bug("cotangent", "linear", "the bias counts rows", |b| {
        let rows = b.x(0).shape().rows() as f64;
        b.changed(2, |d| d.data_mut().fill(rows))
    }),
    bug("cotangent", "conv2d", "the bias counts pixels", |b| {
        let rows = b.g().shape().rows() as f64;
        b.changed(b.op::<Conv2d>().parts + 1, |d| d.data_mut().fill(rows))
    }),
    bug("cotangent", "exp", "as if a sum were the loss", |b| b.at(b.inputs, &[Tensor::full(*b.g().shape(), 1.0)])),
    bug("cotangent", "square", "its absolute value", |b| b.at(b.inputs, &[b.g().map(f64::abs)])),
    // Extreme arguments, and branches that were not taken.
    bug("extreme", "sigmoid", "a quotient of infinities", |b| {
        b.by_element(|g, x| g * (-x).exp() / (1.0 + (-x).exp()).powi(2))
    }),
    bug("extreme", "elu", "zero times the branch not taken", |b| {
        b.by_element(|g, x| g * (f64::from(x > 0.0) + f64::from(x <= 0.0) * x.exp()))
    }),
    bug("extreme", "gelu", "the tail cut off", |b| b.by_element_where(|x| x > 15.0, 0.0)),
    bug("extreme", "select", "zero times what was not chosen", |b| {
        b.changed(1, |d| d.data_mut().iter_mut().zip(b.x(1).data()).for_each(|(d, x)| *d += 0.0 * x))
    }),
    bug("extreme", "softplus", "a quotient of infinities", |b| b.by_element(|g, x| g * x.exp() / (1.0 + x.exp()))),
    // Values used more than once.
    handed(Overwriting, "fan-out", "upsample_nearest", "overwrites what another use gave", |b| b.right()),
    handed(Overwriting, "fan-out", "mul", "overwrites what another use gave", |b| b.right()),
    handed(Overwriting, "fan-out", "batch_norm", "overwrites what another use gave", |b| b.right()),
    handed(OntoStale, "fan-out", "max_pool2d", "onto memory that was not cleared", |b| b.right()),
    handed(OntoStale, "fan-out", "concat", "onto memory that was not cleared", |b| b.right()),
    bug("fan-out", "index_select", "of equal indices the last one wins", |b| {
        let IndexSelect { axis } = *b.op::<IndexSelect>();
        let index: Vec<usize> = b.x(1).data().iter().map(|i| *i as usize).collect();
        b.changed(0, |d| {
            let (n, inner): (usize, usize) = (d.dims()[axis], d.dims()[axis + 1..].iter().product());
            for (outer, g) in b.g().data().chunks((index.len() * inner).max(1)).enumerate() {
                for (&i, g) in index.iter().zip(g.chunks(inner)) {
                    d.data_mut()[(outer * n + i) * inner..][..inner].copy_from_slice(g);
                }
            }
        })
    }),
    handed(Overwriting, "fan-out", "gather", "overwrites what another use gave", |b| b.right()),
    // Groups.
    bug("groups", "conv2d", "the group of an output is its number modulo groups", |b| {
        let Conv2d { groups, parts, .. } = *b.op::<Conv2d>();
        let out = b.x(parts).shape().last();
        b.changed(parts, |d| {
            for row in d.data_mut().chunks_exact_mut(out) {
                let right = row.to_vec();
                (0..out).for_each(|o| row[o] = right[(o % groups) * (out / groups) + o / groups]);
            }
        })
    }),
    bug("groups", "conv2d", "groups with a stride", |b| {
        let op = b.op::<Conv2d>();
        let factor = if op.groups > 1 && op.stride != [1, 1] { 5.0 } else { 1.0 };
        scaled(b, 0, factor)
    }),
    // Kinks and ties.
    bug("kink", "max", "every tied element gets all", |b| {
        let Extreme { first, count, .. } = *b.op::<Extreme<Max>>();
        let dims = b.x(0).dims();
        let n: usize = dims[first..first + count].iter().product();
        let inner: usize = dims[first + count..].iter().product();
        let top = b.case.run(&[&b.x(0).clone().into()]).swap_remove(0);
        b.changed(0, |d| {
            for (i, (d, x)) in d.data_mut().iter_mut().zip(b.x(0).data()).enumerate() {
                let o = i / (n * inner) * inner + i % inner;
                *d = if *x == top.value().data()[o] { b.g().data()[o] } else { 0.0 };
            }
        })
    }),
    bug("kink", "max_pool2d", "every tied element gets all", |b| {
        b.changed(0, |d| {
            d.data_mut().fill(0.0);
            winners(b, |at, g| at.iter().for_each(|&at| d.data_mut()[at] += g));
        })
    }),
    bug("kink", "maximum", "both sides get all at a tie", ties_doubled),
    bug("kink", "minimum", "neither side gets any at a tie", |b| {
        if b.x(0).shape() != b.x(1).shape() {
            return b.right();
        }
        let mut both = b.right();
        for d in both.iter_mut().flatten() {
            let equal = b.x(0).data().iter().zip(b.x(1).data()).map(|(a, b)| a == b);
            d.data_mut().iter_mut().zip(equal).filter(|(_, equal)| *equal).for_each(|(d, _)| *d = 0.0);
        }
        both
    }),
    bug("kink", "hardswish", "the interval closed at 3", |b| {
        b.by_element(|g, x| {
            g * if x < -3.0 {
                0.0
            } else if x > 3.0 {
                1.0
            } else {
                (2.0 * x + 3.0) / 6.0
            }
        })
    }),
    bug("kink", "relu", "a slope of one and a half at 0", |b| {
        b.by_element(|g, x| g * if x == 0.0 { 1.5 } else { f64::from(x > 0.0) })
    }),
    bug("kink", "clamp", "the gradient passes outside", |b| b.by_element(|g, _| g)),
    bug("kink", "min_reprojection", "every candidate gets the gradient", |b| {
        let share = b.g().item() / b.x(0).len() as f64;
        let mut all = b.right();
        all.iter_mut().flatten().for_each(|d| d.data_mut().fill(share));
        all
    }),
    bug("kink", "relu6", "a half at 6", |b| b.by_element_where(|x| x == 6.0, 0.5)),
    bug("kink", "hardsigmoid", "a slope where it is flat", |b| b.by_element_where(|x| x < -3.0, 1.0 / 6.0)),
    bug("kink", "leaky_relu", "the slope squared", |b| {
        let LeakyRelu { slope } = b.op::<Unary<LeakyRelu>>().0;
        b.by_element(|g, x| if x > 0.0 { g } else { g * slope * slope })
    }),
    // Layout.
    bug("layout", "conv2d", "the window not turned", |b| {
        let mut inputs = b.inputs.to_vec();
        let weights = &mut inputs[b.op::<Conv2d>().parts];
        let block = weights.dims()[2] * weights.dims()[3];
        *weights = turned(weights, block);
        keep(b, 0, b.at(&inputs, &b.upstream))
    }),
    bug("layout", "conv2d", "the last part sees the weights of the first", |b| {
        let parts = b.op::<Conv2d>().parts;
        if parts == 1 {
            return b.right();
        }
        let mut inputs = b.inputs.to_vec();
        let last = inputs[parts - 1].shape().last();
        let [channels, out] = [2, 3].map(|d| inputs[parts].dims()[d]);
        let taps = inputs[parts].data_mut().chunks_exact_mut((channels * out).max(1));
        taps.for_each(|tap| tap.rotate_right((channels - last) * out));
        keep(b, parts - 1, b.at(&inputs, &b.upstream))
    }),
    bug("layout", "linear", "weights as if transposed", |b| {
        let (k, n) = (b.x(1).dims()[0], b.x(1).dims()[1]);
        let mut inputs = b.inputs.to_vec();
        inputs[1] = transposed(&inputs[1]).reshape([k, n]);
        keep(b, 0, b.at(&inputs, &b.upstream))
    }),
    // Only in f32; not the same from run to run, or from one thread to two.
    bug("rounding", "add", "the tail of a vector forgotten in f32", |b| {
        let single = b.single;
        b.changed(0, |d| {
            if let Some(last) = d.data_mut().last_mut().filter(|_| single) {
                *last = 0.0;
            }
        })
    }),
    bug("rounding", "mul", "a little noise", |b| {
        static CALLS: std::sync::atomic::AtomicU64 = std::sync::atomic::AtomicU64::new(0);
        let noise = 1.0 + 1e-14 * CALLS.fetch_add(1, std::sync::atomic::Ordering::Relaxed) as f64;
        scaled(b, 0, noise)
    }),
    bug("rounding", "sum", "a little for every thread", |b| scaled(b, 0, 1.0 + 1e-14 * parallel::threads() as f64)),
    // Scale.
    bug("scale", "max_pool2d", "a quarter", |b| scaled(b, 0, 0.25)),
    bug("scale", "sum", "a mean forgets to divide", |b| {
        let Sum { first, count, mean } = *b.op::<Sum>();
        let n: usize = b.x(0).dims()[first..first + count].iter().product();
        scaled(b, 0, if mean { n as f64 } else { 1.0 })
    }),
    bug("scale", "square", "half", |b| scaled(b, 0, 0.5)),
    bug("scale", "factorised_attention", "one part in a thousand", |b| scaled(b, 0, 1.001)),
    bug("scale", "add", "the first of many instead of their sum", |b| {
        let mut both = b.right();
        for d in both.iter_mut().flatten().filter(|d| d.len() < b.g().len()) {
            let n = d.len();
            d.data_mut().copy_from_slice(&b.g().data()[..n]);
        }
        both
    }),
    bug("scale", "dropout", "not divided by what is kept", |b| scaled(b, 0, b.op::<Dropout>().keep)),
    bug("scale", "cross_entropy", "ignored rows counted", |b| {
        let counted = b.x(1).data().iter().filter(|t| **t >= 0.0).count();
        scaled(b, 0, counted as f64 / b.x(1).len().max(1) as f64)
    }),
    bug("scale", "log_sum_exp", "equal shares", |b| {
        b.changed(0, |d| {
            let mean = d.data().iter().sum::<f64>() / d.len().max(1) as f64;
            d.data_mut().fill(mean);
        })
    }),
    // Sign.
    bug("sign", "div", "the denominator's", |b| scaled(b, 1, -1.0)),
    bug("sign", "minimum", "the second operand's", |b| scaled(b, 1, -1.0)),
    bug("sign", "warp", "the pose's", |b| scaled(b, 2, -1.0)),
    bug("sign", "sqrt", "divided by the argument, not by the result", |b| b.by_element(|g, x| 0.5 * g / x)),
    bug("sign", "cross", "the second operand's", |b| scaled(b, 1, -1.0)),
    // Which inputs are tracked.
    bug("subset", "concat", "misaligned where a part is constant", |b| {
        let mut parts = b.right();
        let axis = b.op::<Concat>().axis;
        if b.wanted.contains(&false) {
            parts.iter_mut().flatten().filter(|d| d.dims()[axis] > 0).for_each(|d| d.data_mut().rotate_left(1));
        }
        parts
    }),
    bug("subset", "mul", "nothing saved where one side is constant", |b| {
        scaled(b, 0, if b.wanted[1] { 1.0 } else { 0.0 })
    }),
    bug("subset", "pow", "nothing saved where one side is constant", |b| {
        scaled(b, 0, if b.wanted[1] { 1.0 } else { 0.0 })
    }),
    // A term dropped, or one too many.
    bug("term", "softmax", "the sum forgotten", |b| {
        let y = b.case.run(&[&b.x(0).clone().into()]).swap_remove(0);
        b.changed(0, |d| {
            let terms = d.data_mut().iter_mut().zip(b.g().data().iter().zip(y.value().data()));
            terms.for_each(|(d, (g, y))| *d = g * y);
        })
    }),
    bug("term", "batch_norm", "a term in the mean, small where samples are many", |b| {
        let (c, rows) = (b.x(0).shape().last(), b.x(0).shape().rows() as f64);
        let mut sums = vec![0.0; c];
        b.g().data().chunks_exact(c).for_each(|g| sums.iter_mut().zip(g).for_each(|(s, g)| *s += g));
        b.changed(0, |d| {
            let each = |d: &mut [f64]| d.iter_mut().zip(&sums).for_each(|(d, s)| *d += s / (rows * rows));
            d.data_mut().chunks_exact_mut(c).for_each(each);
        })
    }),
    bug("term", "batch_norm_eval", "the gradient of training", |b| {
        let (c, rows) = (b.x(0).shape().last(), b.x(0).shape().rows() as f64);
        b.changed(0, |d| {
            let mut mean = vec![0.0; c];
            d.data().chunks_exact(c).for_each(|d| mean.iter_mut().zip(d).for_each(|(m, d)| *m += d / rows));
            let each = |d: &mut [f64]| d.iter_mut().zip(&mean).for_each(|(d, m)| *d -= m);
            d.data_mut().chunks_exact_mut(c).for_each(each);
        })
    }),
    bug("term", "layer_norm", "eps outside the root", |b| {
        let (eps, c) = (b.op::<LayerNorm>().eps, b.x(0).shape().last());
        b.changed(0, |d| {
            for (d, x) in d.data_mut().chunks_exact_mut(c).zip(b.x(0).data().chunks_exact(c)) {
                let mean = x.iter().sum::<f64>() / c as f64;
                let variance = x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / c as f64;
                let factor = (variance + eps).sqrt() / (variance.sqrt() + eps);
                d.iter_mut().for_each(|d| *d *= factor);
            }
        })
    }),
    bug("term", "tanh", "of the argument, not of the result", |b| b.by_element(|g, x| g * (1.0 - x * x))),
    bug("term", "batch_norm", "the statistics taken for constants", statistics_constant),
    bug("term", "log_softmax", "the sum forgotten", |b| b.changed(0, |d| *d = b.g().clone())),
    bug("term", "l2_normalize", "another eps backwards", |b| {
        let L2Normalize { eps } = *b.op::<L2Normalize>();
        b.of(b.inputs, &b.upstream, |v| apply(L2Normalize { eps: 2.0 * eps }, v))
    }),
    bug("term", "top_k", "the first ones, not the largest", |b| {
        b.changed(0, |d| {
            let n = b.g().len();
            d.data_mut().fill(0.0);
            d.data_mut()[..n].copy_from_slice(b.g().data());
        })
    }),
    // Exact zeros.
    bug("zero", "abs", "x over its absolute value", |b| b.by_element(|g, x| g * x / x.abs())),
    bug("zero", "axis_angle_to_rotation", "divided by an angle of 0", |b| {
        b.changed(0, |d| {
            for (d, v) in d.data_mut().chunks_exact_mut(3).zip(b.x(0).data().chunks_exact(3)) {
                let angle = v.iter().map(|v| v * v).sum::<f64>().sqrt();
                d.iter_mut().for_each(|d| *d = *d * angle / angle);
            }
        })
    }),
    bug("zero", "photometric", "a quotient of differences that are 0", |b| {
        let differences: Vec<f64> = b.x(0).data().iter().zip(b.x(1).data()).map(|(a, b)| a - b).collect();
        b.changed(0, |d| d.data_mut().iter_mut().zip(&differences).for_each(|(d, x)| *d = *d * x / x))
    }),
    bug("zero", "silu", "the result over the argument", |b| {
        b.by_element(|g, x| {
            let y = x / (1.0 + (-x).exp());
            g * y / x * (1.0 + x - y)
        })
    }),
    bug("zero", "log_sigmoid", "nothing at 0", |b| b.by_element_where(|x| x == 0.0, 0.0)),
    bug("zero", "pow", "the logarithm of 0", |b| {
        if b.x(0).shape() != b.x(1).shape() {
            return b.right();
        }
        b.changed(1, |d| d.data_mut().iter_mut().zip(b.x(0).data()).for_each(|(d, a)| *d = *d * a / a))
    }),
    bug("zero", "prod", "divided by the factor", by_the_argument_over_itself),
    bug("zero", "cumprod", "divided by the factor", by_the_argument_over_itself),
    bug("zero", "norm", "divided by a length of 0", by_the_argument_over_itself),
    bug("zero", "variance", "a root of nothing", |b| {
        b.changed(0, |d| {
            if d.data().iter().all(|d| *d == 0.0) {
                d.data_mut().fill(f64::NAN);
            }
        })
    }),
];

/// Right but for zeros, where the quotient is NaN.
fn by_the_argument_over_itself(b: &Backward) -> Gradients {
    b.changed(0, |d| d.data_mut().iter_mut().zip(b.x(0).data()).for_each(|(d, x)| *d = *d * x / x))
}

/// The right gradients, with that of one input multiplied.
fn scaled(b: &Backward, input: usize, factor: f64) -> Gradients {
    b.changed(input, |d| d.data_mut().iter_mut().for_each(|d| *d *= factor))
}

/// The right gradients, with that of one input from others.
fn keep(b: &Backward, input: usize, mut wrong: Gradients) -> Gradients {
    b.changed(input, |d| *d = wrong[input].take().expect("wanted"))
}

/// The last two dimensions swapped.
fn transposed(x: &Tensor<f64>) -> Tensor<f64> {
    let mut order: Vec<usize> = (0..x.shape().rank()).collect();
    let last = order.len() - 1;
    order.swap(last - 1, last);
    x.permute(&order)
}

/// The gradient of b as A dY, read as it comes, where A^T dY is right.
fn product_kept_as_it_lies(b: &Backward) -> Gradients {
    let turned = |x: &Tensor<f64>| transposed(x).reshape(*x.shape());
    keep(b, 1, b.at(&[turned(b.x(0)), b.x(1).clone()], &b.upstream))
}

/// Blocks of numbers (the pixels of a window) in reverse order.
fn turned(w: &Tensor<f64>, block: usize) -> Tensor<f64> {
    let mut blocks: Vec<&[f64]> = w.data().chunks(block.max(1)).collect();
    blocks.reverse();
    Tensor::from_vec(*w.shape(), blocks.concat())
}

/// Calls `f` with the elements that equal the maximum of each window, in order, and its upstream gradient.
fn winners(b: &Backward, mut f: impl FnMut(&[usize], f64)) {
    let MaxPool2d { kernel, stride, padding } = *b.op::<MaxPool2d>();
    let [batch, h, w, c] = b.x(0).shape().nhwc().expect("an image");
    let [_, oh, ow, _] = b.g().shape().nhwc().expect("an image");
    let places = Shape::new(&[batch, oh, ow, c]);
    for o in 0..places.len() {
        let (n, oy, ox, ch) = (o / (oh * ow * c), o / (ow * c) % oh, o / c % ow, o % c);
        let mut at = Vec::new();
        for (ky, kx) in (0..kernel).flat_map(|ky| (0..kernel).map(move |kx| (ky, kx))) {
            let (y, x) = ((oy * stride + ky).wrapping_sub(padding), (ox * stride + kx).wrapping_sub(padding));
            if y < h && x < w {
                at.push(((n * h + y) * w + x) * c + ch);
            }
        }
        let x = b.x(0).data();
        let top = at.iter().map(|&i| x[i]).fold(f64::NEG_INFINITY, f64::max);
        at.retain(|&i| x[i] == top);
        f(&at, b.g().data()[o]);
    }
}

fn ties_doubled(b: &Backward) -> Gradients {
    if b.x(0).shape() != b.x(1).shape() {
        return b.right();
    }
    let mut both = b.right();
    for d in both.iter_mut().flatten() {
        let equal = b.x(0).data().iter().zip(b.x(1).data()).map(|(a, b)| a == b);
        d.data_mut().iter_mut().zip(equal).filter(|(_, equal)| *equal).for_each(|(d, _)| *d *= 2.0);
    }
    both
}

/// dx = weight / deviation dy, without what the mean and the variance add. Without an activation only.
fn statistics_constant(b: &Backward) -> Gradients {
    let (eps, c) = (b.op::<BatchNorm>().eps, b.x(0).shape().last());
    let rows = b.x(0).shape().rows() as f64;
    let mut mean = vec![0.0; c];
    let mut variance = vec![0.0; c];
    for x in b.x(0).data().chunks_exact(c) {
        mean.iter_mut().zip(x).for_each(|(m, x)| *m += x / rows);
    }
    for x in b.x(0).data().chunks_exact(c) {
        variance.iter_mut().zip(x.iter().zip(&mean)).for_each(|(v, (x, m))| *v += (x - m).powi(2) / rows);
    }
    b.changed(0, |d| {
        for (d, g) in d.data_mut().chunks_exact_mut(c).zip(b.g().data().chunks_exact(c)) {
            let terms = d.iter_mut().zip(g.iter().zip(b.x(1).data().iter().zip(&variance)));
            terms.for_each(|(d, (g, (weight, variance)))| *d = g * weight / (variance + eps).sqrt());
        }
    })
}
