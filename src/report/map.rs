//! Maps of values that are known in some pixels alone, in colours; and the bar that says what a colour means.

use image::{Rgb, RgbImage};

use super::colormap::magma;

/// The colour of what is not known.
pub const UNKNOWN: Rgb<u8> = Rgb([70, 78, 88]);

/// Draws values at places of a map of `(height, width)` into a picture of `size` (width and height in pixels), in magma from
/// `low` (dark) to `high` (bright). Where several values share a pixel the last one shows; a value alone is spread over
/// `reach` pixels around it, where nothing else is known, so that sparse points can be seen.
pub fn draw_values(
    values: impl IntoIterator<Item = (usize, usize, f64)>,
    (height, width): (usize, usize),
    size: (u32, u32),
    [low, high]: [f64; 2],
    reach: u32,
) -> RgbImage {
    let (w, h) = size;
    let mut known: Vec<Option<f64>> = vec![None; w as usize * h as usize];
    for (row, column, value) in values {
        if row < height && column < width && value.is_finite() {
            let (x, y) = (column * w as usize / width, row * h as usize / height);
            known[y * w as usize + x] = Some(value);
        }
    }
    let range = if high > low { high - low } else { 1.0 };
    RgbImage::from_fn(w, h, |x, y| {
        nearest(&known, size, [x, y], reach).map_or(UNKNOWN, |value| magma(((value - low) / range) as f32))
    })
}

/// Draws a map that is known everywhere, row-major, `(height, width)`, into a picture of `size`, as [`draw_values`].
///
/// # Panics
/// If the map is not that large.
pub fn draw_map(map: &[f64], (height, width): (usize, usize), (w, h): (u32, u32), [low, high]: [f64; 2]) -> RgbImage {
    assert!(map.len() == height * width && !map.is_empty(), "draw_map: a map of {width}x{height} expected");
    let range = if high > low { high - low } else { 1.0 };
    RgbImage::from_fn(w, h, |x, y| {
        let (row, column) = (y as usize * height / h as usize, x as usize * width / w as usize);
        magma(((map[row * width + column] - low) / range) as f32)
    })
}

/// The known value nearest to a pixel, at most `reach` pixels away along either axis.
fn nearest(known: &[Option<f64>], (w, h): (u32, u32), [x, y]: [u32; 2], reach: u32) -> Option<f64> {
    let at = |x: u32, y: u32| known[y as usize * w as usize + x as usize];
    if let Some(value) = at(x, y) {
        return Some(value);
    }
    let span = |centre: u32, side: u32| centre.saturating_sub(reach)..(centre + reach + 1).min(side);
    let places = span(y, h).flat_map(|row| span(x, w).map(move |column| (column, row)));
    let found =
        places.filter_map(|(column, row)| Some((column.abs_diff(x).pow(2) + row.abs_diff(y).pow(2), at(column, row)?)));
    found.min_by_key(|(distance, _)| *distance).map(|(_, value)| value)
}

/// The bar of magma's colours, dark on the left.
pub fn colour_bar(width: u32, height: u32) -> RgbImage {
    RgbImage::from_fn(width, height, |x, _| magma(x as f32 / width.saturating_sub(1).max(1) as f32))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::colormap::MAGMA;

    #[test]
    fn values_have_their_colours_and_points_are_spread_over_nothing_else() {
        let values = [(0, 0, 0.0), (0, 1, 2.0), (5, 5, 1.0), (9, 9, f64::NAN), (40, 0, 1.0)];
        let picture = draw_values(values, (10, 10), (10, 10), [0.0, 2.0], 1);
        let at = |x, y| picture.get_pixel(x, y).0;
        assert_eq!((at(0, 0), at(1, 0), at(5, 5)), (MAGMA[0], MAGMA[255], MAGMA[128]));
        assert_eq!((at(4, 6), at(7, 5), at(9, 9)), (MAGMA[128], UNKNOWN.0, UNKNOWN.0));
        // The nearer of two.
        assert_eq!(at(2, 0), MAGMA[255]);
        let half = draw_values([(9, 9, 1.0)], (10, 10), (5, 5), [1.0, 1.0], 0);
        assert_eq!((half.get_pixel(4, 4).0, half.get_pixel(3, 3).0), (MAGMA[0], UNKNOWN.0));
    }

    #[test]
    fn a_small_map_fills_its_picture() {
        let picture = draw_map(&[0.0, 2.0], (1, 2), (6, 3), [0.0, 2.0]);
        assert_eq!((picture.get_pixel(2, 2).0, picture.get_pixel(3, 0).0), (MAGMA[0], MAGMA[255]));
    }

    #[test]
    fn the_bar_runs_from_dark_to_bright() {
        let bar = colour_bar(100, 3);
        assert_eq!((bar.get_pixel(0, 2).0, bar.get_pixel(99, 0).0), (MAGMA[0], MAGMA[255]));
    }
}
