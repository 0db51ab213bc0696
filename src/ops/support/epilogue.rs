//! What an op does to its result while it is still in the cache: adds a bias, applies an activation.
//!
//! A pass over memory of its own would cost as much as the arithmetic of a small convolution.

use crate::ops::elementwise::unary::{Elu, Function, Hardswish, Relu};
use crate::tensor::pool::Buffer;
use crate::tensor::{Float, Tensor, parallel, simd};

/// An activation that an op applies in the same pass over memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Activation {
    /// Nothing.
    #[default]
    None,
    /// max(x, 0).
    Relu,
    /// x clamp(x + 3, 0, 6) / 6.
    Hardswish,
    /// x where x > 0, else e^x - 1.
    Elu,
}

impl Activation {
    /// All of them.
    pub(in crate::ops) const ALL: [Activation; 4] =
        [Activation::None, Activation::Relu, Activation::Hardswish, Activation::Elu];

    /// A name for kernel paths.
    pub(in crate::ops) fn name(self) -> &'static str {
        match self {
            Activation::None => "plain",
            Activation::Relu => "relu",
            Activation::Hardswish => "hardswish",
            Activation::Elu => "elu",
        }
    }

    /// A kernel path's name, of those that [`paths`] makes.
    pub(in crate::ops) fn among(self, [plain, relu, hardswish, elu]: [&'static str; 4]) -> &'static str {
        match self {
            Activation::None => plain,
            Activation::Relu => relu,
            Activation::Hardswish => hardswish,
            Activation::Elu => elu,
        }
    }

    /// Whether the derivative follows from the result alone, so that the argument need not be kept.
    pub(in crate::ops) fn follows_from_result(self) -> bool {
        self != Activation::Hardswish
    }

    /// y from z, in a pass of its own: for who must keep z.
    pub(in crate::ops) fn of<T: Float>(self, z: &Tensor<T>) -> Tensor<T> {
        let finish = Finish::new(None, self);
        Tensor::build(*z.shape(), |out| {
            let work = 4 * out.len();
            parallel::for_each_chunk(out, CHUNK, work, |i, out| {
                out.copy_from_slice(&z.data()[i * CHUNK..][..out.len()]);
                finish.run(out);
            });
        })
    }

    /// dL/dz = dL/dy act'(z), from what was kept: y if the derivative follows from it, else z.
    pub(in crate::ops) fn backward<T: Float>(self, kept: Option<&Tensor<T>>, mut dy: Tensor<T>) -> Tensor<T> {
        let Some(kept) = kept else { return dy };
        match self {
            Activation::None => {}
            Activation::Relu => scale_by_derivative(Relu, kept, &mut dy),
            Activation::Hardswish => scale_by_derivative(Hardswish, kept, &mut dy),
            Activation::Elu => scale_by_derivative(Elu, kept, &mut dy),
        }
        dy
    }
}

/// A kernel path's names, by the activation behind it: for [`Activation::among`].
macro_rules! paths {
    ($path:literal) => {
        [$path, concat!($path, "_relu"), concat!($path, "_hardswish"), concat!($path, "_elu")]
    };
}
pub(in crate::ops) use paths;

/// Elements handed to a thread at a time.
const CHUNK: usize = 1 << 14;

/// `dy *= f'`. ReLU's derivative is the same function of its result as of its argument.
fn scale_by_derivative<T: Float>(f: impl Function, kept: &Tensor<T>, dy: &mut Tensor<T>) {
    let dy = dy.data_mut();
    let work = 4 * dy.len();
    parallel::for_each_chunk(dy, CHUNK, work, |i, dy| {
        let kept = &kept.data()[i * CHUNK..][..dy.len()];
        simd::dispatch(
            #[inline(always)]
            || dy.iter_mut().zip(kept).for_each(|(d, &k)| *d *= f.df(k)),
        );
    });
}

/// `y = act(y + bias)` over rows of as many channels as the bias has.
pub(in crate::ops) struct Finish<T: Float> {
    /// The bias, repeated to whole vectors.
    bias: Option<Buffer<T>>,
    activation: Activation,
}

impl<T: Float> Finish<T> {
    /// Nothing at all.
    pub(in crate::ops) fn nothing() -> Self {
        Finish { bias: None, activation: Activation::None }
    }

    pub(in crate::ops) fn new(bias: Option<&[T]>, activation: Activation) -> Self {
        let bias = bias.filter(|b| !b.is_empty()).map(|bias| repeat(width(bias.len()), bias));
        Finish { bias, activation }
    }

    /// Finishes whole rows.
    pub(in crate::ops) fn run(&self, y: &mut [T]) {
        match self.activation {
            Activation::None => self.run_with(y, |x| x),
            Activation::Relu => self.run_with(
                y,
                #[inline(always)]
                |x| Relu.f(x),
            ),
            Activation::Hardswish => self.run_with(
                y,
                #[inline(always)]
                |x| Hardswish.f(x),
            ),
            Activation::Elu => self.run_with(
                y,
                #[inline(always)]
                |x| Elu.f(x),
            ),
        }
    }

    fn run_with(&self, y: &mut [T], f: impl Fn(T) -> T) {
        match &self.bias {
            None if self.activation == Activation::None => {}
            None => simd::dispatch(
                #[inline(always)]
                || y.iter_mut().for_each(|y| *y = f(*y)),
            ),
            Some(bias) => simd::dispatch(
                #[inline(always)]
                || {
                    for y in y.chunks_mut(bias.len()) {
                        y.iter_mut().zip(bias.iter()).for_each(|(y, &b)| *y = f(*y + b));
                    }
                },
            ),
        }
    }
}

/// A multiple of the channels that whole vectors divide, or at least one that is long: rows are read together with
/// their followers up to it, so that few channels vectorise as well as many.
pub(in crate::ops) fn width(c: usize) -> usize {
    let (mut a, mut b) = (c, 64);
    while b != 0 {
        (a, b) = (b, a % b);
    }
    let lcm = c / a * 64;
    if lcm <= 2048 { lcm.max(128 / c * c) } else { c * 128usize.div_ceil(c) }
}

/// Per-channel numbers, repeated to `width`.
pub(in crate::ops) fn repeat<T: Float>(width: usize, numbers: &[T]) -> Buffer<T> {
    let mut lanes = Buffer::stale(width);
    lanes.chunks_exact_mut(numbers.len()).for_each(|l| l.copy_from_slice(numbers));
    lanes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lanes_are_whole_rows() {
        for c in 1..600 {
            assert_eq!(width(c) % c, 0);
            assert!(width(c) >= 64 && width(c) <= 2048.max(c), "{c}: {}", width(c));
        }
    }

    #[test]
    fn finishing_is_bias_then_activation() {
        for c in [1, 3, 8, 130] {
            let bias: Vec<f64> = (0..c).map(|k| 0.1 * k as f64 - 0.2).collect();
            let y: Vec<f64> = (0..7 * c).map(|i| ((i * 5) % 11) as f64 - 5.0).collect();
            for activation in Activation::ALL {
                let mut found = y.clone();
                Finish::new(Some(&bias), activation).run(&mut found);
                for (i, (&found, &y)) in found.iter().zip(&y).enumerate() {
                    let z = y + bias[i % c];
                    let expected = match activation {
                        Activation::None => z,
                        Activation::Relu => z.max(0.0),
                        Activation::Hardswish => z * (z + 3.0).clamp(0.0, 6.0) / 6.0,
                        Activation::Elu => {
                            if z > 0.0 {
                                z
                            } else {
                                z.exp_m1()
                            }
                        }
                    };
                    assert!((found - expected).abs() < 1e-14, "{activation:?} of {z}: {found} for {expected}");
                }
            }
        }
    }
}
