//! The pose network: ResNet-18 (He et al., 1512.03385) on two frames, and a small decoder (Monodepth2, section 4).

use super::config::Config;
use crate::nn::{Builder, Context, Conv, ConvBn, ConvStart};
use crate::ops::{Activation, Conv2d};
use crate::tensor::{Float, Var};

/// Pose encoder: ResNet-18 on two frames, concatenated along the channels; its last map goes on.
#[derive(Clone, Debug)]
pub struct PoseEncoder {
    stem: ConvBn,
    blocks: Vec<BasicBlock>,
}

impl PoseEncoder {
    /// The parameters stand directly under the builder's path.
    pub fn new<T: Float>(b: &mut Builder<T>, config: &Config) -> Self {
        let b = &mut b.at("encoder");
        let w = config.pose_width;
        let stem = Conv::new(&mut b.at("conv1"), [6, w], 7, Conv2d::padded(3).strided(2), ConvStart::He)
            .normalised(&mut b.at("bn1"), Activation::Relu);
        let mut blocks = Vec::new();
        let mut channels = w;
        for layer in 0..4 {
            for block in 0..2 {
                let out = w << layer;
                let stride = if layer > 0 && block == 0 { 2 } else { 1 };
                let mut b = b.at(format!("layer{}.{block}", layer + 1));
                blocks.push(BasicBlock::new(&mut b, [channels, out], stride));
                channels = out;
            }
        }
        PoseEncoder { stem, blocks }
    }

    /// Two frames `[B, H, W, 3]` in [0, 1], in time order, to a map at 1/32 of the image.
    #[track_caller]
    pub fn forward<T: Float>(&self, c: &Context<T>, first: &Var<T>, second: &Var<T>) -> Var<T> {
        let x = Var::concat(&[first, second], 3).affine(1.0 / 0.225, -0.45 / 0.225);
        let mut x = self.stem.forward(c, &x).max_pool2d(3, 2, 1);
        for block in &self.blocks {
            x = block.forward(c, &x);
        }
        x
    }
}

/// Two 3x3 convolutions, and what went in added to what came out.
#[derive(Clone, Debug)]
struct BasicBlock {
    conv1: ConvBn,
    conv2: ConvBn,
    downsample: Option<ConvBn>,
}

impl BasicBlock {
    fn new<T: Float>(b: &mut Builder<T>, [inputs, outputs]: [usize; 2], stride: usize) -> Self {
        let conv = |b: &mut Builder<T>, inputs, stride| {
            Conv::new(b, [inputs, outputs], 3, Conv2d::padded(1).strided(stride), ConvStart::He)
        };
        BasicBlock {
            conv1: conv(&mut b.at("conv1"), inputs, stride).normalised(&mut b.at("bn1"), Activation::Relu),
            conv2: conv(&mut b.at("conv2"), outputs, 1).normalised(&mut b.at("bn2"), Activation::None),
            downsample: (stride != 1 || inputs != outputs).then(|| {
                let op = Conv2d::default().strided(stride);
                Conv::new(&mut b.at("downsample.0"), [inputs, outputs], 1, op, ConvStart::He)
                    .normalised(&mut b.at("downsample.1"), Activation::None)
            }),
        }
    }

    fn forward<T: Float>(&self, c: &Context<T>, x: &Var<T>) -> Var<T> {
        let h = self.conv2.forward(c, &self.conv1.forward(c, x));
        match &self.downsample {
            Some(conv) => (h + conv.forward(c, x)).relu(),
            None => (h + x).relu(),
        }
    }
}

/// The pose decoder: four convolutions, the mean over the image, times 0.01.
#[derive(Clone, Debug)]
pub struct PoseDecoder {
    net: Vec<Conv>,
}

impl PoseDecoder {
    /// The parameters stand directly under the builder's path.
    pub fn new<T: Float>(b: &mut Builder<T>, config: &Config) -> Self {
        let (w, s) = (8 * config.pose_width, config.pose_squeeze);
        let sizes = [([w, s], 1), ([s, s], 3), ([s, s], 3), ([s, 12], 1)];
        let net = sizes.into_iter().enumerate().map(|(i, (channels, kernel))| {
            let op = Conv2d::padded(kernel / 2);
            let activation = if i < 3 { Activation::Relu } else { Activation::None };
            let op = op.activated(activation);
            Conv::new(&mut b.at(format!("net.{i}")), channels, kernel, op, ConvStart::FanInWithBias)
        });
        PoseDecoder { net: net.collect() }
    }

    /// Axis-angle and translation, `[B, 6]`, of the motion between the two frames.
    ///
    /// The published decoder predicts two motions and uses the first: so do we, and its names fit.
    #[track_caller]
    pub fn forward<T: Float>(&self, c: &Context<T>, map: &Var<T>) -> Var<T> {
        let mut x = map.clone();
        for conv in &self.net[..3] {
            x = conv.forward(c, &x);
        }
        self.net[3].forward(c, &x).mean(1, 2).affine(0.01, 0.0).slice(1, 0..6)
    }
}
