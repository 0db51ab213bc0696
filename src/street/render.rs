//! From a street and a view to a picture and exact depth: one ray at a pixel's centre for depth, nine for colour,
//! which find the edges.

use image::RgbImage;
use rayon::prelude::*;

use super::camera::View;
use super::shape::{NOTHING, Placed, Rays, Rect, on_screen};
use super::surface::Point;
use super::world::{Solid, World};
use crate::depth::DepthMap;

/// Rays a pixel, along each side.
const GRID: usize = 3;
/// A footprint over the pixel it stands for.
const FILTER: f32 = 1.0;

/// A solid as one view sees it.
struct Seen<'a> {
    solid: &'a Solid,
    placed: Placed,
    rect: Rect,
    /// How far ahead of the eye it begins along the street, in metres.
    near: f64,
    /// The origin of its texture, relative to the eye.
    origin: [f32; 3],
    who: u32,
}

/// A street from one place at one moment.
pub(crate) struct Scene<'a> {
    world: &'a World,
    view: View,
    frame: usize,
    seen: Vec<Seen<'a>>,
    /// Where each solid is among `seen`.
    index: Vec<u32>,
}

impl<'a> Scene<'a> {
    /// The street at a frame, with what cannot be seen left out.
    pub(crate) fn new(world: &'a World, view: View, frame: usize) -> Self {
        let mut seen = Vec::new();
        let mut index = vec![NOTHING; world.solids.len()];
        for (who, solid) in world.solids.iter().enumerate() {
            let by = solid.speed * frame as f64;
            let shape = solid.shape.forward(by);
            let Some(rect) = on_screen(&shape, &view) else { continue };
            let [right, bottom] = [view.width, view.height].map(|n| n as f64);
            if rect[1] < -1.0 || rect[0] > right || rect[3] < -1.0 || rect[2] > bottom {
                continue;
            }
            let eye = view.pose.position;
            let origin = [solid.origin[0], solid.origin[1], solid.origin[2] + by];
            let origin = std::array::from_fn(|k| (origin[k] - eye[k]) as f32);
            let near = shape.bounds().map_or(0.0, |(low, _)| low[2] - eye[2]);
            seen.push(Seen { solid, placed: shape.place(eye), rect, near, origin, who: who as u32 });
        }
        // Nearest first, so that what is hidden is left alone early; a stable sort keeps ties in order.
        seen.sort_by(|a: &Seen, b: &Seen| a.near.total_cmp(&b.near));
        for (i, seen) in seen.iter().enumerate() {
            index[seen.who as usize] = i as u32;
        }
        Scene { world, view, frame, seen, index }
    }

    /// Casts the rays through row `v` and `per` evenly spaced points a pixel.
    fn cast(&self, rays: &mut Rays, v: f64, columns: &[f32], per: usize) {
        rays.aim(&self.view, v, columns);
        // The index of the first ray not left of `u`, with one pixel to spare for rounding.
        let index = |u: f64| ((u + 0.5) * per as f64).clamp(0.0, columns.len() as f64) as usize;
        for seen in &self.seen {
            let [left, right, top, bottom] = seen.rect;
            if v >= top - 0.01 && v <= bottom + 0.01 {
                rays.meet(index(left - 1.0)..index(right + 1.0), &seen.placed, seen.who);
            }
        }
    }

    /// The slopes `x/z` of `per` rays a pixel along a row.
    fn columns(&self, per: usize) -> Vec<f32> {
        let slope = |i: usize| {
            let u = (i as f64 + 0.5) / per as f64 - 0.5;
            ((u - self.view.centre[0]) / self.view.focal[0]) as f32
        };
        (0..self.view.width * per).map(slope).collect()
    }

    /// Exact depth at the pixels' centres, in metres; 0 for the sky.
    pub(crate) fn depth(&self) -> DepthMap {
        let View { width, height, .. } = self.view;
        let mut metres = vec![0f32; width * height];
        let columns = self.columns(1);
        metres.par_chunks_mut(width.max(1)).enumerate().for_each_init(Rays::default, |rays, (y, row)| {
            self.cast(rays, y as f64, &columns, 1);
            for ((out, &depth), &who) in row.iter_mut().zip(&rays.depth).zip(&rays.who) {
                *out = if who == NOTHING { 0.0 } else { depth };
            }
        });
        DepthMap { width, height, metres }
    }

    /// The picture.
    pub(crate) fn image(&self) -> RgbImage {
        let View { width, height, .. } = self.view;
        let mut image = RgbImage::new(width as u32, height as u32);
        let columns = self.columns(GRID);
        let shader = Shader::new(self);
        let rows = image.par_chunks_mut(3 * width.max(1)).enumerate();
        rows.for_each_init(<[Rays; GRID]>::default, |rays, (y, row)| {
            for (j, rays) in rays.iter_mut().enumerate() {
                let v = y as f64 + (j as f64 + 0.5) / GRID as f64 - 0.5;
                self.cast(rays, v, &columns, GRID);
            }
            for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
                let colour = shader.pixel(rays, x);
                for (out, c) in pixel.iter_mut().zip(colour) {
                    *out = (c.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
                }
            }
        });
        image
    }
}

/// The colours of rays.
struct Shader<'a> {
    scene: &'a Scene<'a>,
    /// The camera's x and y axes in the world, times the slope between two pixels.
    across: [f32; 3],
    down: [f32; 3],
    /// The eye in the world.
    eye: [f32; 3],
    pixel: f32,
}

impl<'a> Shader<'a> {
    fn new(scene: &'a Scene<'a>) -> Self {
        let view = &scene.view;
        let [x, y, _] = view.axes();
        let step = view.focal.map(|f| (FILTER as f64 / f) as f32);
        let eye = view.pose.position.map(|x| x as f32);
        Shader { scene, across: x.map(|a| a * step[0]), down: y.map(|a| a * step[1]), eye, pixel: step[0].max(step[1]) }
    }

    /// The colour of a pixel. Texture is averaged over the pixel's footprint already, so one ray a surface is coloured,
    /// the one nearest to the middle of that surface's rays, and counts for all of them.
    fn pixel(&self, rays: &[Rays; GRID], x: usize) -> [f32; 3] {
        let first = GRID * x;
        let surface = |j: usize, i: usize| {
            let (row, i) = (&rays[j], first + i);
            let who = row.who[i];
            if who == NOTHING { (who, 0) } else { (who, self.seen(who).placed.face(row.direction(i), row.depth[i])) }
        };
        let who = rays[0].who[first];
        let one = rays.iter().all(|row| row.who[first..first + GRID].iter().all(|&w| w == who));
        if one && (who == NOTHING || flat(rays, first)) {
            return self.ray(&rays[GRID / 2], first + GRID / 2).map(|c| c.min(1.0));
        }
        let all: [_; GRID * GRID] = std::array::from_fn(|k| surface(k / GRID, k % GRID));
        let mut sum = [0f32; 3];
        for (k, &face) in all.iter().enumerate() {
            if all[..k].contains(&face) {
                continue;
            }
            let (mut n, mut y, mut x) = (0, 0, 0);
            for m in (k..all.len()).filter(|&m| all[m] == face) {
                (n, y, x) = (n + 1, y + m / GRID, x + m % GRID);
            }
            // Distances to the middle, times the number of rays to stay with whole numbers.
            let off = |m: usize| (n * (m / GRID)).abs_diff(y).pow(2) + (n * (m % GRID)).abs_diff(x).pow(2);
            let middle = (k..all.len()).filter(|&m| all[m] == face).min_by_key(|&m| off(m)).unwrap_or(k);
            let colour = self.ray(&rays[middle / GRID], first + middle % GRID);
            let weight = n as f32 / all.len() as f32;
            sum = std::array::from_fn(|c| sum[c] + weight * colour[c].min(1.0));
        }
        sum
    }

    /// What a ray has hit.
    fn seen(&self, who: u32) -> &Seen<'a> {
        &self.scene.seen[self.scene.index[who as usize] as usize]
    }

    /// The colour of one ray.
    fn ray(&self, rays: &Rays, i: usize) -> [f32; 3] {
        let light = &self.scene.world.light;
        let d = rays.direction(i);
        if rays.who[i] == NOTHING {
            return light.sky(d, self.pixel);
        }
        let seen = self.seen(rays.who[i]);
        let t = rays.depth[i];
        let (axis, normal) = seen.placed.normal(d, t);
        let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        // How the point of a plane moves with the pixel: t (a - d (n.a)/(n.d)) for each axis `a` of the picture.
        let facing = dot(normal, d).min(-1e-4);
        let (na, nb) = (dot(normal, self.across) / facing, dot(normal, self.down) / facing);
        let footprint =
            std::array::from_fn(|k| t * ((self.across[k] - d[k] * na).abs() + (self.down[k] - d[k] * nb).abs()));
        let at = d.map(|x| x * t);
        let world: [f32; 3] = std::array::from_fn(|k| self.eye[k] + at[k]);
        let local = std::array::from_fn(|k| at[k] - seen.origin[k]);
        let point = Point { world, local, footprint, axis, normal };
        let (material, seed, wear) = (&seen.solid.material, seen.solid.seed, self.scene.world.wear);
        let colour = if wear < 1.0 { material.worn(&point, seed, wear) } else { material.colour(&point, seed) };
        let mut factor = light.on(world, normal);
        if axis == 1 && world[0].abs() < 6.5 && seen.solid.shape.bounds().is_none_or(|(_, high)| high[1] > 1.9) {
            factor *= self.scene.world.open(world, self.scene.frame);
        }
        light.through(colour.map(|c| c * factor), t)
    }
}

/// Whether a pixel's rays, all on one solid, hit one plane: on a plane `1/depth` is linear in the picture.
fn flat(rays: &[Rays; GRID], first: usize) -> bool {
    let last = GRID - 1;
    let near = |j: usize, i: usize| 1.0 / rays[j].depth[first + i];
    let twice = 2.0 * near(GRID / 2, GRID / 2);
    let off = (twice - near(0, 0) - near(last, last)).abs().max((twice - near(0, last) - near(last, 0)).abs());
    off < 3e-5 * twice
}
