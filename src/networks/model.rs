//! The networks that are trained together: encoder, decoder, pose network, over one set of parameters.

use super::{AnyDecoder, AnyEncoder, Config};
use crate::monovit::pose::{PoseDecoder, PoseEncoder};
use crate::nn::{Builder, Context, Conv, Folded, ParamId, Params};
use crate::random::{Random, Stream};
use crate::tensor::{Float, Tensor, Var, profile};

/// A depth network and the pose network that it is trained with: `encoder`, `depth`, `pose_encoder`, `pose` in a checkpoint.
#[derive(Clone, Debug)]
pub struct DepthNetwork {
    /// The sizes.
    pub config: Config,
    encoder: AnyEncoder,
    depth: AnyDecoder,
    pose_encoder: PoseEncoder,
    pose: PoseDecoder,
}

impl DepthNetwork {
    /// The networks, and their parameters as they start, drawn from `seed`.
    ///
    /// # Panics
    /// If [`Config::check`] refuses the sizes.
    #[track_caller]
    pub fn new<T: Float>(config: impl Into<Config>, seed: u64) -> (Self, Params<T>) {
        let config: Config = config.into();
        let (mut params, mut random) = (Params::new(), Random::of(seed, Stream::Weights));
        let b = &mut Builder::new(&mut params, &mut random).starting(config.start);
        let model = DepthNetwork {
            encoder: config.encoder.build(&mut b.at("encoder")),
            depth: config.decoder.build(&mut b.at("depth"), &config.encoder.maps()),
            pose_encoder: PoseEncoder::new(&mut b.at("pose_encoder"), config.pose),
            pose: PoseDecoder::new(&mut b.at("pose"), config.pose),
            config,
        };
        (model, params)
    }

    /// The biases of the convolutions whose sigmoid the disparities are, largest disparity first.
    pub fn head_biases(&self) -> Vec<ParamId> {
        self.depth.heads().iter().filter_map(Conv::bias).collect()
    }

    /// The encoder's maps, largest first, of an image `[B, H, W, 3]` in [0, 1].
    #[track_caller]
    pub fn features<T: Float>(&self, c: &Context<T>, image: &Var<T>) -> Vec<Var<T>> {
        self.encoder.forward(c, image)
    }

    /// Disparities (sigmoid, in [0, 1]) at 1, 1/2, 1/4, 1/8 of the image, `[B, h, w, 1]` each.
    #[track_caller]
    pub fn disparities<T: Float>(&self, c: &Context<T>, image: &Var<T>) -> Vec<Var<T>> {
        self.depth.forward(c, &self.features(c, image))
    }

    /// [`disparities`](DepthNetwork::disparities) for inference, as plain tensors: nothing is recorded, and normalisations
    /// are folded into convolutions.
    ///
    /// Pictures run side by side, one on a thread, so that what a layer computes is still in its core's cache when the
    /// next one reads it.
    #[track_caller]
    pub fn predict<T: Float>(&self, params: &Folded<T>, images: &Tensor<T>) -> Vec<Tensor<T>> {
        let [count, h, w, channels] = images.shape().nhwc().expect("pictures");
        let picture = |i: usize| {
            let numbers = &images.data()[i * h * w * channels..][..h * w * channels];
            let image = Tensor::build([1, h, w, channels], |out| out.copy_from_slice(numbers));
            let c = Context::folded(params);
            let scales = self.disparities(&c, &Var::constant(image));
            profile::phase("freeing", || drop(c));
            scales.into_iter().map(Var::into_value).collect::<Vec<_>>()
        };
        let mut pictures = profile::map(count, picture);
        if count == 1 {
            return pictures.swap_remove(0);
        }
        let scale = |s: usize| Tensor::stack(&pictures.iter().map(|p| &p[s]).collect::<Vec<_>>());
        profile::phase("pictures into a batch", || (0..4).map(scale).collect())
    }

    /// Disparities from the encoder's maps.
    #[track_caller]
    pub fn decode<T: Float>(&self, c: &Context<T>, features: &[Var<T>]) -> Vec<Var<T>> {
        self.depth.forward(c, features)
    }

    /// Axis-angle and translation, `[B, 6]`, of the camera's motion from the first frame to the second.
    #[track_caller]
    pub fn motion<T: Float>(&self, c: &Context<T>, first: &Var<T>, second: &Var<T>) -> Var<T> {
        self.pose.forward(c, &self.pose_encoder.forward(c, first, second))
    }

    /// The transforms `[B, 3, 4]` of points of the target camera into the previous and the next one.
    ///
    /// The pairs are seen in time order, in two separate passes: (previous, target), whose motion is inverted, then
    /// (target, next).
    #[track_caller]
    pub fn transforms<T: Float>(&self, c: &Context<T>, prev: &Var<T>, target: &Var<T>, next: &Var<T>) -> Vec<Var<T>> {
        [(prev, target, true), (target, next, false)]
            .map(|(first, second, invert)| {
                let motion = self.motion(c, first, second);
                Var::pose_matrix(&motion.slice(1, 0..3), &motion.slice(1, 3..6), invert)
            })
            .into()
    }
}
