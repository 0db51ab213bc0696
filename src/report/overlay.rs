//! Maps laid over a picture: the picture in dark grey, the map glowing on it.

use image::imageops::{FilterType, resize};
use image::{ImageBuffer, Luma, Rgb, RgbImage};

/// The warm colours of what is positive, and the cold ones of what is negative: faint, and at full strength.
const POSITIVE: [[f32; 3]; 2] = [[200.0, 30.0, 20.0], [255.0, 225.0, 120.0]];
const NEGATIVE: [[f32; 3]; 2] = [[20.0, 60.0, 220.0], [150.0, 240.0, 255.0]];

/// A picture to lay maps over.
#[derive(Clone, Debug)]
pub struct Overlay {
    /// Brightness in [0, 255], row-major.
    grey: Vec<f32>,
    width: u32,
    height: u32,
}

impl Overlay {
    /// Over this picture.
    pub fn new(picture: &RgbImage) -> Self {
        let grey = picture.pixels().map(|p| {
            let [r, g, b] = p.0.map(f32::from);
            // The middle of the range: bright skies must not outshine a map, nor dark roads hide one.
            30.0 + 0.5 * (0.299 * r + 0.587 * g + 0.114 * b)
        });
        Overlay { grey: grey.collect(), width: picture.width(), height: picture.height() }
    }

    /// Lays a signed map (row-major, `(height, width)`) over the picture, resized smoothly to its size: warm where it is
    /// positive, cold where it is negative, the more the further from 0. The largest absolute value has full strength;
    /// values that are not finite have none.
    ///
    /// # Panics
    /// If `map` does not hold `height * width` values, or none.
    pub fn signed(&self, map: &[f32], (height, width): (usize, usize)) -> RgbImage {
        assert!(map.len() == height * width && !map.is_empty(), "Overlay: a map of {width}x{height} expected");
        let largest = map.iter().filter(|x| x.is_finite()).fold(0.0, |m: f32, x| m.max(x.abs()));
        let scale = if largest > 0.0 { 1.0 / largest } else { 0.0 };
        // Resizing keeps to [0, 1], so 0 goes to the middle.
        let middle = |x: f32| if x.is_finite() { 0.5 + 0.5 * x * scale } else { 0.5 };
        let map = map.iter().map(|&x| middle(x)).collect();
        let map = ImageBuffer::<Luma<f32>, Vec<f32>>::from_raw(width as u32, height as u32, map).expect("its size");
        let map = resize(&map, self.width, self.height, FilterType::CatmullRom);
        RgbImage::from_fn(self.width, self.height, |x, y| {
            glow(self.grey[(y * self.width + x) as usize], 2.0 * map.get_pixel(x, y).0[0] - 1.0)
        })
    }
}

/// A grey pixel under a strength in [-1, 1].
pub fn glow(grey: f32, strength: f32) -> Rgb<u8> {
    let [faint, full] = if strength < 0.0 { NEGATIVE } else { POSITIVE };
    let t = strength.abs().min(1.0);
    let mut rgb = [0; 3];
    for (i, byte) in rgb.iter_mut().enumerate() {
        let colour = faint[i] + t * (full[i] - faint[i]);
        *byte = (grey + t * (colour - grey)).round().clamp(0.0, 255.0) as u8;
    }
    Rgb(rgb)
}

/// Marks a point, which may lie outside: a white ring with dark edges, to be seen on bright and on dark alike.
pub fn mark(picture: &mut RgbImage, x: f32, y: f32) {
    let radius = (0.02 * picture.width().min(picture.height()) as f32).max(4.0);
    let thick = 0.4 * radius;
    // How much of a pixel lies within `half` of the ring.
    let cover = |distance: f32, half: f32| (half + 0.5 - (distance - radius).abs()).clamp(0.0, 1.0);
    let reach = radius + 2.0 * thick;
    let span = |centre: f32, side: u32| ((centre - reach).max(0.0) as u32)..((centre + reach + 1.0) as u32).min(side);
    for row in span(y, picture.height()) {
        for column in span(x, picture.width()) {
            let distance = (column as f32 - x).hypot(row as f32 - y);
            let (dark, white) = (cover(distance, thick), cover(distance, 0.5 * thick));
            let pixel = picture.get_pixel_mut(column, row);
            pixel.0 = pixel.0.map(|byte| {
                let edged = f32::from(byte) * (1.0 - dark);
                (edged + white * (255.0 - edged)).round() as u8
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warm_is_positive_cold_is_negative_and_nothing_stays_grey() {
        let picture = RgbImage::from_pixel(30, 20, Rgb([100, 100, 100]));
        let overlay = Overlay::new(&picture);
        let made = overlay.signed(&[2.0, 0.0, -2.0], (1, 3));
        assert_eq!(made.dimensions(), (30, 20));
        let [[r0, _, b0], middle, [r2, _, b2]] = [2, 15, 27].map(|x| made.get_pixel(x, 10).0);
        assert!(r0 > b0 && b2 > r2, "{r0} {b0} {r2} {b2}");
        let spread = middle.iter().max().unwrap().abs_diff(*middle.iter().min().unwrap());
        assert!(spread < 30, "{middle:?}");
        // The strength is relative.
        assert_eq!(made, overlay.signed(&[0.5, 0.0, -0.5], (1, 3)));
    }

    #[test]
    fn constant_zero_and_poisoned_maps_have_a_picture_too() {
        let overlay = Overlay::new(&RgbImage::from_pixel(5, 4, Rgb([10, 200, 30])));
        let plain = overlay.signed(&[0.0; 6], (2, 3));
        assert!(plain.pixels().all(|p| p.0[0] == p.0[1] && p.0[1] == p.0[2]));
        assert_eq!(overlay.signed(&[f32::NAN; 6], (2, 3)), plain);
        assert_eq!(overlay.signed(&[3.0; 1], (1, 1)).get_pixel(2, 2).0, [255, 225, 120]);
    }

    #[test]
    fn a_mark_shows_on_white_and_on_black_and_may_lie_at_the_border() {
        for shade in [0, 255] {
            let plain = RgbImage::from_pixel(64, 48, Rgb([shade; 3]));
            for (x, y) in [(30.0, 20.0), (0.0, 0.0), (63.0, 47.0), (-40.0, 500.0)] {
                let mut marked = plain.clone();
                mark(&mut marked, x, y);
                let seen = marked.pixels().any(|p| p.0[0].abs_diff(shade) > 200);
                assert_eq!(seen, x >= 0.0, "{shade} at {x}, {y}");
            }
        }
    }
}
