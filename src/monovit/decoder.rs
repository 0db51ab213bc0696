//! The depth decoder: nested (U-Net++-like) with channel attention on its diagonal (MonoViT, section 3.3; after
//! HR-Depth, 2012.07356, and DIFFNet, 2110.09482).
//!
//! Node (i, j) stands at level i (1/2^(i+1) of the image) in column j. It joins the node below and before it,
//! upsampled, with all the nodes to its left.

use std::collections::BTreeMap;

use crate::nn::{Builder, Context, Conv, ConvStart, Init, Joined, Linear};
use crate::ops::{Activation, Conv2d};
use crate::tensor::{Float, Var};

/// Sizes of the decoder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DecoderConfig {
    /// Channels of the encoder's five maps, largest map first; those of the first are a multiple of 4, and decide the widths
    /// of all nodes.
    pub features: [usize; 5],
    /// Whether channels are weighed by attention; without, the convolutions behind it stand alone.
    pub attention: bool,
    /// Reduction ratio of the channel attention.
    pub reduction: usize,
}

impl DecoderConfig {
    /// Channels e of the first column: what the encoder's maps are brought to.
    pub fn lateral_channels(&self) -> [usize; 5] {
        let w = self.features[0];
        [w, w, 2 * w, 4 * w, 8 * w]
    }

    /// Channels d of the nodes, by level.
    pub fn node_channels(&self) -> [usize; 5] {
        let w = self.features[0];
        [w / 4, w / 2, w, 2 * w, 4 * w]
    }
}

/// Depth decoder: from the five maps of the encoder to disparities (sigmoid, in [0, 1]) at 1, 1/2, 1/4, 1/8 of the
/// image.
#[derive(Clone, Debug)]
pub struct Decoder {
    /// Brings the encoder's maps 1..4 to the channels of the first column.
    lateral: Vec<AttentionConv>,
    /// `X_ij_Conv_0`: halves the channels on the way up. (Those of level 0 but the last stand in the public checkpoints
    /// and take no part.)
    up: BTreeMap<(usize, usize), ConvBlock>,
    /// `X_ij_Conv_1`: makes node (i - 1, j + 1) of the concatenation; (0, 4) is the last block before the head.
    join: BTreeMap<(usize, usize), ConvBlock>,
    /// `X_ij_attention`: the diagonal.
    attention: BTreeMap<(usize, usize), AttentionConv>,
    /// `X_ij_downsample`: narrows long concatenations.
    narrow: BTreeMap<(usize, usize), Conv>,
    heads: Vec<Conv>,
}

/// The nodes in the order in which they can be computed.
const ORDER: [(usize, usize); 10] = [(0, 1), (1, 1), (2, 1), (3, 1), (0, 2), (1, 2), (2, 2), (0, 3), (1, 3), (0, 4)];

/// Whether a node is made by channel attention: those on the diagonal.
fn on_diagonal((i, j): (usize, usize)) -> bool {
    i + j == 4
}

impl Decoder {
    /// The parameters stand directly under the builder's path.
    pub fn new<T: Float>(b: &mut Builder<T>, config: &DecoderConfig) -> Self {
        let b = &mut b.at("convs");
        let (features, e, d) = (config.features, config.lateral_channels(), config.node_channels());
        // Channels of node (i, j).
        let width = |i: usize, j: usize| match j {
            0 => e[i],
            _ => d[i + 1],
        };
        let mut lateral: Vec<AttentionConv> = (1..5)
            .rev()
            .map(|i| AttentionConv::new(&mut b.at(format!("f{i}")), [features[i], e[i]], config, "ca.fc", 3))
            .collect();
        lateral.reverse();

        let mut up = BTreeMap::new();
        for j in 0..5 {
            for i in 0..=(4 - j) {
                let channels = width(i, j);
                let block = ConvBlock::new(&mut b.at(format!("X_{i}{j}_Conv_0")), [channels, channels / 2]);
                up.insert((i, j), block);
            }
        }
        let mut join = BTreeMap::new();
        join.insert((0, 4), ConvBlock::new(&mut b.at("X_04_Conv_1"), [d[0]; 2]));

        // Channels of the concatenation at node (i, j): the upsampled node below, and all to the left.
        let joined = |i: usize, j: usize| width(i + 1, j - 1) / 2 + (0..j).map(|k| width(i, k)).sum::<usize>();
        let mut attention = BTreeMap::new();
        for (i, j) in [(3, 1), (2, 2), (1, 3), (0, 4)] {
            let channels = [joined(i, j), width(i + 1, j - 1) / 2];
            let mut b = b.at(format!("X_{i}{j}_attention"));
            attention.insert((i, j), AttentionConv::new(&mut b, channels, config, "fc", 1));
        }
        let mut narrow = BTreeMap::new();
        for (i, j) in ORDER.into_iter().filter(|&n| !on_diagonal(n)) {
            let mut channels = joined(i, j);
            if j > 1 {
                let narrowed = 2 * d[i + 1];
                let mut b = b.at(format!("X_{i}{j}_downsample.conv"));
                let conv = Conv::new(&mut b, [channels, narrowed], 1, Conv2d::default(), ConvStart::FanIn);
                narrow.insert((i, j), conv);
                channels = narrowed;
            }
            let mut b = b.at(format!("X_{}{}_Conv_1", i + 1, j - 1));
            join.insert((i + 1, j - 1), ConvBlock::new(&mut b, [channels, d[i + 1]]));
        }
        let heads = (0..4).map(|s| conv3x3(&mut b.at(format!("dispconv{s}")), [d[s], 1])).collect();
        Decoder { lateral, up, join, attention, narrow, heads }
    }

    /// Disparities at 1, 1/2, 1/4, 1/8 of the image, `[B, h, w, 1]` each.
    #[track_caller]
    pub fn forward<T: Float>(&self, c: &Context<T>, features: &[Var<T>]) -> Vec<Var<T>> {
        let mut nodes: BTreeMap<(usize, usize), Var<T>> = BTreeMap::new();
        nodes.insert((0, 0), features[0].clone());
        for (i, lateral) in self.lateral.iter().enumerate() {
            nodes.insert((i + 1, 0), lateral.forward(c, &Joined::from(&features[i + 1])));
        }
        for (i, j) in ORDER {
            let below = (i + 1, j - 1);
            let small = self.up[&below].forward(c, &Joined::from(&nodes[&below]));
            let joined = Joined { small: Some(&small), parts: (0..j).map(|k| &nodes[&(i, k)]).collect() };
            let node = match (self.attention.get(&(i, j)), self.narrow.get(&(i, j))) {
                (Some(attention), _) => attention.forward(c, &joined),
                (None, Some(narrow)) => {
                    self.join[&below].forward(c, &Joined::from(&narrow.forward_joined(c, &joined, None)))
                }
                (None, None) => self.join[&below].forward(c, &joined),
            };
            nodes.insert((i, j), node);
        }
        let last = &nodes[&(0, 4)];
        let small = self.up[&(0, 4)].forward(c, &Joined::from(last));
        let full = self.join[&(0, 4)].forward(c, &Joined { small: Some(&small), parts: vec![] });
        let inputs = [&full, last, &nodes[&(1, 3)], &nodes[&(2, 2)]];
        self.heads.iter().zip(inputs).map(|(head, x)| head.forward(c, x).sigmoid()).collect()
    }

    /// The convolutions whose sigmoid the disparities are, largest first.
    pub fn heads(&self) -> &[Conv] {
        &self.heads
    }
}

/// A 3x3 convolution with bias over mirrored padding; `conv` in a checkpoint.
pub(crate) fn conv3x3<T: Float>(b: &mut Builder<T>, channels: [usize; 2]) -> Conv {
    Conv::new(&mut b.at("conv"), channels, 3, Conv2d::padded(1).reflecting(), ConvStart::FanInWithBias)
}

/// A 3x3 convolution over mirrored padding, and ELU.
#[derive(Clone, Debug)]
pub(crate) struct ConvBlock(Conv);

impl ConvBlock {
    /// From and to so many channels; the parameters stand under `conv` below the builder's path.
    pub(crate) fn new<T: Float>(b: &mut Builder<T>, channels: [usize; 2]) -> Self {
        ConvBlock(conv3x3(&mut b.at("conv"), channels).activated(Activation::Elu))
    }

    /// `[B, H, W, in] -> [B, H, W, out]`.
    pub(crate) fn forward<T: Float>(&self, c: &Context<T>, joined: &Joined<T>) -> Var<T> {
        self.0.forward_joined(c, joined, None)
    }
}

/// Channel attention, if the configuration has it, then a convolution and ReLU.
#[derive(Clone, Debug)]
struct AttentionConv {
    attention: Option<ChannelAttention>,
    conv: Conv,
}

impl AttentionConv {
    fn new<T: Float>(
        b: &mut Builder<T>,
        channels: [usize; 2],
        config: &DecoderConfig,
        fc: &str,
        kernel: usize,
    ) -> Self {
        let [inputs, _] = channels;
        let attention =
            config.attention.then(|| ChannelAttention::new(&mut b.at(fc), inputs, inputs / config.reduction));
        let op = Conv2d::padded(kernel / 2).activated(Activation::Relu);
        let conv = Conv::new(&mut b.at("conv_se"), channels, kernel, op, ConvStart::FanInWithBias);
        AttentionConv { attention, conv }
    }

    fn forward<T: Float>(&self, c: &Context<T>, joined: &Joined<T>) -> Var<T> {
        let Some(attention) = &self.attention else { return self.conv.forward_joined(c, joined, None) };
        let gate = attention.gate(c, joined);
        let b = gate.shape().dims()[0];
        if b == 1 {
            return self.conv.forward_joined(c, joined, Some(&gate));
        }
        // Pictures differ in their gates, and share the weights.
        let mut first = 0;
        let gated = joined.images().map(|image| {
            let channels = image.shape().last();
            let gate = gate.slice(1, first..first + channels).reshape([b, 1, 1, channels]);
            first += channels;
            image * gate
        });
        let gated: Vec<Var<T>> = gated.collect();
        let (small, parts) = gated.split_at(joined.small.is_some() as usize);
        self.conv.forward_joined(c, &Joined { small: small.first(), parts: parts.iter().collect() }, None)
    }
}

/// The gate of channel attention (Hu et al., 1709.01507), by which an image z is multiplied, here of channels from
/// several images: sigmoid(fc2(relu(fc0(mean of z over the image)))).
#[derive(Clone, Debug)]
struct ChannelAttention {
    squeeze: Linear,
    excite: Linear,
}

impl ChannelAttention {
    fn new<T: Float>(b: &mut Builder<T>, channels: usize, hidden: usize) -> Self {
        ChannelAttention {
            squeeze: Linear::new(&mut b.at("0"), [channels, hidden], Init::FanIn(channels), false),
            excite: Linear::new(&mut b.at("2"), [hidden, channels], Init::FanIn(hidden), false),
        }
    }

    /// One factor for each channel, `[B, C]`.
    fn gate<T: Float>(&self, c: &Context<T>, joined: &Joined<T>) -> Var<T> {
        // Enlarging an image leaves its mean as it is.
        let means: Vec<Var<T>> = joined.images().map(|image| image.mean(1, 2)).collect();
        let mean = Var::concat(&means.iter().collect::<Vec<_>>(), 1);
        self.excite.forward(c, &self.squeeze.forward(c, &mean).relu()).sigmoid()
    }
}
