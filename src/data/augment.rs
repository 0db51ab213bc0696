//! What training does to a sample so that the network sees more than there is: a mirror and a change of colours.
//!
//! One draw serves all frames and scales of a sample. The networks see the jittered pictures, the loss the plain ones.
//! The colour formulas are those of Pillow, on 8 bits with its truncations, in any order.

use image::RgbImage;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::camera::Intrinsics;

/// A number in [0, 1): the upper 24 bits of the next 32-bit word, over 2^24. One word of the stream.
pub fn uniform(rng: &mut ChaCha8Rng) -> f32 {
    (rng.next_u32() >> 8) as f32 / (1u32 << 24) as f32
}

/// True with probability 1/2: [`uniform`] below a half. One word of the stream.
pub fn coin(rng: &mut ChaCha8Rng) -> bool {
    uniform(rng) < 0.5
}

/// A whole number in `0..n`: [`uniform`] times `n`, rounded down. One word of the stream; `n` is small.
fn below(rng: &mut ChaCha8Rng, n: usize) -> usize {
    ((uniform(rng) * n as f32) as usize).min(n - 1)
}

/// The picture mirrored left to right.
pub fn flip(image: &RgbImage) -> RgbImage {
    image::imageops::flip_horizontal(image)
}

/// The camera of a mirrored picture of `width` pixels. Pixel centres are whole numbers, so pixel u becomes W - 1 - u, and
/// the principal point with it: `cx' = 1 - 1/W - cx` over the width. That of 0.5 becomes 0.496875 at 320 pixels.
///
/// Constants that are a convention and no measurement stay as they are: [`DataSource::mirrored_intrinsics`] decides.
///
/// [`DataSource::mirrored_intrinsics`]: super::DataSource::mirrored_intrinsics
pub fn flip_intrinsics(camera: Intrinsics, width: usize) -> Intrinsics {
    let width = width as f64;
    Intrinsics { cx: (width - 1.0) / width - camera.cx, ..camera }
}

/// One step of a colour jitter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Change {
    /// Every channel times this factor.
    Brightness(f32),
    /// A blend with the mean of the grey picture: `f x + (1 - f) mean`.
    Contrast(f32),
    /// A blend with the grey picture: `f x + (1 - f) grey`, grey = .299 R + .587 G + .114 B.
    Saturation(f32),
    /// A turn of the hue, 1 being the whole circle.
    Hue(f32),
}

/// A change of colours: its steps in the order in which they are applied.
#[derive(Clone, Debug, PartialEq)]
pub struct Jitter {
    /// The steps.
    pub changes: [Change; 4],
}

impl Jitter {
    /// With probability 1/2 a jitter: factors of brightness, contrast and saturation uniform in [0.8, 1.2), hue in
    /// [-0.1, 0.1), in an order drawn uniformly. Eight words of the stream either way (the coin, four amounts, three
    /// for the order), so that what is drawn afterwards does not depend on the coin.
    pub fn draw(rng: &mut ChaCha8Rng) -> Option<Jitter> {
        let jittered = coin(rng);
        let mut amount = |range: f32| (2.0 * uniform(rng) - 1.0) * range;
        let mut changes = [
            Change::Brightness(1.0 + amount(0.2)),
            Change::Contrast(1.0 + amount(0.2)),
            Change::Saturation(1.0 + amount(0.2)),
            Change::Hue(amount(0.1)),
        ];
        // Fisher and Yates.
        for last in (1..changes.len()).rev() {
            changes.swap(last, below(rng, last + 1));
        }
        jittered.then_some(Jitter { changes })
    }

    /// The picture with its colours changed.
    pub fn apply(&self, image: &RgbImage) -> RgbImage {
        let mut out = image.clone();
        for &change in &self.changes {
            apply_change(change, &mut out);
        }
        out
    }
}

/// Applies one change in place.
pub fn apply_change(change: Change, image: &mut RgbImage) {
    match change {
        Change::Brightness(factor) => blend_with(image, factor, 0),
        Change::Contrast(factor) => {
            let sum: u64 = pixels(image).map(|p| u64::from(grey(*p))).sum();
            let count = (image.as_raw().len() / 3).max(1);
            let mean = (sum as f64 / count as f64 + 0.5) as u8;
            blend_with(image, factor, mean);
        }
        Change::Saturation(factor) => {
            for p in pixels_mut(image) {
                let grey = grey(*p);
                *p = p.map(|c| blend(grey, c, factor));
            }
        }
        Change::Hue(turn) => {
            // Truncated towards zero, then taken modulo 256: a negative turn goes the other way round.
            let shift = (turn * 255.0) as i32 as u8;
            for p in pixels_mut(image) {
                let [h, s, v] = rgb_to_hsv(*p);
                *p = hsv_to_rgb([h.wrapping_add(shift), s, v]);
            }
        }
    }
}

fn pixels(image: &RgbImage) -> impl Iterator<Item = &[u8; 3]> {
    image.as_raw().as_chunks::<3>().0.iter()
}

fn pixels_mut(image: &mut RgbImage) -> impl Iterator<Item = &mut [u8; 3]> {
    image.as_chunks_mut::<3>().0.iter_mut()
}

/// The grey value, rounded: .299 R + .587 G + .114 B in 16-bit fixed point.
fn grey([r, g, b]: [u8; 3]) -> u8 {
    ((u32::from(r) * 19595 + u32::from(g) * 38470 + u32::from(b) * 7471 + 0x8000) >> 16) as u8
}

/// `factor * x + (1 - factor) * other`, cut to [0, 255] and truncated.
fn blend(other: u8, x: u8, factor: f32) -> u8 {
    let other = f32::from(other);
    // A float cast to an integer saturates: that is the cut.
    (other + factor * (f32::from(x) - other)) as u8
}

/// Blends every channel with one value: 256 cases, so a table.
fn blend_with(image: &mut RgbImage, factor: f32, other: u8) {
    let table: [u8; 256] = std::array::from_fn(|x| blend(other, x as u8, factor));
    for byte in image.iter_mut() {
        *byte = table[usize::from(*byte)];
    }
}

/// Hue, saturation and value, each in 8 bits, truncated; a grey has hue and saturation 0. Quotients are rounded to
/// f32 and sums are not, as in Pillow: the truncation turns a last bit into a whole level.
fn rgb_to_hsv([r, g, b]: [u8; 3]) -> [u8; 3] {
    let (high, low) = (r.max(g).max(b), r.min(g).min(b));
    if high == low {
        return [0, 0, high];
    }
    let range = f32::from(high - low);
    let from_top = |c: u8| f64::from(f32::from(high - c) / range);
    let sector = if r == high {
        from_top(b) - from_top(g)
    } else if g == high {
        2.0 + from_top(r) - from_top(b)
    } else {
        4.0 + from_top(g) - from_top(r)
    };
    // In [-1, 5]: a sixth of it, modulo 1.
    let turned = f64::from(sector as f32) / 6.0 + 1.0;
    let hue = (if turned >= 1.0 { turned - 1.0 } else { turned }) as f32;
    let saturation = range / f32::from(high);
    [(f64::from(hue) * 255.0) as u8, (f64::from(saturation) * 255.0) as u8, high]
}

/// The inverse, rounded.
fn hsv_to_rgb([h, s, v]: [u8; 3]) -> [u8; 3] {
    if s == 0 {
        return [v, v, v];
    }
    let sectors = f64::from(h) * 6.0 / 255.0;
    let sector = sectors as u8;
    let within = (sectors - f64::from(sector)) as f32;
    let (saturation, value) = (f32::from(s) / 255.0, f64::from(v));
    let rounded = |x: f64| (x + 0.5) as u8;
    let p = rounded(value * (1.0 - f64::from(saturation)));
    let q = rounded(value * (1.0 - f64::from(saturation * within)));
    let t = rounded(value * (1.0 - f64::from(saturation) * (1.0 - f64::from(within))));
    match sector % 6 {
        0 => [v, t, p],
        1 => [q, v, p],
        2 => [p, v, t],
        3 => [p, q, v],
        4 => [t, p, v],
        _ => [v, p, q],
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use safetensors::SafeTensors;

    use super::*;
    use crate::test_support::{difference, fixture_bytes, rgb};

    #[test]
    fn every_change_equals_pillow() {
        let bytes = fixture_bytes("images.safetensors");
        let file = SafeTensors::deserialize(&bytes).unwrap();
        for (name, change) in [
            ("brightness/1.15", Change::Brightness(1.15)),
            ("contrast/0.85", Change::Contrast(0.85)),
            ("saturation/1.2", Change::Saturation(1.2)),
            ("hue/0.05", Change::Hue(0.05)),
        ] {
            let mut image = rgb(&file, "source");
            apply_change(change, &mut image);
            assert_eq!(difference(&image, &rgb(&file, name)), (0.0, 0), "{name}");
        }
    }

    #[test]
    fn a_draw_is_deterministic_and_takes_eight_words() {
        for seed in 0..20 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let jitter = Jitter::draw(&mut rng);
            assert_eq!(rng.get_word_pos(), 8);
            assert_eq!(jitter, Jitter::draw(&mut ChaCha8Rng::seed_from_u64(seed)));
        }
    }

    #[test]
    fn draws_stay_in_their_ranges_and_orders_are_even() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let (mut drawn, mut hue_first, mut sums) = (0, 0, [0.0; 4]);
        for _ in 0..4000 {
            let Some(jitter) = Jitter::draw(&mut rng) else {
                continue;
            };
            drawn += 1;
            hue_first += usize::from(matches!(jitter.changes[0], Change::Hue(_)));
            for change in jitter.changes {
                let (kind, amount, range) = match change {
                    Change::Brightness(f) => (0, f - 1.0, 0.2),
                    Change::Contrast(f) => (1, f - 1.0, 0.2),
                    Change::Saturation(f) => (2, f - 1.0, 0.2),
                    Change::Hue(f) => (3, f, 0.1),
                };
                assert!(amount.abs() <= range + 1e-6, "{change:?}");
                sums[kind] += f64::from(amount / range);
            }
        }
        assert!((1850..2150).contains(&drawn), "{drawn}");
        assert!((420..580).contains(&hue_first), "{hue_first}");
        assert!(sums.iter().all(|s| s.abs() / f64::from(drawn) < 0.06), "{sums:?}");
    }

    #[test]
    fn order_matters_and_the_neutral_jitter_changes_little() {
        let bytes = fixture_bytes("images.safetensors");
        let source = rgb(&SafeTensors::deserialize(&bytes).unwrap(), "source");
        let (bright, grey) = (Change::Brightness(1.2), Change::Contrast(0.8));
        let (hue, colour) = (Change::Hue(0.1), Change::Saturation(1.2));
        let one = Jitter { changes: [bright, grey, colour, hue] }.apply(&source);
        let other = Jitter { changes: [hue, colour, grey, bright] }.apply(&source);
        assert!(difference(&one, &other).0 > 0.5);
        let neutral = [Change::Brightness(1.0), Change::Contrast(1.0), Change::Saturation(1.0), Change::Hue(0.0)];
        // Only the round trip through 8-bit HSV remains.
        assert!(difference(&Jitter { changes: neutral }.apply(&source), &source).0 < 1.5);
    }

    #[test]
    fn hue_turns_both_ways() {
        let red = RgbImage::from_pixel(2, 2, image::Rgb([200, 40, 40]));
        let turned = |turn| {
            let mut image = red.clone();
            apply_change(Change::Hue(turn), &mut image);
            image.get_pixel(0, 0).0
        };
        let [r, g, b] = turned(0.1);
        assert!(r > g && g > b, "towards yellow: {r} {g} {b}");
        let [r, g, b] = turned(-0.1);
        assert!(r > b && b > g, "towards magenta: {r} {g} {b}");
    }

    #[test]
    fn flipping_moves_pixels_and_the_centre() {
        let ramp = RgbImage::from_fn(4, 1, |x, _| image::Rgb([x as u8, 0, 0]));
        let reds: Vec<u8> = flip(&ramp).pixels().map(|p| p[0]).collect();
        assert_eq!(reds, [3, 2, 1, 0]);
        // What a camera is called is no matter: the same numbers may be measured, as those of the street are.
        let street = flip_intrinsics(Intrinsics::KITTI, 320);
        assert!((street.cx - 0.496875).abs() < 1e-12);
        assert_eq!(Intrinsics { cx: 0.5, ..street }, Intrinsics::KITTI);
        let camera = Intrinsics { fx: 0.5, fy: 1.0, cx: 0.49, cy: 0.4 };
        let flipped = flip_intrinsics(camera, 100);
        assert!((flipped.cx * 100.0 - (99.0 - 49.0)).abs() < 1e-9);
        assert!((flip_intrinsics(flipped, 100).cx - camera.cx).abs() < 1e-12);
    }

    #[test]
    fn a_frame_takes_little_time() {
        let image = RgbImage::from_fn(320, 96, |x, y| {
            image::Rgb([(x * 7 + y * 3) as u8, (x * 5) as u8 ^ y as u8, (y * 11 + x) as u8])
        });
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let jitter = std::iter::from_fn(|| Some(Jitter::draw(&mut rng))).flatten().next().unwrap();
        let best = (0..10)
            .map(|_| {
                let start = std::time::Instant::now();
                std::hint::black_box(jitter.apply(&image));
                start.elapsed()
            })
            .min()
            .unwrap();
        println!("a jitter of 320x96 takes {best:?}");
        // The aim is 2 ms; the bound leaves room for a busy machine.
        assert!(best.as_secs_f64() < 0.02, "{best:?}");
    }
}
