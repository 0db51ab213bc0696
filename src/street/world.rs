//! What stands where: one sequence's street, from its generator.

use super::camera::FASTEST;
use super::draw::Draw;
use super::houses;
use super::light::{BEHIND, GROUND, Light};
use super::props;
use super::shape::{FAR, Shape};
use super::surface::{Colour, Material, Road};

/// One thing with one surface.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Solid {
    pub(crate) shape: Shape,
    pub(crate) material: Material,
    /// The origin of its texture in the world.
    pub(crate) origin: [f64; 3],
    pub(crate) seed: u32,
    /// How far it moves along the street, in metres a frame; 0 for what stands.
    pub(crate) speed: f64,
}

/// The footprint of a car on the road, `[x0, x1, z0, z1]`, for the shade below it.
pub(crate) type Footprint = [f64; 4];

/// A street.
pub(crate) struct World {
    /// The middle of the lane that the camera's car keeps to, in metres from the middle of the road.
    pub(crate) lane: f64,
    /// How far the camera may stray from there, in metres.
    pub(crate) room: f64,
    pub(crate) light: Light,
    pub(crate) solids: Vec<Solid>,
    /// The footprints of what is parked, by metres from -[`BEHIND`], left and right: at most two reach into a metre.
    shade: [Vec<[Option<Footprint>; 2]>; 2],
    /// The footprints of what moves, and their speeds.
    movers: Vec<(Footprint, f64)>,
}

/// What a sequence has its own of, besides the houses.
pub(crate) struct Style {
    /// Half the road between the kerbs, in metres.
    pub(crate) half: f64,
    /// How far the houses stand back behind the pavement, left and right, in metres.
    pub(crate) setback: [f64; 2],
    /// Whether a side is built on here and there only.
    pub(crate) open: [bool; 2],
    /// Where the street begins and ends, in metres.
    pub(crate) begin: f64,
    pub(crate) end: f64,
    /// Longest gap between parked cars, left and right, and between trees (0 for none), in metres.
    pub(crate) car_gap: [f64; 2],
    pub(crate) tree_gap: f64,
    pub(crate) foliage: Colour,
}

/// A colour with each channel moved by up to `by`, all together by up to `tone`.
pub(crate) fn vary(draw: &mut Draw, colour: [f64; 3], by: f64, tone: f64) -> Colour {
    let all = draw.range(-tone, tone);
    colour.map(|c| (c + all + draw.range(-by, by)).clamp(0.03, 0.95) as f32)
}

impl World {
    /// The street of a sequence of `frames` frames.
    pub(crate) fn new(draw: &mut Draw, frames: usize, moving_cars: bool) -> Self {
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
        let mut world =
            World { lane, room, light, solids: Vec::new(), shade: [Vec::new(), Vec::new()], movers: Vec::new() };
        world.ground(draw, &style);
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
    fn ground(&mut self, draw: &mut Draw, style: &Style) {
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
        self.add(draw, shape, Material::Road(road), [0.0, GROUND as f64, 0.0]);
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
            self.add(draw, shape, material, [0.0, GROUND as f64, 0.0]);
        }
    }

    /// Puts a solid with a texture of its own into the street.
    pub(crate) fn add(&mut self, draw: &mut Draw, shape: Shape, material: Material, origin: [f64; 3]) {
        // 24 bits, so that materials may count up from it.
        let seed = draw.bits() >> 8;
        self.solids.push(Solid { shape, material, origin, seed, speed: 0.0 });
    }

    /// Notes the shade below a parked or a moving car.
    pub(crate) fn darken(&mut self, footprint: Footprint, speed: f64) {
        if speed != 0.0 {
            self.movers.push((footprint, speed));
            return;
        }
        let [x0, x1, z0, z1] = footprint;
        let bins = &mut self.shade[(x0 + x1 > 0.0) as usize];
        let bin = |z: f64| (z + BEHIND).max(0.0) as usize;
        let (first, last) = (bin(z0 - REACH), bin(z1 + REACH));
        if bins.len() < last + 1 {
            bins.resize(last + 1, [None; 2]);
        }
        for slots in &mut bins[first..=last] {
            if let Some(free) = slots.iter_mut().find(|slot| slot.is_none()) {
                *free = Some(footprint);
            }
        }
    }

    /// How much of the sky's light reaches a point of the road past the cars above and beside it, at a frame.
    pub(crate) fn open(&self, p: [f32; 3], frame: usize) -> f32 {
        let bins = &self.shade[(p[0] > 0.0) as usize];
        let bin = bins.get((p[2] + BEHIND as f32).max(0.0) as usize);
        let mut light = 1.0;
        for footprint in bin.into_iter().flatten().flatten() {
            light *= under(*footprint, p);
        }
        for &([x0, x1, z0, z1], speed) in &self.movers {
            let by = speed * frame as f64;
            light *= under([x0, x1, z0 + by, z1 + by], p);
        }
        light
    }
}

/// From a parked car's side to the camera: half a car of its own, and what a careful driver leaves.
const CLEARANCE: f64 = 1.45;
/// From bumper to bumper, to hardly a car.
const CAR_GAPS: [f64; 6] = [3.0, 4.0, 7.0, 10.0, 14.0, 30.0];
/// Leaves and paving, before they vary.
const GREEN: [f64; 3] = [0.27, 0.37, 0.17];
const STONE: [f64; 3] = [0.56, 0.54, 0.51];

/// How far the shade of a car reaches beside it, in metres.
const REACH: f64 = 0.7;

fn under(footprint: Footprint, p: [f32; 3]) -> f32 {
    let [x0, x1, z0, z1] = footprint.map(|x| x as f32);
    let dx = (x0 - p[0]).max(p[0] - x1).max(0.0);
    let dz = (z0 - p[2]).max(p[2] - z1).max(0.0);
    let t = ((dx * dx + dz * dz).sqrt() / REACH as f32).min(1.0);
    0.3 + 0.7 * t * (2.0 - t)
}

/// The x range of something between `near` and `far` of the middle, on a side.
pub(crate) fn across(side: f64, near: f64, far: f64) -> (f64, f64) {
    if side > 0.0 { (near, far) } else { (-far, -near) }
}

#[cfg(test)]
mod tests {
    use super::super::camera::drive;
    use super::props::HALF_CAR;
    use super::*;

    /// The camera looks out of a car that is as wide as others.
    #[test]
    fn the_camera_scrapes_no_parked_car() {
        for seed in 0..300 {
            let world = World::new(&mut Draw::new(seed, 0, 1), 10, false);
            for pose in drive(&mut Draw::new(seed, 0, 2), 10, world.lane, world.room, false) {
                for [x0, x1, z0, z1] in world.shade.iter().flatten().flatten().flatten() {
                    if (z0 - 2.0..z1 + 2.0).contains(&pose.position[2]) {
                        let clear = (x0 - pose.position[0]).max(pose.position[0] - x1);
                        assert!(clear > HALF_CAR + 0.1, "seed {seed}: {clear:.2} m from the camera to a car's side");
                    }
                }
            }
        }
    }
}
