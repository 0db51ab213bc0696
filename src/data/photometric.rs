//! How cameras differ from one another and from day to day: changes of what the networks see, never of what the loss
//! compares.
//!
//! One draw serves all frames of a sample, as with colour jitter; only the noise is another in each frame. Everything follows
//! from the stream of random numbers, so a batch is a function of the seed and the step.

use image::RgbImage;
use image::codecs::jpeg::{JpegDecoder, JpegEncoder};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::augment::uniform;
use crate::error::{Error, Result};

/// How often a sample meets each change: probabilities from 0 (never) to 1.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Photometric {
    /// Exposure: all channels times 0.6 to 1.6.
    pub exposure: f64,
    /// Contrast curve: values in [0, 1] to the power of 0.6 to 1.7.
    pub gamma: f64,
    /// White balance: each channel times 0.85 to 1.15.
    pub white_balance: f64,
    /// Sensor noise: normal, of 1 to 10 levels, another in each frame.
    pub noise: f64,
    /// Defocus: a 3x3 binomial filter, once or twice.
    pub blur: f64,
    /// JPEG of quality 25 to 90.
    pub jpeg: f64,
    /// Vignetting: corners darker by up to half.
    pub vignetting: f64,
    /// Fog of a picture: values drawn towards a grey by up to 0.35, more so in the upper half.
    pub fog: f64,
}

impl Photometric {
    /// Whether nothing is ever changed.
    pub fn is_none(&self) -> bool {
        *self == Photometric::default()
    }

    /// Checks every probability.
    ///
    /// # Errors
    /// Names the field that is not from 0 to 1.
    pub fn check(&self) -> Result<()> {
        let Photometric { exposure, gamma, white_balance, noise, blur, jpeg, vignetting, fog } = *self;
        for (field, p) in [
            ("exposure", exposure),
            ("gamma", gamma),
            ("white_balance", white_balance),
            ("noise", noise),
            ("blur", blur),
            ("jpeg", jpeg),
            ("vignetting", vignetting),
            ("fog", fog),
        ] {
            if !(0.0..=1.0).contains(&p) {
                let message = format!("{p} is not a probability from 0 to 1");
                return Err(Error::setting(format!("augment.photometric.{field}"), message));
            }
        }
        Ok(())
    }

    /// The changes of one sample. Thirty-two words of the stream, whatever they are.
    pub fn draw(&self, rng: &mut ChaCha8Rng) -> Changes {
        let words: [f32; 32] = std::array::from_fn(|_| uniform(rng));
        let on = |i: usize, p: f64| f64::from(words[i]) < p;
        let between = |i: usize, low: f32, high: f32| low + (high - low) * words[i];
        let mut gain = [1f32; 3];
        if on(0, self.exposure) {
            gain = [factor(words[8], 0.6, 1.6); 3];
        }
        if on(1, self.white_balance) {
            gain = std::array::from_fn(|c| gain[c] * between(9 + c, 0.85, 1.15));
        }
        Changes {
            gain,
            gamma: if on(2, self.gamma) { factor(words[12], 0.6, 1.7) } else { 1.0 },
            fog: if on(3, self.fog) { [between(13, 0.0, 0.35), between(14, 0.6, 0.95)] } else { [0.0; 2] },
            vignetting: if on(4, self.vignetting) { between(15, 0.0, 0.5) } else { 0.0 },
            blur: if on(5, self.blur) { 1 + usize::from(words[16] < 0.4) } else { 0 },
            noise: if on(6, self.noise) { between(17, 1.0, 10.0) } else { 0.0 },
            jpeg: on(7, self.jpeg).then(|| between(18, 25.0, 90.0) as u8),
            seed: u64::from((words[19] * 16_777_216.0) as u32),
        }
    }
}

/// The changes that the frames of one sample meet.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Changes {
    gain: [f32; 3],
    gamma: f32,
    /// How much of the fog's grey, and that grey.
    fog: [f32; 2],
    vignetting: f32,
    blur: usize,
    noise: f32,
    jpeg: Option<u8>,
    seed: u64,
}

impl Changes {
    /// A picture, the `frame`-th of its sample, as such a camera would have taken it.
    ///
    /// # Errors
    /// If the JPEG of it cannot be made or read.
    pub fn apply(&self, image: &RgbImage, frame: u64) -> Result<RgbImage> {
        let (w, h) = image.dimensions();
        let tables: [[f32; 256]; 3] = self.gain.map(|gain| {
            std::array::from_fn(|i| 255.0 * libm::powf((gain * i as f32 / 255.0).clamp(0.0, 1.0), self.gamma))
        });
        let mut out = image.clone();
        for _ in 0..self.blur {
            out = image::imageops::filter3x3(&out, &[1., 2., 1., 2., 4., 2., 1., 2., 1.].map(|k: f32| k / 16.0));
        }
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed.wrapping_mul(8).wrapping_add(frame));
        for (x, y, pixel) in out.enumerate_pixels_mut() {
            let (u, v) = (2.0 * x as f32 / w as f32 - 1.0, 2.0 * y as f32 / h as f32 - 1.0);
            let dark = 1.0 - self.vignetting * 0.5 * (u * u + v * v);
            let fog = self.fog[0] * if v < 0.1 { 1.0 } else { 1.0 - 0.7 * (v - 0.1) };
            // Sums of uniform bytes are nearly normal; one word serves a channel: deviation 147.8.
            for (c, value) in pixel.0.iter_mut().enumerate() {
                let mut level = tables[c][usize::from(*value)];
                level += fog * (255.0 * self.fog[1] - level);
                level *= dark;
                if self.noise > 0.0 {
                    let sum: i32 = rng.next_u32().to_le_bytes().iter().map(|&b| i32::from(b)).sum();
                    level += self.noise * (sum - 510) as f32 / 147.8;
                }
                *value = (level + 0.5) as u8;
            }
        }
        match self.jpeg {
            Some(quality) => through_jpeg(&out, quality),
            None => Ok(out),
        }
    }
}

/// A factor between two, with `at` in [0, 1): half-way is their geometric mean.
fn factor(at: f32, low: f32, high: f32) -> f32 {
    low * libm::powf(high / low, at)
}

/// The picture that is left after it was stored as JPEG.
fn through_jpeg(image: &RgbImage, quality: u8) -> Result<RgbImage> {
    let failed = |e: image::ImageError| Error::Failed(format!("augment.photometric.jpeg: {e}"));
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, quality).encode_image(image).map_err(failed)?;
    let decoder = JpegDecoder::new(std::io::Cursor::new(bytes)).map_err(failed)?;
    Ok(image::DynamicImage::from_decoder(decoder).map_err(failed)?.into_rgb8())
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: Photometric = Photometric {
        exposure: 1.0,
        gamma: 1.0,
        white_balance: 1.0,
        noise: 1.0,
        blur: 1.0,
        jpeg: 1.0,
        vignetting: 1.0,
        fog: 1.0,
    };

    fn picture() -> RgbImage {
        RgbImage::from_fn(64, 32, |x, y| image::Rgb([(x * 4) as u8, (y * 8) as u8, 128]))
    }

    #[test]
    fn a_draw_takes_as_many_words_whatever_is_switched_on_and_none_changes_nothing() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let none = Photometric::default().draw(&mut rng);
        assert_eq!(rng.get_word_pos(), 32);
        assert_eq!(none.apply(&picture(), 0).unwrap(), picture());
        ALL.draw(&mut rng);
        assert_eq!(rng.get_word_pos(), 64);
    }

    #[test]
    fn the_same_draw_gives_the_same_picture_and_each_switch_changes_it() {
        let draw = |of: Photometric| of.draw(&mut ChaCha8Rng::seed_from_u64(5));
        assert_eq!(draw(ALL).apply(&picture(), 1).unwrap(), draw(ALL).apply(&picture(), 1).unwrap());
        let none = Photometric::default();
        let each = [
            Photometric { exposure: 1.0, ..none },
            Photometric { gamma: 1.0, ..none },
            Photometric { white_balance: 1.0, ..none },
            Photometric { noise: 1.0, ..none },
            Photometric { blur: 1.0, ..none },
            Photometric { jpeg: 1.0, ..none },
            Photometric { vignetting: 1.0, ..none },
            Photometric { fog: 1.0, ..none },
        ];
        for of in each {
            assert_ne!(draw(of).apply(&picture(), 0).unwrap(), picture(), "{of:?}");
        }
        let noise = draw(Photometric { noise: 1.0, ..none });
        assert_ne!(noise.apply(&picture(), 0).unwrap(), noise.apply(&picture(), 1).unwrap());
    }

    #[test]
    fn what_is_no_probability_is_named() {
        let error = Photometric { blur: 1.5, ..Photometric::default() }.check().unwrap_err().to_string();
        assert!(error.contains("photometric.blur"), "{error}");
    }
}
