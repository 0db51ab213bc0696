//! The photometric loss: structure and colour, in one op.

use super::ssim::{Kernel, TILE, pair};
use crate::ops::Tile;
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::random::Random;
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var};

/// Photometric error `w mean_c clamp((1 - SSIM) / 2, 0, 1) + (1 - w) mean_c |prediction - target|` for every pixel:
/// from two images `[batch, height, width, channels]` to `[batch, height, width, 1]`. With w = 0 the structural part is
/// not computed.
///
/// The derivative of |0| is 0; for the clamp see [`SsimLoss`](super::ssim::SsimLoss).
#[derive(Clone, Copy, Debug)]
pub struct Photometric {
    /// Weight of the SSIM term: 0.85 as published.
    pub ssim_weight: f64,
    /// Rows handed to a thread at a time; 16 by default.
    pub tile: Tile,
}

impl Photometric {
    fn kernel(self, channels: usize) -> Kernel {
        let n = channels as f64;
        Kernel { ssim: self.ssim_weight / n, l1: (1.0 - self.ssim_weight) / n, tile: self.tile.or(TILE), sum: true }
    }
}

impl<T: Float> Op<T> for Photometric {
    /// Prediction and target.
    type Saved = [Tensor<T>; 2];

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        pair(inputs).map(|[b, h, w, _]| vec![[b, h, w, 1].into()])
    }

    fn algo(&self, inputs: &[Shape]) -> &'static str {
        match (self.ssim_weight == 0.0, inputs[0].last()) {
            (true, _) => "l1",
            (false, 3) => "rgb",
            (false, _) => "channels",
        }
    }

    fn flops(&self, inputs: &[Shape]) -> u64 {
        (if self.ssim_weight == 0.0 { 3 } else { 50 }) * inputs[0].len() as u64
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let (x, y) = (inputs[0], inputs[1]);
        let kernel = self.kernel(x.shape().last());
        let loss = Tensor::build(x.shape().with(3, 1), |out| kernel.forward(x, y, out));
        (vec![loss], [x.clone(), y.clone()])
    }

    /// That of SSIM (derived beside the kernel), and the sign of the difference. It is symmetric in the two images.
    fn backward(&self, [x, y]: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let kernel = self.kernel(x.shape().last());
        sink.accumulate(0, |out, accum| kernel.backward(&x, &y, &g, out, accum));
        sink.accumulate(1, |out, accum| kernel.backward(&y, &x, &g, out, accum));
    }
}

impl Checked for Photometric {
    fn cases() -> Vec<Case<Self>> {
        let op = |ssim_weight, tile| Photometric { ssim_weight, tile: Tile::of(tile) };
        let images = |shape: [usize; 4]| {
            // Evenly spaced, and a quarter of the spacing apart: no pixel of one equals one of the other.
            let quarter = 0.25 / shape.iter().product::<usize>() as f64;
            [
                Input::distinct_in("prediction", shape, 0.0, 1.0),
                Input::distinct_in("target", shape, quarter, 1.0 + quarter),
            ]
        };
        let equal = |name| Input::values(name, [1, 2, 2, 1], [0.3, 0.8, 0.1, 0.6]);
        vec![
            Case::new("colour", op(0.85, 0), images([2, 5, 7, 3])),
            Case::new("one channel, least size", op(0.85, 0), images([2, 2, 2, 1])),
            Case::new("many channels", op(0.5, 0), images([1, 3, 2, 17])),
            Case::new("differences alone", op(0.0, 0), images([2, 5, 4, 3])),
            Case::new("differences alone, in tiles", op(0.0, 2), images([2, 5, 3, 1])),
            Case::new("structure alone", op(1.0, 0), images([2, 3, 4, 3])),
            Case::new("tile less one", op(0.85, 5), images([2, 4, 3, 3])),
            Case::new("a whole tile", op(0.85, 4), images([2, 4, 3, 3])),
            Case::new("tile and one", op(0.85, 3), images([2, 4, 3, 3])),
            Case::new("equal images", op(0.0, 0), [equal("prediction"), equal("target")])
                .kinks(8)
                .flat()
                .promises(0, [0.0; 4]),
        ]
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        let op = Photometric { ssim_weight: random.pick(&[0.0, 0.85, 1.0]), tile: Tile::of(random.extreme(0, 6)) };
        let shape = [random.extreme(1, 3), random.extreme(2, 6), random.extreme(2, 7), random.pick(&[1, 2, 3, 4])];
        let quarter = 0.25 / shape.iter().product::<usize>() as f64;
        let prediction = Input::distinct_in("prediction", shape, 0.0, 1.0);
        Some(Case::drawn(op, [prediction, Input::distinct_in("target", shape, quarter, 1.0 + quarter)]))
    }
}

impl<T: Float> Var<T> {
    /// The photometric loss `[batch, height, width, 1]` of this prediction against a target, both `[batch, height,
    /// width, channels]`: structural dissimilarity with weight `ssim_weight`, mean absolute difference with the rest.
    #[track_caller]
    pub fn photometric(&self, target: &Self, ssim_weight: f64) -> Self {
        apply1(Photometric { ssim_weight, tile: Tile::AUTO }, &[self, target])
    }
}
