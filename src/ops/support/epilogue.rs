//! What an op does to its result while it is still in the cache: adds a bias, applies an activation.
//!
//! A pass over memory of its own would cost as much as the arithmetic of a small convolution.

use crate::ops::Case;
pub(in crate::ops) use crate::ops::elementwise::unary::{Elu, Hardswish, Relu};
use crate::ops::elementwise::unary::{Function, Unary};
use crate::tensor::pool::Buffer;
use crate::tensor::{Float, Tensor, parallel, regime};

/// Makes everything that has a line for each activation: the enum, and the two macros that go through it. A new
/// activation is a [`Function`] and its line in the list below: its variant, that function, its name, and what it adds
/// to the name of a kernel path.
macro_rules! activations {
    ($d:tt $($(#[$note:meta])* $variant:ident = $function:ident, $name:literal, $suffix:literal;)*) => {
        /// An activation that an op applies in the same pass over memory.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
        pub enum Activation {
            $($(#[$note])* $variant,)*
        }

        /// How many there are.
        const COUNT: usize = [$($name),*].len();

        impl Activation {
            /// All of them.
            pub(in crate::ops) const ALL: [Activation; COUNT] = [$(Activation::$variant),*];

            /// A name for kernel paths.
            pub(in crate::ops) fn name(self) -> &'static str {
                [$($name),*][self as usize]
            }

            /// Whether the derivative follows from the result alone, so that the argument need not be kept.
            pub(in crate::ops) fn follows_from_result(self) -> bool {
                [$($function::FROM_RESULT),*][self as usize]
            }
        }

        /// `with_activation!(activation, |f| body)`: the body, with `f` the [`Function`] of the activation.
        macro_rules! with_activation {
            ($d activation:expr, |$d f:ident| $d body:expr) => {
                match $d activation {
                    $($crate::ops::support::epilogue::Activation::$variant => {
                        let $d f = $crate::ops::support::epilogue::$function;
                        $d body
                    })*
                }
            };
        }

        /// A kernel path's names, one for each activation behind it: for [`Activation::among`].
        macro_rules! paths {
            ($d path:literal) => {
                [$(concat!($d path, $suffix)),*]
            };
        }
    };
}

activations! { $
    /// Nothing.
    #[default]
    None = Identity, "plain", "";
    /// max(x, 0).
    Relu = Relu, "relu", "_relu";
    /// x clamp(x + 3, 0, 6) / 6.
    Hardswish = Hardswish, "hardswish", "_hardswish";
    /// x where x > 0, else e^x - 1.
    Elu = Elu, "elu", "_elu";
}
pub(in crate::ops) use {paths, with_activation};

/// No activation.
#[derive(Clone, Copy, Debug)]
pub(in crate::ops) struct Identity;

impl Function for Identity {
    const FROM_RESULT: bool = true;
    #[inline(always)]
    fn f<T: Float>(self, x: T) -> T {
        x
    }
    #[inline(always)]
    fn df<T: Float>(self, _: T) -> T {
        T::ONE
    }
    /// None: it is no op, and is checked where it is fused.
    fn cases() -> Vec<Case<Unary<Self>>> {
        Vec::new()
    }
}

impl Activation {
    /// All but none.
    pub(in crate::ops) fn fused() -> impl Iterator<Item = Activation> {
        Self::ALL.into_iter().filter(|activation| *activation != Activation::None)
    }

    /// A kernel path's name, of those that [`paths!`](paths) makes.
    pub(in crate::ops) fn among(self, names: [&'static str; COUNT]) -> &'static str {
        names[self as usize]
    }

    /// The result of an op that ends in this activation, and what [`backward`](Self::backward) needs of it.
    ///
    /// `op` computes the result and finishes it as it is told. Where the derivative needs the argument, that is what it
    /// computes, and the activation gets a pass of its own.
    pub(in crate::ops) fn after<T: Float>(
        self,
        bias: Option<&[T]>,
        wanted: bool,
        op: impl FnOnce(&Finish<T>) -> Tensor<T>,
    ) -> (Tensor<T>, Option<Tensor<T>>) {
        let keeps_argument = wanted && !self.follows_from_result();
        let y = op(&Finish::new(bias, if keeps_argument { Activation::None } else { self }));
        let kept = (wanted && self != Activation::None).then(|| y.clone());
        (if keeps_argument { self.of(&y) } else { y }, kept)
    }

    /// y from z, in a pass of its own.
    fn of<T: Float>(self, z: &Tensor<T>) -> Tensor<T> {
        let finish = Finish::new(None, self);
        Tensor::build(*z.shape(), |out| {
            let (chunk, work) = (regime::size(CHUNK), 4 * out.len());
            parallel::for_each_chunk(out, chunk, work, |i, out| {
                out.copy_from_slice(&z.data()[i * chunk..][..out.len()]);
                finish.run(out);
            });
        })
    }

    /// dL/dz = dL/dy act'(z), from what was kept: y if the derivative follows from it, else z.
    pub(in crate::ops) fn backward<T: Float>(self, kept: Option<&Tensor<T>>, mut dy: Tensor<T>) -> Tensor<T> {
        if let Some(kept) = kept {
            with_activation!(self, |f| scale_by_derivative(f, kept, &mut dy));
        }
        dy
    }
}

/// Elements handed to a thread at a time.
const CHUNK: usize = 1 << 14;

/// `dy *= f'`.
fn scale_by_derivative<T: Float>(f: impl Function, kept: &Tensor<T>, dy: &mut Tensor<T>) {
    let dy = dy.data_mut();
    let (chunk, work) = (regime::size(CHUNK), 4 * dy.len());
    parallel::for_each_chunk(dy, chunk, work, |i, dy| {
        let kept = &kept.data()[i * chunk..][..dy.len()];
        T::dispatch(
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
        if self.bias.is_some() || self.activation != Activation::None {
            with_activation!(self.activation, |f| self.run_with(y, f));
        }
    }

    fn run_with(&self, y: &mut [T], f: impl Function) {
        T::dispatch(
            #[inline(always)]
            || match &self.bias {
                None => y.iter_mut().for_each(|y| *y = f.f(*y)),
                Some(bias) => {
                    for y in y.chunks_mut(bias.len()) {
                        y.iter_mut().zip(bias.iter()).for_each(|(y, &b)| *y = f.f(*y + b));
                    }
                }
            },
        );
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
