//! What a check found, and whether that will do.

use super::differences::Differences;
use super::{Gradients, Options};
use crate::tensor::Tensor;

/// What the check of one input found.
#[derive(Clone, Debug)]
pub struct InputReport {
    /// max |analytic - numeric| / max |analytic|, kinks left out.
    pub error: f64,
    /// The element where they differ most.
    pub worst: usize,
    /// The analytic derivative there.
    pub analytic: f64,
    /// The numeric derivative there.
    pub numeric: f64,
    /// The largest analytic derivative.
    pub scale: f64,
    /// Elements compared.
    pub elements: usize,
    /// Elements at a kink.
    pub kinks: Vec<usize>,
}

impl InputReport {
    fn new(gradient: &Tensor<f64>, differences: &Differences) -> Self {
        let scale = gradient.data().iter().fold(0.0, |m: f64, g| if g.is_nan() { f64::NAN } else { m.max(g.abs()) });
        let kinks = differences.kinks(scale);
        let mut r =
            InputReport { error: 0.0, worst: 0, analytic: 0.0, numeric: 0.0, scale, elements: gradient.len(), kinks };
        for (k, (&a, &n)) in gradient.data().iter().zip(&differences.central).enumerate() {
            if r.kinks.contains(&k) {
                continue;
            }
            // Where the analytic gradient is zero throughout, the numeric one is held to the same size as an absolute
            // error.
            let error = (a - n).abs() / if scale > 0.0 { scale } else { 1.0 };
            if error.is_nan() || error > r.error {
                (r.error, r.worst, r.analytic, r.numeric) = (error, k, a, n);
            }
        }
        r
    }
}

/// What a check found.
#[derive(Clone, Debug)]
pub struct Report {
    /// For each input; `None` for constants.
    pub inputs: Vec<Option<InputReport>>,
    /// The options it was made with.
    pub options: Options,
    /// What made comparison impossible, if anything did.
    pub broken: Option<String>,
}

impl Report {
    /// Compares gradients with differences, input by input.
    pub fn new(gradients: &Gradients, differences: &[Option<Differences>], options: &Options) -> Self {
        let inputs = gradients.inputs.iter().zip(differences);
        let inputs = inputs.map(|(g, d)| Some(InputReport::new(g.as_ref()?, d.as_ref()?))).collect();
        Report { inputs, options: options.clone(), broken: None }
    }

    /// A report that says only why nothing could be compared.
    pub(super) fn broken(options: &Options, why: impl Into<String>) -> Self {
        Report { inputs: vec![], options: options.clone(), broken: Some(why.into()) }
    }

    /// The largest error of any input.
    pub fn error(&self) -> f64 {
        self.inputs.iter().flatten().map(|i| i.error).fold(0.0, f64::max)
    }

    /// The number of elements compared.
    pub fn elements(&self) -> usize {
        self.inputs.iter().flatten().map(|i| i.elements).sum()
    }

    /// The number of elements at a kink.
    pub fn kinks(&self) -> usize {
        self.inputs.iter().flatten().map(|i| i.kinks.len()).sum()
    }

    /// What is wrong, in a sentence; `None` if nothing is.
    pub fn failure(&self) -> Option<String> {
        if let Some(why) = &self.broken {
            return Some(why.clone());
        }
        for (i, input) in self.inputs.iter().enumerate() {
            let Some(r) = input else { continue };
            if r.error.is_nan() || r.error > self.options.tolerance {
                return Some(format!(
                    "input {i}, element {}: analytic {:e}, numeric {:e}, error {:.1e} of {:.1e} allowed",
                    r.worst, r.analytic, r.numeric, r.error, self.options.tolerance
                ));
            }
        }
        if self.kinks() != self.options.kinks {
            let at: Vec<_> = self.inputs.iter().flatten().map(|i| &i.kinks).collect();
            return Some(format!("{} elements at a kink, {} were declared: {at:?}", self.kinks(), self.options.kinks));
        }
        let zero = self.inputs.iter().flatten().all(|r| r.scale == 0.0);
        if zero != self.options.flat {
            return Some(match zero {
                true => "every gradient is zero: nothing was checked".into(),
                false => "a gradient is not zero, though declared flat".into(),
            });
        }
        None
    }
}
