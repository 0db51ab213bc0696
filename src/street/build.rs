//! What stands where: one sequence's street, from its generator.

use super::camera::FASTEST;
use super::draw::Draw;
use super::light::{GROUND, Light};
use super::shape::{FAR, Shape};
use super::surface::{Material, Road};
use super::world::{Style, World, across, vary};
use super::{houses, props};

/// The street of a sequence of `frames` frames.
pub(crate) fn street(draw: &mut Draw, frames: usize, moving_cars: bool) -> World {
    let travel = frames as f64 * FASTEST;
    // Lanes, streets and avenues; traffic needs a street.
    let half = match draw.pick(&[0, 1, 1, 1, 2]) {
        0 if !moving_cars => draw.range(4.0, 4.7),
        2 if !moving_cars => draw.range(5.8, 7.4),
        _ => draw.range(5.15, 5.45),
    };
    let mut garden = || if draw.chance(0.3) { draw.range(2.0, 9.0) } else { 0.0 };
    let setback = [garden(), garden()];
    let style = Style {
        half,
        setback,
        open: [draw.chance(0.15), draw.chance(0.15)],
        begin: -12.0,
        end: travel + FAR as f64,
        car_gap: [draw.pick(&CAR_GAPS), draw.pick(&CAR_GAPS)],
        tree_gap: draw.pick(&[0.0, 0.0, 0.0, 24.0]),
        foliage: vary(draw, GREEN, 0.04, 0.06),
    };
    let light = Light::new(draw, setback.map(|back| half + 2.2 + back));
    let lane = draw.range(-0.6, 0.6) * (half - 5.5).max(0.0);
    let room = props::nearest_parked(half) - props::HALF_CAR - CLEARANCE - lane.abs();
    let mut world = World::empty(lane, room, light);
    ground(&mut world, draw, &style);
    for side in [-1.0, 1.0] {
        houses::row(&mut world, draw, &style, side);
        props::parked(&mut world, draw, &style, side, moving_cars);
        props::poles(&mut world, draw, &style, side);
        props::trees(&mut world, draw, &style, side);
    }
    if draw.chance(0.4) {
        houses::across(&mut world, draw, [travel + 30.0, travel + 80.0]);
    }
    if moving_cars {
        props::traffic(&mut world, draw, frames);
    }
    world
}

/// The road and what lies beside it.
fn ground(world: &mut World, draw: &mut Draw, style: &Style) {
    let lane = draw.pick(&[1.75, 1.9, 1.9, 2.0]);
    let dashed = draw.chance(0.75);
    let road = Road {
        colour: vary(draw, [0.40, 0.40, 0.415], 0.015, 0.07),
        half: style.half as f32,
        lane: lane as f32,
        period: if dashed { draw.pick(&[5.0, 6.0, 8.0]) } else { 1e6 },
        dash: if dashed { draw.pick(&[2.0, 3.0]) } else { 0.0 },
        width: draw.range(0.1, 0.17) as f32,
        bays: draw.chance(0.3),
        crossing: if draw.chance(0.4) { draw.range(8.0, 60.0) as f32 } else { -1e4 },
        grain: draw.range(0.75, 1.15) as f32,
        tracks: draw.range(0.0, 0.14) as f32,
        repairs: draw.range(0.12, 0.38) as f32,
    };
    let shape = Shape::Ground { y: GROUND as f64 };
    world.add(draw, shape, Material::Road(road), [0.0, GROUND as f64, 0.0]);
    let stone = vary(draw, STONE, 0.02, 0.08);
    let yard = if draw.chance(0.5) { [0.33, 0.40, 0.22] } else { [0.48, 0.45, 0.40] };
    let material = Material::Pavement {
        stone,
        yard: vary(draw, yard, 0.03, 0.05),
        slab: draw.pick(&[0.6, 0.9, 1.5]),
        edge: (style.half + draw.range(2.2, 4.5)) as f32,
    };
    let kerb = draw.range(0.1, 0.16);
    for side in [-1.0, 1.0] {
        let (low, high) = across(side, style.half, 80.0);
        let (top, bottom) = (GROUND as f64 - kerb, GROUND as f64 + 0.5);
        let shape = Shape::Box { low: [low, top, -60.0], high: [high, bottom, style.end + 60.0] };
        world.add(draw, shape, material, [0.0, GROUND as f64, 0.0]);
    }
}

/// From a parked car's side to the camera: half a car of its own, and what a careful driver leaves.
const CLEARANCE: f64 = 1.45;
/// From bumper to bumper, to hardly a car.
const CAR_GAPS: [f64; 6] = [3.0, 4.0, 7.0, 10.0, 14.0, 30.0];
/// Leaves and paving, before they vary.
const GREEN: [f64; 3] = [0.27, 0.37, 0.17];
const STONE: [f64; 3] = [0.56, 0.54, 0.51];

#[cfg(test)]
mod tests {
    use super::super::camera::drive;
    use super::props::HALF_CAR;
    use super::*;

    /// The camera looks out of a car that is as wide as others.
    #[test]
    fn the_camera_scrapes_no_parked_car() {
        for seed in 0..300 {
            let world = street(&mut Draw::new(seed, 0, 1), 10, false);
            for pose in drive(&mut Draw::new(seed, 0, 2), 10, world.lane, world.room, false) {
                for [x0, x1, z0, z1] in world.parked() {
                    if (z0 - 2.0..z1 + 2.0).contains(&pose.position[2]) {
                        let clear = (x0 - pose.position[0]).max(pose.position[0] - x1);
                        assert!(clear > HALF_CAR + 0.1, "seed {seed}: {clear:.2} m from the camera to a car's side");
                    }
                }
            }
        }
    }
}
