//! Monodepth2's decoder (Godard et al., ICCV 2019, 1806.01260): a U-Net that joins each map on its way up.

use super::{Decoder, FeatureMap, Pyramid};
use crate::error::Result;
use crate::monovit::decoder::{ConvBlock, conv3x3};
use crate::nn::{Builder, Context, Conv, Joined};
use crate::tensor::{Float, Var};

/// Monodepth2's decoder, of as many levels as there are maps: from the deepest map up, a block, the map of the level above
/// beside what was enlarged, and another block.
#[derive(Clone, Debug)]
pub struct UNetDecoder {
    /// The blocks before and behind the enlargement, of level 4 (to 1/16 of the picture) first, then 3, 2, 1, 0.
    levels: Vec<[ConvBlock; 2]>,
    heads: Vec<Conv>,
}

/// Number of disparities, those of the levels 0 to 3.
const SCALES: usize = 4;

impl Decoder for UNetDecoder {
    /// All widths follow from the maps.
    type Config = ();

    fn check((): &(), maps: &[FeatureMap]) -> Result<()> {
        Pyramid::of(maps).map(drop)
    }

    #[track_caller]
    fn new<T: Float>(b: &mut Builder<T>, (): &(), maps: &[FeatureMap]) -> Self {
        let pyramid = Pyramid::of(maps).expect("maps that were checked");
        let (Pyramid(features), d) = (pyramid, pyramid.levels());
        let b = &mut b.at("decoder");
        // Numbered as they are used: two blocks a level, then the heads, largest picture first.
        let mut below = features[4];
        let levels: Vec<[ConvBlock; 2]> = (0..5)
            .rev()
            .enumerate()
            .map(|(n, level)| {
                let beside = if level > 0 { features[level - 1] } else { 0 };
                let blocks = [
                    ConvBlock::new(&mut b.at(2 * n), [below, d[level]]),
                    ConvBlock::new(&mut b.at(2 * n + 1), [d[level] + beside, d[level]]),
                ];
                below = d[level];
                blocks
            })
            .collect();
        let first = 2 * levels.len();
        let heads = (0..SCALES).map(|s| conv3x3(&mut b.at(first + s), [d[s], 1])).collect();
        UNetDecoder { levels, heads }
    }

    #[track_caller]
    fn forward<T: Float>(&self, c: &Context<T>, features: &[Var<T>]) -> Vec<Var<T>> {
        let mut x = features[features.len() - 1].clone();
        let mut disparities = Vec::with_capacity(SCALES);
        for ([before, behind], level) in self.levels.iter().zip((0..self.levels.len()).rev()) {
            let small = before.forward(c, &Joined::from(&x));
            let beside = level.checked_sub(1).map(|above| &features[above]);
            x = behind.forward(c, &Joined { small: Some(&small), parts: beside.into_iter().collect() });
            if let Some(head) = self.heads.get(level) {
                disparities.push(head.forward(c, &x).sigmoid());
            }
        }
        disparities.reverse();
        disparities
    }

    fn heads(&self) -> &[Conv] {
        &self.heads
    }
}
