//! The next frame seen from a frame's own place, by the frame's true depth: shows whether depth, camera and frames belong
//! together, whatever says how the camera moved.

use image::{Rgb, RgbImage};

use super::epipolar::{Motion, Pair, Pinhole};
use super::track::{Matches, matches};
use super::vectors::{Vector, apply, cross, dot};
use super::{LEAST_MATCHES, WIDE, median};
use crate::camera::Intrinsics;
use crate::depth::DepthMap;

/// The fewest matches with depth that say how far the camera moved.
const LEAST_DEPTHS: usize = 10;

/// `next` warped to `frame`: every pixel of the frame with known depth gets what the next frame shows of the same point,
/// all others are black. The rotation and the direction of travel are those that the matches of the frames obey; how far it
/// went is the median over the matches whose depth is known. Nothing if too few points are found again.
pub(in crate::data) fn warped(frame: &RgbImage, next: &RgbImage, k: Intrinsics, depth: &DepthMap) -> Option<RgbImage> {
    let (width, height) = frame.dimensions();
    let (w, h) = (f64::from(width), f64::from(height));
    let camera = Pinhole { focal: [k.fx * w, k.fy * h], centre: [k.cx * w, k.cy * h] };
    let matches = matches(frame, next);
    if matches.0.len() < LEAST_MATCHES || depth.width == 0 || depth.height == 0 {
        return None;
    }
    let motion = Pair::new(&matches, camera).search(WIDE);
    let depth_at = |[x, y]: [f64; 2]| {
        let place = |at: f64, from: f64, to: usize| (((at + 0.5) * to as f64 / from) as usize).min(to - 1);
        let metres = depth.metres.get(place(y, h, depth.height) * depth.width + place(x, w, depth.width))?;
        (*metres > 0.0).then_some(f64::from(*metres))
    };
    let far = distance(&matches, camera, &motion, &depth_at)?;
    let colour = |x: u32, y: u32| {
        let at = [f64::from(x), f64::from(y)];
        let metres = depth_at(at)?;
        let point = seen(camera.ray(at).map(|r| r * metres), &motion, far);
        let [u, v] = [0, 1].map(|axis| camera.focal[axis] * point[axis] / point[2] + camera.centre[axis]);
        let inside = point[2] > 0.0 && (0.0..=w - 1.0).contains(&u) && (0.0..=h - 1.0).contains(&v);
        inside.then(|| between(next, u, v))
    };
    Some(RgbImage::from_fn(width, height, |x, y| colour(x, y).unwrap_or(Rgb([0; 3]))))
}

/// A point of the first camera in the second's frame, which has moved by `far`.
fn seen(point: Vector, motion: &Motion, far: f64) -> Vector {
    let turned = apply(&motion.rotation, point);
    std::array::from_fn(|k| turned[k] + far * motion.direction[k])
}

/// How far the camera went along the direction of its motion (negative: against it), in the unit of the depth: for each match
/// with depth what brings its point nearest to the ray on which it is seen, and of those the median.
fn distance(
    matches: &Matches,
    camera: Pinhole,
    motion: &Motion,
    depth_at: &dyn Fn([f64; 2]) -> Option<f64>,
) -> Option<f64> {
    let of_match = |[from, to]: &[[f64; 2]; 2]| {
        let metres = depth_at(*from)?;
        let turned = apply(&motion.rotation, camera.ray(*from).map(|r| r * metres));
        let ray = camera.ray(*to);
        let (apart, along) = (cross(ray, turned), cross(ray, motion.direction));
        let length = dot(along, along);
        (length > 1e-6).then(|| -dot(apart, along) / length)
    };
    let all: Vec<f64> = matches.0.iter().filter_map(of_match).collect();
    (all.len() >= LEAST_DEPTHS).then(|| median(all.into_iter()))
}

/// The colour between pixels, bilinear; the place lies inside.
fn between(picture: &RgbImage, x: f64, y: f64) -> Rgb<u8> {
    let (left, top) = (x as u32, y as u32);
    let (right, bottom) = ((left + 1).min(picture.width() - 1), (top + 1).min(picture.height() - 1));
    let (a, b) = (x - f64::from(left), y - f64::from(top));
    let at = |x: u32, y: u32, c: usize| f64::from(picture.get_pixel(x, y).0[c]);
    Rgb(std::array::from_fn(|c| {
        let row = |y: u32| at(left, y, c) * (1.0 - a) + at(right, y, c) * a;
        (row(top) * (1.0 - b) + row(bottom) * b).round() as u8
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::DataSource;
    use crate::street::{Street, StreetConfig};

    /// The mean difference of two pictures where the second is not black, and the share of it that is.
    fn apart(a: &RgbImage, b: &RgbImage) -> (f64, f64) {
        let known: Vec<_> = a.pixels().zip(b.pixels()).filter(|(_, b)| b.0 != [0; 3]).collect();
        let difference = |(a, b): &(&Rgb<u8>, &Rgb<u8>)| {
            a.0.iter().zip(b.0).map(|(&a, b)| f64::from(a.abs_diff(b))).sum::<f64>() / 3.0
        };
        let n = known.len() as f64;
        (known.iter().map(difference).sum::<f64>() / n, n / f64::from(a.width() * a.height()))
    }

    #[test]
    fn true_depth_warps_the_next_frame_onto_a_frame_and_depth_of_another_frame_does_not() {
        let config = StreetConfig { sequences: 1, frames: 10, ..StreetConfig::default() };
        let street = Street::render(&config, None);
        let (frame, next) = (street.image(3, 0).unwrap(), street.image(3, 1).unwrap());
        let depth = street.depth(3).unwrap().unwrap();
        let warp = |depth: &DepthMap| warped(&frame, &next, config.intrinsics, depth);
        let (right, known) = apart(&frame, &warp(&depth).unwrap());
        let (unwarped, _) = apart(&frame, &next);
        assert!(right < 0.5 * unwarped && known > 0.6, "{right} of {unwarped}, {known} known");
        // The unit of depth does not matter, its shape does.
        let feet = DepthMap { metres: depth.metres.iter().map(|m| m * 3.28).collect(), ..depth.clone() };
        assert!((apart(&frame, &warp(&feet).unwrap()).0 - right).abs() < 0.1);
        let flat = DepthMap { metres: vec![10.0; depth.metres.len()], ..depth.clone() };
        let (wrong, _) = apart(&frame, &warp(&flat).unwrap());
        assert!(wrong > 1.5 * right, "{wrong} {right}");
        let unknown = DepthMap { metres: vec![0.0; depth.metres.len()], ..depth };
        assert_eq!(warp(&unknown), None);
    }
}
