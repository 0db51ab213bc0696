//! How parameters start.

use serde::{Deserialize, Serialize};

use crate::random::Random;
use crate::tensor::{Float, Shape, Tensor};

/// Initialisation: the distribution of a parameter's starting values.
#[derive(Clone, Copy, Debug)]
pub enum Init {
    /// Constant.
    Constant(f64),
    /// Normal with mean 0 and this standard deviation.
    Normal(f64),
    /// Normal with mean 0, drawn again where it is more than two (absolute) away: at these deviations, never.
    TruncatedNormal(f64),
    /// Uniform within 1 / sqrt(fan in), which is given.
    FanIn(usize),
}

/// Initialisation of the layers in front of a normalisation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Start {
    /// As published: He's normal, and a truncated normal of 0.02 for the transformer's linear layers.
    #[default]
    Published,
    /// Uniform within 1 / sqrt(fan in), everywhere. A normalisation takes the scale of these weights out of the result,
    /// but the smaller they are, the further a step of a given size turns them: from scratch, that is faster.
    Uniform,
}

impl Init {
    /// He's normal for a convolution, by fan out: deviation sqrt(2 / (kh kw out)).
    pub fn he(kernel: usize, out: usize) -> Self {
        Init::Normal((2.0 / (kernel * kernel * out) as f64).sqrt())
    }

    pub(super) fn tensor<T: Float>(self, shape: Shape, random: &mut Random) -> Tensor<T> {
        let mut draw = || match self {
            Init::Constant(value) => value,
            Init::Normal(deviation) => deviation * random.normal(),
            Init::TruncatedNormal(deviation) => loop {
                let x = deviation * random.normal();
                if x.abs() <= 2.0 {
                    break x;
                }
            },
            Init::FanIn(fan_in) => {
                let bound = 1.0 / (fan_in as f64).sqrt();
                random.uniform(-bound, bound)
            }
        };
        Tensor::build(shape, |out| out.iter_mut().for_each(|x| *x = T::of(draw())))
    }
}
