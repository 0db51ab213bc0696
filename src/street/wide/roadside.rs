//! Things beside the road: lamps, signs, rails, hedges, fences, trees and the lines of them that close the view.

use super::super::draw::Draw;
use super::super::light::GROUND;
use super::super::shape::Shape;
use super::super::surface::Material;
use super::super::texture::Colour;
use super::super::world::{World, across, vary};
use super::Look;

const GROUND_Y: f64 = GROUND as f64;

fn pole(world: &mut World, draw: &mut Draw, [x, z]: [f64; 2], radius: f64, height: f64, colour: Colour) {
    let shape = Shape::Pole { x, z, radius, top_y: GROUND_Y - height, bottom_y: GROUND_Y };
    world.add(draw, shape, Material::Wide(Look::Smooth(colour)), [x, GROUND_Y, z]);
}

/// A lamp post, a sign, a bollard or a cabinet at `x`.
pub(super) fn post(world: &mut World, draw: &mut Draw, x: f64, z: f64) {
    let metal = vary(draw, [0.42, 0.43, 0.43], 0.02, 0.15);
    match draw.pick(&[0, 0, 1, 1, 2, 3]) {
        0 => {
            let height = draw.range(4.5, 8.5);
            pole(world, draw, [x, z], draw_radius(height), height, metal);
            let reach = -x.signum() * draw.range(0.3, 1.8);
            let (a, b) = (x.min(x + reach), x.max(x + reach));
            let arm = Shape::Box {
                low: [a, GROUND_Y - height - 0.05, z - 0.08],
                high: [b, GROUND_Y - height + 0.07, z + 0.08],
            };
            world.add(draw, arm, Material::Wide(Look::Smooth(metal)), [x, GROUND_Y, z]);
        }
        1 => {
            let height = draw.range(2.2, 3.2);
            pole(world, draw, [x, z], 0.035, height, metal);
            let tint = draw.pick(&[[0.70, 0.10, 0.10], [0.08, 0.2, 0.55], [0.85, 0.75, 0.15], [0.8, 0.8, 0.8]]);
            let (half, tall) = (draw.range(0.25, 0.4), draw.range(0.4, 0.8));
            let low = [x - half, GROUND_Y - height, z - 0.06];
            let board = Shape::Box { low, high: [x + half, GROUND_Y - height + tall, z - 0.035] };
            let colour = vary(draw, tint, 0.03, 0.05);
            world.add(draw, board, Material::Sign(colour), [x, GROUND_Y - height, z]);
        }
        2 => pole(world, draw, [x, z], 0.06, 1.0, vary_bollard(metal)),
        _ => {
            let (half, tall) = (draw.range(0.2, 0.45), draw.range(0.8, 1.5));
            let low = [x - half, GROUND_Y - tall, z - half];
            let cabinet = Shape::Box { low, high: [x + half, GROUND_Y, z + half] };
            let tint = draw.pick(&[[0.5, 0.52, 0.48], [0.2, 0.26, 0.2], [0.65, 0.55, 0.15], [0.25, 0.25, 0.26]]);
            world.add(draw, cabinet, Material::Wide(Look::Smooth(vary_of(tint))), [x, GROUND_Y, z]);
        }
    }
}

fn draw_radius(height: f64) -> f64 {
    0.04 + 0.007 * height
}

fn vary_bollard(metal: Colour) -> Colour {
    metal.map(|c| 0.6 * c)
}

fn vary_of(tint: [f64; 3]) -> Colour {
    tint.map(|c| c as f32)
}

/// A guard rail on posts, from `z` on, `length` long.
pub(super) fn rail(world: &mut World, draw: &mut Draw, x: f64, z: f64, length: f64) {
    let metal = vary(draw, [0.52, 0.53, 0.54], 0.01, 0.06);
    let shape = Shape::Box { low: [x - 0.05, GROUND_Y - 0.78, z], high: [x + 0.05, GROUND_Y - 0.45, z + length] };
    world.add(draw, shape, Material::Wide(Look::Smooth(metal)), [x, GROUND_Y, z]);
    let mut at = z + 1.0;
    while at < z + length {
        pole(world, draw, [x, at], 0.05, 0.7, metal);
        at += 2.0;
    }
}

/// A hedge, a wall or a fence along `x`, from `z` on.
pub(super) fn border(world: &mut World, draw: &mut Draw, x: f64, z: f64, length: f64, green: Colour) {
    let kind = draw.pick(&[0, 0, 1, 2]);
    let (height, thick) = match kind {
        0 => (draw.range(0.9, 2.4), 0.9),
        1 => (draw.range(0.6, 2.0), 0.25),
        _ => (draw.range(0.9, 1.8), 0.06),
    };
    let (low, high) = across(x.signum(), x.abs(), x.abs() + thick);
    let shape = Shape::Box { low: [low, GROUND_Y - height, z], high: [high, GROUND_Y, z + length] };
    let material = match kind {
        0 => Material::Leaves(vary(draw, green.map(f64::from), 0.02, 0.03)),
        1 => Material::Masonry(vary(draw, [0.56, 0.52, 0.47], 0.04, 0.12)),
        _ => Material::Wide(Look::Windows {
            paint: vary(draw, [0.40, 0.36, 0.30], 0.03, 0.2),
            low: 0.1,
            high: height as f32 - 0.1,
            pitch: 0.24,
        }),
    };
    world.add(draw, shape, material, [x, GROUND_Y, z]);
}

/// A tree with a crown of several balls of leaves; `size` 1 is some 6 m high.
pub(super) fn tree(world: &mut World, draw: &mut Draw, [x, z]: [f64; 2], size: f64, green: Colour) {
    let size = size * draw.range(0.75, 1.3);
    let bare = size * draw.range(1.6, 2.6);
    let bark = vary(draw, [0.24, 0.20, 0.17], 0.02, 0.06);
    let radius = size * draw.range(0.1, 0.17);
    pole(world, draw, [x, z], radius, bare + 1.5 * size, bark);
    let green = vary(draw, green.map(f64::from), 0.03, 0.04);
    let slim = draw.range(0.7, 1.1);
    for k in 0..5 {
        let (spread, r) = if k == 0 { (0.0, 1.6) } else { (1.0, draw.range(0.7, 1.2)) };
        let centre = [
            x + size * slim * draw.range(-spread, spread),
            GROUND_Y - bare - size * (1.1 + draw.range(-0.4, 1.4) * spread),
            z + size * slim * draw.range(-spread, spread),
        ];
        let radii = [slim * r, r, slim * r].map(|r| r * size);
        let seed = draw.bits() >> 8;
        world.add(draw, Shape::Crown { centre, radii, seed }, Material::Leaves(green), centre);
    }
}

/// A dense line of trees from `z` on: trunks in the dark below crowns that run together.
pub(super) fn tree_line(world: &mut World, draw: &mut Draw, side: f64, near: f64, z: f64, length: f64, green: Colour) {
    let height = draw.range(4.0, 11.0);
    let (low, high) = across(side, near + 1.5, near + 6.0);
    let dark = green.map(|c| 0.55 * c);
    let shape = Shape::Box { low: [low, GROUND_Y - 0.6 * height, z], high: [high, GROUND_Y, z + length] };
    world.add(draw, shape, Material::Leaves(dark), [low, GROUND_Y, z]);
    let mut at = z;
    while at < z + length {
        let r = draw.range(1.6, 3.2);
        let x = side * (near + draw.range(1.2, 3.5));
        let centre = [x, GROUND_Y - draw.range(0.35, 0.85) * height, at + 0.5 * r];
        let seed = draw.bits() >> 8;
        let tone = vary(draw, green.map(f64::from), 0.02, 0.05);
        let crown = Shape::Crown { centre, radii: [r, r * draw.range(0.9, 1.5), r], seed };
        world.add(draw, crown, Material::Leaves(tone), centre);
        if draw.chance(0.3) {
            let radius = draw.range(0.08, 0.2);
            pole(world, draw, [side * (near + 0.6), at], radius, 0.6 * height, [0.2, 0.17, 0.14]);
        }
        at += r * draw.range(0.7, 1.3);
    }
    world.light.house((side > 0.0) as usize, z, z + length, 0.8 * height);
}
