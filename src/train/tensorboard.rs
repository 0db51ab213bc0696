//! The figures, pictures and histograms that a run writes for TensorBoard, if its recipe asks for them.
//!
//! Every session of a run has an event file of its own in `tensorboard/`. A run that goes on tells readers to forget what
//! was written of steps after its state, as its log does.

use std::fs;

use image::ImageReader;

use super::run::{Event, Run, TENSORBOARD, VIEWS};
use super::trainer::{StepReport, Trainer};
use super::validation::{RunMetrics, Validation};
use super::views::Views;
use crate::error::{Error, Result};
use crate::eval::metrics::Metrics;
use crate::formats::tensorboard::{EventWriter, Histogram, Point};
use crate::nn::Params;
use crate::tensor::Tensor;

/// The parts that learn at rates of their own, as tags call them.
const PARTS: [&str; 3] = ["encoder", "decoder", "pose"];

/// The event file of a session.
pub(super) struct Board {
    writer: EventWriter,
    /// How the gradients of the step before a validation are spread, part by part.
    gradients: Vec<Point>,
}

impl Run {
    /// Opens an event file, if the recipe asks for one. A failure is told, and ends nothing.
    pub(super) fn open_board(&mut self, tell: &mut impl FnMut(Event)) {
        if self.config.tensorboard {
            let writer = EventWriter::create(&self.folder.join(TENSORBOARD), self.trainer.steps() + 1);
            let told =
                writer.inspect_err(|e| tell(Event::Warning(&format!("nothing is written for TensorBoard: {e}"))));
            self.board = told.ok().map(|writer| Board { writer, gradients: Vec::new() });
        }
    }

    /// Lets the event file have something, if there is one. After a failure, which is told, it gets no more.
    pub(super) fn board_gets(
        &mut self,
        give: impl FnOnce(&mut Board, &Run) -> Result<()>,
        tell: &mut impl FnMut(Event),
    ) {
        let Some(mut board) = self.board.take() else { return };
        match give(&mut board, self) {
            Ok(()) => self.board = Some(board),
            Err(error) => tell(Event::Warning(&format!("nothing more is written for TensorBoard: {error}"))),
        }
    }
}

impl Board {
    /// The figures of a logged step; seconds of it, and of waiting for its data.
    pub(super) fn step(&mut self, report: &StepReport, [seconds, data_seconds]: [f64; 2]) -> Result<()> {
        let vitals = &report.vitals;
        let mut points: Vec<Point> = [
            ("training/loss", report.loss),
            ("training/photometric", report.photometric),
            ("training/warped", report.warped),
            ("training/unwarped", report.unwarped),
            ("training/smoothness", report.smoothness),
            ("training/depth_error", report.depth_error),
            ("health/auto_mask", report.auto_mask),
            ("health/disparity", vitals.disparity),
            ("health/disparity_spread", vitals.disparity_spread),
            ("health/saturated", vitals.saturated),
            ("health/translation", vitals.translation),
            ("health/flow", vitals.flow),
            ("health/inside", vitals.inside),
            ("gradient_norms/all", report.grad_norm),
            ("time/step", seconds),
            ("time/data", data_seconds),
        ]
        .map(|(tag, value)| Point::scalar(tag, value))
        .into();
        for (i, part) in PARTS.iter().enumerate() {
            points.push(Point::scalar(format!("gradient_norms/{part}"), report.grad_norms[i]));
            points.push(Point::scalar(format!("learning_rates/{part}"), report.learning_rates[i]));
        }
        self.writer.add(report.step, points)
    }

    /// Notes how the gradients of a step are spread, until its weights are validated.
    pub(super) fn see_gradients(&mut self, trainer: &Trainer, gradients: &[Option<Tensor<f32>>]) {
        self.gradients = spread("gradients", trainer, |i| gradients.get(i)?.as_ref());
    }

    /// The figures of a validation, its views, and how the weights that were validated and the last gradients are spread.
    pub(super) fn validation(
        &mut self,
        run: &Run,
        line: &Validation,
        weights: &Params<f32>,
        views: &Views,
    ) -> Result<()> {
        let figures = [
            ("photometric", Some(line.photometric)),
            ("warped", Some(line.warped)),
            ("unwarped", Some(line.unwarped)),
            ("abs_rel", line.abs_rel),
            ("a1", line.a1),
        ];
        let scalar = |(name, value): (&str, Option<f64>)| Some(Point::scalar(format!("validation/{name}"), value?));
        let mut points: Vec<Point> = figures.into_iter().filter_map(scalar).collect();
        let values: Vec<_> = weights.iter().map(|(_, p)| p.learnt.then_some(&p.value)).collect();
        points.extend(spread("weights", &run.trainer, |i| values[i]));
        points.append(&mut self.gradients);
        self.writer.add(line.validated, points)?;
        for group in &views.groups {
            for view in &group.views {
                let path = run.folder.join(VIEWS).join(&view.file);
                let size = ImageReader::open(&path).map_err(|e| Error::io(&path, e))?.into_dimensions();
                let (width, height) = size.map_err(|e| Error::file(&path, format!("cannot be read back: {e}")))?;
                let bytes = fs::read(&path).map_err(|e| Error::io(&path, e))?;
                let name = view.file.rsplit_once('.').map_or(&view.file[..], |(name, _)| name);
                let tag = format!("{}/{name}", group.kind);
                self.writer.add(line.validated, vec![Point::image(tag, bytes, [width, height])])?;
            }
        }
        Ok(())
    }

    /// The metrics of the best weights, at the run's last step.
    pub(super) fn end(&mut self, step: u64, metrics: &RunMetrics) -> Result<()> {
        let Some(Metrics { abs_rel, sq_rel, rmse, rmse_log, a1, a2, a3 }) = metrics.after else { return Ok(()) };
        let figures = [
            ("test/abs_rel", abs_rel),
            ("test/sq_rel", sq_rel),
            ("test/rmse", rmse),
            ("test/rmse_log", rmse_log),
            ("test/a1", a1),
            ("test/a2", a2),
            ("test/a3", a3),
        ];
        self.writer.add(step, figures.map(|(tag, value)| Point::scalar(tag, value)).into())
    }
}

/// A histogram for each part, of a tensor of each parameter.
fn spread<'a>(what: &str, trainer: &Trainer, of: impl Fn(usize) -> Option<&'a Tensor<f32>>) -> Vec<Point> {
    let part = |(number, name): (usize, &&str)| {
        let own = trainer.parts.iter().enumerate().filter(|(_, part)| **part == number).filter_map(|(i, _)| of(i));
        let histogram = Histogram::of(own.flat_map(|tensor| tensor.data()))?;
        Some(Point::histogram(format!("{what}/{name}"), histogram))
    };
    PARTS.iter().enumerate().filter_map(part).collect()
}
