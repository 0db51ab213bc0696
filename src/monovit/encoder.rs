//! The depth encoder: MPViT (Lee et al., 2112.11010) with five outputs (MonoViT, section 3.2).
//!
//! Every stage embeds its input at several window sizes (a cascade of 3x3 depthwise-separable convolutions), sends each
//! embedding through transformer layers and the first one through a convolutional block beside them, and fuses all.

use std::sync::Arc;

use super::config::Config;
use crate::nn::{Builder, Context, Conv, ConvBn, ConvStart, DepthwiseConv, Init, LayerNorm, Linear, Normalised};
use crate::ops::{Activation, Conv2d};
use crate::tensor::{Float, Var};

/// MPViT encoder: from RGB in [0, 1], `[B, H, W, 3]` with H and W multiples of 32, to five maps at 1/2, 1/4, 1/8, 1/16,
/// 1/32.
#[derive(Clone, Debug)]
pub struct Encoder {
    stem: [ConvBn; 2],
    stages: Vec<Stage>,
}

/// One stage: patch embeddings in cascade, then the joint layer.
#[derive(Clone, Debug)]
struct Stage {
    embeddings: Vec<PatchEmbedding>,
    joint: JointLayer,
}

impl Encoder {
    /// The parameters stand directly under the builder's path.
    pub fn new<T: Float>(b: &mut Builder<T>, config: &Config) -> Self {
        let d = config.channels;
        let stem = [
            ConvBn::new(&mut b.at("stem.0"), [3, d[0] / 2], 3, 2, Activation::Hardswish),
            ConvBn::new(&mut b.at("stem.1"), [d[0] / 2, d[0]], 3, 1, Activation::Hardswish),
        ];
        let embeddings: Vec<Vec<PatchEmbedding>> = (0..4)
            .map(|i| {
                let mut b = b.at(format!("patch_embed_stages.{i}.patch_embeds"));
                // The CNN path reads the first embedding, so one is there without transformer paths too.
                (0..config.paths[i].max(1))
                    .map(|p| {
                        PatchEmbedding::new(&mut b.at(format!("{p}.patch_conv")), d[i], if p == 0 { 2 } else { 1 })
                    })
                    .collect()
            })
            .collect();
        let stages = embeddings.into_iter().enumerate();
        let stages = stages
            .map(|(i, embeddings)| Stage {
                embeddings,
                joint: JointLayer::new(&mut b.at(format!("mhca_stages.{i}")), config, i),
            })
            .collect();
        Encoder { stem, stages }
    }

    /// The five maps, largest first.
    #[track_caller]
    pub fn forward<T: Float>(&self, c: &Context<T>, image: &Var<T>) -> Vec<Var<T>> {
        let mut maps = vec![self.stem[1].forward(c, &self.stem[0].forward(c, image))];
        for stage in &self.stages {
            let mut embedded: Vec<Var<T>> = Vec::with_capacity(stage.embeddings.len());
            for embedding in &stage.embeddings {
                let previous = embedded.last().unwrap_or(&maps[maps.len() - 1]);
                embedded.push(embedding.forward(c, previous));
            }
            maps.push(stage.joint.forward(c, &embedded));
        }
        maps
    }
}

/// A depthwise-separable convolution: depthwise 3x3, pointwise, batch normalisation, Hardswish.
#[derive(Clone, Debug)]
struct PatchEmbedding {
    depthwise: DepthwiseConv,
    pointwise: ConvBn,
}

impl PatchEmbedding {
    fn new<T: Float>(b: &mut Builder<T>, channels: usize, stride: usize) -> Self {
        let init = b.start(Init::he(3, channels), 9);
        PatchEmbedding {
            depthwise: DepthwiseConv::new(&mut b.at("dwconv"), channels, 3, stride, init, false),
            pointwise: Conv::new(&mut b.at("pwconv"), [channels; 2], 1, Conv2d::default(), ConvStart::He)
                .normalised(&mut b.at("bn"), Activation::Hardswish),
        }
    }

    fn forward<T: Float>(&self, c: &Context<T>, x: &Var<T>) -> Var<T> {
        self.pointwise.forward(c, &self.depthwise.forward(c, x))
    }
}

/// The joint CNN and transformer layer: both kinds of path side by side, concatenated and fused by a 1x1 convolution,
/// whose width follows the number of paths. Either kind may be missing.
#[derive(Clone, Debug)]
struct JointLayer {
    convolutional: Option<InvertedResidual>,
    transformers: Vec<TransformerPath>,
    aggregate: ConvBn,
}

impl JointLayer {
    fn new<T: Float>(b: &mut Builder<T>, config: &Config, stage: usize) -> Self {
        let (channels, paths) = (config.channels[stage], config.paths[stage]);
        let (out, parts) = (config.channels[(stage + 1).min(3)], paths + usize::from(config.cnn_path));
        JointLayer {
            transformers: (0..paths)
                .map(|p| TransformerPath::new(&mut b.at(format!("mhca_blks.{p}")), config, stage))
                .collect(),
            convolutional: config.cnn_path.then(|| InvertedResidual::new(&mut b.at("InvRes"), channels)),
            aggregate: ConvBn::new(&mut b.at("aggregate"), [channels * parts, out], 1, 1, Activation::Hardswish),
        }
    }

    fn forward<T: Float>(&self, c: &Context<T>, embedded: &[Var<T>]) -> Var<T> {
        let mut parts: Vec<Var<T>> = self.convolutional.iter().map(|path| path.forward(c, &embedded[0])).collect();
        parts.extend(self.transformers.iter().zip(embedded).map(|(path, x)| path.forward(c, x)));
        self.aggregate.forward_parts(c, &parts.iter().collect::<Vec<_>>())
    }
}

/// The CNN path: x + conv2(hardswish(norm(dwconv(conv1(x))))).
#[derive(Clone, Debug)]
struct InvertedResidual {
    conv1: ConvBn,
    depthwise: Normalised<DepthwiseConv>,
    conv2: ConvBn,
}

impl InvertedResidual {
    fn new<T: Float>(b: &mut Builder<T>, channels: usize) -> Self {
        // By fan out over the groups: each output channel has its own window.
        let init = b.start(Init::he(3, 1), 9);
        InvertedResidual {
            conv1: ConvBn::new(&mut b.at("conv1"), [channels; 2], 1, 1, Activation::Hardswish),
            depthwise: DepthwiseConv::new(&mut b.at("dwconv"), channels, 3, 1, init, false)
                .normalised(&mut b.at("norm"), Activation::Hardswish),
            conv2: ConvBn::new(&mut b.at("conv2"), [channels; 2], 1, 1, Activation::None),
        }
    }

    fn forward<T: Float>(&self, c: &Context<T>, x: &Var<T>) -> Var<T> {
        let h = self.depthwise.forward(c, &self.conv1.forward(c, x));
        x + self.conv2.forward(c, &h)
    }
}

/// A transformer path: layers over the tokens of an embedding, which share their position encodings.
#[derive(Clone, Debug)]
struct TransformerPath {
    encodings: Arc<Encodings>,
    layers: Vec<Arc<TransformerLayer>>,
}

/// Position encodings that the layers of a path share: a depthwise convolution of the tokens, and that of their values.
#[derive(Debug)]
struct Encodings {
    position: DepthwiseConv,
    relative: RelativePosition,
}

impl TransformerPath {
    fn new<T: Float>(b: &mut Builder<T>, config: &Config, stage: usize) -> Self {
        let channels = config.channels[stage];
        let position = DepthwiseConv::new(&mut b.at("cpe.proj"), channels, 3, 1, Init::FanIn(9), true);
        let relative = RelativePosition::new(&mut b.at("crpe"), config, channels);
        let before: usize = config.layers[..stage].iter().sum();
        let total: usize = config.layers.iter().sum();
        let layers = (0..config.layers[stage])
            .map(|l| {
                let mut b = b.at(format!("MHCA_layers.{l}"));
                let (weight, bias) = position.params();
                b.alias("cpe.proj.weight", weight);
                b.alias("cpe.proj.bias", bias.expect("made with a bias"));
                relative.alias(&mut b.at("crpe"));
                let drop_path = config.drop_path * (before + l) as f64 / (total - 1).max(1) as f64;
                Arc::new(TransformerLayer::new(&mut b, config, &relative, channels, drop_path))
            })
            .collect();
        TransformerPath { encodings: Arc::new(Encodings { position, relative }), layers }
    }

    fn forward<T: Float>(&self, c: &Context<T>, image: &Var<T>) -> Var<T> {
        let [b, h, w, channels] = image.shape().nhwc().expect("an image");
        let mut x = image.clone();
        for layer in &self.layers {
            let (layer, encodings) = (layer.clone(), self.encodings.clone());
            x = c.part(&x, move |c, x| layer.forward(c, &encodings, x));
        }
        x.reshape([b, h, w, channels])
    }
}

/// The convolutional relative position encoding: one depthwise window for each group of heads.
#[derive(Clone, Debug)]
struct RelativePosition {
    /// Window, heads, and the convolution.
    windows: Vec<(usize, usize, DepthwiseConv)>,
}

impl RelativePosition {
    fn new<T: Float>(b: &mut Builder<T>, config: &Config, channels: usize) -> Self {
        let per_head = channels / config.heads;
        let windows = config.windows.iter().enumerate().map(|(j, &(window, heads))| {
            let init = Init::FanIn(window * window);
            let mut b = b.at(format!("conv_list.{j}"));
            (window, heads, DepthwiseConv::new(&mut b, heads * per_head, window, 1, init, true))
        });
        RelativePosition { windows: windows.collect() }
    }

    fn alias<T: Float>(&self, b: &mut Builder<T>) {
        for (j, (_, _, conv)) in self.windows.iter().enumerate() {
            let (weight, bias) = conv.params();
            b.alias(&format!("conv_list.{j}.weight"), weight);
            b.alias(&format!("conv_list.{j}.bias"), bias.expect("made with a bias"));
        }
    }
}

/// One transformer layer: position encoding, attention and MLP, each added to what it was computed from.
#[derive(Clone, Debug)]
struct TransformerLayer {
    /// What an observer knows its q, k and v by.
    name: String,
    norm1: LayerNorm,
    qkv: Linear,
    proj: Linear,
    norm2: LayerNorm,
    fc1: Linear,
    fc2: Linear,
    heads: usize,
    drop_path: f64,
}

impl TransformerLayer {
    fn new<T: Float>(
        b: &mut Builder<T>,
        config: &Config,
        relative: &RelativePosition,
        channels: usize,
        drop_path: f64,
    ) -> Self {
        let linear = |b: &mut Builder<T>, [inputs, outputs]: [usize; 2]| {
            let init = b.start(Init::TruncatedNormal(0.02), inputs);
            Linear::new(b, [inputs, outputs], init, true)
        };
        let name = b.at("factoratt_crpe.qkv").path().to_owned();
        let qkv = linear(&mut b.at("factoratt_crpe.qkv"), [channels, 3 * channels]);
        let proj = linear(&mut b.at("factoratt_crpe.proj"), [channels; 2]);
        relative.alias(&mut b.at("factoratt_crpe.crpe"));
        let hidden = channels * config.mlp_ratio;
        TransformerLayer {
            name,
            qkv,
            proj,
            fc1: linear(&mut b.at("mlp.fc1"), [channels, hidden]),
            fc2: linear(&mut b.at("mlp.fc2"), [hidden, channels]),
            norm1: LayerNorm::new(&mut b.at("norm1"), channels),
            norm2: LayerNorm::new(&mut b.at("norm2"), channels),
            heads: config.heads,
            drop_path,
        }
    }

    /// `x` is an image `[B, h, w, C]`, which is tokens `[B, h w, C]` read otherwise.
    fn forward<T: Float>(&self, c: &Context<T>, Encodings { position, relative }: &Encodings, x: &Var<T>) -> Var<T> {
        let [b, h, w, channels] = x.shape().nhwc().expect("an image");
        let x = (x + position.forward(c, x)).reshape([b, h * w, channels]);

        let qkv = self.qkv.forward(c, &self.norm1.forward(c, &x));
        c.observe(&self.name, &qkv);
        let windows: Vec<_> = relative
            .windows
            .iter()
            .map(|(window, heads, conv)| {
                let (weight, bias) = conv.params();
                (*window, *heads, c.var(weight), c.var(bias.expect("made with a bias")))
            })
            .collect();
        let attention = qkv.factorised_attention(self.heads) + qkv.conv_relative_position(h, w, self.heads, &windows);
        let x = x + c.drop_path(self.proj.forward(c, &attention), self.drop_path);

        let hidden = self.fc1.forward(c, &self.norm2.forward(c, &x));
        let x = &x + c.drop_path(self.fc2.forward_of_gelu(c, &hidden), self.drop_path);
        x.reshape([b, h, w, channels])
    }
}
