//! Light: the sun and the shadows of the houses, haze, and the sky.

use std::f64::consts::PI;

use super::draw::Draw;
use super::shape::FAR;
use super::texture::{fade, floor, mix, noise, scale};

/// Where the ground is, in metres below the camera.
pub(crate) const GROUND: f32 = 1.65;
/// Where the shadow tables begin, in metres along the street.
pub(crate) const BEHIND: f64 = 20.0;

/// Sun, sky and haze of one sequence.
pub(crate) struct Light {
    /// The unit vector towards the sun.
    sun: [f32; 3],
    /// Light from everywhere, and from the sun at a right angle.
    ambient: f32,
    direct: f32,
    zenith: [f32; 3],
    horizon: [f32; 3],
    cloud: [f32; 3],
    /// How much of the sky is clouds, and how strong they are.
    cover: f32,
    haze: f32,
    seed: u32,
    /// Where the fronts of the houses stand, nearly: the planes in which their shadows are looked up, left and right, in
    /// metres from the middle of the road.
    fronts: [f32; 2],
    /// Heights of the houses, a value a metre from -[`BEHIND`]: left, right.
    skyline: [Vec<f32>; 2],
}

impl Light {
    /// A time of day and a weather.
    pub(crate) fn new(draw: &mut Draw, fronts: [f64; 2]) -> Self {
        let overcast = draw.chance(0.4);
        let (azimuth, elevation) = (draw.range(-PI, PI), draw.range(0.5, 1.1));
        let flat = libm::cos(elevation);
        let sun = [flat * libm::sin(azimuth), -libm::sin(elevation), flat * libm::cos(azimuth)].map(|x| x as f32);
        let direct = if overcast { draw.range(0.05, 0.2) } else { draw.range(0.5, 0.85) } as f32;
        let grey = draw.range(0.62, 0.88) as f32;
        let warm = draw.range(-0.03, 0.05) as f32;
        let horizon = [grey + warm, grey + 0.02, grey - warm + 0.04];
        let zenith = if overcast {
            scale(horizon, draw.range(0.75, 0.95) as f32)
        } else {
            let blue = draw.range(0.0, 0.12) as f32;
            [0.36 + blue, 0.55 + blue, 0.84 + 0.5 * blue]
        };
        Light {
            sun,
            ambient: 1.02 - 0.45 * direct,
            direct,
            zenith,
            horizon,
            cloud: scale([0.95, 0.95, 0.96], draw.range(0.85, 1.03) as f32),
            cover: draw.range(-0.12, 0.12) as f32,
            haze: draw.range(0.15, 0.75) as f32,
            seed: draw.bits(),
            fronts: fronts.map(|x| x as f32),
            skyline: [Vec::new(), Vec::new()],
        }
    }

    /// This light as a camera that exposes for the road takes it: a sky without much colour, shade that is dark. `glare`
    /// from 0 (as it is) to 1 (white).
    pub(crate) fn glaring(mut self, glare: f32) -> Self {
        let white = [1.0, 1.0, 1.0];
        self.zenith = mix(self.zenith, white, glare);
        self.horizon = mix(self.horizon, white, 0.8 * glare);
        self.ambient *= 1.0 - 0.35 * glare;
        self.haze *= 1.0 - 0.5 * glare;
        self
    }

    /// Notes a house of `height` between `z0` and `z1` on a side (0 left, 1 right).
    pub(crate) fn house(&mut self, side: usize, z0: f64, z1: f64, height: f64) {
        let first = (z0 + BEHIND).max(0.0) as usize;
        let last = (z1 + BEHIND).max(0.0) as usize;
        let line = &mut self.skyline[side];
        if line.len() < last + 1 {
            line.resize(last + 1, 0.0);
        }
        line[first..=last].iter_mut().for_each(|h| *h = h.max(height as f32));
    }

    /// The share of the sun that reaches a point of the world, between 0 and 1, past the houses.
    fn sunlit(&self, p: [f32; 3]) -> f32 {
        let side = if self.sun[0] > 0.0 { self.fronts[1] } else { -self.fronts[0] };
        let away = (side - p[0]) * self.sun[0];
        if self.sun[0].abs() < 0.12 || away <= 0.0 {
            return 1.0;
        }
        let k = (side - p[0]) / self.sun[0];
        let (y, z) = (p[1] + k * self.sun[1], p[2] + k * self.sun[2] + BEHIND as f32);
        let line = &self.skyline[(side > 0.0) as usize];
        let i = floor(z);
        let at = |i: i32| usize::try_from(i).ok().and_then(|i| line.get(i)).copied().unwrap_or(0.0);
        let height = at(i) + (at(i + 1) - at(i)) * (z - i as f32);
        // The edge is soft, more so far from the roof that casts it.
        ((GROUND - y - height) / (0.3 + 0.06 * k) + 0.5).clamp(0.0, 1.0)
    }

    /// The light on a surface of a normal at a point, as a factor of its colour.
    pub(crate) fn on(&self, p: [f32; 3], normal: [f32; 3]) -> f32 {
        let toward: f32 = (0..3).map(|k| normal[k] * self.sun[k]).sum();
        let sky = self.ambient * (0.92 - 0.1 * normal[1]);
        if toward <= 0.0 { sky } else { sky + self.direct * toward * self.sunlit(p) }
    }

    /// A colour at a depth, through the haze.
    pub(crate) fn through(&self, colour: [f32; 3], depth: f32) -> [f32; 3] {
        let far = depth / FAR;
        mix(colour, self.horizon, self.haze * far * far)
    }

    /// The sky along a direction; `pixel` is the angle of a pixel.
    pub(crate) fn sky(&self, d: [f32; 3], pixel: f32) -> [f32; 3] {
        let length = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
        let up = (-d[1] / length).max(0.0);
        let clear = mix(self.horizon, self.zenith, (2.2 * up).min(1.0));
        // Clouds on a plane one unit up; towards the horizon they run together.
        let height = up + 0.06;
        let (u, v, f) = (d[0] / length / height, d[2] / length / height, pixel / (height * height));
        let octave = |s: f32, a: f32, k: u32| {
            let weight = fade(f * s);
            if weight > 0.0 { a * weight * noise(u * s, v * s, self.seed.wrapping_add(k)) } else { 0.0 }
        };
        let density = octave(0.7, 1.0, 0) + octave(1.7, 0.6, 1) + octave(4.1, 0.35, 2) + self.cover;
        let cloud = (2.2 * density).clamp(0.0, 1.0) * (up * 9.0).min(1.0);
        mix(clear, self.cloud, 0.8 * cloud)
    }
}
