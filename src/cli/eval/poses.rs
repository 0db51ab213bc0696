//! `parallax eval --poses`: a predicted trajectory against the true one.

use std::path::Path;

use parallax::Result;
use parallax::eval::alignment::Similarity;
use parallax::eval::trajectory::{Pose, TrajectoryErrors, compare_trajectories, read_poses};
use parallax::formats::atomic::write_bytes_atomically;
use parallax::report::plot::{Line, Plot};
use serde::Serialize;

use super::Args;

#[derive(Serialize)]
struct Measured<'a> {
    poses: &'a Path,
    trajectory: &'a Path,
    #[serde(flatten)]
    errors: TrajectoryErrors,
}

/// Compares the files, prints the errors, draws both from above.
pub fn run(args: &Args, poses: &Path, trajectory: &Path) -> Result<()> {
    let (truth, predicted) = (read_poses(poses)?, read_poses(trajectory)?);
    let errors = compare_trajectories(&truth, &predicted)?;
    if let Some(path) = &args.plot {
        write_bytes_atomically(path, from_above(&truth, &predicted)?.svg().as_bytes())?;
    }
    if args.json {
        return crate::cli::print_json(&Measured { poses, trajectory, errors });
    }
    say!("truth        {}", poses.display());
    say!("predicted    {}", trajectory.display());
    say!("frames       {}", errors.frames);
    let five = errors.five_frames;
    say!("five frames  {:.4} m, deviation {:.4} (over {} snippets)", five.mean, five.std, five.count);
    say!(
        "aligned      {:.4} m (ATE: root of the mean square), by a similarity of scale {:.4}",
        errors.ate,
        errors.scale
    );
    match errors.segments {
        Some(found) => say!(
            "segments     {:.3} %, {:.3} degrees in 100 m ({} of 100 to 800 m)",
            found.translation_percent,
            found.degrees_per_100_m,
            found.count
        ),
        None => say!("segments     none: the path is shorter than 100 m"),
    }
    Ok(())
}

/// Both paths from above, the predicted one laid over the true one.
fn from_above(truth: &[Pose], predicted: &[Pose]) -> Result<Plot> {
    let positions = |poses: &[Pose]| poses.iter().map(Pose::position).collect::<Vec<_>>();
    let alignment = Similarity::between(&positions(predicted), &positions(truth))?;
    let aligned: Vec<[f64; 3]> = positions(predicted).into_iter().map(|p| alignment.of_point(p)).collect();
    let line = |name: &str, points: &[[f64; 3]]| {
        let points = points.iter().map(|[x, _, z]| [*x, *z]).collect();
        Line { name: name.to_owned(), points, marked: false }
    };
    Ok(Plot {
        title: "trajectory from above".into(),
        x: "to the right, m".into(),
        y: "ahead, m".into(),
        lines: vec![line("true", &positions(truth)), line("predicted, aligned", &aligned)],
        equal: true,
        ..Plot::default()
    })
}
