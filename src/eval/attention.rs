//! What a pixel looks at: effective rows of the factorised attention, and the gradient of a disparity by the input.
//!
//! Factorised attention ([`FactorisedAttention`](crate::ops::attention::factorised::FactorisedAttention)) never forms a
//! matrix of tokens by tokens: with q, k, v `[N, c]` of one head it computes `c^(-1/2) q (softmax(k)^T v)`, the softmax
//! over the N tokens, channel by channel. Bracketed the other way it is a matrix after all, and token i has a row of
//! it:
//!
//! ```text
//! out_i = Σ_j a_ij v_j    with    a_ij = c^(-1/2) Σ_γ q_iγ p_jγ    and    p_jγ = exp(k_jγ) / Σ_t exp(k_tγ)
//! ```
//!
//! These weights are signed, because q is: they need be neither positive nor sum to 1 (a row sums to `c^(-1/2) Σ_γ
//! q_iγ`, since every column of p sums to 1). A negative weight takes the value of that token away.
//!
//! The convolutional relative position encoding, which is added to this output, is left out: it multiplies q with a
//! window of 3, 5 or 7 tokens around it, with other weights in every channel, and so has no row that a head shares.

use crate::networks::DepthNetwork;
use crate::nn::{Context, Params};
use crate::tensor::{Float, Tape, Tensor, Var};

/// The effective rows of one pixel in one transformer layer.
#[derive(Clone, Debug)]
pub struct AttentionRows<T: Float> {
    /// The stage, from 0: tokens at 1/4, 1/8, 1/16, 1/32 of the image.
    pub stage: usize,
    /// The transformer path, from 0: tokens embedded by windows of 3x3, 5x5, 7x7.
    pub path: usize,
    /// The layer of the path, from 0.
    pub layer: usize,
    /// The token that the pixel lies in: its row and column.
    pub token: [usize; 2],
    /// The weights of all tokens in every head, `[heads, h, w]`.
    pub heads: Tensor<T>,
}

impl<T: Float> AttentionRows<T> {
    /// The mean over the heads, `[h, w]`.
    pub fn mean(&self) -> Tensor<T> {
        let &[heads, h, w] = self.heads.dims() else { unreachable!("made with three dimensions") };
        let share = T::of(1.0 / heads as f64);
        let mut mean = Tensor::zeros([h, w]);
        for head in self.heads.data().chunks_exact(h * w) {
            mean.data_mut().iter_mut().zip(head).for_each(|(m, &a)| *m += a * share);
        }
        mean
    }

    /// What a checkpoint calls the layer.
    pub fn name(&self) -> String {
        layer_name(self.stage, self.path, self.layer)
    }
}

fn layer_name(stage: usize, path: usize, layer: usize) -> String {
    format!("encoder.mhca_stages.{stage}.mhca_blks.{path}.MHCA_layers.{layer}")
}

/// Attention of a pixel, and the disparities, of one prediction.
#[derive(Clone, Debug)]
pub struct Attention<T: Float> {
    /// The disparities at 1, 1/2, 1/4, 1/8 of the image, `[1, h, w, 1]`.
    pub disparities: Vec<Tensor<T>>,
    /// By stage, path and layer.
    pub rows: Vec<AttentionRows<T>>,
}

/// The effective rows of a pixel (its row and column) in every transformer layer, in evaluation mode, for an image
/// `[1, H, W, 3]` with sides that are multiples of 32. A network without attention has no rows.
///
/// # Panics
/// If the image holds more than one sample, or the pixel lies outside it.
#[track_caller]
pub fn attention<T: Float>(
    model: &DepthNetwork,
    params: &Params<T>,
    image: &Tensor<T>,
    pixel: [usize; 2],
) -> Attention<T> {
    let [height, width] = one_image_with(image, pixel);
    let c = Context::inference(params).observed();
    let disparities = model.disparities(&c, &image.clone().into());
    let mut rows = Vec::new();
    let Some(sizes) = model.config.mpvit() else {
        return Attention { disparities: disparities.into_iter().map(Var::into_value).collect(), rows };
    };
    for stage in 0..4 {
        let [h, w] = [height, width].map(|side| side >> (stage + 2));
        let token = pixel.map(|x| x >> (stage + 2));
        for path in 0..sizes.paths[stage] {
            for layer in 0..sizes.layers[stage] {
                let name = format!("{}.factoratt_crpe.qkv", layer_name(stage, path, layer));
                let qkv = c.take_observed(&name).expect("every layer shows its q, k and v");
                let heads = effective_rows(&qkv, sizes.heads, token[0] * w + token[1]);
                let heads = heads.reshape([sizes.heads, h, w]);
                rows.push(AttentionRows { stage, path, layer, token, heads });
            }
        }
    }
    Attention { disparities: disparities.into_iter().map(Var::into_value).collect(), rows }
}

/// The effective row of a token in every head, `[heads, N]`, from q, k and v side by side in `[1, N, 3 C]`, each
/// head-major: `c^(-1/2) Σ_γ q_γ p_jγ`, with p the softmax of k over the tokens and c = C / heads.
///
/// # Panics
/// If the shape is another, the heads do not divide C, or there is no such token.
#[track_caller]
pub fn effective_rows<T: Float>(qkv: &Tensor<T>, heads: usize, token: usize) -> Tensor<T> {
    let &[1, n, width] = qkv.dims() else { panic!("effective_rows: [1, N, 3 C] expected, found {}", qkv.shape()) };
    assert!(
        heads > 0 && width.is_multiple_of(3 * heads),
        "effective_rows: {width} channels are not q, k, v of {heads} heads"
    );
    assert!(token < n, "effective_rows: no token {token} among {n}");
    let (channels, c) = (width / 3, width / 3 / heads);
    let q = &qkv.data()[token * width..][..channels];
    let keys = || qkv.data().chunks_exact(width).map(|t| &t[channels..2 * channels]);
    let mut max = vec![-T::INFINITY; channels];
    keys().for_each(|k| max.iter_mut().zip(k).for_each(|(m, &k)| *m = m.max(k)));
    let mut sum = vec![T::ZERO; channels];
    keys().for_each(|k| sum.iter_mut().zip(k).zip(&max).for_each(|((s, &k), &m)| *s += (k - m).exp()));
    let scale = T::of((c as f64).powf(-0.5));
    let factors: Vec<T> = q.iter().zip(&sum).map(|(&q, &sum)| scale * q / sum).collect();
    Tensor::build([heads, n], |out| {
        for (j, k) in keys().enumerate() {
            for head in 0..heads {
                let lanes = (head * c..(head + 1) * c).map(|i| factors[i] * (k[i] - max[i]).exp());
                out[head * n + j] = lanes.sum();
            }
        }
    })
}

/// How much the disparity of a pixel depends on every pixel of the input: the gradient of the full-size disparity, in
/// evaluation mode, by the image; of its three channels the largest absolute value, `[H, W]`.
///
/// With a `radius` above 0 the disparity is the mean over the square of that radius around the pixel, cut to the image.
/// The image is `[1, H, W, 3]`, the pixel its row and column. Parameters are constants, so nothing is kept for them.
///
/// # Panics
/// If the image holds more than one sample, or the pixel lies outside it.
#[track_caller]
pub fn saliency<T: Float>(
    model: &DepthNetwork,
    params: &Params<T>,
    image: &Tensor<T>,
    pixel: [usize; 2],
    radius: usize,
) -> Tensor<T> {
    let [height, width] = one_image_with(image, pixel);
    let tape = Tape::new();
    let input = tape.leaf(image.clone());
    let disparity = model.disparities(&Context::inference(params), &input).swap_remove(0);
    let near = |centre: usize, side: usize| centre.saturating_sub(radius)..(centre + radius + 1).min(side);
    let (rows, columns) = (near(pixel[0], height), near(pixel[1], width));
    let share = T::of(1.0 / (rows.len() * columns.len()) as f64);
    let mut cotangent = Tensor::zeros(*disparity.shape());
    for row in rows {
        cotangent.data_mut()[row * width..][columns.clone()].fill(share);
    }
    let gradient = tape.backward(&[(&disparity, cotangent)]).take(&input).expect("the disparity depends on the image");
    Tensor::build([height, width], |out| {
        for (out, rgb) in out.iter_mut().zip(gradient.data().chunks_exact(3)) {
            *out = rgb.iter().fold(T::ZERO, |most, &d| most.max(d.abs()));
        }
    })
}

/// Height and width of a single image that has this pixel.
#[track_caller]
fn one_image_with<T: Float>(image: &Tensor<T>, [row, column]: [usize; 2]) -> [usize; 2] {
    let &[1, height, width, 3] = image.dims() else {
        panic!("an image [1, H, W, 3] expected, found {}", image.shape())
    };
    assert!(row < height && column < width, "no pixel at row {row}, column {column} in {height}x{width}");
    [height, width]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monovit::Preset;
    use crate::random::Random;

    fn uniform(shape: &[usize], low: f64, high: f64) -> Tensor<f64> {
        let mut random = Random::new(5, 6);
        Tensor::build(shape, |out| out.iter_mut().for_each(|x| *x = random.uniform(low, high)))
    }

    /// The rows, times v, are what the op says.
    fn assert_rows_give_the_output(qkv: &Tensor<f64>, heads: usize, rows: &Tensor<f64>, token: usize) {
        let &[_, n, width] = qkv.dims() else { unreachable!() };
        let (channels, c) = (width / 3, width / 3 / heads);
        let out = Var::constant(qkv.clone()).factorised_attention(heads);
        for channel in 0..channels {
            let row = &rows.data()[channel / c * n..][..n];
            let values = qkv.data().chunks_exact(width).map(|t| t[2 * channels + channel]);
            let found: f64 = row.iter().zip(values).map(|(a, v)| a * v).sum();
            let expected = out.value().at(&[0, token, channel]);
            assert!((found - expected).abs() < 1e-10, "token {token}, channel {channel}: {found} for {expected}");
        }
    }

    #[test]
    fn effective_rows_times_values_are_the_output_of_the_op() {
        for (heads, c, n) in [(8, 4, 70), (2, 20, 33), (3, 1, 5), (1, 6, 1)] {
            let qkv = uniform(&[1, n, 3 * heads * c], -3.0, 3.0);
            for token in [0, n / 2, n - 1] {
                let rows = effective_rows(&qkv, heads, token);
                assert_rows_give_the_output(&qkv, heads, &rows, token);
                // A row sums to c^(-1/2) times the sum of q.
                for (head, row) in rows.data().chunks_exact(n).enumerate() {
                    let q = &qkv.data()[token * 3 * heads * c + head * c..][..c];
                    let expected = q.iter().sum::<f64>() / (c as f64).sqrt();
                    assert!((row.iter().sum::<f64>() - expected).abs() < 1e-12);
                }
            }
        }
    }

    #[test]
    fn every_layer_of_a_network_shows_rows_that_give_its_output() {
        let (model, params) = DepthNetwork::new::<f64>(Preset::Pico.config(), 1);
        let image = uniform(&[1, 64, 96, 3], 0.0, 1.0);
        let pixel = [40, 90];
        let found = attention(&model, &params, &image, pixel);
        // Layers 1, 1, 2, 1 on paths 2, 3, 3, 3.
        assert_eq!(found.rows.len(), 2 + 3 + 6 + 3);
        let c = Context::inference(&params).observed();
        let disparities = model.disparities(&c, &image.clone().into());
        assert!(found.disparities.iter().zip(&disparities).all(|(a, b)| a.same_bits(b.value())));
        for rows in &found.rows {
            let (h, w) = (64 >> (rows.stage + 2), 96 >> (rows.stage + 2));
            assert_eq!(rows.heads.dims(), [8, h, w]);
            assert_eq!(rows.token, [40 * h / 64, 90 * w / 96]);
            let qkv = c.take_observed(&format!("{}.factoratt_crpe.qkv", rows.name())).expect("shown");
            assert!(params.find(&format!("{}.factoratt_crpe.qkv.weight", rows.name())).is_some(), "{}", rows.name());
            assert_rows_give_the_output(&qkv, 8, &rows.heads, rows.token[0] * w + rows.token[1]);
            let first: f64 = (0..8).map(|head| rows.heads.at(&[head, 0, 0])).sum();
            assert!((rows.mean().at(&[0, 0]) - first / 8.0).abs() < 1e-15);
        }
    }

    #[test]
    fn a_pass_that_nobody_looks_at_keeps_nothing() {
        let c = Context::inference(&Params::<f64>::new());
        c.observe("x", &Tensor::scalar(1.0).into());
        assert!(c.take_observed("x").is_none());
        let c = c.observed();
        c.observe("x", &Tensor::scalar(1.0).into());
        assert!(c.take_observed("x").is_some() && c.take_observed("x").is_none());
    }

    #[test]
    fn saliency_is_what_finite_differences_say() {
        let (model, mut params) = DepthNetwork::new::<f64>(Preset::Pico.config(), 1);
        // Four channels lead to the full-size disparity, behind a ReLU: lifted, none of them is dead.
        let last = params.find("depth.convs.X_04_attention.conv_se.bias").expect("the last node");
        params.value_mut(last).data_mut().fill(0.5);
        let image = uniform(&[1, 64, 96, 3], 0.0, 1.0);
        for (pixel, radius) in [([40, 90], 0), ([0, 10], 2)] {
            let found = saliency(&model, &params, &image, pixel, radius);
            let disparity = |image: &Tensor<f64>| -> f64 {
                let c = Context::inference(&params);
                let all = model.disparities(&c, &image.clone().into()).swap_remove(0);
                let near = |x: usize, centre: usize| x.abs_diff(centre) <= radius;
                let kept = (0..64 * 96).filter(|i| near(i / 96, pixel[0]) && near(i % 96, pixel[1]));
                let values: Vec<f64> = kept.map(|i| all.value().data()[i]).collect();
                values.iter().sum::<f64>() / values.len() as f64
            };
            let scale = found.data().iter().fold(0.0, |m: f64, &x| m.max(x));
            assert!(scale > 0.0);
            for [row, column] in [pixel, [pixel[0] + 1, pixel[1]], [30, 40], [63, 0]] {
                let by = |channel: usize| {
                    let moved = |h: f64| {
                        let mut image = image.clone();
                        image.data_mut()[(row * 96 + column) * 3 + channel] += h;
                        disparity(&image)
                    };
                    (moved(1e-5) - moved(-1e-5)) / 2e-5
                };
                let expected = (0..3).map(|channel| by(channel).abs()).fold(0.0, f64::max);
                let found = found.at(&[row, column]);
                assert!((found - expected).abs() < 1e-6 * scale, "at {row}, {column}: {found} for {expected}");
            }
        }
    }
}
