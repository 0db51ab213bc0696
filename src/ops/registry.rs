//! The registry: every op of this crate, by name. One line each; what is not here does not build.

use std::any::Any;
use std::marker::PhantomData;

use super::apply::execute;
use super::attention::{factorised, relative_position};
use super::case::{Case, Input, Terms};
use super::conv::{conv2d, depthwise, transpose, upsampled};
use super::depth::{disparity_to_depth, min_reprojection, photometric, pose, rotation, smoothness, ssim, warp};
use super::elementwise::{activation, binary, dropout, pow, select, unary};
use super::image::{grid_sample, pool2d, reflect_pad, resize_bilinear, upsample_nearest};
use super::movement::{concat, flip, gather, index_select, repeat, scatter_add, shape_ops, slice, sort, top_k};
use super::normalise::{batch_norm, layer_norm};
use super::op::{Op, Registered};
use super::product::{cross, linear, matmul};
use super::reduce::{cross_entropy, cumulative, log_softmax, log_sum_exp, norm, prod, softmax, sum, variance};
use super::{ShapeError, apply};
use crate::random::Random;
use crate::tensor::{Float, Shape, Signature, Var};

/// What runs an op in one element type.
type Run<O, T> = fn(O, &[&Var<T>]) -> Result<Vec<Var<T>>, String>;

/// [`Run`] for both.
struct Runs<O>(PhantomData<O>);

impl<O> Signature for Runs<O> {
    type Of<T: Float> = Run<O, T>;
}

/// Makes the list of all ops and, in the same breath, lets each of them be an [`Op`].
macro_rules! registry {
    ($($name:literal => $op:ty),* $(,)?) => {
        $(impl Registered for $op {
            const NAME: &'static str = $name;

            fn run<T: Float>(self, inputs: &[&Var<T>]) -> Result<Vec<Var<T>>, String>
            where
                Self: Op<T>,
            {
                // The two instances exist in this crate, whoever calls.
                static SINGLE: Run<$op, f32> = execute;
                static DOUBLE: Run<$op, f64> = execute;
                T::pick::<Runs<$op>>(SINGLE, DOUBLE)(self, inputs)
            }
        })*

        /// Every op of this crate.
        pub fn all() -> Vec<Entry> {
            vec![$(Entry::of::<$op>()),*]
        }
    };
}

registry! {
    "relu" => unary::Unary<unary::Relu>,
    "elu" => unary::Unary<unary::Elu>,
    "gelu" => unary::Unary<unary::Gelu>,
    "hardswish" => unary::Unary<unary::Hardswish>,
    "sigmoid" => unary::Unary<unary::Sigmoid>,
    "tanh" => unary::Unary<unary::Tanh>,
    "exp" => unary::Unary<unary::Exp>,
    "log" => unary::Unary<unary::Log>,
    "sqrt" => unary::Unary<unary::Sqrt>,
    "abs" => unary::Unary<unary::Abs>,
    "reciprocal" => unary::Unary<unary::Reciprocal>,
    "square" => unary::Unary<unary::Square>,
    "clamp" => unary::Unary<unary::Clamp>,
    "affine" => unary::Unary<unary::Affine>,
    "add" => binary::Binary<binary::Add>,
    "sub" => binary::Binary<binary::Sub>,
    "mul" => binary::Binary<binary::Mul>,
    "div" => binary::Binary<binary::Div>,
    "maximum" => binary::Binary<binary::Maximum>,
    "minimum" => binary::Binary<binary::Minimum>,
    "sum" => sum::Sum,
    "max" => sum::Extreme<sum::Max>,
    "min" => sum::Extreme<sum::Min>,
    "reshape" => shape_ops::Reshape,
    "permute" => shape_ops::Permute,
    "matmul" => matmul::Matmul,
    "linear" => linear::Linear,
    "conv2d" => conv2d::Conv2d,
    "concat" => concat::Concat,
    "depthwise_conv2d" => depthwise::DepthwiseConv2d,
    "max_pool2d" => pool2d::MaxPool2d,
    "avg_pool2d" => pool2d::AvgPool2d,
    "resize_bilinear" => resize_bilinear::ResizeBilinear,
    "reflect_pad" => reflect_pad::ReflectPad,
    "slice" => slice::Slice,
    "upsample_nearest" => upsample_nearest::UpsampleNearest,
    "upsampled_conv2d" => upsampled::UpsampledConv2d,
    "batch_norm" => batch_norm::BatchNorm,
    "batch_norm_eval" => batch_norm::BatchNormEval,
    "layer_norm" => layer_norm::LayerNorm,
    "softmax" => softmax::Softmax,
    "factorised_attention" => factorised::FactorisedAttention,
    "axis_angle_to_rotation" => rotation::AxisAngleToRotation,
    "grid_sample" => grid_sample::GridSample,
    "warp" => warp::Warp,
    "ssim_loss" => ssim::SsimLoss,
    "photometric" => photometric::Photometric,
    "smoothness" => smoothness::Smoothness,
    "min_reprojection" => min_reprojection::MinReprojection,
    "pose_matrix" => pose::PoseMatrix,
    "conv_relative_position" => relative_position::ConvRelativePosition,
    "index_select" => index_select::IndexSelect,
    "gather" => gather::Gather,
    "scatter_add" => scatter_add::ScatterAdd,
    "sort" => sort::Sort,
    "top_k" => top_k::TopK,
    "dropout" => dropout::Dropout,
    "conv_transpose2d" => transpose::ConvTranspose2d,
    "cross" => cross::Cross,
    "repeat" => repeat::Repeat,
    "flip" => flip::Flip,
    "disparity_to_depth" => unary::Unary<disparity_to_depth::DisparityToDepth>,
    "softplus" => unary::Unary<activation::Softplus>,
    "log_sigmoid" => unary::Unary<activation::LogSigmoid>,
    "silu" => unary::Unary<activation::Silu>,
    "leaky_relu" => unary::Unary<activation::LeakyRelu>,
    "relu6" => unary::Unary<activation::Relu6>,
    "hardsigmoid" => unary::Unary<activation::Hardsigmoid>,
    "pow" => binary::Binary<pow::Pow>,
    "powf" => unary::Unary<pow::Powf>,
    "select" => select::Select,
    "prod" => prod::Prod,
    "cumsum" => cumulative::CumSum,
    "cumprod" => cumulative::CumProd,
    "norm" => norm::Norm,
    "l2_normalize" => norm::L2Normalize,
    "variance" => variance::Variance,
    "log_sum_exp" => log_sum_exp::LogSumExp,
    "log_softmax" => log_softmax::LogSoftmax,
    "cross_entropy" => cross_entropy::CrossEntropy,
}

/// The most numbers in the inputs of a case that is drawn.
const MOST_DRAWN: usize = 1000;

/// One registered op: its name and its gradient-check cases.
pub struct Entry {
    /// The name.
    pub name: &'static str,
    cases: fn() -> Vec<Box<dyn AnyCase>>,
    draw: fn(&mut Random) -> Option<Box<dyn AnyCase>>,
}

impl Entry {
    /// An op, of this crate or a [`CustomOp`](super::CustomOp).
    pub fn of<O: Op<f64> + Op<f32>>() -> Self {
        Entry {
            name: O::NAME,
            cases: || O::cases().into_iter().map(|case| Box::new(case) as Box<dyn AnyCase>).collect(),
            draw: |random| O::draw(random).map(|case| Box::new(case) as Box<dyn AnyCase>),
        }
    }

    /// A case that nobody listed (see [`Checked::draw`](super::Checked::draw)), which the op's shape rule takes, which has
    /// something to differentiate, and not more than finite differences can afford; `None` if the op draws none, or none
    /// in a hundred is taken.
    pub fn draw(&self, random: &mut Random) -> Option<Box<dyn AnyCase>> {
        for _ in 0..100 {
            let case = (self.draw)(random)?;
            let shapes = case.terms().shapes();
            let taken = case.outputs(&shapes).is_ok_and(|outputs| outputs.iter().all(|y| !y.is_empty()));
            let elements: usize = shapes.iter().map(Shape::len).sum();
            if taken && elements <= MOST_DRAWN && shapes.iter().all(|x| !x.is_empty()) {
                return Some(case);
            }
        }
        None
    }

    /// Its gradient-check cases.
    pub fn cases(&self) -> Vec<Box<dyn AnyCase>> {
        (self.cases)()
    }
}

/// A case of any op.
pub trait AnyCase {
    /// The op's name.
    fn op(&self) -> &'static str;
    /// The kernel path it takes.
    fn algo(&self) -> &'static str;
    /// Its inputs, and what is promised of its gradients.
    fn terms(&self) -> &Terms;
    /// How many of the outputs, at the end, are not differentiated.
    fn auxiliary(&self) -> usize;
    /// The shapes of all its outputs.
    fn outputs(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError>;
    /// The [`Case`] itself, for who knows its op.
    fn as_any(&self) -> &dyn Any;
    /// Runs the op in f64.
    fn run(&self, inputs: &[&Var<f64>]) -> Vec<Var<f64>>;
    /// Runs the op in f32.
    fn run_f32(&self, inputs: &[&Var<f32>]) -> Vec<Var<f32>>;
}

impl dyn AnyCase + '_ {
    /// The case's name.
    pub fn name(&self) -> &'static str {
        self.terms().name
    }
    /// Its inputs.
    pub fn inputs(&self) -> &[Input] {
        &self.terms().inputs
    }
    /// The largest error allowed.
    pub fn tolerance(&self) -> f64 {
        self.terms().tolerance
    }
    /// Why that is more than usual.
    pub fn reason(&self) -> Option<&'static str> {
        self.terms().reason
    }
    /// How many elements sit on a kink.
    pub fn kinks(&self) -> usize {
        self.terms().kinks
    }
    /// An input and its gradient for cotangents of one, where the case promises it.
    pub fn promise(&self) -> Option<(usize, &[f64])> {
        self.terms().promise.as_ref().map(|(input, gradient)| (*input, &gradient[..]))
    }
    /// Whether every gradient is rightly zero.
    pub fn flat(&self) -> bool {
        self.terms().flat
    }
}

impl<O: Op<f64> + Op<f32>> AnyCase for Case<O> {
    fn op(&self) -> &'static str {
        O::NAME
    }
    fn algo(&self) -> &'static str {
        Op::<f64>::algo(&self.op, &self.terms.shapes())
    }
    fn terms(&self) -> &Terms {
        &self.terms
    }
    fn outputs(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        Op::<f64>::shape(&self.op, inputs)
    }
    fn as_any(&self) -> &dyn Any {
        self
    }
    fn auxiliary(&self) -> usize {
        Op::<f64>::auxiliary(&self.op)
    }
    fn run(&self, inputs: &[&Var<f64>]) -> Vec<Var<f64>> {
        apply(self.op.clone(), inputs)
    }
    fn run_f32(&self, inputs: &[&Var<f32>]) -> Vec<Var<f32>> {
        apply(self.op.clone(), inputs)
    }
}
