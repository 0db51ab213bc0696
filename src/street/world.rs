//! A street: its solids, its light, and the shade below its cars. `build` fills it.

use super::draw::Draw;
use super::light::{BEHIND, Light};
use super::shape::Shape;
use super::surface::Material;
use super::texture::Colour;

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
    /// How fast the road bends to the right, in 1/m.
    pub(crate) bend: f64,
    /// How thick dust lies: 1 in the embedded street, less in the wide world.
    pub(crate) wear: f32,
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
    /// A street with nothing in it.
    pub(crate) fn empty(lane: f64, room: f64, light: Light) -> Self {
        World {
            lane,
            room,
            light,
            bend: 0.0,
            wear: 1.0,
            solids: Vec::new(),
            shade: [Vec::new(), Vec::new()],
            movers: Vec::new(),
        }
    }

    /// The footprints of what is parked.
    #[cfg(test)]
    pub(crate) fn parked(&self) -> impl Iterator<Item = Footprint> {
        self.shade.iter().flatten().flatten().flatten().copied()
    }

    /// Puts a solid with a texture of its own into the street.
    pub(crate) fn add(&mut self, draw: &mut Draw, shape: Shape, material: Material, origin: [f64; 3]) {
        // 24 bits, so that materials may count up from it.
        let seed = draw.bits() >> 8;
        self.solids.push(Solid { shape, material, origin, seed, speed: 0.0 });
    }

    /// Moves the solids from the number `first` on by `by` metres to the right.
    pub(crate) fn shift(&mut self, first: usize, by: f64) {
        for solid in &mut self.solids[first..] {
            solid.shape = solid.shape.sideways(by);
            solid.origin[0] += by;
        }
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
