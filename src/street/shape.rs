//! The solids a street is made of, and where rays meet them.
//!
//! A shape is stated in the world in `f64`, then placed relative to the camera in `f32` for one frame. The ray is
//! `t d` with `d` of unit depth, so `t` is the camera's z. All loops run over a span of one row of rays and hold
//! no branch but a select, so that they vectorise.

use super::camera::View;
use super::texture::noise3;

/// Nothing nearer is seen, in metres.
pub(crate) const NEAR: f32 = 0.1;
/// Nothing farther is seen, in metres: beyond it is sky.
pub(crate) const FAR: f32 = 100.0;

/// A solid in the world, in metres.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Shape {
    /// The plane of constant y, seen from above.
    Ground { y: f64 },
    /// An axis-aligned box.
    Box { low: [f64; 3], high: [f64; 3] },
    /// Six planes around two rectangles, one above the other: a car's body, a roof. Each is `[x0, x1, z0, z1]`.
    Frustum { top_y: f64, top: [f64; 4], bottom_y: f64, bottom: [f64; 4] },
    /// An upright cylinder without caps: a pole, a trunk.
    Pole { x: f64, z: f64, radius: f64, top_y: f64, bottom_y: f64 },
    /// A cylinder along x with caps.
    Wheel { x: [f64; 2], y: f64, z: f64, radius: f64 },
    /// A ball of leaves with holes: an ellipsoid's shell where noise over the world's space is high enough.
    Crown { centre: [f64; 3], radii: [f64; 3], seed: u32 },
}

impl Shape {
    /// The corners `(low, high)` of the box around it; none for the ground.
    pub(crate) fn bounds(&self) -> Option<([f64; 3], [f64; 3])> {
        Some(match *self {
            Shape::Ground { .. } => return None,
            Shape::Box { low, high } => (low, high),
            Shape::Frustum { top_y, top, bottom_y, bottom } => (
                [top[0].min(bottom[0]), top_y, top[2].min(bottom[2])],
                [top[1].max(bottom[1]), bottom_y, top[3].max(bottom[3])],
            ),
            Shape::Pole { x, z, radius, top_y, bottom_y } => {
                ([x - radius, top_y, z - radius], [x + radius, bottom_y, z + radius])
            }
            Shape::Wheel { x, y, z, radius } => ([x[0], y - radius, z - radius], [x[1], y + radius, z + radius]),
            Shape::Crown { centre, radii, .. } => {
                (std::array::from_fn(|k| centre[k] - radii[k]), std::array::from_fn(|k| centre[k] + radii[k]))
            }
        })
    }

    /// The same solid `by` metres farther along z.
    pub(crate) fn forward(self, by: f64) -> Shape {
        match self {
            Shape::Ground { .. } => self,
            Shape::Box { low, high } => {
                Shape::Box { low: [low[0], low[1], low[2] + by], high: [high[0], high[1], high[2] + by] }
            }
            Shape::Frustum { top_y, top, bottom_y, bottom } => {
                let along = |r: [f64; 4]| [r[0], r[1], r[2] + by, r[3] + by];
                Shape::Frustum { top_y, top: along(top), bottom_y, bottom: along(bottom) }
            }
            Shape::Pole { x, z, radius, top_y, bottom_y } => Shape::Pole { x, z: z + by, radius, top_y, bottom_y },
            Shape::Wheel { x, y, z, radius } => Shape::Wheel { x, y, z: z + by, radius },
            Shape::Crown { centre, radii, seed } => {
                Shape::Crown { centre: [centre[0], centre[1], centre[2] + by], radii, seed }
            }
        }
    }

    /// This solid, `by` metres farther to the right.
    pub(crate) fn sideways(self, by: f64) -> Shape {
        let right = |[x, y, z]: [f64; 3]| [x + by, y, z];
        match self {
            Shape::Ground { .. } => self,
            Shape::Box { low, high } => Shape::Box { low: right(low), high: right(high) },
            Shape::Frustum { top_y, top, bottom_y, bottom } => {
                let across = |r: [f64; 4]| [r[0] + by, r[1] + by, r[2], r[3]];
                Shape::Frustum { top_y, top: across(top), bottom_y, bottom: across(bottom) }
            }
            Shape::Pole { x, z, radius, top_y, bottom_y } => Shape::Pole { x: x + by, z, radius, top_y, bottom_y },
            Shape::Wheel { x, y, z, radius } => Shape::Wheel { x: x.map(|x| x + by), y, z, radius },
            Shape::Crown { centre, radii, seed } => Shape::Crown { centre: right(centre), radii, seed },
        }
    }

    /// The solid as the camera at `eye` sees it.
    pub(crate) fn place(&self, eye: [f64; 3]) -> Placed {
        let relative = |p: [f64; 3]| -> [f32; 3] { std::array::from_fn(|k| (p[k] - eye[k]) as f32) };
        match *self {
            Shape::Ground { y } => Placed::Ground { y: (y - eye[1]) as f32 },
            Shape::Box { low, high } => Placed::Box { low: relative(low), high: relative(high) },
            Shape::Frustum { top_y, top, bottom_y, bottom } => {
                let rise = bottom_y - top_y;
                // A side's normal: outward along its axis, and up (-y) by how much the top is drawn in.
                let side = |axis: usize, outward: f64, at_top: f64, at_bottom: f64| {
                    let mut n = [0.0; 3];
                    n[axis] = outward * rise;
                    n[1] = outward * (at_top - at_bottom);
                    let mut p = [0.0; 3];
                    p[axis] = at_bottom;
                    p[1] = bottom_y;
                    plane(n, p, eye)
                };
                Placed::Frustum {
                    planes: [
                        side(0, -1.0, top[0], bottom[0]),
                        side(0, 1.0, top[1], bottom[1]),
                        plane([0.0, -1.0, 0.0], [0.0, top_y, 0.0], eye),
                        plane([0.0, 1.0, 0.0], [0.0, bottom_y, 0.0], eye),
                        side(2, -1.0, top[2], bottom[2]),
                        side(2, 1.0, top[3], bottom[3]),
                    ],
                }
            }
            Shape::Pole { x, z, radius, top_y, bottom_y } => Placed::Pole {
                x: (x - eye[0]) as f32,
                z: (z - eye[2]) as f32,
                radius: radius as f32,
                y: [(top_y - eye[1]) as f32, (bottom_y - eye[1]) as f32],
            },
            Shape::Wheel { x, y, z, radius } => Placed::Wheel {
                x: [(x[0] - eye[0]) as f32, (x[1] - eye[0]) as f32],
                y: (y - eye[1]) as f32,
                z: (z - eye[2]) as f32,
                radius: radius as f32,
            },
            Shape::Crown { centre, radii, seed } => {
                Placed::Crown { centre: relative(centre), radii: radii.map(|r| r as f32), seed }
            }
        }
    }
}

/// `[n, k]` with `n` of unit length: inside is `n . p <= k`, `p` relative to the eye.
fn plane(normal: [f64; 3], point: [f64; 3], eye: [f64; 3]) -> [f32; 4] {
    let length = normal.iter().map(|x| x * x).sum::<f64>().sqrt();
    let n = normal.map(|x| x / length);
    let k: f64 = (0..3).map(|i| n[i] * (point[i] - eye[i])).sum();
    [n[0] as f32, n[1] as f32, n[2] as f32, k as f32]
}

/// A solid relative to the eye, ready for rays.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Placed {
    Ground { y: f32 },
    Box { low: [f32; 3], high: [f32; 3] },
    Frustum { planes: [[f32; 4]; 6] },
    Pole { x: f32, z: f32, radius: f32, y: [f32; 2] },
    Wheel { x: [f32; 2], y: f32, z: f32, radius: f32 },
    Crown { centre: [f32; 3], radii: [f32; 3], seed: u32 },
}

/// One row of rays: the directions, their reciprocals, and the nearest hit so far.
#[derive(Default)]
pub(crate) struct Rays {
    pub(crate) d: [Vec<f32>; 3],
    pub(crate) inverse: [Vec<f32>; 3],
    /// Depth of the nearest hit, in metres; [`FAR`] where there is none.
    pub(crate) depth: Vec<f32>,
    /// Which solid was hit; [`NOTHING`] for the sky.
    pub(crate) who: Vec<u32>,
}

/// The `who` of a ray that hits no solid.
pub(crate) const NOTHING: u32 = u32::MAX;

fn smaller(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

impl Rays {
    /// The rays through the points `columns` (pixels) of the row `v`.
    pub(crate) fn aim(&mut self, view: &View, v: f64, columns: &[f32]) {
        let y = (v - view.centre[1]) / view.focal[1];
        let n = columns.len();
        for (k, r) in view.pose.rotation.iter().enumerate() {
            let base = (r[1] * y + r[2]) as f32;
            let step = r[0] as f32;
            self.d[k].clear();
            self.d[k].extend(columns.iter().map(|&x| base + step * x));
            self.inverse[k].clear();
            // A ray along a plane: a tiny slope, so that no infinity meets a zero.
            self.inverse[k].extend(self.d[k].iter().map(|&d| 1.0 / if d.abs() < 1e-7 { 1e-7 } else { d }));
        }
        self.depth.clear();
        self.depth.resize(n, FAR);
        self.who.clear();
        self.who.resize(n, NOTHING);
    }

    /// The direction of one ray.
    pub(crate) fn direction(&self, i: usize) -> [f32; 3] {
        [self.d[0][i], self.d[1][i], self.d[2][i]]
    }

    /// Meets the rays of a span with a solid, and keeps what is nearer than before.
    pub(crate) fn meet(&mut self, span: std::ops::Range<usize>, solid: &Placed, who: u32) {
        let [dx, dy, dz] = [0, 1, 2].map(|k| &self.d[k][span.clone()]);
        let [ix, iy, iz] = [0, 1, 2].map(|k| &self.inverse[k][span.clone()]);
        let depths = &mut self.depth[span.clone()];
        let whos = &mut self.who[span];
        let rays = dx.iter().zip(dy).zip(dz).zip(ix.iter().zip(iy).zip(iz)).zip(depths.iter_mut().zip(whos.iter_mut()));
        let rays = rays.map(|((((dx, dy), dz), ((ix, iy), iz)), kept)| ([*dx, *dy, *dz], [*ix, *iy, *iz], kept));
        let keep = |t: f32, hit: bool, depth: &mut f32, kept: &mut u32| {
            let hit = hit & (t < *depth) & (t > NEAR);
            *depth = if hit { t } else { *depth };
            *kept = if hit { who } else { *kept };
        };
        match *solid {
            Placed::Ground { y } => {
                for (_, i, (depth, kept)) in rays {
                    keep(y * i[1], true, depth, kept);
                }
            }
            Placed::Box { low, high } => meet_box([ix, iy, iz], [low, high], depths, whos, who),
            Placed::Frustum { planes } => {
                for (d, _, (depth, kept)) in rays {
                    let (mut enter, mut leave) = (0f32, FAR);
                    for [nx, ny, nz, k] in planes {
                        let along = nx * d[0] + ny * d[1] + nz * d[2];
                        let t = k / if along.abs() < 1e-7 { 1e-7 } else { along };
                        enter = if along < 0.0 { larger(enter, t) } else { enter };
                        leave = if along < 0.0 { leave } else { smaller(leave, t) };
                    }
                    keep(enter, enter < leave, depth, kept);
                }
            }
            Placed::Pole { x, z, radius, y } => {
                for (d, _, (depth, kept)) in rays {
                    let t = round(x, z, radius, d[0], d[2]);
                    let at = t * d[1];
                    keep(t, (at > y[0]) & (at < y[1]), depth, kept);
                }
            }
            Placed::Wheel { x, y, z, radius } => {
                for (d, i, (depth, kept)) in rays {
                    let (a, b) = (x[0] * i[0], x[1] * i[0]);
                    let cap = smaller(a, b);
                    let (py, pz) = (cap * d[1] - y, cap * d[2] - z);
                    keep(cap, py * py + pz * pz < radius * radius, depth, kept);
                    let tread = round(y, z, radius, d[1], d[2]);
                    let at = tread * d[0];
                    keep(tread, (at > x[0]) & (at < x[1]), depth, kept);
                }
            }
            Placed::Crown { centre, radii, seed } => {
                for (d, _, (depth, kept)) in rays {
                    let Some((t0, t1)) = ellipsoid(centre, radii, d) else { continue };
                    if t0 >= *depth {
                        continue;
                    }
                    for t in [t0, t1] {
                        let leaf = leaves(centre, [t * d[0], t * d[1], t * d[2]], seed);
                        if leaf {
                            keep(t, true, depth, kept);
                            break;
                        }
                    }
                }
            }
        }
    }
}

/// The rays of a span against a box, given their reciprocals: a function of its own, since only as arguments are the
/// slices known to the compiler to be apart, and the loop becomes vector instructions.
#[inline(never)]
fn meet_box([ix, iy, iz]: [&[f32]; 3], [low, high]: [[f32; 3]; 2], depths: &mut [f32], whos: &mut [u32], who: u32) {
    let n = depths.len();
    let (ix, iy, iz, whos) = (&ix[..n], &iy[..n], &iz[..n], &mut whos[..n]);
    for k in 0..n {
        let (ax, bx) = (low[0] * ix[k], high[0] * ix[k]);
        let (ay, by) = (low[1] * iy[k], high[1] * iy[k]);
        let (az, bz) = (low[2] * iz[k], high[2] * iz[k]);
        let enter = larger(larger(smaller(ax, bx), smaller(ay, by)), smaller(az, bz));
        let leave = smaller(smaller(larger(ax, bx), larger(ay, by)), larger(az, bz));
        // A mask instead of a select, which would come back as a branch.
        let hit = 0u32.wrapping_sub((enter < leave) as u32 & (enter < depths[k]) as u32 & (enter > NEAR) as u32);
        depths[k] = f32::from_bits(enter.to_bits() & hit | depths[k].to_bits() & !hit);
        whos[k] = who & hit | whos[k] & !hit;
    }
}

/// Where a ray of plane direction `(a, b)` enters the circle about `(p, q)`; -1 where it does not. The distance is
/// taken from a cross product, since `b^2 - 4ac` would cancel for a thin pole far away.
fn round(p: f32, q: f32, radius: f32, a: f32, b: f32) -> f32 {
    let square = a * a + b * b;
    let cross = p * b - q * a;
    let inside = radius * radius * square - cross * cross;
    let t = (p * a + q * b - inside.max(0.0).sqrt()) / square;
    if inside > 0.0 { t } else { -1.0 }
}

/// Where a ray enters and leaves an ellipsoid.
fn ellipsoid(centre: [f32; 3], radii: [f32; 3], d: [f32; 3]) -> Option<(f32, f32)> {
    let c: [f32; 3] = std::array::from_fn(|k| centre[k] / radii[k]);
    let d: [f32; 3] = std::array::from_fn(|k| d[k] / radii[k]);
    let square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
    let cross = [c[1] * d[2] - c[2] * d[1], c[2] * d[0] - c[0] * d[2], c[0] * d[1] - c[1] * d[0]];
    let inside = square - (cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2]);
    if inside <= 0.0 {
        return None;
    }
    let (middle, root) = (c[0] * d[0] + c[1] * d[1] + c[2] * d[2], inside.sqrt());
    Some(((middle - root) / square, (middle + root) / square))
}

/// Whether there are leaves at the point `p` of a crown's shell.
fn leaves(centre: [f32; 3], p: [f32; 3], seed: u32) -> bool {
    let at = |cells: f32| noise3(std::array::from_fn(|k| (p[k] - centre[k]) * cells), seed);
    // The second octave, within 0.225 of zero, is only asked where it can decide.
    let first = at(2.7);
    first > 0.075 || first > -0.375 && first + 0.45 * at(6.5) > -0.15
}

impl Placed {
    /// Which of a solid's faces is hit at depth `t` along `d`: the axis of its normal, as in [`Self::normal`].
    pub(crate) fn face(&self, d: [f32; 3], t: f32) -> usize {
        match self {
            Placed::Ground { .. } | Placed::Crown { .. } => 1,
            Placed::Pole { .. } => 0,
            _ => self.normal(d, t).0,
        }
    }

    /// The axis that a surface's normal is closest to, and the unit normal towards the eye, at depth `t` along `d`.
    pub(crate) fn normal(&self, d: [f32; 3], t: f32) -> (usize, [f32; 3]) {
        let p = d.map(|x| x * t);
        let axis = |k: usize| {
            let mut n = [0.0; 3];
            n[k] = if d[k] > 0.0 { -1.0 } else { 1.0 };
            (k, n)
        };
        let unit = |n: [f32; 3]| {
            let length = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt().max(1e-9);
            let sign = if n[0] * d[0] + n[1] * d[1] + n[2] * d[2] > 0.0 { -1.0 } else { 1.0 };
            n.map(|x| sign * x / length)
        };
        match *self {
            Placed::Ground { .. } => axis(1),
            Placed::Box { low, high } => {
                let gap = |k: usize| (p[k] - low[k]).abs().min((p[k] - high[k]).abs());
                axis(if gap(0) < gap(1) && gap(0) < gap(2) {
                    0
                } else if gap(1) < gap(2) {
                    1
                } else {
                    2
                })
            }
            Placed::Frustum { planes } => {
                let gap = |[a, b, c, k]: [f32; 4]| (a * p[0] + b * p[1] + c * p[2] - k).abs();
                let best = (1..6).fold(0, |best, i| if gap(planes[i]) < gap(planes[best]) { i } else { best });
                (best / 2, unit([planes[best][0], planes[best][1], planes[best][2]]))
            }
            Placed::Pole { x, z, .. } => (0, unit([p[0] - x, 0.0, p[2] - z])),
            Placed::Wheel { x, y, z, radius } => {
                let (py, pz) = (p[1] - y, p[2] - z);
                let tread = (py * py + pz * pz).sqrt() - radius;
                let cap = (p[0] - x[0]).abs().min((p[0] - x[1]).abs());
                if cap < tread.abs() { axis(0) } else { (1, unit([0.0, py, pz])) }
            }
            Placed::Crown { centre, radii, .. } => {
                (1, unit(std::array::from_fn(|k| (p[k] - centre[k]) / (radii[k] * radii[k]))))
            }
        }
    }
}

/// Part of the picture, in pixels: `[left, right, top, bottom]`, pixel centres at whole numbers.
pub(crate) type Rect = [f64; 4];

/// The part of the picture in which a solid can be seen; none if it is behind the camera or too far.
pub(crate) fn on_screen(shape: &Shape, view: &View) -> Option<Rect> {
    let Some((low, high)) = shape.bounds() else { return Some([-1e9, 1e9, -1e9, 1e9]) };
    let corner = |i: usize| {
        let p = std::array::from_fn(|k| if i >> k & 1 == 0 { low[k] } else { high[k] });
        view.pose.to_camera(p)
    };
    let corners: [[f64; 3]; 8] = std::array::from_fn(corner);
    if corners.iter().all(|c| c[2] > FAR as f64) {
        return None;
    }
    let near = 0.5 * NEAR as f64;
    let mut rect = [f64::INFINITY, f64::NEG_INFINITY, f64::INFINITY, f64::NEG_INFINITY];
    let mut see = |p: [f64; 3]| {
        let u = p[0] / p[2] * view.focal[0] + view.centre[0];
        let v = p[1] / p[2] * view.focal[1] + view.centre[1];
        rect = [rect[0].min(u), rect[1].max(u), rect[2].min(v), rect[3].max(v)];
    };
    for i in 0..8 {
        if corners[i][2] >= near {
            see(corners[i]);
        }
        // The edges of the box that cross the near plane.
        for k in 0..3 {
            let j = i | 1 << k;
            let (a, b) = (corners[i], corners[j]);
            if j != i && (a[2] < near) != (b[2] < near) {
                let s = (near - a[2]) / (b[2] - a[2]);
                see(std::array::from_fn(|k| if k == 2 { near } else { a[k] + s * (b[k] - a[k]) }));
            }
        }
    }
    (rect[0] <= rect[1]).then_some(rect)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::street::{Pose, StreetConfig};

    fn view() -> View {
        let config = StreetConfig { height: 48, width: 160, ..StreetConfig::default() };
        View::new(&config, config.intrinsics, Pose::new([0.2, 0.0, 1.0], 0.05, 0.01))
    }

    fn shapes() -> Vec<Shape> {
        vec![
            Shape::Ground { y: 1.65 },
            Shape::Box { low: [1.0, -1.0, 6.0], high: [3.0, 1.65, 9.0] },
            Shape::Box { low: [-9.0, -3.0, -6.0], high: [-2.0, 1.65, 9.0] },
            Shape::Frustum { top_y: 0.2, top: [-1.0, 0.5, 8.0, 9.0], bottom_y: 1.4, bottom: [-1.3, 0.8, 7.0, 11.0] },
            Shape::Pole { x: 1.0, z: 7.0, radius: 0.2, top_y: -3.0, bottom_y: 1.65 },
            Shape::Wheel { x: [0.5, 0.9], y: 1.0, z: 5.0, radius: 0.6 },
            Shape::Crown { centre: [-1.0, -0.4, 12.0], radii: [1.5, 1.0, 2.0], seed: 3 },
        ]
    }

    /// Whether a world point lies on the surface.
    fn on_surface(shape: &Shape, p: [f64; 3]) -> bool {
        let e = 2e-3;
        match *shape {
            Shape::Ground { y } => (p[1] - y).abs() < e,
            Shape::Box { low, high } => {
                let inside = (0..3).all(|k| p[k] > low[k] - e && p[k] < high[k] + e);
                inside && (0..3).any(|k| (p[k] - low[k]).abs() < e || (p[k] - high[k]).abs() < e)
            }
            Shape::Frustum { top_y, top, bottom_y, bottom } => {
                let s = (p[1] - top_y) / (bottom_y - top_y);
                let r: [f64; 4] = std::array::from_fn(|i| top[i] + s * (bottom[i] - top[i]));
                let inside = p[0] > r[0] - e && p[0] < r[1] + e && p[2] > r[2] - e && p[2] < r[3] + e;
                let face = [p[0] - r[0], p[0] - r[1], p[2] - r[2], p[2] - r[3], s, s - 1.0];
                inside && (-e..1.0 + e).contains(&s) && face.iter().any(|x| x.abs() < e)
            }
            Shape::Pole { x, z, radius, .. } => ((p[0] - x).hypot(p[2] - z) - radius).abs() < e,
            Shape::Wheel { x, y, z, radius } => {
                let r = (p[1] - y).hypot(p[2] - z);
                let cap = r < radius + e && ((p[0] - x[0]).abs() < e || (p[0] - x[1]).abs() < e);
                cap || (r - radius).abs() < e && p[0] > x[0] - e && p[0] < x[1] + e
            }
            Shape::Crown { centre, radii, .. } => {
                let r: f64 = (0..3).map(|k| ((p[k] - centre[k]) / radii[k]).powi(2)).sum();
                (r - 1.0).abs() < 4.0 * e
            }
        }
    }

    #[test]
    fn hits_lie_on_the_surface_inside_the_screen_bounds_with_a_normal_towards_the_eye() {
        let view = view();
        let columns: Vec<f32> = (0..160).map(|u| ((u as f64 - view.centre[0]) / view.focal[0]) as f32).collect();
        for shape in shapes() {
            let placed = shape.place(view.pose.position);
            let rect = on_screen(&shape, &view).expect("it is in front");
            let mut hits = 0;
            for v in 0..48 {
                let mut rays = Rays::default();
                rays.aim(&view, v as f64, &columns);
                rays.meet(0..160, &placed, 5);
                for u in (0..160).filter(|&u| rays.who[u] == 5) {
                    hits += 1;
                    let (d, t) = (rays.direction(u), rays.depth[u]);
                    let p = std::array::from_fn(|k| view.pose.position[k] + (d[k] * t) as f64);
                    assert!(on_surface(&shape, p), "{shape:?} {p:?}");
                    assert!((view.pose.to_camera(p)[2] - t as f64).abs() < 1e-3);
                    let (u, v) = (u as f64, v as f64);
                    assert!(u >= rect[0] - 1e-3 && u <= rect[1] + 1e-3 && v >= rect[2] - 1e-3 && v <= rect[3] + 1e-3);
                    let (axis, n) = placed.normal(d, t);
                    assert_eq!(axis, placed.face(d, t));
                    assert!((n.iter().map(|x| x * x).sum::<f32>() - 1.0).abs() < 1e-4);
                    assert!(n[0] * d[0] + n[1] * d[1] + n[2] * d[2] <= 0.0);
                }
            }
            assert!(hits > 10, "{shape:?}: {hits}");
        }
    }

    #[test]
    fn what_is_behind_or_too_far_is_not_on_screen() {
        let view = view();
        let at = |z: f64| Shape::Box { low: [0.0, 0.0, z], high: [1.0, 1.0, z + 1.0] };
        assert!(on_screen(&at(-5.0), &view).is_none());
        assert!(on_screen(&at(FAR as f64 + 5.0), &view).is_none());
        assert!(on_screen(&at(20.0), &view).is_some());
    }
}
