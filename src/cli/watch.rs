//! Flags of `train` about looking on: the run's page in the browser, TensorBoard.

use std::path::Path;

use parallax::train::RunConfig;

#[derive(clap::Args)]
#[command(next_help_heading = "Looking on")]
pub struct Watch {
    /// Open the run's page, report.html, in the default browser; it loads itself again until the run has ended.
    #[arg(long)]
    open: bool,
    /// Write event files for TensorBoard into the folder `tensorboard` of the run, too: figures of steps and validations, depth
    /// maps, histograms of weights and gradients. Look at them with `tensorboard --logdir RUN`. A run that goes on with
    /// --resume goes on writing them.
    #[arg(long)]
    tensorboard: bool,
}

impl Watch {
    /// Puts what the flags say over a configuration, of a new run or of one that goes on.
    pub fn apply(&self, config: &mut RunConfig) {
        config.tensorboard |= self.tensorboard;
    }

    /// Shows the run's page, if asked to.
    pub fn begin(&self, run: &Path) {
        if self.open {
            super::report::leave(run, true);
            super::report::show(&run.join(super::report::PAGE));
        }
    }
}
