//! The norm of all gradients together, and a bound on it.

use crate::tensor::{Float, Tensor, parallel, regime};

/// Elements handed to a thread at a time.
const CHUNK: usize = 1 << 14;

/// In f64, sixteen sums side by side.
fn sum_of_squares<T: Float>(x: &[T]) -> f64 {
    let (blocks, rest) = x.as_chunks::<16>();
    let mut result = [0.0; 16];
    T::dispatch(
        #[inline(always)]
        || {
            let mut sums = result;
            for block in blocks {
                sums.iter_mut().zip(block).for_each(|(s, x)| *s += x.f64() * x.f64());
            }
            result = sums;
        },
    );
    result.iter().sum::<f64>() + rest.iter().map(|x| x.f64() * x.f64()).sum::<f64>()
}

/// The Euclidean norm of all gradients as one vector.
pub fn norm<T: Float>(gradients: &[Option<Tensor<T>>]) -> f64 {
    let squares = |g: &Tensor<T>| {
        let chunk = regime::size(CHUNK);
        let sum = |i: usize| sum_of_squares(&g.data()[i * chunk..((i + 1) * chunk).min(g.len())]);
        parallel::map(g.len().div_ceil(chunk), 2 * g.len(), sum).into_iter().sum::<f64>()
    };
    gradients.iter().flatten().map(squares).sum::<f64>().sqrt()
}

/// Scales all gradients by one factor so that their norm is at most `bound`; returns the norm before.
pub fn clip_norm<T: Float>(gradients: &mut [Option<Tensor<T>>], bound: f64) -> f64 {
    let before = norm(gradients);
    if before > bound {
        let factor = T::of(bound / before);
        for g in gradients.iter_mut().flatten() {
            let g = g.data_mut();
            let work = g.len();
            parallel::for_each_chunk(g, regime::size(CHUNK), work, |_, g| g.iter_mut().for_each(|x| *x *= factor));
        }
    }
    before
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clipping_keeps_the_direction() {
        let mut g = [Some(Tensor::from_vec([2], vec![3.0f64, 0.0])), None, Some(Tensor::scalar(-4.0))];
        assert_eq!(clip_norm(&mut g, 1.0), 5.0);
        assert!((norm(&g) - 1.0).abs() < 1e-12);
        assert!((g[2].as_ref().unwrap().item() + 0.8).abs() < 1e-12);
        assert!((clip_norm(&mut g, 2.0) - 1.0).abs() < 1e-12 && (norm(&g) - 1.0).abs() < 1e-12);
    }
}
