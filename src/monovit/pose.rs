//! The pose network: ResNet-18 (He et al., 1512.03385) on two frames, and a small decoder (Monodepth2, section 4).

use serde::{Deserialize, Serialize};

use crate::nn::{Builder, Context, Conv, ConvStart, ResNet, ResNetLayers};
use crate::ops::{Activation, Conv2d};
use crate::tensor::{Float, Var};

/// Sizes of the pose network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PoseConfig {
    /// Number of channels of the ResNet's first stage.
    pub width: usize,
    /// Number of channels of the decoder.
    pub squeeze: usize,
}

/// Pose encoder: ResNet-18 on two frames, concatenated along the channels; its last map goes on.
#[derive(Clone, Debug)]
pub struct PoseEncoder(ResNet);

impl PoseEncoder {
    /// The parameters stand directly under the builder's path.
    pub fn new<T: Float>(b: &mut Builder<T>, config: PoseConfig) -> Self {
        PoseEncoder(ResNet::new(&mut b.at("encoder"), 6, ResNetLayers::Eighteen, config.width))
    }

    /// Two frames `[B, H, W, 3]` in [0, 1], in time order, to a map at 1/32 of the image.
    #[track_caller]
    pub fn forward<T: Float>(&self, c: &Context<T>, first: &Var<T>, second: &Var<T>) -> Var<T> {
        let x = Var::concat(&[first, second], 3).affine(1.0 / 0.225, -0.45 / 0.225);
        self.0.forward(c, &x).swap_remove(4)
    }
}

/// The pose decoder: four convolutions, the mean over the image, times 0.01.
#[derive(Clone, Debug)]
pub struct PoseDecoder {
    net: Vec<Conv>,
}

impl PoseDecoder {
    /// The parameters stand directly under the builder's path.
    pub fn new<T: Float>(b: &mut Builder<T>, config: PoseConfig) -> Self {
        let (w, s) = (8 * config.width, config.squeeze);
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
