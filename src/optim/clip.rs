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

/// The Euclidean norms of the gradients of several parts, by which part each belongs to, as one vector a part.
///
/// # Panics
/// If `part` names a part from `N` on.
pub fn norms<T: Float, const N: usize>(gradients: &[Option<Tensor<T>>], part: impl Fn(usize) -> usize) -> [f64; N] {
    let mut squares = [0.0; N];
    for (i, gradient) in gradients.iter().enumerate() {
        squares[part(i)] += norm(std::slice::from_ref(gradient)).powi(2);
    }
    squares.map(f64::sqrt)
}

/// Scales all gradients by one factor so that their norm, which is `before`, is at most `bound`.
pub fn clip_from<T: Float>(gradients: &mut [Option<Tensor<T>>], before: f64, bound: f64) {
    if before > bound {
        scale(gradients, bound / before);
    }
}

/// Multiplies all gradients by a factor.
pub fn scale<T: Float>(gradients: &mut [Option<Tensor<T>>], factor: f64) {
    let factor = T::of(factor);
    for g in gradients.iter_mut().flatten() {
        let g = g.data_mut();
        let work = g.len();
        parallel::for_each_chunk(g, regime::size(CHUNK), work, |_, g| g.iter_mut().for_each(|x| *x *= factor));
    }
}

/// Adds gradients to those that are there; what has none yet takes them as they are.
///
/// # Panics
/// If one has another shape than the one that it is added to.
pub fn add<T: Float>(sum: &mut [Option<Tensor<T>>], gradients: Vec<Option<Tensor<T>>>) {
    for (sum, gradient) in sum.iter_mut().zip(gradients) {
        match (sum, gradient) {
            (Some(sum), Some(gradient)) => {
                assert_eq!(sum.shape(), gradient.shape(), "gradients of one parameter");
                let chunk = regime::size(CHUNK);
                let work = gradient.len();
                parallel::for_each_chunk(sum.data_mut(), chunk, work, |i, sum| {
                    sum.iter_mut().zip(&gradient.data()[i * chunk..]).for_each(|(s, &g)| *s += g);
                });
            }
            (sum @ None, gradient) => *sum = gradient,
            (Some(_), None) => {}
        }
    }
}

/// Scales all gradients by one factor so that their norm is at most `bound`; returns the norm before.
pub fn clip_norm<T: Float>(gradients: &mut [Option<Tensor<T>>], bound: f64) -> f64 {
    let before = norm(gradients);
    clip_from(gradients, before, bound);
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

    #[test]
    fn norms_by_part_are_those_of_the_parts() {
        let g = [
            Some(Tensor::from_vec([2], vec![3.0f64, 4.0])),
            None,
            Some(Tensor::scalar(-2.0)),
            Some(Tensor::scalar(1.0)),
        ];
        let found: [f64; 3] = norms(&g, |i| [0, 0, 1, 0][i]);
        assert!((found[0] - 26f64.sqrt()).abs() < 1e-12 && found[1] == 2.0 && found[2] == 0.0, "{found:?}");
    }

    #[test]
    fn sums_take_what_is_there_and_add_to_it() {
        let mut sum = [Some(Tensor::from_vec([2], vec![1.0f64, 2.0])), None, Some(Tensor::scalar(5.0))];
        add(&mut sum, vec![Some(Tensor::from_vec([2], vec![0.5, -2.0])), Some(Tensor::scalar(7.0)), None]);
        scale(&mut sum, 0.5);
        let numbers: Vec<f64> = sum.iter().flatten().flat_map(|t| t.data().to_vec()).collect();
        assert_eq!(numbers, [0.75, 0.0, 3.5, 2.5]);
    }
}
