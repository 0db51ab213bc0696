//! The whole state of a training, to go on from: weights, moments, averages, steps.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use super::trainer::Trainer;
use crate::error::{Error, Result};
use crate::formats::safetensors;
use crate::tensor::Tensor;

impl Trainer {
    /// Writes the whole state: weights, moments, average, step.
    pub fn save(&self, path: &Path, metadata: HashMap<String, String>) -> Result<()> {
        let mut tensors: BTreeMap<String, Tensor<f32>> = BTreeMap::new();
        for (id, p) in self.params.iter() {
            tensors.insert(format!("weights/{}", p.name()), p.value.clone());
            if let Some([m, v]) = &self.adamw.moments[id.0] {
                tensors.insert(format!("first_moment/{}", p.name()), m.clone());
                tensors.insert(format!("second_moment/{}", p.name()), v.clone());
            }
            if let Some(average) = &self.average {
                tensors.insert(format!("average/{}", p.name()), average.values[id.0].clone());
            }
        }
        let mut metadata = metadata;
        metadata.insert("steps".into(), self.adamw.steps.to_string());
        safetensors::write(path, &tensors, metadata)
    }

    /// Goes on from a state written by [`save`](Trainer::save).
    pub fn load(&mut self, path: &Path) -> Result<()> {
        let mut contents = safetensors::read::<f32>(path)?;
        let broken = |what: &str| Error::file(path, format!("{what}: not a training state of this configuration"));
        let steps = contents.metadata.get("steps").and_then(|s| s.parse().ok());
        self.adamw.steps = steps.ok_or_else(|| broken("the number of steps is missing"))?;
        let ids: Vec<_> = self.params.iter().map(|(id, p)| (id, p.name().to_owned(), *p.value.shape())).collect();
        for (id, name, shape) in ids {
            let mut take = |kind: &str| match contents.tensors.remove(&format!("{kind}/{name}")) {
                Some(t) if *t.shape() != shape => Err(broken(&format!("{kind}/{name} has shape {}", t.shape()))),
                found => Ok(found),
            };
            self.params.set(id, take("weights")?.ok_or_else(|| broken(&format!("{name} is missing")))?);
            self.adamw.moments[id.0] = match (take("first_moment")?, take("second_moment")?) {
                (Some(m), Some(v)) => Some([m, v]),
                _ => None,
            };
            if let Some(average) = &mut self.average {
                average.values[id.0] = take("average")?.ok_or_else(|| broken("the averaged weights are missing"))?;
            }
        }
        Ok(())
    }
}
