//! One training step, and the state that it moves.

mod report;

use std::collections::HashMap;

pub use report::StepReport;

use super::freeze::{Frozen, frozen};
use super::recipe::Plan;
use super::rotations::Lesson;
use super::vitals::{Signs, Vitals};
use crate::data::batch::Batch;
use crate::error::{Error, Result};
use crate::monovit::loss::{Loss, LossConfig, Scales, TieBreak, Views, loss};
use crate::networks::{Config, DepthNetwork};
use crate::nn::{Context, Param, ParamId, Params};
use crate::optim::{AdamW, Average, Group, add, clip_from, norms, scale};
use crate::random::{Random, Stream};
use crate::tensor::profile;
use crate::tensor::{Tape, Tensor, Var};

/// A model in training.
pub struct Trainer {
    /// The networks.
    pub model: DepthNetwork,
    /// Their parameters.
    pub params: Params<f32>,
    plan: Plan,
    pub(super) adamw: AdamW<f32>,
    pub(super) average: Option<Average<f32>>,
    ties: TieBreak<f32>,
    /// The part that each parameter belongs to.
    pub(super) parts: Vec<usize>,
    frozen: Frozen,
}

/// Contribution of one batch to a step.
struct Pass {
    gradients: Vec<Option<Tensor<f32>>>,
    /// Running statistics that it moved.
    moved: HashMap<ParamId, Tensor<f32>>,
    /// Its figures, as far as they are those of a batch.
    report: StepReport,
}

/// Results of a forward pass.
struct Forward {
    c: Context<f32>,
    found: Loss<f32>,
    /// At full size, `[B, H, W, 1]`.
    disparity: Tensor<f32>,
    /// Of each source, `[B, 3, 4]`.
    transforms: Vec<Tensor<f32>>,
}

/// The pose networks' part.
const POSE: usize = 2;

/// The part that a parameter belongs to: 0 the encoder, 1 the decoder, 2 the pose networks.
fn part_of(name: &str) -> usize {
    if name.starts_with("encoder.") {
        0
    } else if name.starts_with("depth.") {
        1
    } else {
        POSE
    }
}

/// What the loss compares in a batch.
fn views(batch: &Batch, scales: Scales) -> Views<f32> {
    let smaller = if scales == Scales::Own { batch.smaller_sources() } else { Vec::new() };
    Views {
        pyramid: batch.pyramid.iter().cloned().map(Var::constant).collect(),
        sources: batch.sources.iter().cloned().map(Var::constant).collect(),
        smaller_sources: smaller.into_iter().map(|s| s.into_iter().map(Var::constant).collect()).collect(),
        intrinsics: batch.intrinsics.clone(),
        depth: batch.depth.clone(),
    }
}

/// Transforms of points from the targets' cameras to those of their sources, `[B, 3, 4]` each: what the pose network sees in
/// neighbours, what is known of a second camera.
pub(super) fn transforms(model: &DepthNetwork, c: &Context<f32>, batch: &Batch, target: &Var<f32>) -> Vec<Var<f32>> {
    let in_time = batch.neighbours.as_ref().map(|neighbours| {
        let [prev, next] = neighbours.each_ref().map(|t| Var::constant(t.clone()));
        model.transforms(c, &prev, target, &next)
    });
    in_time.into_iter().flatten().chain(batch.to_other_camera().map(Var::constant)).collect()
}

impl Trainer {
    /// A model at its start.
    pub fn new(config: impl Into<Config>, plan: Plan) -> Self {
        let (model, params) = DepthNetwork::new(config, plan.seed);
        Self::of(model, params, plan)
    }

    /// A model with the given weights.
    pub fn of(model: DepthNetwork, params: Params<f32>, plan: Plan) -> Self {
        let mut adamw = AdamW::new(&params);
        adamw.betas = plan.optim.betas;
        let average = (plan.optim.average > 0.0).then(|| Average::new(&params, plan.optim.average));
        let ties = TieBreak::new(plan.loss.tie_break, &mut Random::of(plan.seed, Stream::TiePool));
        let parts = params.iter().map(|(_, p)| part_of(p.name())).collect();
        Trainer { model, params, plan, adamw, average, ties, parts, frozen: Frozen::default() }
    }

    /// Leaves the parameters and running statistics alone that patterns name, such as `encoder.*`: they keep their bits,
    /// and normalisations whose statistics are among them use those.
    ///
    /// # Errors
    /// If a pattern matches nothing, or nothing is left to learn.
    pub fn freeze(&mut self, patterns: &[String]) -> Result<()> {
        self.frozen = frozen(&self.params, patterns)?;
        if !self.pose_learns() {
            self.plan.pose_first = 0;
        }
        Ok(())
    }

    /// Whether any parameter of the pose networks is not frozen.
    fn pose_learns(&self) -> bool {
        let learns = |(i, (_, p)): (usize, (_, &Param<f32>))| {
            self.parts[i] == POSE && p.learnt && !self.frozen.get(i).copied().unwrap_or(false)
        };
        self.params.iter().enumerate().any(learns)
    }

    /// Parameters and statistics that stay as they are in a step (from 0).
    fn frozen_at(&self, step: u64) -> Frozen {
        if step >= self.plan.pose_first {
            return self.frozen.clone();
        }
        let frozen = |i: usize| self.frozen.get(i).copied().unwrap_or(false);
        self.parts.iter().enumerate().map(|(i, &part)| part != POSE || frozen(i)).collect()
    }

    /// Teaches the pose network known rotations, before the first step; `tell` hears of every step and its error in
    /// pixels, and says whether to go on. Whether it came to the end.
    pub fn learn_rotations(
        &mut self,
        mut next_batch: impl FnMut() -> Result<Batch>,
        mut tell: impl FnMut(u64, f64) -> bool,
    ) -> Result<bool> {
        let rotations = self.plan.rotations;
        if !self.pose_learns() {
            return Ok(true);
        }
        let mut lesson = Lesson::new(rotations, &self.params, self.plan.seed).keeping(self.frozen.clone());
        for step in 1..=rotations.steps {
            let error = lesson.step(&self.model, &mut self.params, &next_batch()?);
            if !tell(step, error) {
                return Ok(false);
            }
        }
        self.average = (self.plan.optim.average > 0.0).then(|| Average::new(&self.params, self.plan.optim.average));
        Ok(true)
    }

    /// Steps taken.
    pub fn steps(&self) -> u64 {
        self.adamw.steps
    }

    /// The weights to use: the average, where there is one.
    pub fn weights(&self) -> Params<f32> {
        self.average.as_ref().map_or_else(|| self.params.clone(), |a| a.params(&self.params))
    }

    /// The loss of a batch, and what it was computed from.
    /// `pass` (from 0) counts the batches.
    fn forward(&self, tape: &Tape<f32>, batch: &Batch, pass: u64) -> Forward {
        let step = self.adamw.steps;
        let random = Random::of(self.plan.seed, Stream::Dropout(pass));
        let c = Context::training_part(&self.params, tape, random, self.frozen_at(step));
        let c = c.recomputing(self.plan.recompute);
        let target = Var::constant(batch.target.clone());
        let disparities = self.model.disparities(&c, &target);
        let transforms = transforms(&self.model, &c, batch, &target);
        let mut random = Random::of(self.plan.seed, Stream::Ties(pass));
        let auto_mask = self.plan.loss.auto_mask && step >= self.plan.auto_mask_after;
        let config = LossConfig { auto_mask, ..self.plan.loss };
        let all = views(batch, config.scales);
        let mut loss_of = |disparities: &[Var<f32>], transforms: &[Var<f32>], views: &Views<f32>| {
            loss(disparities, transforms, views, &config, Some((&self.ties, &mut random)))
        };
        let found = if batch.neighbours.is_some() && batch.shifts.is_some() && step < self.plan.pairs_first {
            // Depth learns from the pairs alone, and the pose networks the motion that belongs to this depth.
            let (pair, known) = (all.sources.len() - 1, disparities.iter().map(Var::detach).collect::<Vec<_>>());
            let in_time = loss_of(&known, &transforms[..pair], &all.of_sources(0..pair));
            in_time.and(loss_of(&disparities, &transforms[pair..], &all.of_sources(pair..pair + 1)))
        } else {
            loss_of(&disparities, &transforms, &all)
        };
        let disparity = disparities[0].value().clone();
        let transforms = transforms.iter().map(|t| t.value().clone()).collect();
        Forward { c, found, disparity, transforms }
    }

    /// One step on one batch: forward, backward, AdamW.
    ///
    /// # Errors
    /// As [`step_of`](Trainer::step_of).
    pub fn step(&mut self, batch: &Batch) -> Result<StepReport> {
        self.step_of(std::slice::from_ref(batch))
    }

    /// One step on several batches of one size: AdamW with the mean of their gradients, which is that of all their samples
    /// in one batch, but for normalisations, which see one batch after the other.
    ///
    /// # Errors
    /// If the loss or a gradient is not finite: the step, and the op that first made such a number; no weight is changed.
    /// If a weight is not finite after the step: its name; that weight is lost.
    ///
    /// # Panics
    /// If there is no batch.
    pub fn step_of(&mut self, batches: &[Batch]) -> Result<StepReport> {
        self.step_watched(batches, |_, _| ())
    }

    /// [`step_of`](Trainer::step_of), of which `watch` sees the gradients, parameter by parameter, as the optimiser gets them.
    pub(super) fn step_watched(
        &mut self,
        batches: &[Batch],
        watch: impl FnOnce(&Self, &[Option<Tensor<f32>>]),
    ) -> Result<StepReport> {
        let step = self.adamw.steps + 1;
        let mut sum: Vec<Option<Tensor<f32>>> = Vec::new();
        let mut reports = Vec::new();
        for (i, batch) in batches.iter().enumerate() {
            let Pass { gradients, moved, report } = self.pass((step - 1) * batches.len() as u64 + i as u64, batch)?;
            if i == 0 {
                sum = gradients;
            } else {
                profile::phase("sum of gradients", || add(&mut sum, gradients));
            }
            reports.push(report);
            profile::phase("running statistics", || {
                for (id, value) in moved {
                    self.params.set(id, value);
                }
            });
        }
        if batches.len() > 1 {
            scale(&mut sum, 1.0 / batches.len() as f64);
        }
        let (grad_norms, grad_norm) = self.clip(&mut sum, &reports)?;
        watch(self, &sum);
        let factor = self.plan.schedule.factor(step);
        let learning_rates =
            [self.plan.optim.encoder_rate, self.plan.optim.rate, self.plan.optim.pose_rate].map(|r| r * factor);
        let decay = self.plan.optim.decay;
        let group = |name: &str| Group { learning_rate: learning_rates[part_of(name)], decay };
        if !profile::phase("adamw", || self.adamw.step(&mut self.params, &sum, group)) {
            self.check_finite()?;
        }
        if let Some(average) = &mut self.average {
            profile::phase("weight averaging", || average.update(&self.params, step));
        }
        Ok(StepReport { step, learning_rates, grad_norm, grad_norms, ..StepReport::mean(&reports) })
    }

    /// Bounds the norm of the gradients; the norms of the parts and of the whole before.
    fn clip(&self, gradients: &mut [Option<Tensor<f32>>], reports: &[StepReport]) -> Result<([f64; 3], f64)> {
        let bound = if self.plan.optim.clip > 0.0 { self.plan.optim.clip } else { f64::INFINITY };
        let (parts, whole) = profile::phase("norm of the gradients", || {
            let parts: [f64; 3] = norms(gradients, |i| self.parts[i]);
            let whole = parts.iter().map(|norm| norm * norm).sum::<f64>().sqrt();
            clip_from(gradients, whole, bound);
            (parts, whole)
        });
        if !whole.is_finite() {
            let bad = self.params.iter().zip(&*gradients).find(|(_, g)| g.as_ref().is_some_and(|g| !g.is_finite()));
            let name = bad.map_or("of a parameter", |((_, p), _)| p.name());
            return Err(Error::Failed(format!(
                "step {}: the gradient of {name} is not finite (the loss is {})",
                self.adamw.steps + 1,
                StepReport::mean(reports).loss
            )));
        }
        Ok((parts, whole))
    }

    /// Forward and backward for one batch; `pass` (from 0) counts the batches.
    fn pass(&self, pass: u64, batch: &Batch) -> Result<Pass> {
        let step = self.adamw.steps;
        let tape = Tape::new();
        let Forward { c, found, disparity, transforms } = self.forward(&tape, batch, pass);
        let total = found.total.value().item() as f64;
        if !total.is_finite() {
            return Err(self.explain(step + 1, batch, pass));
        }
        let objective = match self.plan.rotations.term([step, pass], &self.model, &c, batch, self.plan.seed) {
            Some(term) => &found.total + term,
            None => found.total.clone(),
        };
        let mut all = objective.backward();
        let gradients = c.gradients(&mut all);
        // From here on nobody else holds the weights: they are changed in place.
        let moved = c.into_moved();
        let report = StepReport {
            loss: total,
            photometric: found.photometric,
            warped: found.warped,
            unwarped: found.unwarped,
            smoothness: found.smoothness,
            auto_mask: found.auto_mask,
            depth_error: found.depth_error,
            vitals: profile::phase("vitals", || {
                let signs = Signs { disparity: &disparity, transforms: &transforms, intrinsics: &batch.intrinsics };
                Vitals::of(&signs, &self.plan.loss)
            }),
            ..StepReport::default()
        };
        profile::phase("freeing", move || drop((all, objective, found, disparity, transforms, tape)));
        Ok(Pass { gradients, moved, report })
    }

    /// Takes the passes of a step, forward and backward, for its time alone: no weight is changed.
    pub(super) fn rehearse(&self, batch: &Batch) -> Result<()> {
        self.pass(0, batch).map(drop)
    }

    /// Runs the forward pass once more, looking at every number.
    fn explain(&self, step: u64, batch: &Batch, pass: u64) -> Error {
        let culprit = profile::first_not_finite(|| self.forward(&Tape::new(), batch, pass));
        Error::Failed(match culprit {
            Some(culprit) => format!(
                "step {step}: the loss is not finite; {culprit}. The last good checkpoint is kept: try a smaller learning \
                 rate"
            ),
            None => format!("step {step}: the loss is not finite, and was so only once: a hardware fault?"),
        })
    }

    /// The mean photometric errors of batches with the given weights in evaluation mode: the minimum that validation
    /// selects by, that of warped neighbours alone, and that of unwarped ones.
    pub fn validate(&self, params: &Params<f32>, batches: &[Batch]) -> [f64; 3] {
        let c = Context::inference(params);
        let errors = batches.iter().map(|batch| {
            let target = Var::constant(batch.target.clone());
            let disparities = self.model.disparities(&c, &target);
            let transforms = transforms(&self.model, &c, batch, &target);
            let found = loss(&disparities[..1], &transforms, &views(batch, Scales::Full), &self.plan.loss, None);
            [found.photometric, found.warped, found.unwarped]
        });
        let mut sums = [0.0; 3];
        errors.for_each(|error| sums.iter_mut().zip(error).for_each(|(s, e)| *s += e));
        sums.map(|s| s / batches.len().max(1) as f64)
    }
}
