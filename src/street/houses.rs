//! Rows of houses with gaps, their roofs, balconies and shop awnings, and what fills the gaps.

use super::draw::Draw;
use super::light::GROUND;
use super::props;
use super::shape::Shape;
use super::surface::{Facade, Material};
use super::texture::Colour;
use super::world::{Style, World, across as beside, vary};

const GROUND_Y: f64 = GROUND as f64;
/// How far a house reaches back from its front, in metres.
const DEEP: f64 = 9.0;

/// Walls by district: plaster, brick, concrete.
const DISTRICTS: [&[[f64; 3]]; 4] = [
    &[[0.78, 0.70, 0.55], [0.74, 0.62, 0.50], [0.70, 0.68, 0.62], [0.66, 0.52, 0.42], [0.80, 0.76, 0.66]],
    &[[0.52, 0.30, 0.24], [0.60, 0.40, 0.30], [0.46, 0.31, 0.27], [0.70, 0.58, 0.46]],
    &[[0.55, 0.55, 0.54], [0.64, 0.62, 0.58], [0.45, 0.47, 0.50], [0.70, 0.70, 0.69]],
    &[[0.56, 0.62, 0.66], [0.72, 0.56, 0.48], [0.62, 0.66, 0.54], [0.76, 0.66, 0.46], [0.52, 0.30, 0.24]],
];

/// One side of the street.
pub(crate) fn row(world: &mut World, draw: &mut Draw, style: &Style, side: f64) {
    let walls = draw.pick(&DISTRICTS);
    let (low, high) = draw.pick(&[(4.0, 8.0), (4.0, 14.0), (7.0, 14.0)]);
    let brick = draw.chance(0.4);
    let shops = draw.pick(&[0.0, 0.3, 0.8]);
    let terrace = draw.chance(0.4);
    let (i, back) = ((side > 0.0) as usize, style.half - 5.3);
    let (open, back) = (style.open[i], back + style.setback[i]);
    let line = draw.range(6.9, 9.5) + back;
    let closed = draw.pick(&[0.35, 0.67, 0.85]);
    let mut z = style.begin + draw.range(0.0, 4.0);
    while z < style.end {
        let width = draw.range(5.0, 14.0);
        let front = if terrace { line + draw.range(-0.25, 0.25) } else { draw.range(6.7, 10.5) + back };
        let height = draw.range(low, high);
        let facade = facade(draw, walls, height, brick, shops);
        house(world, draw, side, front, z, width, facade);
        z += width;
        if open || !draw.chance(closed) {
            let gap = if open { draw.range(6.0, 35.0) } else { draw.range(1.0, 7.0) };
            let behind = if open { draw.range(14.0, 28.0) } else { 14.0 };
            fill(world, draw, style, [side, front, behind], z, gap);
            z += gap;
        }
    }
}

/// A house across the end of the street, somewhere in `range`.
pub(crate) fn across(world: &mut World, draw: &mut Draw, range: [f64; 2]) {
    let z = draw.range(range[0], range[1]);
    let mut x = -40.0;
    while x < 40.0 {
        let (width, height) = (draw.range(8.0, 16.0), draw.range(6.0, 13.0));
        let facade = facade(draw, DISTRICTS[0], height, false, 0.3);
        let shape = Shape::Box { low: [x, GROUND_Y - height, z], high: [x + width, GROUND_Y + 0.3, z + DEEP] };
        world.add(draw, shape, Material::Facade(facade), [x + 0.5 * width, GROUND_Y, z]);
        x += width;
    }
}

/// The walls of a district.
pub(crate) fn district(draw: &mut Draw) -> &'static [[f64; 3]] {
    draw.pick(&DISTRICTS)
}

/// The look of one house.
pub(crate) fn facade(draw: &mut Draw, walls: &[[f64; 3]], height: f64, brick: bool, shops: f64) -> Facade {
    let wall = draw.pick(walls);
    let sign =
        draw.pick(&[[0.45, 0.12, 0.12], [0.12, 0.26, 0.42], [0.14, 0.34, 0.24], [0.55, 0.42, 0.16], [0.2, 0.2, 0.22]]);
    let pitch = draw.range(1.9, 3.2);
    let storey = draw.range(2.7, 3.3);
    let shop = draw.chance(shops);
    let dark = draw.chance(0.2);
    Facade {
        wall: vary(draw, wall, 0.03, 0.07),
        trim: if dark {
            vary(draw, [0.34, 0.31, 0.29], 0.02, 0.06)
        } else {
            vary(draw, [0.78, 0.76, 0.72], 0.02, 0.09)
        },
        glass: vary(draw, [0.19, 0.23, 0.28], 0.03, 0.06),
        sign: vary(draw, sign, 0.05, 0.05),
        height: height as f32,
        ground_floor: if shop { draw.range(3.3, 3.8) } else { draw.range(2.8, 3.2) } as f32,
        storey: storey as f32,
        pitch: pitch as f32,
        window: [(pitch * draw.range(0.36, 0.58)) as f32, draw.range(1.15, 1.7) as f32],
        sill: draw.range(0.7, 0.95) as f32,
        shop,
        brick: brick && draw.chance(0.8),
        shutters: draw.chance(0.25),
    }
}

/// A house with its front `front` metres from the middle, from `z` on, `width` along the street.
pub(crate) fn house(world: &mut World, draw: &mut Draw, side: f64, front: f64, z: f64, width: f64, facade: Facade) {
    let height = facade.height as f64;
    let eaves = GROUND_Y - height;
    let (x0, x1) = beside(side, front, front + DEEP);
    let origin = [side * front, GROUND_Y, z + 0.5 * width];
    let walls = Shape::Box { low: [x0, eaves, z], high: [x1, GROUND_Y + 0.3, z + width] };
    world.add(draw, walls, Material::Facade(facade), origin);
    let mut total = height;
    if height < 10.0 && draw.chance(0.65) {
        let rise = draw.range(1.5, 3.5);
        total += 0.6 * rise;
        let tile = draw.pick(&[[0.45, 0.24, 0.18], [0.32, 0.30, 0.31], [0.38, 0.28, 0.23]]);
        let tile = Material::Tiles(vary(draw, tile, 0.02, 0.05));
        let over = 0.3;
        let bottom = [x0 - over, x1 + over, z, z + width];
        let ridge = 0.5 * (x0 + x1);
        let middle = z + 0.5 * width;
        // The ridge runs along the street, or the gable looks at it.
        let gable = width < 9.0 && draw.chance(0.4);
        let top = if gable { [x0, x1, middle - 0.1, middle + 0.1] } else { [ridge - 0.3, ridge + 0.3, z, z + width] };
        let bottom = if gable { [x0, x1, z - 0.2, z + width + 0.2] } else { bottom };
        let roof = Shape::Frustum { top_y: eaves - rise, top, bottom_y: eaves, bottom };
        world.add(draw, roof, tile, origin);
    }
    world.light.house((side > 0.0) as usize, z, z + width, total);
    // What juts out towards the street: the ground between the front and this is `near`.
    let out = |near: f64, y0: f64, y1: f64, a: f64, b: f64| {
        let (low, high) = beside(side, front - near, front + 0.1);
        Shape::Box { low: [low, GROUND_Y - y1, a], high: [high, GROUND_Y - y0, b] }
    };
    let floor = facade.ground_floor as f64;
    if facade.shop && draw.chance(0.5) {
        let near = draw.range(0.5, 1.0);
        let cloth = Material::Sign(facade.sign);
        world.add(draw, out(near, floor - 0.95, floor - 0.75, z + 0.5, z + width - 0.5), cloth, origin);
    }
    if draw.chance(0.35) && height > floor + 2.5 {
        let pitch = facade.pitch as f64;
        let every = draw.range(1.0, 2.5);
        let colour: Colour = facade.trim;
        let storeys = ((height - floor - 0.5) / facade.storey as f64) as usize;
        for storey in 0..storeys.min(4) {
            let up = floor + storey as f64 * facade.storey as f64;
            let mut k = -(width / (2.0 * pitch)) + 0.6;
            while k < width / (2.0 * pitch) - 0.6 {
                let at = origin[2] + libm::round(k) * pitch;
                let (a, b) = (at - 0.45 * pitch, at + 0.45 * pitch);
                if a > z && b < z + width {
                    world.add(draw, out(0.9, up - 0.1, up + 0.9, a, b), Material::Masonry(colour), origin);
                }
                k += 1.0 + every;
            }
        }
    }
}

/// What stands in a gap between houses: a hedge, a wall, trees behind, or nothing.
/// `behind` the front stand other houses; all in metres.
fn fill(world: &mut World, draw: &mut Draw, style: &Style, [side, front, behind]: [f64; 3], z: f64, gap: f64) {
    if draw.chance(0.7) {
        let height = draw.range(0.9, 2.2);
        let (low, high) = beside(side, front + 0.3, front + 1.0);
        let shape = Shape::Box { low: [low, GROUND_Y - height, z], high: [high, GROUND_Y, z + gap] };
        let material = if draw.chance(0.5) {
            Material::Leaves(style.foliage)
        } else {
            Material::Masonry(vary(draw, [0.55, 0.46, 0.40], 0.06, 0.08))
        };
        world.add(draw, shape, material, [low, GROUND_Y, z]);
    }
    if gap > 2.5 && draw.chance(0.2) {
        let x = side * (front + draw.range(2.5, 5.0));
        props::tree(world, draw, style, x, z + 0.5 * gap, 1.3);
    }
    // The houses of the next street close the view.
    let (low, high) = beside(side, front + behind, front + behind + 8.0);
    let height = draw.range(5.0, 11.0);
    let back = facade(draw, DISTRICTS[3], height, false, 0.0);
    let shape = Shape::Box { low: [low, GROUND_Y - height, z - 8.0], high: [high, GROUND_Y, z + gap + 8.0] };
    world.add(draw, shape, Material::Facade(back), [side * (front + behind), GROUND_Y, z]);
}
