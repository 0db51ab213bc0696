//! Flip post-processing (Monodepth, 1609.03677): a prediction joined with that of the mirrored picture.

/// Flip post-processing: joins the prediction `left` of an image with `right`, the prediction of the mirrored image
/// mirrored back; rows of `width` values. Either is trusted least at the border where its own disocclusions lie: at
/// the left border the result is `right`, at the right border `left`, within 5 % it fades, and in between it is their
/// mean.
///
/// # Panics
/// If the maps differ in length or are not rows of `width`.
pub fn flip_post_process(left: &[f32], right: &[f32], width: usize) -> Vec<f32> {
    assert_eq!(left.len(), right.len(), "flip_post_process: two maps of one size expected");
    assert!(width > 0 && left.len().is_multiple_of(width), "flip_post_process: rows of {width} expected");
    // 1 at the left border, 0 from a tenth of the width on.
    let ramp = |i: usize| {
        let x = i as f64 / (width - 1).max(1) as f64;
        1.0 - (20.0 * (x - 0.05)).clamp(0.0, 1.0)
    };
    let ramps: Vec<(f64, f64)> = (0..width).map(|i| (ramp(i), ramp(width - 1 - i))).collect();
    let pairs = left.iter().zip(right).zip(ramps.iter().cycle());
    pairs
        .map(|((&l, &r), &(at_left, at_right))| {
            let (l, r) = (f64::from(l), f64::from(r));
            (at_right * l + at_left * r + (1.0 - at_left - at_right) * (l + r) / 2.0) as f32
        })
        .collect()
}

/// A map mirrored left to right, rows of `width` values.
///
/// # Panics
/// If the map is not rows of `width`.
pub fn mirror(map: &[f32], width: usize) -> Vec<f32> {
    assert!(width > 0 && map.len().is_multiple_of(width), "mirror: rows of {width} expected");
    map.chunks_exact(width).flat_map(|row| row.iter().rev().copied()).collect()
}
