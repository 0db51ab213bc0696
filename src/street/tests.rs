use std::sync::atomic::{AtomicUsize, Ordering};

use super::*;
use crate::data::DataSource;

fn small() -> StreetConfig {
    StreetConfig { height: 48, width: 160, sequences: 3, frames: 5, ..StreetConfig::default() }
}

fn bytes(street: &Street) -> Vec<u8> {
    let images = street.sequences.iter().flat_map(|s| &s.images);
    images.flat_map(|image| image.as_raw().iter().copied()).collect()
}

/// The camera's pixel-to-metre numbers: fx, fy, cx, cy in pixels.
fn pixels(config: &StreetConfig) -> [f64; 4] {
    let (w, h, k) = (config.width as f64, config.height as f64, config.intrinsics);
    [k.fx * w, k.fy * h, k.cx * w, k.cy * h]
}

/// Where a pixel of the target at a depth is in the source: `(u, v, z)`.
fn reproject(config: &StreetConfig, m: &[[f64; 4]; 3], u: usize, v: usize, z: f64) -> [f64; 3] {
    let [fx, fy, cx, cy] = pixels(config);
    let p = [(u as f64 - cx) / fx * z, (v as f64 - cy) / fy * z, z];
    let q: [f64; 3] = std::array::from_fn(|i| m[i][0] * p[0] + m[i][1] * p[1] + m[i][2] * p[2] + m[i][3]);
    [fx * q[0] / q[2] + cx, fy * q[1] / q[2] + cy, q[2]]
}

/// Bilinear sampling inside the picture.
fn sample(image: &RgbImage, u: f64, v: f64) -> Option<[f64; 3]> {
    let (x, y) = (u.floor(), v.floor());
    if x < 0.0 || y < 0.0 || x + 1.0 >= image.width() as f64 || y + 1.0 >= image.height() as f64 {
        return None;
    }
    let (a, b) = (u - x, v - y);
    let at = |i: u32, j: u32| image.get_pixel(x as u32 + i, y as u32 + j).0.map(f64::from);
    let (p, q, r, s) = (at(0, 0), at(1, 0), at(0, 1), at(1, 1));
    let mixed = |k: usize| (p[k] * (1.0 - a) + q[k] * a) * (1.0 - b) + (r[k] * (1.0 - a) + s[k] * a) * b;
    Some([mixed(0), mixed(1), mixed(2)])
}

/// Mean absolute differences, of the neighbour as it is and warped, over pixels of known depth that the source sees too.
fn errors(street: &Street, sample_index: usize, offset: i32) -> (f64, f64, usize) {
    let (sequence, frame) = street.locate(sample_index);
    let config = &StreetConfig { intrinsics: street.camera(sequence), ..street.config().clone() };
    let target = street.image(sample_index, 0).unwrap();
    let source = street.image(sample_index, offset).unwrap();
    let depth = street.depth(sample_index).unwrap().unwrap();
    let there = street.frame_depth(sequence, (frame as i32 + offset) as usize);
    let m = street.relative_pose(sample_index, offset);
    let (mut still, mut warped, mut n) = (0.0, 0.0, 0);
    for v in 0..config.height {
        for u in 0..config.width {
            let z = depth.metres[v * config.width + u] as f64;
            if z == 0.0 {
                continue;
            }
            let [su, sv, sz] = reproject(config, &m, u, v, z);
            let Some(colour) = sample(&source, su, sv) else { continue };
            // Not hidden there: the source's own depth agrees.
            let seen = there.metres[(sv + 0.5) as usize * config.width + (su + 0.5) as usize] as f64;
            if (seen - sz).abs() > 0.1 * sz {
                continue;
            }
            let here = target.get_pixel(u as u32, v as u32).0.map(f64::from);
            let before = source.get_pixel(u as u32, v as u32).0.map(f64::from);
            for k in 0..3 {
                still += (before[k] - here[k]).abs();
                warped += (colour[k] - here[k]).abs();
            }
            n += 3;
        }
    }
    (still / n as f64, warped / n as f64, n / 3)
}

#[test]
fn depth_pose_and_intrinsics_warp_neighbours_onto_the_target() {
    let config = StreetConfig { sequences: 4, frames: 5, ..StreetConfig::default() };
    let street = Street::render(&config, None);
    let (mut still, mut warped, mut seen, mut count) = (0.0, 0.0, 0, 0);
    for sample in 0..street.len() {
        for offset in [-1, 1] {
            let (a, b, n) = errors(&street, sample, offset);
            (still, warped, seen, count) = (still + a, warped + b, seen + n, count + 1);
        }
    }
    let (still, warped) = (still / count as f64, warped / count as f64);
    let share = seen as f64 / (count * config.width * config.height) as f64;
    println!("as it is {still:.2}, warped {warped:.2} of 255; {share:.2} of the pixels");
    assert!(share > 0.5, "{share}");
    assert!(warped < 0.35 * still, "{warped} against {still}");
}

/// Every lens, height, pitch and roll: what a network is told of them has to be true.
#[test]
fn wide_streets_of_many_cameras_warp_onto_their_targets_too() {
    let config = StreetConfig {
        world: WorldKind::Street2,
        own_lenses: true,
        sequences: 24,
        frames: 3,
        ..StreetConfig::default()
    };
    let street = Street::render(&config, None);
    let (mut still, mut warped, mut better) = (0.0, 0.0, 0);
    for sample in 0..street.len() {
        let (a, b, n) = errors(&street, sample, 1);
        assert!(n > 0, "sample {sample} sees nothing again");
        (still, warped, better) = (still + a, warped + b, better + usize::from(b < a));
    }
    println!("as it is {still:.1}, warped {warped:.1}; {better} of {} are better", street.len());
    assert!(better == street.len() && warped < 0.5 * still, "{warped} against {still}, {better}");
}

/// Figures of runs are compared over the years: the embedded street keeps its pixels.
#[test]
fn the_embedded_street_is_what_it_was() {
    let street = Street::render(&StreetConfig { height: 96, width: 320, sequences: 3, frames: 4, ..small() }, None);
    assert_eq!(crc32fast::hash(&bytes(&street)), 1_117_542_805, "the embedded street looks otherwise than it did");
}

#[test]
fn a_wrong_depth_pose_or_focal_length_warps_worse() {
    let config = StreetConfig { sequences: 2, frames: 3, ..StreetConfig::default() };
    let street = Street::render(&config, None);
    let depth = street.depth(0).unwrap().unwrap();
    let (target, source) = (street.image(0, 0).unwrap(), street.image(0, 1).unwrap());
    let m = street.relative_pose(0, 1);
    let error = |m: &[[f64; 4]; 3], config: &StreetConfig, scale: f64| {
        let (mut sum, mut n) = (0.0, 0.0);
        for v in 0..config.height {
            for u in 0..config.width {
                let z = depth.metres[v * config.width + u] as f64 * scale;
                let [su, sv, _] = reproject(config, m, u, v, z.max(0.1));
                if let (true, Some(c)) = (z > 0.0, sample(&source, su, sv)) {
                    let here = target.get_pixel(u as u32, v as u32).0.map(f64::from);
                    sum += (0..3).map(|k| (c[k] - here[k]).abs()).sum::<f64>();
                    n += 3.0;
                }
            }
        }
        sum / n
    };
    let right = error(&m, &config, 1.0);
    let backwards = m.map(|r| [r[0], r[1], r[2], -r[3]]);
    assert!(error(&m, &config, 1.2) > 1.1 * right);
    assert!(error(&m, &config, 0.8) > 1.1 * right);
    assert!(error(&backwards, &config, 1.0) > 1.5 * right);
    let k = Intrinsics { fx: 0.65, ..config.intrinsics };
    assert!(error(&m, &StreetConfig { intrinsics: k, ..config.clone() }, 1.0) > 1.02 * right);
}

#[test]
fn the_same_seed_gives_the_same_bytes_on_any_number_of_threads() {
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let street = Street::render(&StreetConfig { moving_cars: true, ..small() }, None);
            let depths: Vec<f32> = (0..street.len()).flat_map(|s| street.depth(s).unwrap().unwrap().metres).collect();
            (bytes(&street), depths)
        })
    };
    let (one, two) = (on(1), on(2));
    assert!(one == two);
    assert!(one == on(1));
}

#[test]
fn seeds_and_sequences_differ_and_more_sequences_change_none() {
    let a = Street::render(&small(), None);
    let b = Street::render(&StreetConfig { seed: 1, ..small() }, None);
    assert_ne!(bytes(&a), bytes(&b));
    assert_ne!(a.frame(0, 0), a.frame(1, 0));
    assert_ne!(a.poses(0), a.poses(1));
    let fewer = Street::render(&StreetConfig { sequences: 1, ..small() }, None);
    assert_eq!(fewer.frame(0, 2), a.frame(0, 2));
}

#[test]
fn depth_is_that_of_a_street() {
    let street = Street::render(&StreetConfig { sequences: 8, ..small() }, None);
    for sample in 0..street.len() {
        let depth = street.depth(sample).unwrap().unwrap();
        assert_eq!((depth.width, depth.height, depth.metres.len()), (160, 48, 160 * 48));
        assert!(depth.metres.iter().all(|z| z.is_finite() && (0.0..250.0).contains(z)));
        let sky = depth.metres.iter().filter(|&&z| z == 0.0).count() as f64 / depth.metres.len() as f64;
        assert!((0.005..0.6).contains(&sky), "{}: {sky}", street.name(sample));
        let near = depth.metres.iter().filter(|&&z| z > 0.0).fold(f32::MAX, |a, &b| a.min(b));
        assert!((1.0..7.0).contains(&near), "{}: {near}", street.name(sample));
        // In the middle of the last row lies the road, at 1.65 m / slope; the pitch moves it by a few percent.
        let slope = (47.0 - 24.0) / (1.92 * 48.0);
        let z = depth.metres[47 * 160 + 80] as f64;
        assert!((z * slope / 1.65 - 1.0).abs() < 0.05, "{z}");
    }
}

#[test]
fn any_size_renders() {
    for (height, width) in [(1, 1), (32, 64), (64, 32), (7, 3), (0, 0), (5, 0)] {
        let config = StreetConfig { height, width, sequences: 1, frames: 3, ..StreetConfig::default() };
        let street = Street::render(&config, None);
        assert_eq!(street.len(), 1);
        assert_eq!(street.image(0, 1).unwrap().dimensions(), (width as u32, height as u32));
        assert_eq!(street.depth(0).unwrap().unwrap().metres.len(), width * height);
    }
    for frames in 0..3 {
        let street = Street::render(&StreetConfig { frames, ..small() }, None);
        assert!(street.is_empty());
    }
}

#[test]
fn a_larger_picture_made_small_is_the_small_picture() {
    let config = StreetConfig { sequences: 4, frames: 1, ..StreetConfig::default() };
    // Twice the pixels, with centres at whole numbers: the principal point moves by a quarter of a small pixel.
    let (w, h, k) = (config.width, config.height, config.intrinsics);
    let moved = Intrinsics { cx: k.cx + 0.25 / w as f64, cy: k.cy + 0.25 / h as f64, ..k };
    let large = StreetConfig { width: 2 * w, height: 2 * h, intrinsics: moved, ..config.clone() };
    let (a, b) = (Street::render(&config, None), Street::render(&large, None));
    for sequence in 0..config.sequences {
        let (a, b) = (a.frame(sequence, 0), b.frame(sequence, 0));
        let mut sum = 0.0;
        for (x, y, pixel) in a.enumerate_pixels() {
            for k in 0..3 {
                let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(i, j)| b.get_pixel(2 * x + i, 2 * y + j).0[k] as f64);
                sum += (four.iter().sum::<f64>() / 4.0 - pixel.0[k] as f64).abs();
            }
        }
        let mean = sum / (3 * w * h) as f64;
        // Measured by what there is to see: the mean step from a pixel to its right neighbour.
        let step = |(p, q): (&u8, &u8)| p.abs_diff(*q) as f64;
        let rows = a.as_raw().chunks_exact(3 * w).map(|row| row.iter().zip(&row[3..]).map(step).sum::<f64>());
        let step = rows.sum::<f64>() / (3 * (w - 1) * h) as f64;
        println!("sequence {sequence}: {mean:.2} of 255, steps of {step:.2}");
        assert!(mean < 0.55 * step, "sequence {sequence}: {mean} beside steps of {step}");
    }
}

#[test]
fn surfaces_have_texture_to_match_by() {
    let config = StreetConfig { sequences: 6, frames: 3, ..StreetConfig::default() };
    let street = Street::render(&config, None);
    for sample in 0..street.len() {
        let (image, depth) = (street.image(sample, 0).unwrap(), street.depth(sample).unwrap().unwrap());
        let (mut flat, mut all) = (0, 0);
        // Blocks of 8 x 8 pixels on solids: the mean step between neighbours must be visible.
        for by in 0..config.height / 8 {
            for bx in 0..config.width / 8 {
                let (mut step, mut n) = (0.0, 0);
                for y in 8 * by..8 * by + 7 {
                    for x in 8 * bx..8 * bx + 7 {
                        if depth.metres[y * config.width + x] > 0.0 {
                            let at = |x: usize, y: usize| image.get_pixel(x as u32, y as u32).0[1] as f64;
                            step += (at(x + 1, y) - at(x, y)).abs() + (at(x, y + 1) - at(x, y)).abs();
                            n += 2;
                        }
                    }
                }
                if n == 98 {
                    all += 1;
                    flat += (step / (n as f64) < 1.0) as usize;
                }
            }
        }
        let share = flat as f64 / all as f64;
        println!("{}: {share:.3} of {all} blocks are flat", street.name(sample));
        assert!(share < 0.1, "{}: {share} of {all} blocks are flat", street.name(sample));
    }
}

#[test]
fn moving_cars_move() {
    let config = StreetConfig { sequences: 2, frames: 4, moving_cars: true, ..StreetConfig::default() };
    let street = Street::render(&config, None);
    let still = Street::render(&StreetConfig { sequences: 4, moving_cars: false, frames: 4, ..config.clone() }, None);
    let mean = |street: &Street| {
        let all: Vec<f64> = (0..street.len()).map(|s| errors(street, s, 1)).map(|(a, b, _)| b / a).collect();
        all.iter().sum::<f64>() / all.len() as f64
    };
    assert!(street.sequences.iter().all(|s| s.world.solids.iter().any(|solid| solid.speed != 0.0)));
    assert!(still.sequences.iter().all(|s| s.world.solids.iter().all(|solid| solid.speed == 0.0)));
    assert!(mean(&street) > mean(&still));
}

#[test]
fn samples_are_named_and_bounded_and_progress_is_told() {
    let count = AtomicUsize::new(0);
    let street = Street::render(
        &StreetConfig { seed: 7, ..small() },
        Some(&|done, total| {
            assert!((1..=15).contains(&done) && total == 15);
            count.fetch_add(1, Ordering::Relaxed);
        }),
    );
    assert_eq!(count.into_inner(), 15);
    assert_eq!(street.len(), 9);
    assert_eq!(street.name(4), "street seed 7, sequence 1, frame 2");
    assert_eq!(&street.image(4, -1).unwrap(), street.frame(1, 1));
    let error = street.image(0, -2).unwrap_err().to_string();
    assert!(error.contains("sequence 0, frame 1") && error.contains("-2"), "{error}");
    let m = street.relative_pose(4, 0);
    for (i, row) in m.iter().enumerate() {
        for (j, x) in row.iter().enumerate() {
            assert!((x - (i == j) as u8 as f64).abs() < 1e-12);
        }
    }
    assert!(street.relative_pose(4, 1)[2][3] < -0.4, "the next camera is ahead, so points come nearer");
}

#[test]
fn a_configuration_reads_back_and_may_leave_fields_out() {
    let config = StreetConfig { seed: 3, moving_cars: true, ..StreetConfig::default() };
    assert_eq!(toml::from_str::<StreetConfig>(&toml::to_string(&config).unwrap()).unwrap(), config);
    assert_eq!(toml::from_str::<StreetConfig>("seed = 3\nmoving_cars = true").unwrap(), config);
    assert!(toml::from_str::<StreetConfig>("sede = 3").is_err());
}
