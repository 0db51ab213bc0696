//! Changes of a picture that another camera or another weather would have made: exposure, white balance, haze, vignetting,
//! blur, noise, compression. A network that has seen them carries over to pictures that were not rendered.
//!
//! One draw serves all frames of a sample; noise is new in each. As with [colour jitter](super::augment), the networks see
//! the changed pictures, and the loss the plain ones.

use image::codecs::jpeg::{JpegDecoder, JpegEncoder};
use image::{DynamicImage, ImageDecoder, RgbImage};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::augment::{coin, uniform};
use crate::random::Random;

/// Changes that a sensor makes to the pictures of a sample.
#[derive(Clone, Debug, PartialEq)]
pub struct Sensor {
    /// Response of each channel: `255 gain (x / 255)^gamma`, and what haze leaves of it.
    pub gains: [f32; 3],
    /// Exponent of the response.
    pub gamma: f32,
    /// The share of a haze, and its grey level in 0..255.
    pub haze: [f32; 2],
    /// The darkening in the corners, a share, which grows with the square of the distance from the centre.
    pub vignette: f32,
    /// The share of a 3x3 binomial blur.
    pub blur: f32,
    /// Standard deviation of noise, in levels of 255.
    pub noise: f32,
    /// Quality of a JPEG compression, of 100.
    pub jpeg: Option<u8>,
    /// Where the noise comes from.
    pub seed: u64,
}

impl Sensor {
    /// Draws each change with probability 1/2: gains in [0.6, 1.5) and, by channel, within 15 % of it; gamma in
    /// [0.7, 1.5); haze up to 0.4; vignetting up to 0.5; blur up to 1; noise up to 8 levels; JPEG quality in 30..90. A
    /// fixed number of words of the stream.
    pub fn draw(rng: &mut ChaCha8Rng) -> Sensor {
        let mut range = |least: f32, most: f32, none: f32| {
            let (drawn, amount) = (coin(rng), least + (most - least) * uniform(rng));
            if drawn { amount } else { none }
        };
        let exposure = range(0.6, 1.5, 1.0);
        let gains = [0; 3].map(|_| exposure * range(0.85, 1.15, 1.0));
        let gamma = range(0.7, 1.5, 1.0);
        let haze = [range(0.0, 0.4, 0.0), range(120.0, 255.0, 200.0)];
        let (vignette, blur, noise) = (range(0.0, 0.5, 0.0), range(0.0, 1.0, 0.0), range(0.0, 8.0, 0.0));
        let jpeg = range(30.0, 90.0, 100.0);
        let jpeg = (jpeg < 100.0).then_some(jpeg as u8);
        let seed = u64::from(rng.next_u32());
        Sensor { gains, gamma, haze, vignette, blur, noise, jpeg, seed }
    }

    /// The picture as this sensor saw it; `frame` tells the noise of frames apart.
    pub fn apply(&self, image: &RgbImage, frame: u64) -> RgbImage {
        let mut out = image.clone();
        if self.blur > 0.0 {
            blur(&mut out, self.blur);
        }
        self.respond(&mut out);
        if self.noise > 0.0 {
            let mut random = Random::new(self.seed, frame);
            for byte in out.iter_mut() {
                *byte = (f32::from(*byte) + self.noise * normal(random.chacha())).round() as u8;
            }
        }
        match self.jpeg {
            Some(quality) => compressed(&out, quality).unwrap_or(out),
            None => out,
        }
    }

    /// Response, haze and vignetting.
    fn respond(&self, image: &mut RgbImage) {
        let [haze, level] = self.haze;
        let curves = self.gains.map(|gain| {
            let seen = |x: usize| 255.0 * gain * libm::powf(x as f32 / 255.0, self.gamma);
            std::array::from_fn::<f32, 256, _>(|x| (1.0 - haze) * seen(x).min(255.0) + haze * level)
        });
        let (w, h) = (image.width() as f32, image.height() as f32);
        for (x, y, pixel) in image.enumerate_pixels_mut() {
            let [u, v] = [(x as f32 + 0.5) / w - 0.5, (y as f32 + 0.5) / h - 0.5];
            let light = 1.0 - self.vignette * 2.0 * (u * u + v * v);
            for (byte, curve) in pixel.0.iter_mut().zip(&curves) {
                *byte = (light * curve[usize::from(*byte)]).round() as u8;
            }
        }
    }
}

/// Nearly normal: the sum of the four bytes of a word, of deviation 1.
fn normal(rng: &mut ChaCha8Rng) -> f32 {
    // The deviation of the sum of four numbers uniform in 0..=255.
    const DEVIATION: f32 = 147.8;
    let sum: u32 = rng.next_u32().to_le_bytes().iter().map(|&b| u32::from(b)).sum();
    (sum as f32 - 510.0) / DEVIATION
}

/// Blends with a 1 2 1 blur in both directions, edges repeated.
fn blur(image: &mut RgbImage, share: f32) {
    let (w, h) = (image.width() as usize, image.height() as usize);
    let plain = image.as_raw().clone();
    let at = |x: usize, y: usize, c: usize| f32::from(plain[(y * w + x) * 3 + c]);
    for y in 0..h {
        let rows = [y.saturating_sub(1), y, (y + 1).min(h - 1)];
        for x in 0..w {
            let columns = [x.saturating_sub(1), x, (x + 1).min(w - 1)];
            for c in 0..3 {
                let line = |y: usize| 0.25 * at(columns[0], y, c) + 0.5 * at(x, y, c) + 0.25 * at(columns[2], y, c);
                let blurred = 0.25 * line(rows[0]) + 0.5 * line(y) + 0.25 * line(rows[2]);
                let pixel = image.get_pixel_mut(x as u32, y as u32);
                pixel.0[c] = ((1.0 - share) * at(x, y, c) + share * blurred).round() as u8;
            }
        }
    }
}

/// The picture after a JPEG compression; nothing if it cannot be compressed.
fn compressed(image: &RgbImage, quality: u8) -> Option<RgbImage> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, quality).encode_image(image).ok()?;
    let decoder = JpegDecoder::new(std::io::Cursor::new(&bytes)).ok()?;
    debug_assert_eq!(decoder.dimensions(), image.dimensions());
    Some(DynamicImage::from_decoder(decoder).ok()?.into_rgb8())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp() -> RgbImage {
        RgbImage::from_fn(32, 16, |x, y| image::Rgb([x as u8 * 8, y as u8 * 16, 128]))
    }

    const PLAIN: Sensor = Sensor {
        gains: [1.0; 3],
        gamma: 1.0,
        haze: [0.0, 200.0],
        vignette: 0.0,
        blur: 0.0,
        noise: 0.0,
        jpeg: None,
        seed: 7,
    };

    #[test]
    fn a_sensor_that_changes_nothing_gives_the_picture_back() {
        assert_eq!(PLAIN.apply(&ramp(), 0), ramp());
    }

    #[test]
    fn every_change_does_what_it_says() {
        let of = |sensor: Sensor| sensor.apply(&ramp(), 0);
        assert_eq!(of(Sensor { gains: [0.5, 1.0, 2.0], ..PLAIN }).get_pixel(10, 5).0, [40, 80, 255]);
        assert_eq!(of(Sensor { gamma: 2.0, ..PLAIN }).get_pixel(10, 5).0, [25, 25, 64]);
        assert_eq!(of(Sensor { haze: [0.5, 100.0], ..PLAIN }).get_pixel(10, 5).0, [90, 90, 114]);
        let dark = of(Sensor { vignette: 0.5, ..PLAIN });
        assert!(dark.get_pixel(0, 0).0[2] < 75 && dark.get_pixel(16, 8).0[2] > 126, "{:?}", dark.get_pixel(0, 0));
        // A blur keeps a ramp, but for its edges.
        let blurred = of(Sensor { blur: 1.0, ..PLAIN });
        assert_eq!((blurred.get_pixel(10, 5).0, blurred.get_pixel(0, 0).0), ([80, 80, 128], [2, 4, 128]));
        let compressed = of(Sensor { jpeg: Some(30), ..PLAIN });
        let error = |a: &RgbImage, b: &RgbImage| {
            let squares = a.as_raw().iter().zip(b.as_raw()).map(|(&a, &b)| f64::from(a.abs_diff(b)).powi(2));
            (squares.sum::<f64>() / a.as_raw().len() as f64).sqrt()
        };
        assert!((0.5..12.0).contains(&error(&compressed, &ramp())));
        let grey = RgbImage::from_pixel(64, 64, image::Rgb([128; 3]));
        let noisy = Sensor { noise: 5.0, ..PLAIN };
        let (first, second) = (noisy.apply(&grey, 0), noisy.apply(&grey, 1));
        assert!((error(&first, &grey) - 5.0).abs() < 0.2, "{}", error(&first, &grey));
        assert!(error(&first, &second) > 6.0 && noisy.apply(&grey, 0) == first);
    }

    #[test]
    fn draws_take_the_same_number_of_words_and_stay_in_their_ranges() {
        let mut random = Random::new(3, 0);
        let before = random.chacha().get_word_pos();
        let mut sensors = Vec::new();
        for i in 1..=400u128 {
            sensors.push(Sensor::draw(random.chacha()));
            assert_eq!(random.chacha().get_word_pos() - before, 23 * i);
        }
        let share = |of: &dyn Fn(&Sensor) -> bool| sensors.iter().filter(|s| of(s)).count();
        for drawn in [
            share(&|s| s.gamma != 1.0),
            share(&|s| s.haze[0] > 0.0),
            share(&|s| s.vignette > 0.0),
            share(&|s| s.blur > 0.0),
            share(&|s| s.noise > 0.0),
            share(&|s| s.jpeg.is_some()),
        ] {
            assert!((160..240).contains(&drawn), "{drawn} of 400");
        }
        assert!(sensors.iter().all(|s| s.gains.iter().all(|gain| (0.5..1.73).contains(gain))));
    }
}
