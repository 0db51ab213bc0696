//! Grey pictures as floating-point numbers, and pyramids of them.

use image::RgbImage;

/// A grey picture, values from 0 to 255, row by row.
pub(super) struct Grey {
    pub(super) width: usize,
    pub(super) height: usize,
    values: Vec<f32>,
}

impl Grey {
    /// Luma (ITU-R BT.601) of a picture.
    pub(super) fn of(picture: &RgbImage) -> Grey {
        let luma = |p: &[u8]| 0.299 * f32::from(p[0]) + 0.587 * f32::from(p[1]) + 0.114 * f32::from(p[2]);
        let values = picture.as_raw().chunks_exact(3).map(luma).collect();
        Grey { width: picture.width() as usize, height: picture.height() as usize, values }
    }

    /// The value at a pixel, which must lie inside.
    pub(super) fn at(&self, x: usize, y: usize) -> f32 {
        self.values[y * self.width + x]
    }

    /// The value between pixels, bilinear; beyond the border that of the border.
    pub(super) fn between(&self, x: f32, y: f32) -> f32 {
        let (x, y) = (x.clamp(0.0, (self.width - 1) as f32), y.clamp(0.0, (self.height - 1) as f32));
        let (left, top) = (x as usize, y as usize);
        let (right, bottom) = ((left + 1).min(self.width - 1), (top + 1).min(self.height - 1));
        let (a, b) = (x - left as f32, y - top as f32);
        let row = |y: usize| self.at(left, y) * (1.0 - a) + self.at(right, y) * a;
        row(top) * (1.0 - b) + row(bottom) * b
    }

    /// The picture at half its size: a binomial filter of five taps, then every second pixel.
    fn halved(&self) -> Grey {
        const TAPS: [f32; 5] = [1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0];
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let clamp = |i: usize, tap: usize, n: usize| (2 * i + tap).saturating_sub(2).min(n - 1);
        let mut narrow = Vec::with_capacity(width * self.height);
        for y in 0..self.height {
            let value = |x: usize| (0..5).map(|tap| TAPS[tap] * self.at(clamp(x, tap, self.width), y)).sum::<f32>();
            narrow.extend((0..width).map(value));
        }
        let mut values = Vec::with_capacity(width * height);
        for y in 0..height {
            let row = |tap: usize| clamp(y, tap, self.height) * width;
            let value = |x: usize| (0..5).map(|tap| TAPS[tap] * narrow[row(tap) + x]).sum::<f32>();
            values.extend((0..width).map(value));
        }
        Grey { width, height, values }
    }

    /// The picture, its half, its quarter, ..., as long as both sides have `least` pixels.
    pub(super) fn pyramid(self, least: usize) -> Vec<Grey> {
        let mut levels = vec![self];
        while let Some(last) = levels.last()
            && last.width.min(last.height) >= 2 * least
        {
            levels.push(last.halved());
        }
        levels
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_between_pixels_are_means_and_halving_keeps_a_ramp() {
        let picture = RgbImage::from_fn(32, 16, |x, y| image::Rgb([(4 * x + 2 * y) as u8; 3]));
        let grey = Grey::of(&picture);
        assert!((grey.between(3.5, 2.25) - (4.0 * 3.5 + 2.0 * 2.25)).abs() < 1e-3);
        // Beyond the border: the border.
        assert_eq!(grey.between(-4.0, 0.0), grey.at(0, 0));
        let levels = grey.pyramid(4);
        assert_eq!(levels.iter().map(|l| (l.width, l.height)).collect::<Vec<_>>(), [(32, 16), (16, 8), (8, 4)]);
        // Pixel (5, 3) of the half lies where (10, 6) does, and the filter is symmetric.
        assert!((levels[1].at(5, 3) - (40.0 + 12.0)).abs() < 1e-3);
    }
}
