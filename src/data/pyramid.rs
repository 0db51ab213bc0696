//! The image pyramid of the loss: a cascade, each scale made from the one before it.

use image::RgbImage;

use super::resize::lanczos;

/// The pictures of the scales 0, 1, ...: scale 0 is `image` resized to `width x height` (as it is, where it has that
/// size), scale s is scale s-1 at half its size by Lanczos, rounded to 8 bits at every step. So scale 2 is not what a
/// direct resize of the original would give: the published loader works like this.
///
/// # Panics
/// If `scales` is 0, or `width` or `height` is no multiple of `2^(scales - 1)`.
pub fn pyramid(image: &RgbImage, width: u32, height: u32, scales: usize) -> Vec<RgbImage> {
    assert!(scales > 0, "pyramid: at least one scale expected");
    let divisor = 1u32 << (scales - 1);
    assert!(
        width.is_multiple_of(divisor) && height.is_multiple_of(divisor),
        "pyramid: {width}x{height} does not halve {} times",
        scales - 1
    );
    let mut out = vec![lanczos(image, width, height)];
    for s in 1..scales {
        let next = lanczos(&out[s - 1], width >> s, height >> s);
        out.push(next);
    }
    out
}

#[cfg(test)]
mod tests {
    use safetensors::SafeTensors;

    use super::*;
    use crate::test_support::{difference, fixture_bytes, rgb};

    #[test]
    fn is_a_cascade_of_halvings() {
        let bytes = fixture_bytes("images.safetensors");
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let source = rgb(&file, "source");
        let scales = pyramid(&source, 320, 96, 4);
        let sizes: Vec<_> = scales.iter().map(RgbImage::dimensions).collect();
        assert_eq!(sizes, [(320, 96), (160, 48), (80, 24), (40, 12)]);
        assert_eq!(difference(&scales[0], &rgb(&file, "lanczos/320x96")), (0.0, 0));
        assert_eq!(scales[2], lanczos(&scales[1], 80, 24));
        // A cascade differs from the direct resize, but not by much.
        let (mean, _) = difference(&scales[2], &rgb(&file, "lanczos/80x24"));
        assert!(mean > 0.0 && mean < 5.0, "{mean}");
    }

    #[test]
    #[should_panic(expected = "320x100")]
    fn sizes_that_do_not_halve_are_refused() {
        pyramid(&RgbImage::new(640, 200), 320, 100, 4);
    }
}
