//! Cars, poles, signs and trees.

use super::draw::Draw;
use super::light::GROUND;
use super::shape::Shape;
use super::surface::{Car, Material};
use super::world::{Style, World, vary};

const GROUND_Y: f64 = GROUND as f64;

const PAINTS: [[f64; 3]; 10] = [
    [0.80, 0.80, 0.80],
    [0.72, 0.73, 0.75],
    [0.55, 0.56, 0.58],
    [0.34, 0.35, 0.37],
    [0.26, 0.26, 0.28],
    [0.56, 0.22, 0.20],
    [0.24, 0.34, 0.52],
    [0.25, 0.36, 0.44],
    [0.28, 0.38, 0.30],
    [0.62, 0.55, 0.42],
];

/// Half the width of the widest car, in metres.
pub(crate) const HALF_CAR: f64 = 0.92;

/// How near to the middle of a road, `half` of which lies between it and the kerb, the middle of a parked car stands.
pub(crate) fn nearest_parked(half: f64) -> f64 {
    (half - 2.3).max(2.75)
}

/// The cars parked along one side.
pub(crate) fn parked(world: &mut World, draw: &mut Draw, style: &Style, side: f64, traffic: bool) {
    let mut z = style.begin + draw.range(0.0, 10.0);
    // Oncoming traffic needs the room.
    let nearest = if traffic && side < 0.0 { 4.0 } else { nearest_parked(style.half) };
    let furthest = (style.half - 1.1).max(nearest + 0.2);
    while z < style.end - 10.0 {
        let x = side * draw.range(nearest, furthest);
        z += car(world, draw, x, z, side > 0.0, 0.0) + draw.range(1.0, style.car_gap[(side > 0.0) as usize]);
    }
}

/// The cars that move: some ahead on the camera's side, some that come towards it.
pub(crate) fn traffic(world: &mut World, draw: &mut Draw, frames: usize) {
    let x = draw.range(0.2, 0.6);
    let (z, speed) = (draw.range(7.0, 20.0), draw.range(0.75, 1.1));
    let length = car(world, draw, x, z, true, speed);
    if draw.chance(0.4) {
        let next = z + length + draw.range(5.0, 12.0);
        car(world, draw, x, next, true, speed + 0.1);
    }
    let mut z = draw.range(15.0, 40.0);
    while z < 60.0 + 1.8 * frames as f64 {
        let x = draw.range(-2.3, -2.1);
        z += car(world, draw, x, z, false, -0.8) + draw.range(12.0, 60.0);
    }
}

/// A car around `x` from `z` on, seen from behind if `away`; gives its length.
fn car(world: &mut World, draw: &mut Draw, x: f64, z: f64, away: bool, speed: f64) -> f64 {
    let van = draw.chance(0.5);
    let length = if van { draw.range(4.6, 6.0) } else { draw.range(3.6, 4.8) };
    let height = if van { draw.range(1.75, 2.4) } else { draw.range(1.4, 1.65) };
    let half = 0.5 * draw.range(1.68, 2.0 * HALF_CAR);
    let first = world.solids.len();
    let up = |h: f64| GROUND_Y - h;
    let middle = z + 0.5 * length;
    let axles = [-0.31 * length, 0.29 * length];
    let paint = draw.pick(&PAINTS);
    let look =
        Car { paint: vary(draw, paint, 0.03, 0.05), half: 0.5 * length as f32, axles: axles.map(|a| a as f32), away };
    let origin = [x, GROUND_Y, middle];
    let waist = if van { 1.05 } else { draw.range(0.84, 0.96) };
    // A body drawn in a little to the top, more at the ends.
    let tuck = draw.range(0.05, 0.16);
    let body = Shape::Frustum {
        top_y: up(waist),
        top: [x - half + 0.05, x + half - 0.05, z + tuck, z + length - tuck],
        bottom_y: up(0.24),
        bottom: [x - half, x + half, z, z + length],
    };
    world.add(draw, body, Material::Body(look), origin);
    // The cabin, with the bonnet in front of it; a van's is nearly a box.
    let (bonnet, boot) =
        if van { (draw.range(0.5, 0.9), 0.06) } else { (draw.range(0.95, 1.25), draw.pick(&[0.1, 0.12, 0.5, 0.75])) };
    let (front, rear) = (draw.range(0.5, 0.85), if van { 0.05 } else { draw.range(0.25, 0.55) });
    // In metres from the nearer end: away means that the rear is nearer.
    let [bottom, top] = if away {
        [[boot, length - bonnet], [boot + rear, length - bonnet - front]]
    } else {
        [[bonnet, length - boot], [bonnet + front, length - boot - rear]]
    };
    let lean = if van { 0.08 } else { 0.17 };
    let cabin = Shape::Frustum {
        top_y: up(height),
        top: [x - half + 0.06 + lean, x + half - 0.06 - lean, z + top[0], z + top[1]],
        bottom_y: up(waist - 0.01),
        bottom: [x - half + 0.06, x + half - 0.06, z + bottom[0], z + bottom[1]],
    };
    world.add(draw, cabin, Material::Cabin(look), [x, up(height), middle]);
    let under =
        Shape::Box { low: [x - half + 0.12, up(0.3), z + 0.25], high: [x + half - 0.12, up(0.14), z + length - 0.25] };
    world.add(draw, under, Material::Plain([0.07, 0.07, 0.07]), origin);
    for axle in axles {
        for side in [-1.0, 1.0] {
            let outer = x + side * (half + 0.012);
            let inner = outer - side * 0.2;
            let centre = [up(0.31), middle + axle];
            let tyre =
                Shape::Wheel { x: [outer.min(inner), outer.max(inner)], y: centre[0], z: centre[1], radius: 0.31 };
            world.add(draw, tyre, Material::Wheel, [outer, centre[0], centre[1]]);
        }
    }
    world.solids[first..].iter_mut().for_each(|solid| solid.speed = speed);
    world.darken([x - half, x + half, z, z + length], speed);
    length
}

/// Lamp posts, sign posts and bins along one side.
pub(crate) fn poles(world: &mut World, draw: &mut Draw, style: &Style, side: f64) {
    let mut z = style.begin + draw.range(0.0, 10.0);
    while z < style.end {
        let x = side * draw.range(style.half + 0.15, style.half + 0.9);
        let origin = [x, GROUND_Y, z];
        match draw.pick(&[0, 0, 0, 1, 2, 2]) {
            0 => {
                let metal = vary(draw, [0.34, 0.36, 0.36], 0.02, 0.12);
                let radius = draw.range(0.08, 0.12);
                let height = draw.range(5.0, 7.5);
                let pole = Shape::Pole { x, z, radius, top_y: GROUND_Y - height, bottom_y: GROUND_Y };
                world.add(draw, pole, Material::Plain(metal), origin);
                let foot = Shape::Pole { x, z, radius: 1.7 * radius, top_y: GROUND_Y - 1.0, bottom_y: GROUND_Y };
                world.add(draw, foot, Material::Plain(metal), origin);
                let (a, b) = (x.min(x - side * 1.6), x.max(x - side * 1.6));
                let y = GROUND_Y - height;
                let arm = Shape::Box { low: [a, y, z - 0.06], high: [b, y + 0.12, z + 0.06] };
                world.add(draw, arm, Material::Plain(metal), origin);
            }
            1 => {
                let metal = vary(draw, [0.55, 0.56, 0.56], 0.02, 0.08);
                let pole = Shape::Pole { x, z, radius: 0.05, top_y: GROUND_Y - 2.9, bottom_y: GROUND_Y };
                world.add(draw, pole, Material::Plain(metal), origin);
                let sign = draw.pick(&[[0.60, 0.10, 0.10], [0.10, 0.22, 0.52], [0.75, 0.62, 0.15], [0.75, 0.75, 0.75]]);
                let (w, h) = (draw.range(0.25, 0.45), draw.range(0.5, 0.9));
                let (y0, y1) = (GROUND_Y - 2.9, GROUND_Y - 2.9 + h);
                let board = Shape::Box { low: [x - w, y0, z - 0.08], high: [x + w, y1, z - 0.04] };
                let colour = vary(draw, sign, 0.03, 0.05);
                world.add(draw, board, Material::Sign(colour), [x, y0, z]);
            }
            _ => {
                let (w, h) = (draw.range(0.2, 0.4), draw.range(0.9, 1.5));
                let shape = Shape::Box { low: [x - w, GROUND_Y - h, z - w], high: [x + w, GROUND_Y, z + w] };
                let colour = draw.pick(&[[0.22, 0.32, 0.24], [0.45, 0.45, 0.44], [0.30, 0.28, 0.26], [0.6, 0.5, 0.2]]);
                let colour = vary(draw, colour, 0.03, 0.05);
                world.add(draw, shape, Material::Sign(colour), origin);
            }
        }
        z += draw.range(10.0, 26.0);
    }
}

/// The trees along one side.
pub(crate) fn trees(world: &mut World, draw: &mut Draw, style: &Style, side: f64) {
    if style.tree_gap == 0.0 {
        return;
    }
    let mut z = style.begin + draw.range(0.0, style.tree_gap);
    while z < style.end {
        let x = side * draw.range(style.half + 0.4, style.half + 1.1);
        tree(world, draw, style, x, z, 1.0);
        z += draw.range(0.6, 1.2) * style.tree_gap;
    }
}

/// A tree: a trunk, and a crown of several balls of leaves.
pub(crate) fn tree(world: &mut World, draw: &mut Draw, style: &Style, x: f64, z: f64, size: f64) {
    let size = size * draw.range(0.8, 1.2);
    let radius = size * draw.range(0.11, 0.18);
    let height = size * draw.range(2.2, 2.9);
    let bark = vary(draw, [0.30, 0.25, 0.20], 0.02, 0.05);
    let trunk = Shape::Pole { x, z, radius, top_y: GROUND_Y - height - 1.0, bottom_y: GROUND_Y };
    world.add(draw, trunk, Material::Plain(bark), [x, GROUND_Y, z]);
    let green = vary(draw, style.foliage.map(|c| c as f64), 0.02, 0.03);
    for k in 0..6 {
        let (spread, r) = if k == 0 { (0.0, 1.35) } else { (0.95, draw.range(0.65, 1.05)) };
        let centre = [
            x + size * draw.range(-spread, spread),
            GROUND_Y - height - size * (0.9 + draw.range(-0.35, 1.0) * spread),
            z + size * draw.range(-spread, spread),
        ];
        let radii = [r, 0.85 * r, r].map(|r| r * size);
        let seed = draw.bits() >> 8;
        world.add(draw, Shape::Crown { centre, radii, seed }, Material::Leaves(green), centre);
    }
}
