//! `parallax bench agree`: before two programs are compared in speed, whether they do the same.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

use parallax::formats::{TensorFile, safetensors};
use parallax::monovit::loss::{LossConfig, Views, loss};
use parallax::monovit::{Config, Preset};
use parallax::networks::DepthNetwork;
use parallax::networks::setup::check_size;
use parallax::nn::{Context, Folded, Named, fit};
use parallax::ops::Conv2d;
use parallax::random::{Random, Stream};
use parallax::tensor::{Tape, Tensor, Var};
use parallax::{Error, Result};
use serde::Serialize;

/// The largest relative difference that is rounding in f32.
const TOLERANCE: f64 = 1e-4;

/// Differences, over the largest value.
#[derive(Serialize)]
struct Agreement {
    loss: f64,
    expected_loss: f64,
    loss_error: f64,
    /// Of the four scales, with batch statistics, as a training step sees them.
    disparity_errors: Vec<f64>,
    /// Of the four scales, with running statistics.
    inference_errors: Vec<f64>,
    convolution_error: f64,
    tolerance: f64,
}

/// The tensors of a file, in PyTorch's layouts.
struct Theirs<'a> {
    tensors: HashMap<String, Tensor<f32>>,
    path: &'a Path,
}

impl Theirs<'_> {
    fn get(&self, name: &str) -> Result<&Tensor<f32>> {
        let missing = || Error::file(self.path, format!("{name} is missing: written by benches/pytorch/measure.py?"));
        self.tensors.get(name).ok_or_else(missing)
    }

    /// An image or map, from NCHW.
    fn map(&self, name: &str) -> Result<Tensor<f32>> {
        let t = self.get(name)?;
        match t.shape().rank() {
            4 => Ok(t.permute(&[0, 2, 3, 1])),
            _ => Err(Error::file(self.path, format!("{name} has shape {}, expected four dimensions", t.shape()))),
        }
    }

    /// One with the given shape `[batch, height, width, channels]`.
    fn map_of(&self, name: &str, shape: [usize; 4]) -> Result<Var<f32>> {
        let t = self.map(name)?;
        if t.dims() != shape {
            let message = format!("{name}, channels last, has shape {}, expected {shape:?}", t.shape());
            return Err(Error::file(self.path, message));
        }
        Ok(t.into())
    }
}

pub fn run(path: &Path) -> Result<()> {
    let contents = safetensors::read::<f32>(path)?;
    let named = contents.metadata.get("preset").and_then(|name| Preset::ALL.into_iter().find(|p| p.name() == name));
    let preset = named.ok_or_else(|| Error::file(path, "the metadata names no preset"))?;
    let theirs = Theirs { tensors: contents.tensors, path };

    // Both without chance: DropPath is left out.
    let config = Config { drop_path: 0.0, ..preset.config() };
    let (model, mut params) = DepthNetwork::new::<f32>(config, 0);
    let file = Arc::new(path.to_owned());
    let weights: Vec<Named> = (TensorFile::open(path)?.tensors.into_iter())
        .filter_map(|(origin, tensor)| {
            let name = origin.strip_prefix("weights/")?.to_owned();
            Some(Named { name, origin, file: file.clone(), tensor })
        })
        .collect();
    let fitted = fit(&params, &weights)?;
    if let Some(problem) = fitted.report.problem() {
        return Err(Error::file(path, problem));
    }
    fitted.put_into(&mut params);

    let [batch, height, width, _] = theirs.map("in/target")?.shape().nhwc().expect("four dimensions");
    check_size("the height of in/target", height)?;
    check_size("the width of in/target", width)?;
    let image = |name: &str, scale: usize| theirs.map_of(name, [batch, height >> scale, width >> scale, 3]);
    let (prev, target, next) = (image("in/prev", 0)?, image("in/target", 0)?, image("in/next", 0)?);
    let pyramid = ["in/target", "in/pyramid/1", "in/pyramid/2", "in/pyramid/3"];
    let pyramid = pyramid.iter().enumerate().map(|(scale, name)| image(name, scale)).collect::<Result<Vec<_>>>()?;
    let k = theirs.get("in/K")?;
    if k.dims() != [3, 3] {
        return Err(Error::file(path, format!("in/K has shape {}, expected [3, 3]", k.shape())));
    }
    let intrinsics = [[0, 0], [1, 1], [0, 2], [1, 2]].map(|at| f64::from(k.at(&at)));
    let sources = vec![prev.clone(), next.clone()];
    let views =
        Views { pyramid, sources, smaller_sources: Vec::new(), intrinsics: vec![intrinsics; batch], depth: None };

    let tape = Tape::new();
    let c = Context::training(&params, &tape, Random::of(0, Stream::Only));
    let disparities = model.disparities(&c, &target);
    let transforms = model.transforms(&c, &prev, &target, &next);
    let found = loss(&disparities, &transforms, &views, &LossConfig::default(), None).total.value().item();
    let inferred = model.predict(&Folded::new(&params), target.value());
    let inferred: Vec<Var<f32>> = inferred.into_iter().map(Var::constant).collect();
    let errors = |ours: &[Var<f32>], prefix: &str| -> Result<Vec<f64>> {
        let one = |(s, d): (usize, &Var<f32>)| Ok(error(d.value(), &theirs.map(&format!("{prefix}/{s}"))?));
        ours.iter().enumerate().map(one).collect()
    };
    let w = theirs.get("conv/w")?;
    if w.dims() != [16, 3, 3, 3] {
        return Err(Error::file(path, format!("conv/w has shape {}, expected [16, 3, 3, 3]", w.shape())));
    }
    let x = theirs.map_of("conv/x", [2, 320, 320, 3])?;
    let y = x.conv2d(&w.permute(&[2, 3, 1, 0]).into(), None, Conv2d::padded(1));
    let expected = theirs.get("out/loss")?.data().first().copied().unwrap_or(f32::NAN);
    let agreement = Agreement {
        loss: f64::from(found),
        expected_loss: f64::from(expected),
        loss_error: f64::from((found - expected).abs() / expected.abs()),
        disparity_errors: errors(&disparities, "out/disp")?,
        inference_errors: errors(&inferred, "out/inference/disp")?,
        convolution_error: error(y.value(), &theirs.map("conv/y")?),
        tolerance: TOLERANCE,
    };
    super::super::print_json(&agreement)?;
    let all = agreement.disparity_errors.iter().chain(&agreement.inference_errors);
    // Written so that NaN does not pass.
    let agrees = |e: &f64| *e <= TOLERANCE;
    if !(all.chain([&agreement.loss_error, &agreement.convolution_error]).all(agrees)) {
        return Err(Error::file(path, format!("the results differ by more than {TOLERANCE:e}")));
    }
    Ok(())
}

/// max |difference| over max |expected|; NaN where either has one, or another shape.
fn error(ours: &Tensor<f32>, expected: &Tensor<f32>) -> f64 {
    if ours.shape() != expected.shape() {
        return f64::NAN;
    }
    let largest = |it: &mut dyn Iterator<Item = f32>| it.fold(0.0, |m: f32, x| if x > m || x.is_nan() { x } else { m });
    let scale = largest(&mut expected.data().iter().map(|x| x.abs()));
    f64::from(largest(&mut ours.data().iter().zip(expected.data()).map(|(a, b)| (a - b).abs())) / scale)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_difference_is_seen_wherever_it_is() {
        let of = |v: [f32; 3]| Tensor::from_vec([3], v.to_vec());
        assert_eq!(error(&of([1.0, 2.0, 4.0]), &of([1.0, 2.0, 4.0])), 0.0);
        assert_eq!(error(&of([1.0, 3.0, 4.0]), &of([1.0, 2.0, 4.0])), 0.25);
        assert!(error(&of([f32::NAN, 2.0, 4.0]), &of([1.0, 2.0, 4.0])).is_nan());
        assert!(error(&of([1.0, 2.0, 4.0]), &Tensor::zeros([2])).is_nan());
    }
}
