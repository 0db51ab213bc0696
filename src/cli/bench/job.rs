//! What is timed, and how.

use std::time::Instant;

use parallax::Result;
use parallax::data::batch::Batch;
use parallax::nn::Folded;
use parallax::ops::Conv2d;
use parallax::random::Random;
use parallax::tensor::profile;
use parallax::tensor::profile::Profile;
use parallax::tensor::{Precision, Shape, Tensor, Var, pool};
use parallax::train::RunConfig;
use parallax::train::Trainer;

use super::Sizes;
use crate::cli::progress::Progress;

/// Something that can be done again and again.
pub trait Job {
    /// Once.
    fn once(&mut self) -> Result<()>;
}

/// What was measured of a job.
pub struct Measured {
    /// Of each iteration to which nobody listened.
    pub seconds: Vec<f64>,
    /// Of as many that alternate with those, if asked for.
    pub profiles: Vec<Profile>,
    /// Arithmetic of the forward pass.
    pub forward_flops: u64,
    /// Buffers allocated in an iteration to which nobody listened.
    pub fresh_buffers: f64,
}

/// Times a job, after three times that are not counted; `listen` for the profiles too.
pub fn measure(job: &mut impl Job, iterations: usize, listen: bool) -> Result<Measured> {
    let (done, warm) = profile::profile(|| job.once());
    done?;
    job.once()?;
    job.once()?;
    let mut fresh = 0;
    let (mut seconds, mut profiles) = (Vec::new(), Vec::new());
    let iterations = iterations.max(1);
    let mut progress = Progress::new("timing", iterations as u64);
    for done in 1..=iterations {
        let before = pool::fresh_buffers();
        let start = Instant::now();
        job.once()?;
        seconds.push(start.elapsed().as_secs_f64());
        fresh += pool::fresh_buffers() - before;
        if listen {
            let (done, profile) = profile::profile(|| job.once());
            done?;
            profiles.push(profile);
        }
        progress.set(done as u64, "");
    }
    progress.finish();
    let fresh_buffers = fresh as f64 / seconds.len() as f64;
    Ok(Measured { seconds, profiles, forward_flops: warm.ops.iter().map(|e| e.flops).sum(), fresh_buffers })
}

/// A training step, or the disparities of its pictures.
pub struct Network {
    trainer: Trainer,
    batch: Batch,
    /// For inference; a step has no use for weights twice.
    folded: Option<Folded<f32>>,
}

impl Network {
    /// The network of the given sizes, with a batch: for training, or for prediction in some numbers.
    pub fn new(sizes: &Sizes, seed: u64, infer: Option<Precision>) -> Result<Self> {
        sizes.check()?;
        let mut config = RunConfig::new(sizes.architecture()?, 1_000_000);
        // The step as it is for most of the run.
        config.auto_mask_delay = 0.0;
        config.rotations.keep = 0.0;
        config.seed = seed;
        config.recompute = sizes.recompute;
        let trainer = Trainer::new(config.model(), config.plan());
        let folded = infer.map(|precision| Folded::new(&trainer.params).with_precision(precision));
        Ok(Network { trainer, batch: batch(sizes, seed), folded })
    }
}

impl Job for Network {
    fn once(&mut self) -> Result<()> {
        let Some(folded) = &self.folded else { return self.trainer.step(&self.batch).map(drop) };
        self.trainer.model.predict(folded, &self.batch.target);
        Ok(())
    }
}

/// A 3x3 convolution of two pictures of 320x320 with 3 channels to 16, forward.
pub struct Conv {
    x: Var<f32>,
    w: Var<f32>,
}

impl Conv {
    /// With random numbers.
    pub fn new() -> Self {
        let mut random = Random::new(1, 1);
        let mut draw = |shape: Shape| {
            Var::constant(Tensor::build(shape, |out| {
                out.iter_mut().for_each(|x| *x = random.uniform(-1.0, 1.0) as f32)
            }))
        };
        Conv { x: draw([2, 320, 320, 3].into()), w: draw([3, 3, 3, 16].into()) }
    }
}

impl Job for Conv {
    fn once(&mut self) -> Result<()> {
        std::hint::black_box(self.x.conv2d(&self.w, None, Conv2d::padded(1)));
        Ok(())
    }
}

/// Triplets of smooth random pictures.
fn batch(sizes: &Sizes, seed: u64) -> Batch {
    let mut random = Random::new(seed.wrapping_add(1), 0);
    let mut picture = |scale: usize| {
        let (h, w) = (sizes.height >> scale, sizes.width >> scale);
        let coarse: Tensor<f32> = Tensor::build([sizes.batch, h.div_ceil(8), w.div_ceil(8), 3], |out| {
            out.iter_mut().for_each(|x| *x = random.unit() as f32)
        });
        Var::constant(coarse).resize_bilinear(h, w, false).into_value()
    };
    let pyramid: Vec<_> = (0..4).map(&mut picture).collect();
    let sources = [picture(0), picture(0)];
    let (w, h) = (sizes.width as f64, sizes.height as f64);
    Batch::in_time(pyramid, sources, vec![[0.58 * w, 1.92 * h, 0.5 * w, 0.5 * h]; sizes.batch])
}
