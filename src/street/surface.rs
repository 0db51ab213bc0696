//! What surfaces look like: asphalt with its marks, pavements, façades, cars, leaves. Colours are in display space,
//! 0 to 1, before the light.

use super::light::GROUND;
use super::texture::{Colour, Patch, band, fade, floor, hash, hash_unit, mix, noise3, pulse, pulse_centred, scale};
use super::weather::{faintly_weathered, weathered};

/// A point of a surface, with all that its look depends on.
pub(crate) struct Point {
    /// Where it is in the world, in metres.
    pub(crate) world: [f32; 3],
    /// Where it is in the object's own frame, in metres; moves with the object.
    pub(crate) local: [f32; 3],
    /// The footprint of a pixel on the surface, along each axis of the world.
    pub(crate) footprint: [f32; 3],
    /// The axis closest to the normal.
    pub(crate) axis: usize,
    /// The unit normal, towards the eye.
    pub(crate) normal: [f32; 3],
}

impl Point {
    /// The two axes of the texture: along the street or across it, and up (or along).
    pub(crate) fn patch(&self) -> Patch {
        let (a, b) = match self.axis {
            0 => (2, 1),
            1 => (0, 2),
            _ => (0, 1),
        };
        Patch { u: self.local[a], v: self.local[b], du: self.footprint[a], dv: self.footprint[b] }
    }

    /// Height above the ground, in metres.
    pub(crate) fn height(&self) -> f32 {
        GROUND - self.world[1]
    }
}

/// The look of a house's walls.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Facade {
    pub(crate) wall: Colour,
    pub(crate) trim: Colour,
    pub(crate) glass: Colour,
    pub(crate) sign: Colour,
    /// Height of the house to its eaves, of the ground floor, and of a storey.
    pub(crate) height: f32,
    pub(crate) ground_floor: f32,
    pub(crate) storey: f32,
    /// Distance between windows, their width and height, and how high they sit.
    pub(crate) pitch: f32,
    pub(crate) window: [f32; 2],
    pub(crate) sill: f32,
    pub(crate) shop: bool,
    pub(crate) brick: bool,
    pub(crate) shutters: bool,
}

/// The look of a car.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Car {
    pub(crate) paint: Colour,
    /// Half its length, and where its wheels are from its middle, in metres.
    pub(crate) half: f32,
    pub(crate) axles: [f32; 2],
    /// Whether the rear is towards -z.
    pub(crate) away: bool,
}

/// The look of the road.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Road {
    pub(crate) colour: Colour,
    /// Half its width between the kerbs.
    pub(crate) half: f32,
    /// Where the lane marks are, their period, length and width; no length for none.
    pub(crate) lane: f32,
    pub(crate) period: f32,
    pub(crate) dash: f32,
    pub(crate) width: f32,
    /// Parking bays marked off, or not.
    pub(crate) bays: bool,
    /// Where a pedestrian crossing is, if anywhere near.
    pub(crate) crossing: f32,
    /// Strength of the grain, of the wheels' tracks and of the repairs.
    pub(crate) grain: f32,
    pub(crate) tracks: f32,
    pub(crate) repairs: f32,
}

/// What a surface is made of.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Material {
    Road(Road),
    Pavement {
        stone: Colour,
        yard: Colour,
        slab: f32,
        edge: f32,
    },
    Facade(Facade),
    Tiles(Colour),
    Body(Car),
    Cabin(Car),
    Wheel,
    /// Something of one colour, with some grain: poles, trunks, undersides.
    Plain(Colour),
    Leaves(Colour),
    Masonry(Colour),
    Sign(Colour),
    /// A surface of the wide world.
    Wide(super::wide::Look),
}

impl Material {
    /// The colour at a point, before the light.
    pub(crate) fn colour(&self, p: &Point, seed: u32) -> Colour {
        let clean = self.clean(p, seed);
        match self {
            // Leaves are patches all over.
            Material::Leaves(_) => clean,
            _ => weathered(clean, &p.patch(), seed.wrapping_add(900)),
        }
    }

    /// The colour at a point of the wide world, where dust lies as thick as `wear` says: 0 for none, 1 for all of
    /// [`weathered`].
    pub(crate) fn worn(&self, p: &Point, seed: u32, wear: f32) -> Colour {
        let clean = self.clean(p, seed);
        match self {
            Material::Leaves(_) | Material::Wide(_) => clean,
            _ => faintly_weathered(clean, &p.patch(), seed.wrapping_add(900), wear),
        }
    }

    fn clean(&self, p: &Point, seed: u32) -> Colour {
        match self {
            Material::Road(road) => road.colour(p, seed),
            Material::Pavement { stone, yard, slab, edge } => pavement(p, *stone, *yard, *slab, *edge, seed),
            Material::Facade(facade) => facade.colour(p, seed),
            Material::Tiles(colour) => tiles(p, *colour, seed),
            Material::Body(car) => car.body(p, seed),
            Material::Cabin(car) => car.cabin(p, seed),
            Material::Wheel => wheel(p, seed),
            Material::Plain(colour) => {
                scale(*colour, 1.0 + p.patch().octaves(&[(1.3, 0.35), (4.0, 0.35), (11.0, 0.3)], seed))
            }
            Material::Leaves(colour) => leaves(p, *colour, seed),
            Material::Wide(look) => look.colour(p, seed),
            Material::Masonry(colour) => masonry(&p.patch(), *colour, seed),
            Material::Sign(colour) => {
                let patch = p.patch();
                let mark = pulse(patch.v, 0.3, 0.12, patch.dv) * pulse(patch.u, 0.37, 0.25, patch.du);
                scale(mix(*colour, [0.95, 0.95, 0.93], mark), 1.0 + patch.octaves(&[(2.0, 0.2), (7.0, 0.2)], seed))
            }
        }
    }
}

const WHITE: Colour = [0.86, 0.86, 0.84];

impl Road {
    pub(crate) fn colour(&self, p: &Point, seed: u32) -> Colour {
        let patch = p.patch();
        let Patch { u: x, v: z, du: fx, dv: fz } = patch;
        // Grain at several scales; along the street it is drawn out, as wear is, and outlives the grazing footprint.
        let mut tone = 1.0
            + self.grain
                * patch
                    .octaves(&[(0.35, 0.20), (0.9, 0.22), (2.3, 0.26), (6.0, 0.30), (17.0, 0.30), (45.0, 0.25)], seed);
        tone += self.grain * (0.28 * patch.grain(1.7, 0.12, seed + 11) + 0.22 * patch.grain(4.3, 0.35, seed + 12));
        tone += self.grain * 0.35 * patch.grain(0.22, 0.09, seed + 13);
        let tracks = band(x.abs(), 0.5, 1.05, fx.max(0.35));
        if tracks > 0.0 {
            tone -= self.tracks * tracks * (0.8 + patch.grain(0.5, 0.2, seed + 14));
        }
        tone *= self.repair(&patch, seed);
        let mut colour = scale(self.colour, tone);
        // The gutter, and leaves and dust in it.
        let gutter = band(x.abs(), self.half - 0.35, self.half, fx.max(0.1));
        if gutter > 0.0 {
            colour = mix(colour, [0.5, 0.48, 0.44], gutter * (0.5 + 0.6 * patch.grain(3.0, 1.3, seed + 15)));
        }
        let line = |at: f32| band(x.abs(), at - 0.5 * self.width, at + 0.5 * self.width, fx);
        let mut paint = line(self.lane) * pulse(z, self.period, self.dash, fz);
        if self.bays {
            let across = band(x.abs(), self.half - 2.2, self.half, fx) * pulse(z, 6.5, 0.12, fz);
            paint = paint.max(line(self.half - 2.2)).max(across);
        }
        let stripes = band(z, self.crossing, self.crossing + 3.2, fz) * pulse(x + 20.0, 1.0, 0.5, fx);
        paint = paint.max(stripes);
        if paint > 0.0 {
            // Worn in places.
            let wear = (0.85 + 1.1 * patch.octaves(&[(0.8, 0.5), (3.1, 0.5)], seed + 20)).clamp(0.2, 1.0);
            colour = mix(colour, WHITE, paint * wear);
        }
        colour
    }

    /// Dark and light rectangles of newer and older asphalt, and covers.
    fn repair(&self, patch: &Patch, seed: u32) -> f32 {
        let (width, length) = (3.6, 9.0);
        let (i, j) = (floor(patch.u / width), floor(patch.v / length));
        let strength = fade(patch.dv / 6.0);
        let h = hash(i, j, seed + 30);
        if strength <= 0.0 || h % 100 >= 55 {
            return 1.0;
        }
        let (a, b) = (hash_unit(i, j, seed + 31), hash_unit(i, j, seed + 32));
        let (u, v) = (patch.u - i as f32 * width, patch.v - j as f32 * length);
        let inside =
            band(u, 1.2 * a, 1.2 * a + 0.7 + 1.6 * b, patch.du) * band(v, 4.0 * b, 4.0 * b + 1.0 + 3.8 * a, patch.dv);
        let depth = if h & 128 == 0 { -self.repairs } else { 0.7 * self.repairs };
        let mut tone = 1.0 + strength * depth * inside;
        if h & 256 != 0 {
            let (cu, cv) = (u - 0.6 - 2.2 * b, v - 1.0 - 6.5 * a);
            let f = patch.du.max(patch.dv);
            let r = (cu * cu + cv * cv).sqrt();
            tone *= 1.0 - 0.5 * band(r, -1.0, 0.33, f) * fade(f / 0.8);
        }
        tone
    }
}

fn pavement(p: &Point, stone: Colour, yard: Colour, slab: f32, edge: f32, seed: u32) -> Colour {
    let patch = p.patch();
    if p.axis != 1 {
        // The kerb's face: stones a metre long.
        let joint = pulse(patch.u, 1.0, 0.03, patch.du);
        return scale(stone, 1.05 - 0.35 * joint + patch.octaves(&[(0.7, 0.3), (2.5, 0.3)], seed));
    }
    let across = p.world[0].abs();
    let beyond = band(across, edge, 1e6, patch.du.max(0.02));
    let grime = patch.octaves(&[(0.3, 0.28), (0.8, 0.3), (2.1, 0.24), (6.0, 0.2)], seed)
        + 0.25 * patch.grain(1.5, 0.15, seed + 9);
    let joint = pulse(patch.u, slab, 0.03, patch.du).max(pulse(patch.v, slab, 0.03, patch.dv));
    let (i, j) = (floor(patch.u / slab), floor(patch.v / slab));
    let each = (hash_unit(i, j, seed + 7) - 0.5) * 0.22 * fade(patch.du.max(patch.dv) / slab);
    let laid = scale(stone, 1.0 + grime + each - 0.35 * joint);
    let rough = patch.octaves(&[(0.4, 0.4), (1.2, 0.4), (3.5, 0.4), (9.0, 0.3)], seed + 40);
    mix(laid, scale(yard, 1.0 + rough), beyond)
}

/// Bricks or stones in courses, whatever the surface.
fn masonry(patch: &Patch, colour: Colour, seed: u32) -> Colour {
    let (length, course) = (0.26, 0.085);
    let row = floor(patch.v / course);
    let shift = if row & 1 == 0 { 0.0 } else { 0.5 * length };
    let joint = pulse(patch.v, course, 0.014, patch.dv).max(0.7 * pulse(patch.u + shift, length, 0.014, patch.du));
    let each = hash_unit(floor((patch.u + shift) / length), row, seed) - 0.5;
    let tone = 1.0
        + patch.octaves(&[(0.25, 0.3), (0.7, 0.34), (1.9, 0.3), (5.0, 0.22)], seed + 1)
        + 0.35 * each * fade((patch.du / length).max(patch.dv / course));
    scale(mix(colour, [0.66, 0.63, 0.58], 0.55 * joint), tone)
}

impl Facade {
    fn colour(&self, p: &Point, seed: u32) -> Colour {
        let patch = p.patch();
        if p.axis == 1 {
            return scale(self.trim, 0.8 + patch.octaves(&[(0.5, 0.3), (2.0, 0.3)], seed));
        }
        let Patch { u, du: fu, dv: fv, .. } = patch;
        let h = p.height();
        let seed = seed + 100 * p.axis as u32;
        let plain = if self.brick {
            masonry(&patch, self.wall, seed)
        } else {
            // Plaster: stains, and streaks of rain that run down.
            let stains = patch.octaves(&[(0.22, 0.30), (0.6, 0.30), (1.6, 0.26), (4.5, 0.22)], seed);
            scale(self.wall, 1.0 + stains + 0.22 * patch.grain(2.3, 0.25, seed + 5))
        };
        // Upper storeys: a lattice of windows with frames, sills and lintels.
        let up = h - self.ground_floor;
        let (pitch, storey, [wide, high]) = (self.pitch, self.storey, self.window);
        let floors = ((self.height - self.ground_floor - 0.5) / storey).max(0.0);
        let top = floor(floors) as f32 * storey;
        let storeys = band(up, 0.0, top, fv);
        let mut colour = plain;
        if storeys > 0.0 {
            let row = pulse(up - self.sill, storey, high, fv);
            let frame =
                pulse_centred(u, pitch, wide + 0.24, fu) * pulse(up - self.sill + 0.12, storey, high + 0.24, fv);
            let ledge = pulse(up - self.sill + 0.2, storey, 0.14, fv) * pulse_centred(u, pitch, wide + 0.5, fu);
            colour = mix(colour, self.trim, storeys * frame.max(ledge));
            if self.shutters {
                let leaf = pulse_centred(u - 0.5 * wide - 0.3, pitch, 0.42, fu).max(pulse_centred(
                    u + 0.5 * wide + 0.3,
                    pitch,
                    0.42,
                    fu,
                ));
                let slats = 1.0 - 0.25 * pulse(up, 0.12, 0.05, fv);
                colour = mix(colour, scale(self.sign, slats), storeys * leaf * row);
            }
            let pane = pulse_centred(u, pitch, wide, fu) * row;
            let bars = pulse_centred(u, pitch, 0.07, fu).max(pulse(up - self.sill - 0.62 * high, storey, 0.07, fv));
            if pane > 0.0 {
                let (i, j) = (floor(u / pitch + 0.5), floor(up / storey));
                let glass = self.pane(i, j, up - j as f32 * storey - self.sill, high, &patch, seed);
                colour = mix(colour, mix(glass, self.trim, bars), storeys * pane);
            }
            // A belt at each floor.
            colour = mix(colour, self.trim, 0.6 * storeys * pulse(up + 0.09, storey, 0.18, fv));
        }
        let below = band(h, -1.0, self.ground_floor, fv);
        if below > 0.0 {
            colour = mix(colour, self.ground(&patch, h, plain, seed), below);
        }
        // The cornice, with brackets; the plinth.
        let cornice = band(h, self.height - 0.45, self.height + 1.0, fv);
        let brackets = 1.0 - 0.35 * pulse(u, 0.6, 0.25, fu) * band(h, self.height - 0.45, self.height - 0.2, fv);
        colour = mix(colour, scale(self.trim, brackets), cornice);
        scale(colour, 1.0 - 0.35 * band(h, -1.0, 0.55, fv.max(0.03)))
    }

    /// A window: dark glass, the sky in its upper part, sometimes a curtain or a blind.
    fn pane(&self, i: i32, j: i32, above: f32, high: f32, patch: &Patch, seed: u32) -> Colour {
        let own = fade((patch.du / self.pitch).max(patch.dv / self.storey));
        let h = hash_unit(i, j, seed + 50) - 0.5;
        let mut glass = scale(self.glass, 1.0 + 0.9 * own * h + 0.5 * (above / high - 0.4).clamp(-0.5, 0.6));
        let closed = hash_unit(i, j, seed + 51);
        if closed < 0.35 {
            let blind = band(above, high * (0.3 + closed), high, patch.dv.max(0.02));
            glass = mix(glass, [0.78, 0.75, 0.69], 0.8 * own * blind);
        }
        scale(glass, 1.0 + patch.octaves(&[(1.1, 0.35), (3.0, 0.3)], seed + 52))
    }

    /// The ground floor: shop windows under a sign, or doors and windows.
    fn ground(&self, patch: &Patch, h: f32, plain: Colour, seed: u32) -> Colour {
        let Patch { u, du: fu, dv: fv, .. } = *patch;
        if self.shop {
            let pitch = 1.7 * self.pitch;
            let window = pulse_centred(u, pitch, pitch - 0.5, fu) * band(h, 0.55, self.ground_floor - 0.95, fv);
            let goods = patch.octaves(&[(0.8, 0.7), (2.2, 0.7), (5.0, 0.5)], seed + 60);
            let hue = patch.octaves(&[(1.0, 0.5), (2.6, 0.4)], seed + 64);
            let base = scale(self.glass, 1.15 + goods);
            let inside = [base[0] * (1.0 + hue), base[1], base[2] * (1.0 - hue)];
            let mut colour = mix(scale(self.trim, 0.8 + 0.5 * patch.grain(1.5, 1.5, seed + 66)), inside, window);
            let board = band(h, self.ground_floor - 0.8, self.ground_floor - 0.15, fv);
            let (a, b) = (self.ground_floor - 0.62, self.ground_floor - 0.33);
            let letters = band(h, a, b, fv) * pulse(u + 0.2 * patch.grain(3.0, 3.0, seed + 67), 0.34, 0.2, fu);
            let words = pulse(u, 1.7 * pitch, 1.1 * pitch, fu);
            colour = mix(colour, mix(self.sign, WHITE, 0.9 * letters * words), board);
            return colour;
        }
        let (pitch, wide) = (self.pitch, self.window[0]);
        let (i, own) = (floor(u / pitch + 0.5), fade(fu / pitch));
        let door = hash_unit(i, 0, seed + 70) < 0.25;
        let tall = if door { band(h, 0.0, 2.25, fv) } else { band(h, 0.95, 0.95 + self.window[1], fv) };
        let frame_tall = if door { band(h, 0.0, 2.4, fv) } else { band(h, 0.8, 1.1 + self.window[1], fv) };
        let inside = if door {
            scale(self.sign, 0.8 - 0.3 * pulse(h, 0.75, 0.08, fv) + 0.4 * patch.grain(2.0, 1.0, seed + 71))
        } else {
            let bars = pulse_centred(u, pitch, 0.07, fu);
            mix(self.pane(i, -1, h - 0.95, self.window[1], patch, seed), self.trim, bars)
        };
        let colour = mix(plain, self.trim, own * frame_tall * pulse_centred(u, pitch, wide + 0.26, fu));
        mix(colour, inside, own.max(0.5) * tall * pulse_centred(u, pitch, wide, fu))
    }
}

fn tiles(p: &Point, colour: Colour, seed: u32) -> Colour {
    let patch = p.patch();
    let course = pulse(p.height(), 0.22, 0.05, p.footprint[1]);
    scale(colour, 1.0 - 0.4 * course + patch.octaves(&[(0.3, 0.3), (0.9, 0.35), (2.4, 0.3), (6.0, 0.25)], seed))
}

impl Car {
    fn body(&self, p: &Point, seed: u32) -> Colour {
        let patch = p.patch();
        let h = p.height();
        let [x, _, z] = p.local;
        let [fx, fy, fz] = p.footprint;
        // What the paint mirrors, held to the surface, and the dirt.
        let sheen = patch.octaves(&[(0.6, 0.42), (1.6, 0.34), (4.0, 0.26), (9.0, 0.14)], seed);
        let mut colour = scale(self.paint, 0.95 + 0.25 * (h - 0.6) + sheen);
        let dark = [0.07, 0.07, 0.075];
        if p.axis == 0 {
            // Doors, a rub strip, arches.
            let door = |at: f32| band(z, at - 0.012, at + 0.012, fz);
            let gaps = door(-0.75).max(door(0.25)).max(door(1.1)) * band(h, 0.3, 0.95, fy);
            colour = mix(colour, dark, 0.8 * gaps);
            colour = mix(colour, dark, 0.55 * band(h, 0.5, 0.56, fy));
            let handle = band(h, 0.76, 0.8, fy) * (band(z, -0.7, -0.52, fz).max(band(z, 0.3, 0.48, fz)));
            colour = mix(colour, [0.75, 0.75, 0.77], 0.8 * handle);
            for axle in self.axles {
                let (a, b) = (z - axle, h - 0.33);
                colour = mix(colour, dark, band((a * a + b * b).sqrt(), -1.0, 0.39, fz.max(fy)));
            }
            let lamp = band(z.abs(), self.half - 0.22, self.half, fz) * band(h, 0.58, 0.76, fy);
            colour = mix(colour, self.lamp(z < 0.0), 0.9 * lamp);
        } else if p.axis == 2 {
            let rear = (z < 0.0) == self.away;
            let lamps = band(x.abs(), 0.52, 0.84, fx) * band(h, 0.56, 0.8, fy);
            colour = mix(colour, self.lamp(z < 0.0), lamps);
            let plate = band(x.abs(), -1.0, 0.27, fx) * band(h, 0.46, 0.58, fy);
            let digits = 0.7 * pulse(x, 0.08, 0.045, fx) * band(h, 0.485, 0.555, fy);
            let grille = band(x.abs(), -1.0, 0.48, fx) * band(h, 0.6, 0.78, fy);
            if !rear {
                colour = mix(colour, scale(dark, 1.0 + 4.0 * pulse(h, 0.05, 0.02, fy)), grille);
            }
            colour = mix(colour, mix([0.9, 0.88, 0.75], dark, digits), plate);
            colour = mix(colour, dark, 0.7 * band(h, 0.2, 0.42, fy));
        } else {
            // The bonnet and the boot: seams.
            let seam = band(x.abs(), 0.62, 0.645, fx);
            colour = mix(scale(colour, 1.08), dark, 0.5 * seam);
        }
        colour
    }

    fn lamp(&self, towards: bool) -> Colour {
        if towards == self.away { [0.62, 0.07, 0.06] } else { [0.88, 0.88, 0.84] }
    }

    fn cabin(&self, p: &Point, seed: u32) -> Colour {
        let patch = p.patch();
        let [x, y, z] = p.local;
        let [fx, fy, fz] = p.footprint;
        let sheen = patch.octaves(&[(0.8, 0.42), (2.0, 0.34), (5.0, 0.26)], seed + 3);
        let paint = scale(self.paint, 1.0 + sheen);
        // `y` is below the roof.
        let glass = scale([0.24, 0.28, 0.32], (1.5 - 1.1 * y) * (1.0 + 1.8 * sheen));
        if p.axis == 1 {
            let rails = band(x.abs(), 0.5, 0.54, fx);
            return scale(paint, 1.1 - 0.5 * rails);
        }
        let pane = band(y, 0.09, 5.0, fy);
        let posts = if p.axis == 0 {
            pulse(z - 0.25, 1.0, 0.09, fz)
        } else {
            let seats = band(x.abs(), 0.22, 0.5, fx) * band(y, 0.28, 2.0, fy);
            return mix(paint, scale(glass, 1.0 - 0.5 * seats), pane * band(x.abs(), -1.0, 0.68, fx));
        };
        mix(paint, glass, pane * (1.0 - posts))
    }
}

fn wheel(p: &Point, seed: u32) -> Colour {
    let [_, y, z] = p.local;
    let f = p.footprint[1].max(p.footprint[2]);
    let tyre = [0.09, 0.09, 0.095];
    if p.axis != 0 {
        return scale(tyre, 1.0 + p.patch().octaves(&[(4.0, 0.4), (12.0, 0.4)], seed));
    }
    let r = (y * y + z * z).sqrt();
    let spoke = hash_unit(floor(3.0 * y / r.max(1e-3)), floor(3.0 * z / r.max(1e-3)), seed);
    let rim = mix([0.58, 0.59, 0.61], [0.2, 0.2, 0.21], 0.7 * fade(f / 0.12) * (spoke > 0.5) as u8 as f32);
    mix(tyre, rim, band(r, -1.0, 0.21, f))
}

fn leaves(p: &Point, colour: Colour, seed: u32) -> Colour {
    let f = p.footprint.iter().fold(0f32, |a, &b| a.max(b)).min(0.6);
    let octave = |s: f32, a: f32, k: u32| {
        let weight = fade(f * s);
        if weight > 0.0 { a * weight * noise3(p.local.map(|x| x * s), seed + k) } else { 0.0 }
    };
    let clumps = octave(1.1, 0.7, 0) + octave(3.0, 0.9, 1) + octave(8.0, 0.8, 2);
    let depth = 1.0 + clumps - 0.25 * (1.0 + p.normal[1]);
    let warm = 0.5 * clumps;
    let tone = scale(colour, depth.max(0.15));
    [tone[0] * (1.0 + 0.3 * warm), tone[1], tone[2] * (1.0 - 0.3 * warm)]
}
