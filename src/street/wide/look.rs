//! Looks of the wide world's surfaces where the embedded street has none of the kind: paint and glass that
//! mirror the sky, the ground from the road to the fields, rails.

use super::super::surface::{Car, Point, Road};
use super::super::texture::{Colour, Patch, band, mix, pulse, scale};

/// A surface of the wide world.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Look {
    /// The ground plane.
    Ground(Ground),
    /// A vehicle's body: lamps, doors, plate, arches, the sky in the paint.
    Paint(Car),
    /// A cabin with windows, under a roof of the paint's colour. The height of the window's sill above the ground.
    Cabin(Car, f32),
    /// A smooth surface with a faint grain: metal, cloth, skin.
    Smooth(Colour),
    /// A bus: the paint with a row of windows between two heights above the ground, `pitch` apart.
    Windows { paint: Colour, low: f32, high: f32, pitch: f32 },
}

/// The ground plane, by distance from the middle of the road: road, kerb, pavement or nothing, grass or paving.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ground {
    pub(crate) road: Road,
    /// How fast the road bends to the right, in 1/m.
    pub(crate) bend: f32,
    /// Width of the pavements, in metres; 0 for none.
    pub(crate) pavement: f32,
    pub(crate) stone: Colour,
    /// The ground behind.
    pub(crate) field: Colour,
    /// A solid line along both edges of the road.
    pub(crate) edges: bool,
    /// A mark along the middle of the road, continuous or dashed like the lanes'.
    pub(crate) middle: bool,
}

const WHITE: Colour = [0.84, 0.84, 0.82];
const DARK: Colour = [0.06, 0.06, 0.065];
const SKY: Colour = [0.80, 0.84, 0.88];

impl Look {
    /// The colour at a point, before the light.
    pub(crate) fn colour(&self, p: &Point, seed: u32) -> Colour {
        match self {
            Look::Ground(ground) => ground.colour(p, seed),
            Look::Paint(car) => paint(car, p, seed),
            Look::Cabin(car, sill) => cabin(car, *sill, p, seed),
            Look::Smooth(colour) => scale(*colour, 1.0 + p.patch().octaves(&[(1.3, 0.12), (5.0, 0.12)], seed)),
            Look::Windows { paint, low, high, pitch } => {
                let patch = p.patch();
                let base = scale(*paint, 1.0 + patch.octaves(&[(0.5, 0.1), (2.0, 0.08)], seed));
                if p.axis == 1 {
                    return base;
                }
                let pane =
                    band(p.height(), *low, *high, p.footprint[1]) * (1.0 - pulse(patch.u, *pitch, 0.12, patch.du));
                mix(base, glass(p, *low, *high, &patch, seed), pane)
            }
        }
    }
}

impl Ground {
    fn colour(&self, p: &Point, seed: u32) -> Colour {
        let z = p.world[2];
        let local = [p.local[0] - 0.5 * self.bend * z * z, p.local[1], p.local[2]];
        let straight = Point { local, ..*p };
        let patch = straight.patch();
        let (across, f) = (local[0].abs(), patch.du);
        let half = self.road.half;
        let mut colour = [0.0; 3];
        if across < half + f {
            colour = self.road.colour(&straight, seed);
            let mut mark = 0f32;
            if self.middle {
                mark = band(local[0], -0.07, 0.07, f) * pulse(z, self.road.period, self.road.dash, patch.dv);
            }
            if self.edges {
                mark = mark.max(band(across, half - 0.45, half - 0.3, f));
            }
            colour = mix(colour, WHITE, 0.85 * mark);
        }
        let beyond = band(across, half, 1e6, f.max(0.01));
        if beyond <= 0.0 {
            return colour;
        }
        let edge = half + self.pavement;
        let rough = patch.octaves(&[(0.12, 0.35), (0.4, 0.35), (1.3, 0.3), (4.0, 0.35), (13.0, 0.3)], seed + 40);
        let dry = patch.octaves(&[(0.07, 0.6), (0.3, 0.5)], seed + 50);
        let mut outside = scale(mix(self.field, [0.50, 0.46, 0.34], (0.2 + dry).clamp(0.0, 0.7)), 1.0 + rough);
        if self.pavement > 0.0 {
            let joints = pulse(local[0], 0.5, 0.02, f).max(pulse(z, 0.5, 0.02, patch.dv));
            let grime = patch.octaves(&[(0.3, 0.14), (0.9, 0.14), (3.0, 0.14)], seed + 60);
            let mut laid = scale(self.stone, 1.0 + grime - 0.2 * joints);
            let kerb = band(across, half, half + 0.16, f);
            laid = mix(laid, scale(self.stone, 1.15 - 0.3 * pulse(z, 1.0, 0.03, patch.dv)), kerb);
            // The kerb's face, in its own shade.
            laid = mix(laid, scale(self.stone, 0.45), 0.7 * band(across, half - 0.03, half + 0.02, f));
            outside = mix(laid, outside, band(across, edge, 1e6, f.max(0.02)));
        }
        mix(colour, outside, beyond)
    }
}

/// Dark glass that mirrors more of the sky the higher it is.
fn glass(p: &Point, low: f32, high: f32, patch: &Patch, seed: u32) -> Colour {
    let up = ((p.height() - low) / (high - low)).clamp(0.0, 1.0);
    let blotches = patch.octaves(&[(0.7, 0.5), (2.3, 0.35)], seed + 5);
    mix([0.07, 0.08, 0.09], SKY, (0.08 + 0.32 * up * up + 0.35 * blotches).clamp(0.0, 0.6))
}

fn paint(car: &Car, p: &Point, seed: u32) -> Colour {
    let (h, patch) = (p.height(), p.patch());
    let [x, _, z] = p.local;
    let [fx, fy, fz] = p.footprint;
    // The sky in the shoulders, the road in the doors, and dirt below.
    let mirrored = 0.30 * band(h, 0.72, 1.4, 0.35) + 0.25 * patch.octaves(&[(0.5, 0.4), (1.7, 0.3)], seed);
    let mut colour = mix(scale(car.paint, 0.72 + 0.3 * (h - 0.3)), SKY, mirrored.clamp(0.0, 0.4));
    colour = mix(colour, [0.30, 0.28, 0.25], 0.35 * (1.0 - h / 0.6).clamp(0.0, 1.0));
    if p.axis == 0 {
        let door = |at: f32| band(z, at - 0.01, at + 0.01, fz);
        let gaps = door(-0.85).max(door(0.15)).max(door(1.1)) * band(h, 0.3, 0.95, fy);
        colour = mix(colour, DARK, 0.7 * gaps);
        let handle = band(h, 0.76, 0.8, fy) * (band(z, -0.7, -0.52, fz).max(band(z, 0.3, 0.48, fz)));
        colour = mix(colour, DARK, 0.5 * handle);
        for axle in car.axles {
            let (a, b) = (z - axle, h - 0.32);
            colour = mix(colour, DARK, band((a * a + b * b).sqrt(), -1.0, 0.40, fz.max(fy)));
        }
        let lamp = band(z.abs(), car.half - 0.25, car.half, fz) * band(h, 0.6, 0.8, fy);
        colour = mix(colour, lamp_of(car, z < 0.0), 0.9 * lamp);
        colour = mix(colour, DARK, 0.75 * band(h, -1.0, 0.27, fy));
    } else if p.axis == 2 {
        let rear = (z < 0.0) == car.away;
        colour = mix(colour, lamp_of(car, z < 0.0), band(x.abs(), 0.5, 0.86, fx) * band(h, 0.6, 0.84, fy));
        let plate = band(x.abs(), -1.0, 0.26, fx) * band(h, 0.48, 0.6, fy);
        if !rear {
            colour = mix(colour, DARK, band(x.abs(), -1.0, 0.5, fx) * band(h, 0.62, 0.8, fy));
        }
        colour = mix(colour, [0.86, 0.86, 0.82], plate);
        colour = mix(colour, DARK, 0.8 * band(h, -1.0, 0.4, fy));
    } else {
        colour = mix(colour, SKY, 0.25);
    }
    colour
}

fn lamp_of(car: &Car, towards: bool) -> Colour {
    if towards == car.away { [0.55, 0.06, 0.05] } else { [0.85, 0.86, 0.86] }
}

fn cabin(car: &Car, sill: f32, p: &Point, seed: u32) -> Colour {
    let patch = p.patch();
    let [x, y, z] = p.local;
    let [fx, fy, fz] = p.footprint;
    if p.axis == 1 {
        return mix(scale(car.paint, 0.95), SKY, 0.25);
    }
    // `y` is minus the height above the ground here: the origin lies on the road.
    let roof = sill + 0.62;
    let pane = band(-y, sill + 0.03, roof - 0.12, fy);
    let body = mix(scale(car.paint, 0.85), SKY, 0.1);
    let mut inside = glass(p, sill, roof, &patch, seed);
    if p.axis == 0 {
        return mix(body, inside, pane * (1.0 - band(z, 0.1, 0.2, fz)));
    }
    let seats = band(x.abs(), 0.2, 0.52, fx) * band(-y, sill, sill + 0.3, fy);
    inside = mix(inside, DARK, 0.6 * seats);
    mix(body, inside, pane * band(x.abs(), -1.0, 0.66, fx))
}
