//! Plots as SVG: lines with points over two axes.

use std::fmt::Write;

/// The colours of lines, by their order (Okabe and Ito's palette: told apart by colour-blind readers too).
const COLOURS: [&str; 7] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000"];
/// The size of a plot, and of the frame inside it, in pixels.
const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 480.0;
const LEFT: f64 = 80.0;
const RIGHT: f64 = 20.0;
const TOP: f64 = 40.0;
const BOTTOM: f64 = 60.0;

/// A line of a plot.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    /// Name in the legend.
    pub name: String,
    /// Its points, x and y; what is not finite interrupts it.
    pub points: Vec<[f64; 2]>,
    /// Whether every point has a mark.
    pub marked: bool,
}

/// A plot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plot {
    /// Above it.
    pub title: String,
    /// Below the horizontal axis.
    pub x: String,
    /// Beside the vertical axis.
    pub y: String,
    /// The lines.
    pub lines: Vec<Line>,
    /// The names of x = 0, 1, 2, ..., instead of numbers.
    pub categories: Vec<String>,
    /// Whether the vertical axis begins at 0.
    pub from_zero: bool,
    /// Whether both axes have one unit of length, as on a map.
    pub equal: bool,
}

/// An axis: from which value to which, and where on the paper.
struct Axis {
    values: [f64; 2],
    paper: [f64; 2],
}

impl Axis {
    /// Where a value lies on the paper.
    fn at(&self, value: f64) -> f64 {
        let [low, high] = self.values;
        self.paper[0] + (value - low) / (high - low) * (self.paper[1] - self.paper[0])
    }

    /// Round values, some five to ten of them.
    fn ticks(&self) -> Vec<f64> {
        let [low, high] = self.values;
        let rough = (high - low) / 6.0;
        let power = 10f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * power).find(|step| *step >= rough).unwrap_or(rough);
        let first = (low / step).ceil() as i64;
        let ticks = (first..first + 20).map(|i| i as f64 * step);
        ticks.take_while(|tick| *tick <= high + 1e-9 * step).collect()
    }
}

impl Plot {
    /// The plot as the text of an SVG file.
    pub fn svg(&self) -> String {
        let (x, y) = self.axes();
        let mut out = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH}\" height=\"{HEIGHT}\" viewBox=\"0 0 {WIDTH} \
             {HEIGHT}\" font-family=\"sans-serif\" font-size=\"13\">\n<rect width=\"100%\" height=\"100%\" \
             fill=\"white\"/>\n"
        );
        text(&mut out, [WIDTH / 2.0, 24.0], "middle", &self.title);
        text(&mut out, [(LEFT + WIDTH - RIGHT) / 2.0, HEIGHT - 14.0], "middle", &self.x);
        let middle = (TOP + HEIGHT - BOTTOM) / 2.0;
        // Writing to a string never fails, here and below.
        let _ = writeln!(out, "<g transform=\"translate(20 {middle}) rotate(-90)\">");
        text(&mut out, [0.0, 0.0], "middle", &self.y);
        out.push_str("</g>\n");
        self.grid(&mut out, &x, &y);
        for (line, colour) in self.lines.iter().zip(COLOURS.iter().cycle()) {
            draw(&mut out, line, colour, &x, &y);
        }
        for (i, (line, colour)) in self.lines.iter().zip(COLOURS.iter().cycle()).enumerate() {
            let at = TOP + 18.0 + 18.0 * i as f64;
            let (from, to) = (LEFT + 12.0, LEFT + 36.0);
            segment(&mut out, [from, at - 4.0, to, at - 4.0], colour, 2.5);
            text(&mut out, [to + 8.0, at], "start", &line.name);
        }
        out.push_str("</svg>\n");
        out
    }

    /// The axes, a little longer than the lines need.
    fn axes(&self) -> (Axis, Axis) {
        let range = |k: usize| {
            let values = self.lines.iter().flat_map(|line| &line.points).map(|p| p[k]).filter(|v| v.is_finite());
            let [low, high] = values.fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], v| [a.min(v), b.max(v)]);
            if low > high { [0.0, 1.0] } else { [low, high] }
        };
        let ([x0, x1], [mut y0, y1]) = (range(0), range(1));
        if self.from_zero {
            y0 = y0.min(0.0);
        }
        let wider = |[low, high]: [f64; 2], part: f64| {
            let more = if high > low { (high - low) * part } else { high.abs().max(1.0) * 0.1 };
            [low - more, high + more]
        };
        let mut xs =
            if self.categories.is_empty() { wider([x0, x1], 0.05) } else { [-0.5, self.categories.len() as f64 - 0.5] };
        let mut ys = wider([y0, y1], 0.08);
        if self.from_zero && y0 == 0.0 {
            ys[0] = 0.0;
        }
        let (across, up) = (WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM);
        if self.equal {
            let unit = ((xs[1] - xs[0]) / across).max((ys[1] - ys[0]) / up);
            let around = |[low, high]: [f64; 2], length: f64| {
                let middle = (low + high) / 2.0;
                [middle - unit * length / 2.0, middle + unit * length / 2.0]
            };
            (xs, ys) = (around(xs, across), around(ys, up));
        }
        let x = Axis { values: xs, paper: [LEFT, WIDTH - RIGHT] };
        let y = Axis { values: ys, paper: [HEIGHT - BOTTOM, TOP] };
        (x, y)
    }

    /// The frame, the ticks and their numbers.
    fn grid(&self, out: &mut String, x: &Axis, y: &Axis) {
        let floor = HEIGHT - BOTTOM;
        let named = |i: usize, name: &String| (i as f64, name.clone());
        let xs: Vec<(f64, String)> = match self.categories.is_empty() {
            true => x.ticks().into_iter().map(|tick| (tick, number(tick))).collect(),
            false => self.categories.iter().enumerate().map(|(i, name)| named(i, name)).collect(),
        };
        for (tick, name) in xs {
            segment(out, [x.at(tick), TOP, x.at(tick), floor], "#dddddd", 1.0);
            text(out, [x.at(tick), floor + 18.0], "middle", &name);
        }
        for tick in y.ticks() {
            segment(out, [LEFT, y.at(tick), WIDTH - RIGHT, y.at(tick)], "#dddddd", 1.0);
            text(out, [LEFT - 8.0, y.at(tick) + 4.0], "end", &number(tick));
        }
        segment(out, [LEFT, floor, WIDTH - RIGHT, floor], "#404040", 1.0);
        segment(out, [LEFT, TOP, LEFT, floor], "#404040", 1.0);
    }
}

/// A number as short as it is read.
fn number(value: f64) -> String {
    let rounded = (value * 1e6).round() / 1e6;
    // No -0.
    format!("{}", if rounded == 0.0 { 0.0 } else { rounded })
}

fn draw(out: &mut String, line: &Line, colour: &str, x: &Axis, y: &Axis) {
    let finite = |p: &[f64; 2]| p.iter().all(|v| v.is_finite());
    for part in line.points.split(|p| !finite(p)).filter(|part| !part.is_empty()) {
        let points: Vec<String> = part.iter().map(|p| format!("{:.2},{:.2}", x.at(p[0]), y.at(p[1]))).collect();
        let points = points.join(" ");
        let _ = writeln!(
            out,
            "<polyline points=\"{points}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\" stroke-linejoin=\"round\"/>"
        );
    }
    if line.marked {
        for p in line.points.iter().filter(|p| finite(p)) {
            let (cx, cy) = (x.at(p[0]), y.at(p[1]));
            let _ = writeln!(out, "<circle cx=\"{cx:.2}\" cy=\"{cy:.2}\" r=\"3.5\" fill=\"{colour}\"/>");
        }
    }
}

fn segment(out: &mut String, [x1, y1, x2, y2]: [f64; 4], colour: &str, width: f64) {
    let _ = writeln!(
        out,
        "<line x1=\"{x1:.2}\" y1=\"{y1:.2}\" x2=\"{x2:.2}\" y2=\"{y2:.2}\" stroke=\"{colour}\" stroke-width=\"{width}\"/>"
    );
}

fn text(out: &mut String, [x, y]: [f64; 2], anchor: &str, words: &str) {
    let mut safe = String::new();
    for c in words.chars() {
        match c {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            c if c.is_control() => safe.push(' '),
            c => safe.push(c),
        }
    }
    let _ = writeln!(out, "<text x=\"{x:.2}\" y=\"{y:.2}\" text-anchor=\"{anchor}\" fill=\"#202020\">{safe}</text>");
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(points: &[[f64; 2]]) -> Line {
        Line { name: "a < b & c".into(), points: points.to_vec(), marked: true }
    }

    /// The points of the first line on the paper.
    fn drawn(svg: &str) -> Vec<[f64; 2]> {
        let points = svg.split("<polyline points=\"").nth(1).unwrap().split('"').next().unwrap();
        let pair = |p: &str| p.split_once(',').map(|(x, y)| [x, y].map(|v| v.parse().unwrap())).unwrap();
        points.split(' ').map(pair).collect()
    }

    #[test]
    fn points_lie_within_the_frame_and_up_is_more() {
        let svg = Plot { lines: vec![line(&[[1.0, 2.0], [3.0, 8.0]])], ..Plot::default() }.svg();
        let [[ax, ay], [bx, by]] = drawn(&svg)[..] else { panic!("{svg}") };
        assert!(LEFT < ax && ax < bx && bx < WIDTH - RIGHT && TOP < by && by < ay && ay < HEIGHT - BOTTOM, "{svg}");
        assert!(svg.contains("a &lt; b &amp; c") && svg.matches("<circle").count() == 2);
        assert!(svg.starts_with("<svg ") && svg.ends_with("</svg>\n"));
    }

    #[test]
    fn a_map_has_one_unit_of_length_either_way() {
        let square = line(&[[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]]);
        let [a, b, c] = drawn(&Plot { lines: vec![square], equal: true, ..Plot::default() }.svg())[..] else {
            panic!()
        };
        assert!(((b[0] - a[0]) - (b[1] - c[1])).abs() < 0.1, "{a:?} {b:?} {c:?}");
    }

    #[test]
    fn ticks_are_round_and_few() {
        for (low, high) in [(0.0, 1.0), (-3.0, 977.0), (0.021, 0.0223), (1e4, 9e6)] {
            let ticks = Axis { values: [low, high], paper: [0.0, 1.0] }.ticks();
            assert!((3..=12).contains(&ticks.len()), "{ticks:?}");
            assert!(ticks.iter().all(|t| (low..=high * (1.0 + 1e-9)).contains(t)), "{ticks:?}");
        }
        assert_eq!(Axis { values: [0.0, 0.6], paper: [0.0, 1.0] }.ticks().len(), 7);
        assert_eq!([number(0.1 + 0.2), number(-0.0), number(20.0)], ["0.3", "0", "20"]);
    }

    #[test]
    fn empty_constant_and_broken_lines_have_a_plot_too() {
        for points in [&[][..], &[[1.0, 1.0]], &[[f64::NAN, 1.0], [f64::INFINITY, 2.0]]] {
            let svg = Plot { lines: vec![line(points)], from_zero: true, ..Plot::default() }.svg();
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
        let broken = line(&[[0.0, 1.0], [1.0, 2.0], [2.0, f64::NAN], [3.0, 2.0], [4.0, 1.0]]);
        let svg = Plot { lines: vec![broken], categories: vec!["one".into(); 5], ..Plot::default() }.svg();
        assert_eq!((svg.matches("<polyline").count(), svg.matches("<circle").count()), (2, 4));
    }
}
