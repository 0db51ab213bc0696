//! Residual networks (He et al., 1512.03385) for pictures, with torchvision's names: 18, 34 and 50 layers.

use super::{Builder, Context, Conv, ConvBn, ConvStart};
use crate::ops::{Activation, Conv2d};
use crate::tensor::{Float, Var};

/// How many layers a residual network has, which also decides what its blocks are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ResNetLayers {
    /// Blocks of two 3x3 convolutions: 2, 2, 2, 2 of them.
    Eighteen,
    /// Blocks of two 3x3 convolutions: 3, 4, 6, 3 of them.
    ThirtyFour,
    /// Bottlenecks (1x1, 3x3, 1x1 to four times the width): 3, 4, 6, 3 of them.
    Fifty,
}

impl ResNetLayers {
    /// All, smallest first.
    pub const ALL: [ResNetLayers; 3] = [ResNetLayers::Eighteen, ResNetLayers::ThirtyFour, ResNetLayers::Fifty];

    /// The number in the name.
    pub fn count(self) -> usize {
        match self {
            ResNetLayers::Eighteen => 18,
            ResNetLayers::ThirtyFour => 34,
            ResNetLayers::Fifty => 50,
        }
    }

    /// Number of blocks in each of the four stages.
    pub fn blocks(self) -> [usize; 4] {
        match self {
            ResNetLayers::Eighteen => [2, 2, 2, 2],
            ResNetLayers::ThirtyFour | ResNetLayers::Fifty => [3, 4, 6, 3],
        }
    }

    /// Channels that leave a block, over the width of the 3x3 convolution in it.
    pub fn expansion(self) -> usize {
        if self == ResNetLayers::Fifty { 4 } else { 1 }
    }

    /// Channels of the five maps of a network whose stem has `width` channels.
    pub fn channels(self, width: usize) -> [usize; 5] {
        let wide = self.expansion() * width;
        [width, wide, 2 * wide, 4 * wide, 8 * wide]
    }
}

/// A residual network without its classification head.
#[derive(Clone, Debug)]
pub struct ResNet {
    stem: ConvBn,
    stages: [Vec<Block>; 4],
}

impl ResNet {
    /// A network on pictures of `inputs` channels, whose stem has `width` (published: 64). The parameters stand directly
    /// under the builder's path.
    pub fn new<T: Float>(b: &mut Builder<T>, inputs: usize, layers: ResNetLayers, width: usize) -> Self {
        let stem = Conv::new(&mut b.at("conv1"), [inputs, width], 7, Conv2d::padded(3).strided(2), ConvStart::He)
            .normalised(&mut b.at("bn1"), Activation::Relu);
        let mut channels = width;
        let stages = std::array::from_fn(|stage| {
            let block = |block: usize| {
                let stride = if stage > 0 && block == 0 { 2 } else { 1 };
                let mut b = b.at(format!("layer{}.{block}", stage + 1));
                let made = Block::new(&mut b, channels, width << stage, stride, layers.expansion());
                channels = (width << stage) * layers.expansion();
                made
            };
            (0..layers.blocks()[stage]).map(block).collect()
        });
        ResNet { stem, stages }
    }

    /// `[B, H, W, inputs]` to five maps: the stem's at 1/2, and each stage's at 1/4 (behind a 3x3 maximum of stride 2), 1/8,
    /// 1/16, 1/32.
    #[track_caller]
    pub fn forward<T: Float>(&self, c: &Context<T>, x: &Var<T>) -> Vec<Var<T>> {
        let mut maps = vec![self.stem.forward(c, x)];
        let mut x = maps[0].max_pool2d(3, 2, 1);
        for stage in &self.stages {
            for block in stage {
                x = block.forward(c, &x);
            }
            maps.push(x.clone());
        }
        maps
    }
}

/// Convolutions, and what went in added to what came out.
#[derive(Clone, Debug)]
struct Block {
    /// Two, or the three of a bottleneck; the last one has no activation before the sum.
    convs: Vec<ConvBn>,
    downsample: Option<ConvBn>,
}

impl Block {
    fn new<T: Float>(b: &mut Builder<T>, inputs: usize, width: usize, stride: usize, expansion: usize) -> Self {
        let outputs = width * expansion;
        let sizes = match expansion {
            1 => vec![([inputs, width], 3, stride), ([width, width], 3, 1)],
            _ => vec![([inputs, width], 1, 1), ([width, width], 3, stride), ([width, outputs], 1, 1)],
        };
        let last = sizes.len();
        let conv = |(i, (channels, kernel, stride)): (usize, ([usize; 2], usize, usize))| {
            let op = Conv2d::padded(kernel / 2).strided(stride);
            let activation = if i + 1 == last { Activation::None } else { Activation::Relu };
            Conv::new(&mut b.at(format!("conv{}", i + 1)), channels, kernel, op, ConvStart::He)
                .normalised(&mut b.at(format!("bn{}", i + 1)), activation)
        };
        let convs = sizes.into_iter().enumerate().map(conv).collect();
        let downsample = (stride != 1 || inputs != outputs).then(|| {
            let op = Conv2d::default().strided(stride);
            Conv::new(&mut b.at("downsample.0"), [inputs, outputs], 1, op, ConvStart::He)
                .normalised(&mut b.at("downsample.1"), Activation::None)
        });
        Block { convs, downsample }
    }

    fn forward<T: Float>(&self, c: &Context<T>, x: &Var<T>) -> Var<T> {
        let mut h = self.convs[0].forward(c, x);
        for conv in &self.convs[1..] {
            h = conv.forward(c, &h);
        }
        match &self.downsample {
            Some(conv) => (h + conv.forward(c, x)).relu(),
            None => (h + x).relu(),
        }
    }
}
