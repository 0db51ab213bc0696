//! Rendered wide sequences: their pictures and depth.

use crate::street::{Street, StreetConfig, WorldKind};

fn config(seed: u64) -> StreetConfig {
    StreetConfig {
        height: 48,
        width: 160,
        sequences: 6,
        frames: 3,
        seed,
        world: WorldKind::Street2,
        own_lenses: true,
        moving_cars: true,
        ..StreetConfig::default()
    }
}

#[test]
fn a_seed_fixes_every_picture_and_no_two_sequences_share_a_camera() {
    let (a, b) = (Street::render(&config(3), None), Street::render(&config(3), None));
    for sequence in 0..6 {
        for frame in 0..3 {
            assert_eq!(a.frame(sequence, frame), b.frame(sequence, frame));
        }
        assert!(sequence == 0 || a.camera(sequence) != a.camera(sequence - 1));
    }
    assert_ne!(a.frame(0, 0), Street::render(&config(4), None).frame(0, 0));
}

/// Nothing stands in the camera's face, and there is something to see.
#[test]
fn the_road_ahead_is_free_and_depth_has_a_range() {
    for seed in 0..4 {
        let street = Street::render(&config(seed), None);
        for sequence in 0..6 {
            let depth = street.frame_depth(sequence, 1);
            let seen = depth.metres.iter().copied().filter(|m| *m > 0.0);
            let nearest = seen.clone().fold(f32::INFINITY, f32::min);
            let farthest = seen.fold(0.0, f32::max);
            assert!(nearest > 0.4 && farthest > 30.0, "seed {seed}, sequence {sequence}: {nearest} to {farthest} m");
            let ahead = depth.metres[40 * depth.width + depth.width / 2];
            assert!(ahead > 3.0, "seed {seed}, sequence {sequence}: {ahead} m to what stands ahead");
        }
    }
}
