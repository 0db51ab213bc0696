//! Extra supervision by known depth, for worlds that know it: a rendered street. It is no part of the paper's training.

use crate::tensor::{Float, Tensor, Var};

/// How far predicted depth is from known depth: the mean of `|ln predicted - ln known|` over the pixels whose depth is known
/// (above 0), a scalar. Known depth is clipped to the range of predicted ones, so that infinity (the sky) is the far end.
/// 0 if no pixel is known. The gradient where both are equal is 0.
///
/// # Panics
/// If the shapes, `[B, H, W, 1]` both, differ.
#[track_caller]
pub fn depth_error<T: Float>(predicted: &Var<T>, known: &Tensor<T>, [least, most]: [f64; 2]) -> Var<T> {
    assert_eq!(predicted.value().shape(), known.shape(), "depth_error: depth of one shape");
    let is_known = |z: T| z.f64() > 0.0;
    let count = known.data().iter().filter(|z| is_known(**z)).count();
    let each = |f: &dyn Fn(T) -> T| {
        Var::constant(Tensor::build(*known.shape(), |out| {
            out.iter_mut().zip(known.data()).for_each(|(o, &z)| *o = f(z))
        }))
    };
    let logarithm = each(&|z| if is_known(z) { T::of(libm::log(z.f64().clamp(least, most))) } else { T::ZERO });
    let counts = each(&|z| T::of(f64::from(u8::from(is_known(z)))));
    ((predicted.log() - logarithm).abs() * counts).sum_all().affine(1.0 / count.max(1) as f64, 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor::Tape;

    #[test]
    fn it_is_the_mean_ratio_over_known_pixels_and_its_gradient_pulls_towards_them() {
        let e = std::f64::consts::E;
        let shape = [1, 2, 2, 1];
        let tape = Tape::new();
        let predicted = tape.leaf(Tensor::from_vec(shape, vec![2.0 * e, 3.0, 50.0, 1.0]));
        // A factor e too far, unknown, the sky, equal.
        let known = Tensor::from_vec(shape, vec![2.0, 0.0, f64::INFINITY, 1.0]);
        let error = depth_error(&predicted, &known, [0.1, 50.0 * e]);
        assert!((error.value().item() - 2.0 / 3.0).abs() < 1e-12);
        let gradients = error.backward();
        let gradient = gradients.get(&predicted).expect("a gradient");
        for (found, expected) in gradient.data().iter().zip([1.0 / (6.0 * e), 0.0, -1.0 / 150.0, 0.0]) {
            assert!((found - expected).abs() < 1e-12, "{found} {expected}");
        }
        let nothing = depth_error(&predicted.detach(), &Tensor::zeros(shape), [0.1, 100.0]);
        assert_eq!(nothing.value().item(), 0.0);
    }
}
