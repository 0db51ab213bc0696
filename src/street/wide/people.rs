//! People on foot and on bicycles.

use super::super::draw::Draw;
use super::super::light::GROUND;
use super::super::shape::Shape;
use super::super::surface::Material;
use super::super::world::{World, vary};
use super::Look;

const GROUND_Y: f64 = GROUND as f64;

/// A person who stands at `(x, z)`, or sits on a bicycle there.
pub(super) fn person(world: &mut World, draw: &mut Draw, x: f64, z: f64) {
    let tall = draw.range(1.55, 1.9);
    let cycles = draw.chance(0.25);
    let lift = if cycles { 0.18 } else { 0.0 };
    let cloth = |draw: &mut Draw| {
        let colour =
            draw.pick(&[[0.1, 0.1, 0.12], [0.2, 0.22, 0.3], [0.45, 0.15, 0.15], [0.6, 0.58, 0.55], [0.3, 0.35, 0.25]]);
        Look::Smooth(vary(draw, colour, 0.04, 0.06))
    };
    let (legs, coat) = (cloth(draw), cloth(draw));
    let mut pole = |draw: &mut Draw, dx: f64, radius: f64, low: f64, high: f64, look: Look| {
        let shape = Shape::Pole { x: x + dx, z, radius, top_y: GROUND_Y - high, bottom_y: GROUND_Y - low };
        world.add(draw, shape, Material::Wide(look), [x, GROUND_Y, z]);
    };
    for side in [-0.09, 0.09] {
        pole(draw, side, 0.085, lift, 0.5 * tall + lift, legs);
    }
    pole(draw, 0.0, 0.2, 0.47 * tall + lift, 0.82 * tall + lift, coat);
    pole(draw, 0.0, 0.1, 0.82 * tall + lift, tall + lift, Look::Smooth([0.50, 0.36, 0.29]));
    if cycles {
        for along in [-0.5, 0.5] {
            let shape = Shape::Wheel { x: [x - 0.03, x + 0.03], y: GROUND_Y - 0.34, z: z + along, radius: 0.34 };
            world.add(draw, shape, Material::Wheel, [x, GROUND_Y - 0.34, z + along]);
        }
    }
}
