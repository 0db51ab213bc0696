//! Cars, vans, lorries and buses: a body, a cabin with windows, wheels, and the dark below.

use super::super::draw::Draw;
use super::super::light::GROUND;
use super::super::shape::Shape;
use super::super::surface::{Car, Material};
use super::super::world::{World, vary};
use super::Look;

const GROUND_Y: f64 = GROUND as f64;

/// Paints as they are on the road: black, greys, silver and white before colours.
const PAINTS: [[f64; 3]; 14] = [
    [0.07, 0.07, 0.08],
    [0.10, 0.10, 0.11],
    [0.17, 0.18, 0.19],
    [0.28, 0.29, 0.31],
    [0.45, 0.46, 0.48],
    [0.60, 0.61, 0.63],
    [0.66, 0.67, 0.68],
    [0.84, 0.84, 0.84],
    [0.80, 0.80, 0.80],
    [0.10, 0.15, 0.30],
    [0.18, 0.28, 0.45],
    [0.48, 0.09, 0.08],
    [0.14, 0.25, 0.18],
    [0.62, 0.55, 0.38],
];

/// Where a vehicle stands: the middle of its side towards -z, whether that is its rear, metres a frame along z.
#[derive(Clone, Copy)]
pub(super) struct Spot {
    pub(super) x: f64,
    pub(super) z: f64,
    pub(super) away: bool,
    pub(super) speed: f64,
}

/// A vehicle of any kind; gives its length. `heavy` is the chance of a lorry or a bus.
pub(super) fn vehicle(world: &mut World, draw: &mut Draw, spot: Spot, heavy: f64) -> f64 {
    let first = world.solids.len();
    let (length, half) = if draw.chance(heavy) { lorry(world, draw, spot) } else { car(world, draw, spot) };
    world.solids[first..].iter_mut().for_each(|solid| solid.speed = spot.speed);
    let Spot { x, z, speed, .. } = spot;
    world.darken([x - half + 0.1, x + half - 0.1, z + 0.1, z + length - 0.1], speed);
    length
}

fn wheels(world: &mut World, draw: &mut Draw, spot: Spot, half: f64, at: &[f64], radius: f64) {
    for side in [-1.0, 1.0] {
        let (inner, outer) = (spot.x + side * (half - 0.22), spot.x + side * (half + 0.01));
        let x = [inner.min(outer), inner.max(outer)];
        for &z in at {
            let wheel = Shape::Wheel { x, y: GROUND_Y - radius, z, radius };
            world.add(draw, wheel, Material::Wheel, [spot.x, GROUND_Y - radius, z]);
        }
    }
}

/// The layout of a car along its length, in shares: bonnet, windscreen, rear window, boot; and its height and length.
struct Build {
    bonnet: f64,
    screen: f64,
    hatch: f64,
    boot: f64,
    height: [f64; 2],
    length: [f64; 2],
    waist: f64,
}

const BUILDS: [Build; 5] = [
    // Saloon, hatchback, estate, people carrier, van.
    Build {
        bonnet: 1.15,
        screen: 0.75,
        hatch: 0.65,
        boot: 0.65,
        height: [1.40, 1.48],
        length: [4.4, 4.9],
        waist: 0.92,
    },
    Build { bonnet: 0.95, screen: 0.7, hatch: 0.45, boot: 0.1, height: [1.42, 1.55], length: [3.6, 4.3], waist: 0.93 },
    Build { bonnet: 1.1, screen: 0.72, hatch: 0.4, boot: 0.08, height: [1.44, 1.55], length: [4.4, 4.8], waist: 0.93 },
    Build { bonnet: 0.85, screen: 0.8, hatch: 0.25, boot: 0.06, height: [1.6, 1.8], length: [4.0, 4.8], waist: 1.0 },
    Build { bonnet: 0.7, screen: 0.6, hatch: 0.08, boot: 0.04, height: [1.85, 2.5], length: [4.6, 5.9], waist: 1.15 },
];

fn car(world: &mut World, draw: &mut Draw, spot: Spot) -> (f64, f64) {
    let Spot { x, z, away, .. } = spot;
    let kind = draw.pick(&[0usize, 0, 1, 1, 1, 2, 2, 3, 4]);
    let b = &BUILDS[kind];
    let (height, length) = (draw.range(b.height[0], b.height[1]), draw.range(b.length[0], b.length[1]));
    let half = 0.5 * draw.range(1.64, 1.84);
    let up = |h: f64| GROUND_Y - h;
    let axles = [-0.30 * length, 0.30 * length];
    let paint = draw.pick(&PAINTS);
    let look =
        Car { paint: vary(draw, paint, 0.02, 0.03), half: 0.5 * length as f32, axles: axles.map(|a| a as f32), away };
    let origin = [x, GROUND_Y, z + 0.5 * length];
    let (clear, belly) = (0.2, 0.5);
    let tuck = draw.range(0.05, 0.14);
    // Below the bumper's edge it draws in again.
    let edge = [x - half, x + half, z, z + length];
    let under = [x - half + 0.08, x + half - 0.08, z + 0.12, z + length - 0.12];
    let skirt = Shape::Frustum { top_y: up(belly), top: edge, bottom_y: up(clear), bottom: under };
    world.add(draw, skirt, Material::Wide(Look::Paint(look)), origin);
    let shoulders = [x - half + 0.06, x + half - 0.06, z + tuck, z + length - tuck];
    let body = Shape::Frustum { top_y: up(b.waist), top: shoulders, bottom_y: up(belly), bottom: edge };
    world.add(draw, body, Material::Wide(Look::Paint(look)), origin);
    let wiggle = draw.range(-0.1, 0.1);
    let [bottom, top] = if away {
        [[b.boot, length - b.bonnet + wiggle], [b.boot + b.hatch, length - b.bonnet - b.screen + wiggle]]
    } else {
        [[b.bonnet - wiggle, length - b.boot], [b.bonnet + b.screen - wiggle, length - b.boot - b.hatch]]
    };
    let lean = if kind == 4 { 0.08 } else { 0.18 };
    let cabin = Shape::Frustum {
        top_y: up(height),
        top: [x - half + 0.06 + lean, x + half - 0.06 - lean, z + top[0], z + top[1]],
        bottom_y: up(b.waist - 0.01),
        bottom: [x - half + 0.06, x + half - 0.06, z + bottom[0], z + bottom[1]],
    };
    world.add(draw, cabin, Material::Wide(Look::Cabin(look, b.waist as f32)), origin);
    let radius = draw.range(0.29, 0.34);
    wheels(world, draw, spot, half, &axles.map(|a| z + 0.5 * length + a), radius);
    (length, half)
}

/// A lorry (a cab and a box) or a bus.
fn lorry(world: &mut World, draw: &mut Draw, spot: Spot) -> (f64, f64) {
    let Spot { x, z, away, .. } = spot;
    let (half, bus) = (1.22, draw.chance(0.35));
    let length = if bus { draw.range(9.0, 12.0) } else { draw.range(6.5, 13.0) };
    let height = if bus { draw.range(2.9, 3.2) } else { draw.range(2.8, 3.9) };
    let tint =
        draw.pick(&[[0.80, 0.80, 0.80], [0.75, 0.72, 0.2], [0.55, 0.1, 0.1], [0.2, 0.3, 0.5], [0.4, 0.42, 0.42]]);
    let paint = vary(draw, tint, 0.03, 0.05);
    let origin = [x, GROUND_Y, z + 0.5 * length];
    let block = |world: &mut World, draw: &mut Draw, from: f64, to: f64, low: f64, high: f64, look: Look| {
        let shape = Shape::Box { low: [x - half, GROUND_Y - high, z + from], high: [x + half, GROUND_Y - low, z + to] };
        world.add(draw, shape, Material::Wide(look), origin);
    };
    if bus {
        block(
            world,
            draw,
            0.0,
            length,
            0.35,
            height,
            Look::Windows { paint, low: 1.2, high: height as f32 - 0.45, pitch: 1.5 },
        );
    } else {
        let cab = 2.1;
        let (a, b) = if away { (length - cab, length) } else { (0.0, cab) };
        let (c, d) = if away { (0.0, length - cab - 0.4) } else { (cab + 0.4, length) };
        let colour = vary(draw, [0.5, 0.5, 0.52], 0.15, 0.3);
        block(world, draw, a, b, 0.4, 2.6, Look::Windows { paint: colour, low: 1.5, high: 2.2, pitch: 1.9 });
        block(world, draw, c, d, 1.0, height, Look::Smooth(paint));
        block(world, draw, c, d, 0.6, 1.0, Look::Smooth([0.12, 0.12, 0.12]));
    }
    wheels(world, draw, spot, half, &[z + 0.15 * length, z + 0.8 * length], 0.48);
    (length, half)
}
