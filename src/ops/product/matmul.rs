//! Batched matrix product.

use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::random::Random;
use crate::tensor::gemm::{Rows, RowsMut, gemm};
use crate::tensor::{Float, GradSink, Shape, Tensor, Upstream, Var, parallel};

/// Matrix product `[.., m, k] x [.., k, n] -> [.., m, n]`, one product for each matrix of the leading dimensions, which
/// are equal.
#[derive(Clone, Copy, Debug)]
pub struct Matmul;

/// The number of matrices, and m, k, n.
fn extents(a: &Shape, b: &Shape) -> [usize; 4] {
    let r = a.rank();
    [a.dims()[..r - 2].iter().product(), a.dims()[r - 2], a.dims()[r - 1], b.dims()[r - 1]]
}

impl<T: Float> Op<T> for Matmul {
    type Saved = [Option<Tensor<T>>; 2];

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let (a, b) = (inputs[0].dims(), inputs[1].dims());
        let r = a.len();
        if r < 2 || b.len() != r || a[..r - 2] != b[..r - 2] || a[r - 1] != b[r - 2] {
            return Err(ShapeError::new("expected [.., m, k] and [.., k, n] with equal leading dimensions"));
        }
        Ok(vec![inputs[0].with(r - 1, b[r - 1])])
    }

    fn flops(&self, inputs: &[Shape]) -> u64 {
        extents(&inputs[0], &inputs[1]).iter().product::<usize>() as u64 * 2
    }

    fn forward(&self, inputs: &[&Tensor<T>], needs: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let [a, b] = [inputs[0], inputs[1]];
        let [batch, m, k, n] = extents(a.shape(), b.shape());
        let shape = a.shape().with(a.shape().rank() - 1, n);
        let y = Tensor::build(shape, |out| {
            parallel::for_each_unit(out, m * n, 2 * batch * m * n * k, |i, out| {
                let a = Rows::dense(&a.data()[i * m * k..][..m * k], m, k);
                let b = Rows::dense(&b.data()[i * k * n..][..k * n], k, n);
                gemm(RowsMut::dense(out, m, n), crate::tensor::Accum::Replace, a, b, T::ONE);
            });
        });
        (vec![y], [needs.get(1).then(|| a.clone()), needs.get(0).then(|| b.clone())])
    }

    /// dA = dY B^T, dB = A^T dY.
    fn backward(&self, [a, b]: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let r = g.shape().rank();
        let (m, n) = (g.dims()[r - 2], g.dims()[r - 1]);
        if let Some(b) = b {
            let k = b.dims()[r - 2];
            sink.accumulate(0, |out, accum| {
                let work = 2 * g.len() * k;
                parallel::for_each_unit(out, m * k, work, |i, out| {
                    let g = Rows::dense(&g.data()[i * m * n..][..m * n], m, n);
                    let b = Rows::dense(&b.data()[i * k * n..][..k * n], k, n);
                    gemm(RowsMut::dense(out, m, k), accum, g, b.t(), T::ONE);
                });
            });
        }
        if let Some(a) = a {
            let k = a.dims()[r - 1];
            sink.accumulate(1, |out, accum| {
                let work = 2 * g.len() * k;
                parallel::for_each_unit(out, k * n, work, |i, out| {
                    let g = Rows::dense(&g.data()[i * m * n..][..m * n], m, n);
                    let a = Rows::dense(&a.data()[i * m * k..][..m * k], m, k);
                    gemm(RowsMut::dense(out, k, n), accum, a.t(), g, T::ONE);
                });
            });
        }
    }
}

impl Checked for Matmul {
    fn cases() -> Vec<Case<Self>> {
        let case =
            |name, a: &[usize], b: &[usize]| Case::new(name, Matmul, [Input::random("a", a), Input::random("b", b)]);
        vec![
            case("one matrix", &[3, 4], &[4, 5]),
            case("a batch", &[3, 4, 5], &[3, 5, 2]),
            case("two leading dimensions", &[2, 2, 3, 1], &[2, 2, 1, 3]),
            case("a row by a column", &[1, 6], &[6, 1]),
            case("empty inner dimension", &[2, 0], &[0, 3]).flat(),
            case("empty batch", &[0, 2, 3], &[0, 3, 2]).flat(),
            case("no rows", &[0, 3], &[3, 2]).flat(),
        ]
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        let before: Vec<usize> = (0..random.extreme(0, 2)).map(|_| random.extreme(1, 3)).collect();
        let [m, k, n] = [0; 3].map(|_| random.pick(&[1, 2, 5, 8, 17]));
        let shape = |last: [usize; 2]| before.iter().copied().chain(last).collect::<Vec<_>>();
        Some(Case::drawn(Matmul, [Input::random("a", &shape([m, k])), Input::random("b", &shape([k, n]))]))
    }
}

impl<T: Float> Var<T> {
    /// The matrix product `[.., m, k] x [.., k, n] -> [.., m, n]`.
    #[track_caller]
    pub fn matmul(&self, other: &Self) -> Self {
        apply1(Matmul, &[self, other])
    }
}
