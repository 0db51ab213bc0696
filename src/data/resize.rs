//! Lanczos resizing of 8-bit pictures, antialiased: the one that the published loaders use (Pillow's), to the bit.

use image::RgbImage;

/// The half-width of the Lanczos window at scale 1.
const LOBES: f64 = 3.0;

/// Weights are whole multiples of `2^-FRACTION_BITS`: sums of 8-bit values times weights fit an `i32`.
const FRACTION_BITS: u32 = 22;

/// Resizes to `width x height`: every output pixel is a weighted mean of the input under a Lanczos window of three
/// lobes, which is widened by the scale when the picture shrinks (so nothing aliases). Columns first, then rows,
/// rounded to 8 bits in between. A picture that already has the size comes back as it is.
///
/// # Panics
/// If a side of the picture or of the result is 0.
pub fn lanczos(image: &RgbImage, width: u32, height: u32) -> RgbImage {
    assert!(width > 0 && height > 0, "lanczos: a size above 0 expected, found {width}x{height}");
    assert!(image.width() > 0 && image.height() > 0, "lanczos: the picture is empty");
    if image.dimensions() == (width, height) {
        return image.clone();
    }
    let (in_width, in_height) = (image.width() as usize, image.height() as usize);
    let narrowed = resize_columns(image.as_raw(), in_width, in_height, width as usize);
    let bytes = resize_rows(&narrowed, width as usize, in_height, height as usize);
    RgbImage::from_raw(width, height, bytes).expect("three bytes a pixel were made")
}

/// The window of one output position: the first input it reads and the weights from there on, which sum to 1.
struct Window {
    first: usize,
    weights: Vec<i32>,
}

/// The windows of all `output` positions over `input` ones. Pixel centres are at halves; weights outside the picture
/// are dropped and the rest normalised.
fn windows(input: usize, output: usize) -> Vec<Window> {
    let scale = input as f64 / output as f64;
    let stretch = scale.max(1.0);
    let support = LOBES * stretch;
    let window = |i: usize| {
        let centre = (i as f64 + 0.5) * scale;
        let first = (centre - support + 0.5).max(0.0) as usize;
        let end = ((centre + support + 0.5) as usize).min(input);
        let weights: Vec<f64> = (first..end).map(|j| kernel((j as f64 - centre + 0.5) / stretch)).collect();
        let sum: f64 = weights.iter().sum();
        let fixed = |w: &f64| (w / sum * f64::from(1 << FRACTION_BITS)).round() as i32;
        Window { first, weights: weights.iter().map(fixed).collect() }
    };
    (0..output).map(window).collect()
}

/// sinc(x) sinc(x/3) within three lobes, with sinc(x) = sin(pi x) / (pi x).
fn kernel(x: f64) -> f64 {
    let sinc = |x: f64| {
        let x = x * std::f64::consts::PI;
        if x == 0.0 { 1.0 } else { x.sin() / x }
    };
    if x.abs() < LOBES { sinc(x) * sinc(x / LOBES) } else { 0.0 }
}

/// Fixed point to 8 bits, rounded; the lobes below zero make sums outside [0, 255].
fn to_byte(sum: i32) -> u8 {
    ((sum + (1 << (FRACTION_BITS - 1))) >> FRACTION_BITS).clamp(0, 255) as u8
}

/// Rows that are resized together: their values at one place lie side by side, so that sums are taken of all at once.
const TOGETHER: usize = 16;

fn resize_columns(bytes: &[u8], in_width: usize, height: usize, width: usize) -> Vec<u8> {
    if in_width == width {
        return bytes.to_vec();
    }
    let windows = windows(in_width, width);
    let mut out = vec![0; width * height * 3];
    let mut turned = vec![[0u8; TOGETHER]; in_width * 3];
    for (rows, out_rows) in bytes.chunks(in_width * 3 * TOGETHER).zip(out.chunks_mut(width * 3 * TOGETHER)) {
        for (k, row) in rows.chunks_exact(in_width * 3).enumerate() {
            for (column, &value) in turned.iter_mut().zip(row) {
                column[k] = value;
            }
        }
        for (x, window) in windows.iter().enumerate() {
            for channel in 0..3 {
                let columns = turned[window.first * 3 + channel..].iter().step_by(3);
                let mut sums = [0i32; TOGETHER];
                for (column, &w) in columns.zip(&window.weights) {
                    for (sum, &c) in sums.iter_mut().zip(column) {
                        *sum += i32::from(c) * w;
                    }
                }
                for (row, sum) in out_rows.chunks_exact_mut(width * 3).zip(sums) {
                    row[x * 3 + channel] = to_byte(sum);
                }
            }
        }
    }
    out
}

fn resize_rows(bytes: &[u8], width: usize, in_height: usize, height: usize) -> Vec<u8> {
    if in_height == height {
        return bytes.to_vec();
    }
    let stride = width * 3;
    let mut sums = vec![0i32; stride];
    let mut out = vec![0; stride * height];
    for (window, out_row) in windows(in_height, height).iter().zip(out.chunks_exact_mut(stride)) {
        sums.fill(0);
        for (row, &w) in bytes[window.first * stride..].chunks_exact(stride).zip(&window.weights) {
            for (sum, &c) in sums.iter_mut().zip(row) {
                *sum += i32::from(c) * w;
            }
        }
        for (byte, &sum) in out_row.iter_mut().zip(&sums) {
            *byte = to_byte(sum);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use safetensors::SafeTensors;

    use super::*;
    use crate::test_support::{difference, fixture, fixture_bytes, rgb};

    #[test]
    fn equals_pillow_to_the_bit() {
        let bytes = fixture_bytes("images.safetensors");
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let source = rgb(&file, "source");
        for (width, height) in [(160, 48), (80, 24), (320, 96)] {
            let expected = rgb(&file, &format!("lanczos/{width}x{height}"));
            assert_eq!(difference(&lanczos(&source, width, height), &expected), (0.0, 0), "{width}x{height}");
        }
    }

    #[test]
    fn the_decoded_png_is_the_source() {
        let bytes = fixture_bytes("images.safetensors");
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let decoded = image::open(fixture("resize_source.png")).unwrap().to_rgb8();
        assert_eq!(decoded, rgb(&file, "source"));
    }

    #[test]
    fn constants_stay_constant_and_the_same_size_is_the_same_picture() {
        let flat = RgbImage::from_pixel(13, 7, image::Rgb([0, 255, 131]));
        for (width, height) in [(5, 3), (40, 2), (13, 20), (1, 1)] {
            let out = lanczos(&flat, width, height);
            assert!(out.pixels().all(|p| p.0 == [0, 255, 131]), "{width}x{height}");
        }
        let ramp = RgbImage::from_fn(13, 7, |x, y| image::Rgb([x as u8 * 9, y as u8 * 11, 5]));
        assert_eq!(lanczos(&ramp, 13, 7), ramp);
    }
}
