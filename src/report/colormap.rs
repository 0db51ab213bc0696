//! Magma, the colour map of depth: near is bright, far is dark.

use image::{Rgb, RgbImage};

/// The 256 colours of magma (matplotlib's table, released as CC0), dark to bright.
#[rustfmt::skip]
pub const MAGMA: [[u8; 3]; 256] = [
    [0, 0, 3], [0, 0, 4], [0, 0, 6], [1, 0, 7], [1, 1, 9], [1, 1, 11],
    [2, 2, 13], [2, 2, 15], [3, 3, 17], [4, 3, 19], [4, 4, 21], [5, 4, 23],
    [6, 5, 25], [7, 5, 27], [8, 6, 29], [9, 7, 31], [10, 7, 34], [11, 8, 36],
    [12, 9, 38], [13, 10, 40], [14, 10, 42], [15, 11, 44], [16, 12, 47], [17, 12, 49],
    [18, 13, 51], [20, 13, 53], [21, 14, 56], [22, 14, 58], [23, 15, 60], [24, 15, 63],
    [26, 16, 65], [27, 16, 68], [28, 16, 70], [30, 16, 73], [31, 17, 75], [32, 17, 77],
    [34, 17, 80], [35, 17, 82], [37, 17, 85], [38, 17, 87], [40, 17, 89], [42, 17, 92],
    [43, 17, 94], [45, 16, 96], [47, 16, 98], [48, 16, 101], [50, 16, 103], [52, 16, 104],
    [53, 15, 106], [55, 15, 108], [57, 15, 110], [59, 15, 111], [60, 15, 113], [62, 15, 114],
    [64, 15, 115], [66, 15, 116], [67, 15, 117], [69, 15, 118], [71, 15, 119], [72, 16, 120],
    [74, 16, 121], [75, 16, 121], [77, 17, 122], [79, 17, 123], [80, 18, 123], [82, 18, 124],
    [83, 19, 124], [85, 19, 125], [87, 20, 125], [88, 21, 126], [90, 21, 126], [91, 22, 126],
    [93, 23, 126], [94, 23, 127], [96, 24, 127], [97, 24, 127], [99, 25, 127], [101, 26, 128],
    [102, 26, 128], [104, 27, 128], [105, 28, 128], [107, 28, 128], [108, 29, 128], [110, 30, 129],
    [111, 30, 129], [113, 31, 129], [115, 31, 129], [116, 32, 129], [118, 33, 129], [119, 33, 129],
    [121, 34, 129], [122, 34, 129], [124, 35, 129], [126, 36, 129], [127, 36, 129], [129, 37, 129],
    [130, 37, 129], [132, 38, 129], [133, 38, 129], [135, 39, 129], [137, 40, 129], [138, 40, 129],
    [140, 41, 128], [141, 41, 128], [143, 42, 128], [145, 42, 128], [146, 43, 128], [148, 43, 128],
    [149, 44, 128], [151, 44, 127], [153, 45, 127], [154, 45, 127], [156, 46, 127], [158, 46, 126],
    [159, 47, 126], [161, 47, 126], [163, 48, 126], [164, 48, 125], [166, 49, 125], [167, 49, 125],
    [169, 50, 124], [171, 51, 124], [172, 51, 123], [174, 52, 123], [176, 52, 123], [177, 53, 122],
    [179, 53, 122], [181, 54, 121], [182, 54, 121], [184, 55, 120], [185, 55, 120], [187, 56, 119],
    [189, 57, 119], [190, 57, 118], [192, 58, 117], [194, 58, 117], [195, 59, 116], [197, 60, 116],
    [198, 60, 115], [200, 61, 114], [202, 62, 114], [203, 62, 113], [205, 63, 112], [206, 64, 112],
    [208, 65, 111], [209, 66, 110], [211, 66, 109], [212, 67, 109], [214, 68, 108], [215, 69, 107],
    [217, 70, 106], [218, 71, 105], [220, 72, 105], [221, 73, 104], [222, 74, 103], [224, 75, 102],
    [225, 76, 102], [226, 77, 101], [228, 78, 100], [229, 80, 99], [230, 81, 98], [231, 82, 98],
    [232, 84, 97], [234, 85, 96], [235, 86, 96], [236, 88, 95], [237, 89, 95], [238, 91, 94],
    [238, 93, 93], [239, 94, 93], [240, 96, 93], [241, 97, 92], [242, 99, 92], [243, 101, 92],
    [243, 103, 91], [244, 104, 91], [245, 106, 91], [245, 108, 91], [246, 110, 91], [246, 112, 91],
    [247, 113, 91], [247, 115, 92], [248, 117, 92], [248, 119, 92], [249, 121, 92], [249, 123, 93],
    [249, 125, 93], [250, 127, 94], [250, 128, 94], [250, 130, 95], [251, 132, 96], [251, 134, 96],
    [251, 136, 97], [251, 138, 98], [252, 140, 99], [252, 142, 99], [252, 144, 100], [252, 146, 101],
    [252, 147, 102], [253, 149, 103], [253, 151, 104], [253, 153, 105], [253, 155, 106], [253, 157, 107],
    [253, 159, 108], [253, 161, 110], [253, 162, 111], [253, 164, 112], [254, 166, 113], [254, 168, 115],
    [254, 170, 116], [254, 172, 117], [254, 174, 118], [254, 175, 120], [254, 177, 121], [254, 179, 123],
    [254, 181, 124], [254, 183, 125], [254, 185, 127], [254, 187, 128], [254, 188, 130], [254, 190, 131],
    [254, 192, 133], [254, 194, 134], [254, 196, 136], [254, 198, 137], [254, 199, 139], [254, 201, 141],
    [254, 203, 142], [253, 205, 144], [253, 207, 146], [253, 209, 147], [253, 210, 149], [253, 212, 151],
    [253, 214, 152], [253, 216, 154], [253, 218, 156], [253, 220, 157], [253, 221, 159], [253, 223, 161],
    [253, 225, 163], [252, 227, 165], [252, 229, 166], [252, 230, 168], [252, 232, 170], [252, 234, 172],
    [252, 236, 174], [252, 238, 176], [252, 240, 177], [252, 241, 179], [252, 243, 181], [252, 245, 183],
    [251, 247, 185], [251, 249, 187], [251, 250, 189], [251, 252, 191],
];

/// The colour of `x` in [0, 1]; outside it the nearest end, and black for what is not a number.
pub fn magma(x: f32) -> Rgb<u8> {
    // A float cast to an integer saturates, and NaN becomes 0.
    Rgb(MAGMA[(x * 256.0).clamp(0.0, 255.0) as usize])
}

/// Colours a disparity map (row-major, `height * width` values), from its smallest value (dark, far) up to its
/// 95th percentile (bright, near): a few very near pixels do not darken the rest. Values that are not finite do
/// not take part in the range.
///
/// # Panics
/// If `disparity` does not hold `width * height` values.
pub fn disparity_to_image(disparity: &[f32], width: usize, height: usize) -> RgbImage {
    assert_eq!(disparity.len(), width * height, "disparity_to_image: {width}x{height} values expected");
    let mut finite: Vec<f32> = disparity.iter().copied().filter(|d| d.is_finite()).collect();
    finite.sort_unstable_by(f32::total_cmp);
    let low = finite.first().copied().unwrap_or(0.0);
    let range = percentile(&finite, 95.0) - low;
    let scale = if range > 0.0 { 1.0 / range } else { 0.0 };
    RgbImage::from_fn(width as u32, height as u32, |x, y| {
        magma((disparity[y as usize * width + x as usize] - low) * scale)
    })
}

/// The `percent`th percentile of sorted values, linear between neighbours; 0 for none.
fn percentile(sorted: &[f32], percent: f64) -> f32 {
    let Some(last) = sorted.len().checked_sub(1) else {
        return 0.0;
    };
    let position = percent / 100.0 * last as f64;
    let below = position.floor() as usize;
    let above = (below + 1).min(last);
    let t = (position - below as f64) as f32;
    sorted[below] + t * (sorted[above] - sorted[below])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn table_has_the_known_ends_and_middle_and_brightens() {
        assert_eq!(MAGMA[0], [0, 0, 3]);
        assert_eq!(MAGMA[128], [182, 54, 121]);
        assert_eq!(MAGMA[255], [251, 252, 191]);
        let luma = |c: &[u8; 3]| 0.299 * f64::from(c[0]) + 0.587 * f64::from(c[1]) + 0.114 * f64::from(c[2]);
        for pair in MAGMA.windows(2) {
            assert!(luma(&pair[1]) > luma(&pair[0]) - 1.5, "{pair:?}");
        }
    }

    #[test]
    fn percentile_is_linear_between_neighbours() {
        let values: Vec<f32> = (0..11).map(|i| i as f32).collect();
        assert_eq!(percentile(&values, 95.0), 9.5);
        assert_eq!(percentile(&values, 0.0), 0.0);
        assert_eq!(percentile(&[3.0], 95.0), 3.0);
        assert_eq!(percentile(&[], 95.0), 0.0);
    }

    #[test]
    fn smallest_is_dark_and_everything_above_the_percentile_is_brightest() {
        let mut disparity: Vec<f32> = (0..100).map(|i| i as f32 / 100.0).collect();
        disparity[99] = 50.0;
        let picture = disparity_to_image(&disparity, 20, 5);
        assert_eq!(picture.get_pixel(0, 0).0, MAGMA[0]);
        assert_eq!(picture.get_pixel(19, 4).0, MAGMA[255]);
        assert_eq!(picture.get_pixel(16, 4).0, MAGMA[255]); // 0.96, above the percentile
        // 0.5 of a range that ends at 0.9405: entry int(0.5 / 0.9405 * 256) = 136.
        assert_eq!(picture.get_pixel(10, 2).0, MAGMA[136]);
    }

    #[test]
    fn constant_and_poisoned_maps_have_a_picture_too() {
        assert_eq!(disparity_to_image(&[0.3; 6], 3, 2).get_pixel(1, 1).0, MAGMA[0]);
        let picture = disparity_to_image(&[0.0, f32::NAN, 1.0, f32::INFINITY], 4, 1);
        assert_eq!(picture.get_pixel(1, 0).0, MAGMA[0]);
        assert_eq!(picture.get_pixel(2, 0).0, MAGMA[255]);
        assert_eq!(picture.get_pixel(3, 0).0, MAGMA[255]);
    }
}
