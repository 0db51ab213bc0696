//! Procedural texture that a pixel can resolve: value noise whose octaves fade with the pixel's footprint, and edges
//! and pulse trains that are averaged over it exactly.
//!
//! A footprint is the width, in the texture's own metres, of what one pixel averages.

/// A colour: red, green, blue.
pub(crate) type Colour = [f32; 3];

/// The largest whole number not above `x`, for `|x| < 2^31`; without SSE4.1 `f32::floor` would be a call.
pub(crate) fn floor(x: f32) -> i32 {
    let i = x as i32;
    i - (i as f32 > x) as i32
}

/// The strides of the hash along x and y, and between seeds: odd, and far from one another.
const STRIDES: [u32; 3] = [0x9E37_79B1, 0x85EB_CA77, 0xC2B2_AE3D];

fn stir(h: u32) -> u32 {
    let h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
    let h = (h ^ (h >> 13)).wrapping_mul(0x297A_2D39);
    h ^ (h >> 16)
}

/// The upper 24 bits as a number in `[0, 1)`.
fn unit(h: u32) -> f32 {
    (h >> 8) as f32 * (1.0 / (1u32 << 24) as f32)
}

/// Well-mixed bits of a lattice point.
pub(crate) fn hash(x: i32, y: i32, seed: u32) -> u32 {
    let [a, b, c] = [x as u32, y as u32, seed];
    stir(a.wrapping_mul(STRIDES[0]).wrapping_add(b.wrapping_mul(STRIDES[1])).wrapping_add(c.wrapping_mul(STRIDES[2])))
}

/// `hash` as a number in `[0, 1)`.
pub(crate) fn hash_unit(x: i32, y: i32, seed: u32) -> f32 {
    unit(hash(x, y, seed))
}

fn ease(t: f32) -> f32 {
    t * t * (3.0 - 2.0 * t)
}

/// Value noise in `[-0.5, 0.5)`, a lattice cell a unit.
pub(crate) fn noise(u: f32, v: f32, seed: u32) -> f32 {
    let (iu, iv) = (floor(u), floor(v));
    let (fu, fv) = (ease(u - iu as f32), ease(v - iv as f32));
    // The four corners' hashes, with their products shared.
    let (x0, y0) = ((iu as u32).wrapping_mul(STRIDES[0]), (iv as u32).wrapping_mul(STRIDES[1]));
    let y0 = y0.wrapping_add(seed.wrapping_mul(STRIDES[2]));
    let (x1, y1) = (x0.wrapping_add(STRIDES[0]), y0.wrapping_add(STRIDES[1]));
    let at = |x: u32, y: u32| unit(stir(x.wrapping_add(y)));
    let (left, low) = (at(x0, y0), at(x0, y1));
    let top = left + (at(x1, y0) - left) * fu;
    let bottom = low + (at(x1, y1) - low) * fu;
    top + (bottom - top) * fv - 0.5
}

/// Value noise in space, in `[-0.5, 0.5)`.
pub(crate) fn noise3(p: [f32; 3], seed: u32) -> f32 {
    let iz = floor(p[2]);
    let fz = ease(p[2] - iz as f32);
    let layer = |z: i32| noise(p[0], p[1], seed.wrapping_add((z as u32).wrapping_mul(0x27D4_EB2F)));
    let near = layer(iz);
    near + (layer(iz.wrapping_add(1)) - near) * fz
}

/// How much of a pattern with `cells` cells a pixel survives the average: all up to 0.4, nothing from 1.
pub(crate) fn fade(cells: f32) -> f32 {
    ((1.0 - cells) * (1.0 / 0.6)).clamp(0.0, 1.0)
}

/// Texture coordinates of a surface, in metres, with the footprint of a pixel along each.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Patch {
    pub(crate) u: f32,
    pub(crate) v: f32,
    pub(crate) du: f32,
    pub(crate) dv: f32,
}

impl Patch {
    /// Noise of `su` by `sv` cells a metre, faded where the pixel can't resolve it; in `[-0.5, 0.5)`.
    pub(crate) fn grain(&self, su: f32, sv: f32, seed: u32) -> f32 {
        let weight = fade((self.du * su).max(self.dv * sv));
        if weight <= 0.0 { 0.0 } else { weight * noise(self.u * su, self.v * sv, seed) }
    }

    /// Octaves of isotropic noise, each given as cells a metre and amplitude.
    pub(crate) fn octaves(&self, octaves: &[(f32, f32)], seed: u32) -> f32 {
        let one = |(k, &(s, amplitude)): (usize, &(f32, f32))| amplitude * self.grain(s, s, seed + k as u32);
        octaves.iter().enumerate().map(one).sum()
    }
}

/// The part of `[x - f/2, x + f/2]` inside `[a, b]`.
pub(crate) fn band(x: f32, a: f32, b: f32, f: f32) -> f32 {
    let f = f.max(1e-4);
    let low = (x - 0.5 * f).max(a);
    let high = (x + 0.5 * f).min(b);
    ((high - low) / f).max(0.0)
}

/// The part of `[x - f/2, x + f/2]` inside the pulses `[k period, k period + width]`.
pub(crate) fn pulse(x: f32, period: f32, width: f32, f: f32) -> f32 {
    let f = f.max(1e-4);
    let integral = |x: f32| {
        let k = floor(x / period) as f32;
        k * width + (x - k * period).min(width)
    };
    ((integral(x + 0.5 * f) - integral(x - 0.5 * f)) / f).clamp(0.0, 1.0)
}

/// The same, with pulses centred on `k period`.
pub(crate) fn pulse_centred(x: f32, period: f32, width: f32, f: f32) -> f32 {
    pulse(x + 0.5 * width, period, width, f)
}

/// `a (1 - t) + b t`, per channel.
pub(crate) fn mix(a: [f32; 3], b: [f32; 3], t: f32) -> [f32; 3] {
    std::array::from_fn(|k| a[k] + (b[k] - a[k]) * t)
}

/// A colour times a number.
pub(crate) fn scale(a: [f32; 3], s: f32) -> [f32; 3] {
    a.map(|c| c * s)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_continuous_and_spread() {
        let (mut low, mut high, mut sum) = (1f32, -1f32, 0f64);
        let n = 20_000;
        for i in 0..n {
            let (u, v) = (i as f32 * 0.137 - 900.0, i as f32 * 0.071 - 500.0);
            let a = noise(u, v, 7);
            assert!((a - noise(u + 1e-3, v, 7)).abs() < 0.01);
            (low, high, sum) = (low.min(a), high.max(a), sum + a as f64);
        }
        assert!(low < -0.4 && high > 0.4 && (sum / n as f64).abs() < 0.02, "{low} {high} {sum}");
    }

    #[test]
    fn noise_at_a_lattice_point_is_its_hash() {
        for (x, y) in [(0, 0), (3, -4), (-7, 12)] {
            assert_eq!(noise(x as f32, y as f32, 9), hash_unit(x, y, 9) - 0.5);
        }
    }

    #[test]
    fn pulses_and_bands_are_box_averages() {
        for (x, f) in [(0.3f32, 0.2f32), (1.95, 0.5), (-3.2, 2.7), (7.0, 9.0)] {
            let n = 20_000;
            let at = |i: usize| x - 0.5 * f + f * (i as f32 + 0.5) / n as f32;
            let on = |t: f32| t - 2.0 * floor(t / 2.0) as f32 <= 0.6;
            let counted = (0..n).filter(|&i| on(at(i))).count() as f32 / n as f32;
            assert!((pulse(x, 2.0, 0.6, f) - counted).abs() < 2e-3);
            let counted = (0..n).filter(|&i| (0.25..1.8).contains(&at(i))).count() as f32 / n as f32;
            assert!((band(x, 0.25, 1.8, f) - counted).abs() < 2e-3);
        }
    }

    #[test]
    fn floor_is_floor() {
        for x in [-2.0f32, -1.5, -0.0, 0.0, 0.99, 1.0, 123.4] {
            assert_eq!(floor(x), x.floor() as i32);
        }
    }
}
