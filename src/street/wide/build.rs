//! The layout of a wide sequence: where everything stands.

use super::super::draw::Draw;
use super::super::houses;
use super::super::light::{GROUND, Light};
use super::super::shape::{FAR, Shape};
use super::super::surface::{Material, Road};
use super::super::texture::Colour;
use super::super::world::{World, vary};
use super::look::Ground;
use super::ride::FASTEST;
use super::vehicles::{Spot, vehicle};
use super::{Look, people, roadside};

/// The kinds of road.
#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Residential,
    City,
    Country,
    Motorway,
}

/// The equipment of a side of the road.
struct Side {
    side: f64,
    half: f64,
    pavement: f64,
    /// Longest gap between parked cars, in metres; 0 for none.
    cars: f64,
    /// Mean distance between people, posts and trees, in metres; 0 for none.
    people: f64,
    posts: f64,
    trees: f64,
    border: bool,
    rail: bool,
    /// Where houses, or a line of trees, stand: from the middle of the road.
    front: f64,
    houses: f64,
    closed: f64,
    height: [f64; 2],
    green: Colour,
    begin: f64,
    end: f64,
    bend: f64,
}

/// The world of a sequence of `frames` frames.
pub(crate) fn wide_street(draw: &mut Draw, frames: usize, moving: bool) -> World {
    use Kind::{City, Country, Motorway, Residential};
    let kind = draw.pick(&[Residential, Residential, Residential, City, City, Country, Country, Motorway]);
    let half = match kind {
        Residential => draw.range(3.2, 6.0),
        City => draw.range(4.5, 8.5),
        Country => draw.range(3.0, 4.5),
        Motorway => draw.range(6.5, 11.5),
    };
    let moving = moving && (kind != Residential || draw.chance(0.5));
    // What drives goes straight ahead, so only an empty road bends.
    let bend = if moving || draw.chance(0.4) { 0.0 } else { draw.normal(0.0022).clamp(-0.005, 0.005) };
    let green = vary(draw, [0.20, 0.27, 0.12], 0.05, 0.07);
    let end = frames as f64 * FASTEST + FAR as f64;
    let sides = [-1.0, 1.0].map(|side| a_side(draw, kind, side, half, green, end, bend));
    // The nearest of what is high beside the road casts the shadows on it.
    let light = Light::new(draw, [sides[0].front, sides[1].front]);
    let glare = if draw.chance(0.65) { draw.range(0.3, 1.0) } else { 0.0 };
    let light = light.glaring(glare as f32);
    // The camera's lane is the one right of the middle, where there is room for two.
    let lane = if half < 4.2 { draw.range(-0.3, 0.5) } else { draw.range(0.25, 0.5) * half };
    let parked = sides[1].cars > 0.0;
    let lane = if parked { lane.min(half - 2.1 - 1.9).max(-0.3) } else { lane };
    let mut world = World::empty(lane, 0.3, light);
    world.wear = draw.pick(&[0.0, 0.15, 0.3, 0.5]);
    world.bend = bend;
    ground(&mut world, draw, kind, &sides[0]);
    for side in &sides {
        line(&mut world, draw, side);
    }
    if draw.chance(0.5) {
        let z = end - draw.range(10.0, 60.0);
        for k in -6..6 {
            let first = world.solids.len();
            roadside::tree_line(&mut world, draw, 1.0, 0.0, z, 3.0, green);
            world.shift(first, k as f64 * 6.0);
        }
    }
    if moving {
        traffic(&mut world, draw, frames, half, kind == Motorway);
    }
    world
}

fn a_side(draw: &mut Draw, kind: Kind, side: f64, half: f64, green: Colour, end: f64, bend: f64) -> Side {
    let built = match kind {
        Kind::Residential => 0.85,
        Kind::City => 0.9,
        Kind::Country => 0.15,
        Kind::Motorway => 0.1,
    };
    let town = matches!(kind, Kind::Residential | Kind::City);
    let pavement = if town && draw.chance(0.9) { draw.range(1.2, 3.5) } else { 0.0 };
    let garden = match kind {
        Kind::City => draw.range(0.0, 2.0),
        Kind::Residential => draw.range(0.5, 8.0),
        _ => draw.range(2.0, 14.0),
    };
    let wide_enough = half > 3.9;
    let cars = if town && wide_enough && draw.chance(0.75) { draw.pick(&[1.5, 2.5, 4.0, 10.0, 25.0]) } else { 0.0 };
    Side {
        side,
        half,
        pavement,
        cars,
        people: if town && draw.chance(0.5) { draw.range(6.0, 30.0) } else { 0.0 },
        posts: if draw.chance(0.85) { draw.range(6.0, 24.0) } else { 0.0 },
        trees: if draw.chance(0.5) { draw.range(5.0, 16.0) } else { 0.0 },
        border: draw.chance(if kind == Kind::Residential { 0.7 } else { 0.3 }),
        rail: draw.chance(if kind == Kind::Motorway {
            0.8
        } else if kind == Kind::Country {
            0.25
        } else {
            0.0
        }),
        front: half + pavement + 0.6 + garden,
        houses: if draw.chance(built) { 1.0 } else { 0.0 },
        closed: draw.pick(&[0.3, 0.6, 0.9]),
        height: if kind == Kind::City { [8.0, 16.0] } else { [4.0, 9.0] },
        green,
        begin: -14.0,
        end,
        bend,
    }
}

fn ground(world: &mut World, draw: &mut Draw, kind: Kind, side: &Side) {
    let marked = kind != Kind::Residential || draw.chance(0.35);
    let solid = draw.chance(0.2);
    let lanes = if kind == Kind::Motorway { draw.range(1.7, 2.0) } else { side.half + 5.0 };
    let grey = draw.range(0.25, 0.52);
    let road = Road {
        colour: vary(draw, [grey, grey, grey + 0.01], 0.012, 0.0),
        half: side.half as f32,
        lane: lanes as f32,
        period: if solid { 1e6 } else { draw.pick(&[5.0, 9.0, 12.0, 18.0]) },
        dash: if solid { 1e6 } else { draw.pick(&[2.0, 3.0, 4.0]) },
        width: draw.range(0.1, 0.16) as f32,
        bays: kind == Kind::City && draw.chance(0.2),
        crossing: if draw.chance(0.2) { draw.range(8.0, 60.0) as f32 } else { -1e4 },
        grain: draw.range(0.1, 0.6) as f32,
        tracks: draw.range(0.0, 0.2) as f32,
        repairs: draw.range(0.03, 0.3) as f32,
    };
    let stone = draw.range(0.42, 0.68);
    let field = draw.pick(&[[0.26, 0.33, 0.15], [0.30, 0.35, 0.18], [0.42, 0.38, 0.26], [0.45, 0.43, 0.40]]);
    let ground = Ground {
        road,
        bend: side.bend as f32,
        pavement: side.pavement as f32,
        stone: vary(draw, [stone, 0.98 * stone, 0.95 * stone], 0.02, 0.0),
        field: vary(draw, field, 0.03, 0.05),
        edges: marked && draw.chance(0.6),
        middle: marked && kind != Kind::Motorway,
    };
    let y = GROUND as f64;
    world.add(draw, Shape::Ground { y }, Material::Wide(Look::Ground(ground)), [0.0, y, 0.0]);
}

/// Everything along one side.
fn line(world: &mut World, draw: &mut Draw, s: &Side) {
    // Puts something every so often; `each` gives how long it is.
    let along =
        |world: &mut World, draw: &mut Draw, gap: [f64; 2], each: &mut dyn FnMut(&mut World, &mut Draw, f64) -> f64| {
            let mut z = s.begin + draw.range(0.0, gap[1]);
            while z < s.end {
                let first = world.solids.len();
                z += each(world, draw, z) + draw.range(gap[0], gap[1]);
                world.shift(first, 0.5 * s.bend * z * z);
            }
        };
    let kerb = s.side * (s.half + 0.35);
    if s.cars > 0.0 {
        let x = s.side * (s.half - 1.05);
        let rather = draw.chance(0.85);
        along(world, draw, [0.7, s.cars], &mut |world, draw, z| {
            let away = draw.chance(0.9) == ((s.side > 0.0) == rather);
            let spot = Spot { x: x + draw.range(-0.15, 0.15), z, away, speed: 0.0 };
            vehicle(world, draw, spot, 0.02)
        });
    }
    if s.people > 0.0 && s.pavement > 0.0 {
        along(world, draw, [1.0, 2.0 * s.people], &mut |world, draw, z| {
            let x = s.side * (s.half + draw.range(0.4, 0.4 + s.pavement));
            people::person(world, draw, x, z);
            0.5
        });
    }
    if s.posts > 0.0 {
        along(world, draw, [3.0, 2.0 * s.posts], &mut |world, draw, z| {
            let x = kerb + s.side * draw.range(0.0, 0.5);
            roadside::post(world, draw, x, z);
            0.0
        });
    }
    if s.trees > 0.0 {
        along(world, draw, [3.0, 2.0 * s.trees], &mut |world, draw, z| {
            let x = s.side * draw.range(s.half + 0.9, s.front.max(s.half + 1.5));
            roadside::tree(world, draw, [x, z], 1.0, s.green);
            0.0
        });
    }
    if s.rail {
        along(world, draw, [0.0, 0.0001], &mut |world, draw, z| {
            roadside::rail(world, draw, s.side * (s.half + 0.6), z, 8.0);
            8.0
        });
    }
    if s.border {
        along(world, draw, [0.0, 3.0], &mut |world, draw, z| {
            let length = draw.range(3.0, 14.0);
            roadside::border(world, draw, s.side * (s.half + s.pavement + 0.3), z, length, s.green);
            length
        });
    }
    let walls = houses::district(draw);
    let brick = draw.chance(0.25);
    along(world, draw, [0.0, 0.5], &mut |world, draw, z| {
        let length = draw.range(6.0, 15.0);
        if s.houses > 0.0 && draw.chance(s.closed) {
            let height = draw.range(s.height[0], s.height[1]);
            let facade = houses::facade(draw, walls, height, brick, if s.height[0] > 6.0 { 0.4 } else { 0.05 });
            let front = s.front + 0.5 + draw.range(-0.3, 0.6);
            houses::house(world, draw, s.side, front, z, length, facade);
        } else if draw.chance(0.75) {
            let back = if s.houses > 0.0 { 2.0 } else { draw.range(0.0, 10.0) };
            roadside::tree_line(world, draw, s.side, s.front + back, z, length, s.green);
        }
        length
    });
    // The view ends somewhere.
    along(world, draw, [0.0, 12.0], &mut |world, draw, z| {
        let length = draw.range(10.0, 24.0);
        roadside::tree_line(world, draw, s.side, s.front + 24.0, z, length, s.green);
        length
    });
}

/// Traffic: ahead at about the camera's speed, and towards it.
fn traffic(world: &mut World, draw: &mut Draw, frames: usize, half: f64, motorway: bool) {
    let heavy = if motorway { 0.3 } else { 0.1 };
    let mut z = draw.range(7.0, 30.0);
    for _ in 0..draw.pick(&[0, 1, 1, 2, 3]) {
        let lane = if motorway && draw.chance(0.5) { world.lane - 3.5 } else { world.lane };
        let spot = Spot { x: lane + draw.range(-0.2, 0.2), z, away: true, speed: draw.range(0.6, 1.4) };
        z += vehicle(world, draw, spot, heavy) + draw.range(6.0, 30.0) + 0.5 * frames as f64;
    }
    if half < 4.2 || motorway {
        return;
    }
    let mut z = draw.range(10.0, 50.0);
    while z < 60.0 + 2.0 * frames as f64 {
        let spot = Spot {
            x: -world.lane.max(1.8).min(half - 1.2) + draw.range(-0.2, 0.2),
            z,
            away: false,
            speed: -draw.range(0.7, 1.3),
        };
        z += vehicle(world, draw, spot, heavy) + draw.range(14.0, 60.0);
    }
}
