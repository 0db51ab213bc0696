//! Convolutions as modules.

use super::{BatchNorm, Builder, Context, Init, Layout, ParamId};
use crate::ops::{Activation, Conv2d, DepthwiseConv2d};
use crate::tensor::{Float, Var};

/// A convolution with its weight `[k, k, in, out]` and, optionally, bias `[out]`.
#[derive(Clone, Debug)]
pub struct Conv {
    weight: ParamId,
    bias: Option<ParamId>,
    op: Conv2d,
}

/// Concatenation of images along their channels that is never made: a convolution reads the parts where they lie.
#[derive(Clone)]
pub struct Joined<'a, T: Float> {
    /// The first one at half the size of the others, `[B, H / 2, W / 2, ..]`, each of whose pixels stands for four; it
    /// needs a window that keeps the size, 1x1 or 3x3 over mirrored padding.
    pub small: Option<&'a Var<T>>,
    /// The others, `[B, H, W, ..]`.
    pub parts: Vec<&'a Var<T>>,
}

impl<'a, T: Float> Joined<'a, T> {
    /// All its images.
    pub fn images(&self) -> impl Iterator<Item = &'a Var<T>> {
        self.small.into_iter().chain(self.parts.iter().copied())
    }
}

impl<'a, T: Float> From<&'a Var<T>> for Joined<'a, T> {
    fn from(x: &'a Var<T>) -> Self {
        Joined { small: None, parts: vec![x] }
    }
}

/// Initialisation of a convolution, and whether it has a bias.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ConvStart {
    /// He's normal by fan out (or as the builder's [`Start`](super::Start) has it), no bias: in front of a
    /// normalisation.
    He,
    /// Uniform within 1 / sqrt(fan in), no bias.
    FanIn,
    /// Uniform within 1 / sqrt(fan in), the bias too.
    FanInWithBias,
}

impl Conv {
    /// A `kernel` x `kernel` convolution; the parameters stand directly under the builder's path.
    pub fn new<T: Float>(
        b: &mut Builder<T>,
        channels: [usize; 2],
        kernel: usize,
        op: Conv2d,
        start: ConvStart,
    ) -> Self {
        let [inputs, outputs] = channels;
        let count = inputs * kernel * kernel;
        let fan_in = Init::FanIn(count);
        let init = if start == ConvStart::He { b.start(Init::he(kernel, outputs), count) } else { fan_in };
        let weight = b.param("weight", [kernel, kernel, inputs, outputs], Layout::Conv, init);
        let bias = (start == ConvStart::FanInWithBias).then(|| b.param("bias", [outputs], Layout::Same, fan_in));
        Conv { weight, bias, op }
    }

    fn op<T: Float>(&self, c: &Context<T>) -> Conv2d {
        Conv2d { precision: c.precision(), ..self.op }
    }

    /// `[B, H, W, in] -> [B, H', W', out]`.
    #[track_caller]
    pub fn forward<T: Float>(&self, c: &Context<T>, x: &Var<T>) -> Var<T> {
        x.conv2d(c.var(self.weight), self.bias.map(|b| c.var(b)), self.op(c))
    }

    /// The convolution of images side by side along their channels, `[B, H, W, ..] -> [B, H', W', out]`.
    #[track_caller]
    pub fn forward_parts<T: Float>(&self, c: &Context<T>, parts: &[&Var<T>]) -> Var<T> {
        Var::conv2d_of_parts(parts, c.var(self.weight), self.bias.map(|b| c.var(b)), self.op(c))
    }

    /// The same of images `joined`, times one gate `[in]` for each of their channels, if there is one: the weights take
    /// the gate, since there are fewer of them than pixels.
    #[track_caller]
    pub fn forward_joined<T: Float>(&self, c: &Context<T>, joined: &Joined<T>, gate: Option<&Var<T>>) -> Var<T> {
        let (weight, bias) = (c.var(self.weight), self.bias.map(|b| c.var(b)));
        let gated = gate.map(|gate| weight * gate.reshape([1, 1, gate.shape().len(), 1]));
        let weight = gated.as_ref().unwrap_or(weight);
        match joined.small {
            Some(small) => Var::conv2d_of_upsampled(small, &joined.parts, weight, bias, self.op(c)),
            None => Var::conv2d_of_parts(&joined.parts, weight, bias, self.op(c)),
        }
    }

    /// Its bias, if it has one.
    pub fn bias(&self) -> Option<ParamId> {
        self.bias
    }

    /// This convolution with an activation applied to its result.
    pub fn activated(mut self, activation: Activation) -> Self {
        self.op = self.op.activated(activation);
        self
    }

    /// A batch normalisation directly behind this convolution; it stands under the builder's path.
    pub fn normalised<T: Float>(self, b: &mut Builder<T>, activation: Activation) -> Normalised<Conv> {
        let channels = b.channels(self.weight);
        let bn = BatchNorm::new(b, channels, activation);
        b.normalised(self.weight, &bn);
        Normalised { conv: self, bn }
    }
}

/// A convolution and the batch normalisation directly behind it, which inference folds into one.
#[derive(Clone, Debug)]
pub struct Normalised<C> {
    conv: C,
    bn: BatchNorm,
}

impl Normalised<Conv> {
    /// `[B, H, W, in] -> [B, H', W', out]`.
    #[track_caller]
    pub fn forward<T: Float>(&self, c: &Context<T>, x: &Var<T>) -> Var<T> {
        self.forward_parts(c, &[x])
    }

    /// The same of images side by side along their channels, `[B, H, W, ..] -> [B, H', W', out]`.
    #[track_caller]
    pub fn forward_parts<T: Float>(&self, c: &Context<T>, parts: &[&Var<T>]) -> Var<T> {
        if !c.is_folded() {
            return self.bn.forward(c, &self.conv.forward_parts(c, parts));
        }
        let op = self.conv.op(c).activated(self.bn.activation);
        Var::conv2d_of_parts(parts, c.var(self.conv.weight), Some(c.var(self.bn.bias)), op)
    }
}

impl Normalised<DepthwiseConv> {
    /// `[B, H, W, C] -> [B, H / stride, W / stride, C]`.
    #[track_caller]
    pub fn forward<T: Float>(&self, c: &Context<T>, x: &Var<T>) -> Var<T> {
        if !c.is_folded() {
            return self.bn.forward(c, &self.conv.forward(c, x));
        }
        let op = DepthwiseConv2d { activation: self.bn.activation, ..self.conv.op() };
        x.depthwise(c.var(self.conv.weight), Some(c.var(self.bn.bias)), op)
    }
}

/// Convolution without bias, batch normalisation, activation: `conv` and `bn` in a checkpoint.
pub type ConvBn = Normalised<Conv>;

impl ConvBn {
    /// A `kernel` x `kernel` convolution with zero padding of half the kernel.
    pub fn new<T: Float>(
        b: &mut Builder<T>,
        channels: [usize; 2],
        kernel: usize,
        stride: usize,
        activation: Activation,
    ) -> Self {
        let op = Conv2d::padded(kernel / 2).strided(stride);
        Conv::new(&mut b.at("conv"), channels, kernel, op, ConvStart::He).normalised(&mut b.at("bn"), activation)
    }
}

/// A depthwise convolution with zero padding of half its window: weight `[k, k, channels]`, optionally bias.
#[derive(Clone, Debug)]
pub struct DepthwiseConv {
    weight: ParamId,
    bias: Option<ParamId>,
    kernel: usize,
    stride: usize,
}

impl DepthwiseConv {
    /// The parameters stand directly under the builder's path.
    pub fn new<T: Float>(
        b: &mut Builder<T>,
        channels: usize,
        kernel: usize,
        stride: usize,
        init: Init,
        bias: bool,
    ) -> Self {
        let weight = b.param("weight", [kernel, kernel, channels], Layout::Depthwise, init);
        let bias = bias.then(|| b.param("bias", [channels], Layout::Same, init));
        DepthwiseConv { weight, bias, kernel, stride }
    }

    /// `[B, H, W, C] -> [B, H / stride, W / stride, C]`.
    #[track_caller]
    pub fn forward<T: Float>(&self, c: &Context<T>, x: &Var<T>) -> Var<T> {
        x.depthwise(c.var(self.weight), self.bias.map(|b| c.var(b)), self.op())
    }

    fn op(&self) -> DepthwiseConv2d {
        DepthwiseConv2d { stride: self.stride, padding: self.kernel / 2, ..DepthwiseConv2d::default() }
    }

    /// A batch normalisation directly behind this convolution; it stands under the builder's path.
    pub fn normalised<T: Float>(self, b: &mut Builder<T>, activation: Activation) -> Normalised<DepthwiseConv> {
        let channels = b.channels(self.weight);
        let bn = BatchNorm::new(b, channels, activation);
        b.normalised(self.weight, &bn);
        Normalised { conv: self, bn }
    }

    /// Its weight, and its bias if it has one.
    pub fn params(&self) -> (ParamId, Option<ParamId>) {
        (self.weight, self.bias)
    }
}
