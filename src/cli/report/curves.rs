//! The curves of a run's page, as SVG inside it.

use parallax::report::plot::{Line, Plot};
use serde_json::Value;

use super::record::Record;

/// The most points of a line; of more, neighbours are averaged.
const POINTS: usize = 300;

/// A figure of the log.
struct Series {
    name: &'static str,
    /// Whether it stands in the lines of validations, otherwise in those of steps.
    validated: bool,
    /// JSON pointer.
    at: &'static str,
}

const fn step(name: &'static str, at: &'static str) -> Series {
    Series { name, validated: false, at }
}

const fn validated(name: &'static str, at: &'static str) -> Series {
    Series { name, validated: true, at }
}

/// Curves that share a vertical axis.
struct Chart {
    title: &'static str,
    unit: &'static str,
    /// Whether decimal logarithms are drawn.
    log: bool,
    series: &'static [Series],
}

const CHARTS: [Chart; 10] = [
    Chart {
        title: "Loss",
        unit: "error",
        log: false,
        series: &[step("training", "/loss"), validated("validation (photometric)", "/photometric")],
    },
    Chart {
        title: "Photometric error",
        unit: "error",
        log: false,
        series: &[
            step("warped, training", "/warped"),
            step("unwarped, training", "/unwarped"),
            validated("warped, validation", "/warped"),
            validated("unwarped, validation", "/unwarped"),
        ],
    },
    Chart { title: "Abs Rel", unit: "Abs Rel", log: false, series: &[validated("validation", "/abs_rel")] },
    Chart { title: "a1", unit: "share of pixels", log: false, series: &[validated("validation", "/a1")] },
    Chart {
        title: "Disparity spread",
        unit: "deviation over mean",
        log: false,
        series: &[step("training", "/disparity_spread")],
    },
    Chart {
        title: "Shares of pixels",
        unit: "share",
        log: false,
        series: &[
            step("left in by auto-masking", "/auto_mask"),
            step("warped to inside the source", "/inside"),
            step("disparity at an end of the sigmoid", "/saturated"),
        ],
    },
    Chart { title: "Motion of warped samples", unit: "pixels", log: false, series: &[step("median", "/flow")] },
    Chart {
        title: "Gradient norms",
        unit: "log10 of the norm",
        log: true,
        series: &[
            step("encoder", "/grad_norms/0"),
            step("decoder", "/grad_norms/1"),
            step("pose networks", "/grad_norms/2"),
        ],
    },
    Chart {
        title: "Learning rates",
        unit: "rate",
        log: false,
        series: &[
            step("encoder", "/learning_rates/0"),
            step("decoder", "/learning_rates/1"),
            step("pose networks", "/learning_rates/2"),
        ],
    },
    Chart {
        title: "Time of a step",
        unit: "seconds",
        log: false,
        series: &[step("whole step", "/seconds"), step("waiting for data", "/data_seconds")],
    },
];

/// A drawn chart.
pub struct Drawn {
    /// Its title.
    pub title: String,
    /// Its text for those who do not see it: the last value of each line.
    pub words: String,
    /// The picture.
    pub svg: String,
}

/// All curves for which there are points: those of one run together, those of several over each other.
pub fn all(runs: &[Record]) -> Vec<Drawn> {
    let mut drawn = Vec::new();
    for chart in &CHARTS {
        let line = |run: &Record, series: &Series, name: &str| Line {
            name: name.to_owned(),
            points: points(run, series, chart.log),
            marked: series.validated,
        };
        let mut add = |title: String, lines: Vec<Line>| {
            if lines.iter().any(|line| !line.points.is_empty()) {
                drawn.push(draw(title, chart.unit, lines));
            }
        };
        if let [run] = runs {
            add(chart.title.into(), chart.series.iter().map(|s| line(run, s, s.name)).collect());
            continue;
        }
        for series in chart.series {
            let title = format!("{}: {}", chart.title, series.name);
            add(title, runs.iter().map(|run| line(run, series, &run.name)).collect());
        }
    }
    drawn
}

fn draw(title: String, unit: &str, lines: Vec<Line>) -> Drawn {
    let last = |line: &Line| {
        let value = line.points.iter().rev().map(|p| p[1]).find(|v| v.is_finite());
        value.map_or_else(|| format!("{}: none", line.name), |v| format!("{}: {v:.4}", line.name))
    };
    let words = format!("{unit}, last values: {}", lines.iter().map(last).collect::<Vec<_>>().join("; "));
    let plot = Plot { title: title.clone(), x: "step".into(), y: unit.into(), lines, ..Plot::default() };
    Drawn { title, words, svg: plot.svg() }
}

/// Points of a line. A figure that is not finite is written as null and interrupts it; one that is missing is no point.
fn points(run: &Record, series: &Series, log: bool) -> Vec<[f64; 2]> {
    let (lines, at) = if series.validated { (&run.validations, "validated") } else { (&run.steps, "step") };
    let point = |line: &Value| {
        let value = line.pointer(series.at)?.as_f64().unwrap_or(f64::NAN);
        Some([line[at].as_f64()?, if log { value.log10() } else { value }])
    };
    let all: Vec<[f64; 2]> = lines.iter().filter_map(point).collect();
    if all.iter().all(|p| !p[1].is_finite()) {
        return Vec::new();
    }
    thinned(&all)
}

fn thinned(points: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let mean = |part: &[[f64; 2]], k: usize| part.iter().map(|p| p[k]).sum::<f64>() / part.len() as f64;
    points.chunks(points.len().div_ceil(POINTS).max(1)).map(|part| [mean(part, 0), mean(part, 1)]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn many_points_are_averaged_and_gaps_stay() {
        let mut points: Vec<[f64; 2]> = (0..600).map(|i| [f64::from(i), f64::from(i)]).collect();
        points[100][1] = f64::NAN;
        let thin = thinned(&points);
        assert_eq!((thin.len(), thin[0]), (300, [0.5, 0.5]));
        assert!(thin[50][1].is_nan() && thin[51][1].is_finite());
    }
}
