//! Where the corners of one picture lie in the next, to a fraction of a pixel.
//!
//! Lucas and Kanade's method in a pyramid (Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", Intel,
//! 2000): a window is moved until the pictures differ least there, coarse levels first. What is not found again on the
//! way back is dropped.

use image::RgbImage;

use super::corners::corners;
use super::grey::Grey;

/// Half the side of the window, in pixels of each level.
const WINDOW: i32 = 4;
/// Pixels in a window.
const AREA: usize = ((2 * WINDOW + 1) * (2 * WINDOW + 1)) as usize;
/// Moves of a window on a level.
const MOVES: usize = 12;
/// A move that is shorter ends the search, in pixels.
const STILL: f32 = 0.01;
/// The shortest side of the coarsest level, in pixels.
const COARSEST: usize = 12;
/// How far from its start a point may come back, in pixels.
const BACK: f32 = 0.2;
/// The most that windows may differ, in levels on average, once their mean brightness is the same.
const DIFFERENT: f32 = 14.0;
/// How far a point has to stay inside, in pixels.
const BORDER: usize = 6;

/// Points of one picture and where they lie in the other, in pixels, centres at whole numbers.
#[derive(Clone, Debug, Default)]
pub(super) struct Matches(pub(super) Vec<[[f64; 2]; 2]>);

/// The matches of two pictures of one size.
pub(super) fn matches(from: &RgbImage, to: &RgbImage) -> Matches {
    if from.dimensions() != to.dimensions() || from.width() == 0 || from.height() == 0 {
        return Matches::default();
    }
    let (from, to) = (Grey::of(from).pyramid(COARSEST), Grey::of(to).pyramid(COARSEST));
    let mut found = Vec::new();
    for start in corners(&from[0], BORDER) {
        let start = start.map(|n| n as f32);
        let Some(end) = follow(&from, &to, start) else { continue };
        let Some(back) = follow(&to, &from, end) else { continue };
        if (back[0] - start[0]).hypot(back[1] - start[1]) <= BACK {
            found.push([start.map(f64::from), end.map(f64::from)]);
        }
    }
    Matches(found)
}

/// Where a point of the first picture lies in the second, if it is found inside.
fn follow(from: &[Grey], to: &[Grey], start: [f32; 2]) -> Option<[f32; 2]> {
    let mut moved = [0f32; 2];
    for level in (0..from.len().min(to.len())).rev() {
        let scale = (1 << level) as f32;
        let at = start.map(|x| x / scale);
        moved = refine(&from[level], &to[level], at, moved, level == 0)?;
        if level > 0 {
            moved = moved.map(|x| 2.0 * x);
        }
    }
    let end = [start[0] + moved[0], start[1] + moved[1]];
    let (right, bottom) = ((to[0].width - BORDER) as f32, (to[0].height - BORDER) as f32);
    let inside = |x: f32, end: f32| x >= BORDER as f32 && x < end;
    (inside(end[0], right) && inside(end[1], bottom)).then_some(end)
}

/// Moves the window of one level from `moved` on until the pictures differ least. On the `last` level, windows that still
/// differ are no match.
fn refine(from: &Grey, to: &Grey, at: [f32; 2], mut moved: [f32; 2], last: bool) -> Option<[f32; 2]> {
    let mut values = [0f32; AREA];
    let mut slopes = [[0f32; 2]; AREA];
    let (mut xx, mut xy, mut yy) = (0f32, 0f32, 0f32);
    for (k, (dx, dy)) in window().enumerate() {
        let (x, y) = (at[0] + dx, at[1] + dy);
        values[k] = from.between(x, y);
        let slope = [
            0.5 * (from.between(x + 1.0, y) - from.between(x - 1.0, y)),
            0.5 * (from.between(x, y + 1.0) - from.between(x, y - 1.0)),
        ];
        slopes[k] = slope;
        xx += slope[0] * slope[0];
        xy += slope[0] * slope[1];
        yy += slope[1] * slope[1];
    }
    let mean = values.iter().sum::<f32>() / AREA as f32;
    let determinant = xx * yy - xy * xy;
    // A plain window on a coarse level says nothing: the finer ones go on from where they are.
    if determinant < 1e-3 * (xx + yy) * (xx + yy) || xx + yy < 1.0 {
        return if last { None } else { Some(moved) };
    }
    let mut different = f32::INFINITY;
    for _ in 0..MOVES {
        let mut others = [0f32; AREA];
        for (other, (dx, dy)) in others.iter_mut().zip(window()) {
            *other = to.between(at[0] + moved[0] + dx, at[1] + moved[1] + dy);
        }
        // The exposure may change.
        let brighter = others.iter().sum::<f32>() / AREA as f32 - mean;
        let (mut bx, mut by) = (0f32, 0f32);
        different = 0.0;
        for ((&other, &value), slope) in others.iter().zip(&values).zip(&slopes) {
            let difference = value - (other - brighter);
            different += difference.abs() / AREA as f32;
            bx += difference * slope[0];
            by += difference * slope[1];
        }
        let step = [(yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant];
        moved = [moved[0] + step[0], moved[1] + step[1]];
        if step[0].hypot(step[1]) < STILL {
            break;
        }
    }
    let far = moved.iter().any(|x| !x.is_finite()) || (last && different > DIFFERENT);
    (!far).then_some(moved)
}

/// The offsets of a window's pixels.
fn window() -> impl Iterator<Item = (f32, f32)> {
    (-WINDOW..=WINDOW).flat_map(|y| (-WINDOW..=WINDOW).map(move |x| (x as f32, y as f32)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A picture of waves in all directions, moved.
    fn waves(moved: [f64; 2]) -> RgbImage {
        RgbImage::from_fn(160, 96, |x, y| {
            let (x, y) = (f64::from(x) - moved[0], f64::from(y) - moved[1]);
            let sum: f64 = (0..7)
                .map(|k| {
                    let (angle, length) = (0.9 * f64::from(k), 7.0 + 5.0 * f64::from(k));
                    ((x * angle.cos() + y * angle.sin()) * std::f64::consts::TAU / length + f64::from(k * k)).sin()
                })
                .sum();
            image::Rgb([(128.0 + 17.0 * sum).round().clamp(0.0, 255.0) as u8; 3])
        })
    }

    #[test]
    fn a_picture_that_moves_by_fractions_of_a_pixel_is_followed() {
        for moved in [[0.0, 0.0], [2.3, -1.6], [-9.4, 5.75]] {
            let found = matches(&waves([0.0; 2]), &waves(moved)).0;
            assert!(found.len() > 40, "{moved:?}: {}", found.len());
            for [from, to] in found {
                let off = (to[0] - from[0] - moved[0]).hypot(to[1] - from[1] - moved[1]);
                assert!(off < 0.1, "{moved:?}: {from:?} to {to:?}");
            }
        }
    }

    #[test]
    fn pictures_of_two_scenes_or_of_two_sizes_have_hardly_a_match() {
        let noise = |seed: u64| {
            let mut random = crate::random::Random::new(seed, 0);
            RgbImage::from_fn(160, 96, |_, _| image::Rgb([random.below(256) as u8; 3]))
        };
        assert!(matches(&noise(1), &noise(2)).0.len() < 10);
        assert!(matches(&noise(1), &RgbImage::new(80, 48)).0.is_empty());
    }
}
