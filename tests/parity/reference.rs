//! A file of reference values, and PyTorch's layouts turned into ours.

use std::path::PathBuf;

use parallax::tensor::{Float, Tensor};
use safetensors::{Dtype, SafeTensors};
use serde_json::Value;

/// A file under `tests/fixtures`.
pub fn fixture(name: &str) -> Vec<u8> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name);
    std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The list of cases in the metadata of a file.
pub fn cases(bytes: &[u8]) -> Vec<Value> {
    let (_, header) = SafeTensors::read_metadata(bytes).expect("a safetensors header");
    let cases = &header.metadata().as_ref().expect("metadata")["cases"];
    serde_json::from_str(cases).expect("the cases, as JSON")
}

/// A tensor of a file, as it lies there.
pub fn tensor(file: &SafeTensors, name: &str) -> Tensor<f64> {
    let view = file.tensor(name).unwrap_or_else(|e| panic!("{name}: {e}"));
    assert_eq!(view.dtype(), Dtype::F64, "{name}");
    let numbers = view.data().as_chunks::<8>().0.iter().map(|&b| f64::from_le_bytes(b)).collect();
    Tensor::from_vec(view.shape(), numbers)
}

/// How a tensor in PyTorch's layout becomes one of ours.
#[derive(Clone, Copy, Debug)]
pub enum Layout {
    /// As it is.
    Same,
    /// NCHW to NHWC.
    Image,
    /// OIHW to `[kh, kw, in/groups, out]`.
    Convolution,
    /// `[channels, 1, kh, kw]` to `[kh, kw, channels]`.
    Depthwise,
    /// `[out, in]` to `[in, out]`.
    Linear,
    /// `[batch, 4, 4]` to `[batch, 3, 4]`.
    Transform,
}

impl Layout {
    pub fn apply(self, x: &Tensor<f64>) -> Tensor<f64> {
        match self {
            Layout::Same => x.clone(),
            Layout::Image => x.permute(&[0, 2, 3, 1]),
            Layout::Convolution => x.permute(&[2, 3, 1, 0]),
            Layout::Depthwise => {
                let y = x.permute(&[2, 3, 1, 0]);
                y.reshape([y.dims()[0], y.dims()[1], y.dims()[3]])
            }
            Layout::Linear => x.permute(&[1, 0]),
            Layout::Transform => {
                let rows: Vec<f64> = x.data().chunks_exact(16).flat_map(|m| m[..12].to_vec()).collect();
                Tensor::from_vec([x.dims()[0], 3, 4], rows)
            }
        }
    }
}

/// The largest of some numbers that are not negative; NaN if one of them is, whatever follows it.
pub fn largest(numbers: impl Iterator<Item = f64>) -> f64 {
    numbers.fold(0.0, |most: f64, x| if most.is_nan() || x.is_nan() { f64::NAN } else { most.max(x) })
}

/// max |ours - expected| / max |expected|; the absolute error where all of `expected` is 0. NaN if there is one: every
/// comparison of tensors goes through here, and asks whether this is at most a bound, which NaN is not.
pub fn error<T: Float>(ours: &Tensor<T>, expected: &Tensor<T>) -> f64 {
    assert_eq!(ours.shape(), expected.shape());
    let scale = largest(expected.data().iter().map(|x| x.f64().abs()));
    let worst = largest(ours.data().iter().zip(expected.data()).map(|(a, b)| (a.f64() - b.f64()).abs()));
    worst / if scale == 0.0 { 1.0 } else { scale }
}

#[test]
fn a_comparison_never_loses_nan() {
    let tensor = |x: [f64; 3]| Tensor::from_vec([3], x.to_vec());
    let expected = tensor([1.0, -2.0, 0.5]);
    assert_eq!(error(&tensor([1.0, -1.0, 0.5]), &expected), 0.5);
    for at in 0..3 {
        let mut broken = [1.0, -2.0, 0.5];
        broken[at] = f64::NAN;
        assert!(error(&tensor(broken), &expected).is_nan(), "NaN at {at}");
        assert!(error(&expected, &tensor(broken)).is_nan(), "NaN expected at {at}");
    }
    assert!(error(&tensor([f64::NAN; 3]), &expected).is_nan());
    assert_eq!(error(&tensor([1e-3, 0.0, 0.0]), &tensor([0.0; 3])), 1e-3);
}
