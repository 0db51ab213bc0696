//! Points of a picture that can be found again in another: where its gradients point in two directions.
//!
//! Shi and Tomasi, "Good Features to Track", CVPR 1994: the smaller eigenvalue of the structure tensor.

use super::grey::Grey;

/// Half the side of the window of the structure tensor, in pixels.
const WINDOW: usize = 3;
/// Half the side of the square in which a corner has to be the strongest, in pixels.
const APART: usize = 4;
/// The picture is cut into so many columns and rows of cells, so that corners come from all over it.
const CELLS: [usize; 2] = [16, 8];
/// Corners that a cell may have.
const IN_A_CELL: usize = 4;
/// The least eigenvalue of a corner, in squared levels a pixel.
const LEAST: f32 = 12.0;

/// The corners of a picture: pixels, at least `border` from its edges.
pub(super) fn corners(grey: &Grey, border: usize) -> Vec<[usize; 2]> {
    let border = border.max(WINDOW + 1);
    let (width, height) = (grey.width, grey.height);
    if width <= 2 * border || height <= 2 * border {
        return Vec::new();
    }
    let strength = strengths(grey);
    let mut cells: Vec<Vec<(f32, [usize; 2])>> = vec![Vec::new(); CELLS[0] * CELLS[1]];
    for y in border..height - border {
        for x in border..width - border {
            let own = strength[y * width + x];
            if own >= LEAST && is_strongest(&strength, width, [x, y], own) {
                let cell = (y * CELLS[1] / height) * CELLS[0] + x * CELLS[0] / width;
                cells[cell].push((own, [x, y]));
            }
        }
    }
    for cell in &mut cells {
        cell.sort_by(|a, b| b.0.total_cmp(&a.0));
        cell.truncate(IN_A_CELL);
    }
    cells.into_iter().flatten().map(|(_, at)| at).collect()
}

/// Whether no neighbour is stronger; of equal ones the first counts.
fn is_strongest(strength: &[f32], width: usize, [x, y]: [usize; 2], own: f32) -> bool {
    let height = strength.len() / width;
    let rows = y.saturating_sub(APART)..(y + APART + 1).min(height);
    let columns = x.saturating_sub(APART)..(x + APART + 1).min(width);
    rows.into_iter().all(|v| {
        columns.clone().all(|u| {
            let other = strength[v * width + u];
            other < own || (other == own && (v, u) >= (y, x))
        })
    })
}

/// The smaller eigenvalue of the mean structure tensor of each pixel's window; 0 near the border.
fn strengths(grey: &Grey) -> Vec<f32> {
    let (width, height) = (grey.width, grey.height);
    // Sums of xx, xy, yy over all pixels above and to the left.
    let stride = width + 1;
    let mut sums = vec![[0f64; 3]; stride * (height + 1)];
    for y in 0..height {
        let mut row = [0f64; 3];
        for x in 0..width {
            if x > 0 && y > 0 && x + 1 < width && y + 1 < height {
                let dx = 0.5 * f64::from(grey.at(x + 1, y) - grey.at(x - 1, y));
                let dy = 0.5 * f64::from(grey.at(x, y + 1) - grey.at(x, y - 1));
                row = [row[0] + dx * dx, row[1] + dx * dy, row[2] + dy * dy];
            }
            let above = sums[y * stride + x + 1];
            sums[(y + 1) * stride + x + 1] = std::array::from_fn(|k| above[k] + row[k]);
        }
    }
    let mut strength = vec![0f32; width * height];
    let n = ((2 * WINDOW + 1) * (2 * WINDOW + 1)) as f64;
    for y in WINDOW..height.saturating_sub(WINDOW) {
        for x in WINDOW..width.saturating_sub(WINDOW) {
            let (top, bottom) = ((y - WINDOW) * stride, (y + WINDOW + 1) * stride);
            let (left, right) = (x - WINDOW, x + WINDOW + 1);
            let [xx, xy, yy]: [f64; 3] = std::array::from_fn(|k| {
                let at = |place: usize| sums[place][k];
                (at(bottom + right) - at(bottom + left) - at(top + right) + at(top + left)) / n
            });
            let (half, apart) = ((xx + yy) / 2.0, (xx - yy) / 2.0);
            strength[y * width + x] = (half - (apart * apart + xy * xy).sqrt()) as f32;
        }
    }
    strength
}

#[cfg(test)]
mod tests {
    use image::RgbImage;

    use super::*;

    #[test]
    fn corners_of_a_square_are_found_and_its_edges_are_not() {
        let inside = |x: u32, y: u32| (24..56).contains(&x) && (16..40).contains(&y);
        let picture = RgbImage::from_fn(80, 56, |x, y| image::Rgb([if inside(x, y) { 200 } else { 40 }; 3]));
        let found = corners(&Grey::of(&picture), 6);
        assert_eq!(found.len(), 4, "{found:?}");
        for expected in [[24, 16], [55, 16], [24, 39], [55, 39]] {
            let near = |at: &[usize; 2]| at[0].abs_diff(expected[0]) <= 3 && at[1].abs_diff(expected[1]) <= 3;
            assert!(found.iter().any(near), "{expected:?} in {found:?}");
        }
    }

    #[test]
    fn a_plain_or_tiny_picture_has_none() {
        assert!(corners(&Grey::of(&RgbImage::new(80, 40)), 6).is_empty());
        assert!(corners(&Grey::of(&RgbImage::new(9, 3)), 6).is_empty());
    }
}
