//! `parallax data`.

mod check;
mod prepare;
mod street;

use parallax::Result;

#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand)]
enum What {
    /// The embedded street, in the layout of KITTI raw, with exact depth and poses.
    Street(street::Args),
    /// Look at a folder before training on it: what it holds, what is wrong with it, whether its camera fits, what training
    /// would take.
    ///
    /// Exit status 1 if one cannot train on it as it is: nothing to train on, frames that cannot be read, a camera that
    /// does not fit.
    Check(check::Args),
    /// Resize all frames of a folder into one file, from which training reads them without decoding anything.
    ///
    /// What was stopped is gone on with by the same command. A file that no longer belongs to the frames is refused by
    /// train, and made anew by this command.
    Prepare(prepare::Args),
}

pub fn run(args: Args) -> Result<()> {
    match args.what {
        What::Street(args) => street::run(args),
        What::Check(args) => check::run(args),
        What::Prepare(args) => prepare::run(args),
    }
}
