//! The reprojection of Monodepth2 and MonoViT in one op: what the target camera would see, taken from a source image.
//!
//! A row is worked on in blocks of pixels: where they project to is computed side by side (it vectorises), then the
//! four pixels around each place are fetched one place after the other. Nothing but the inputs is saved: projecting
//! again in the backward pass costs less than writing the coordinates out and reading them back.

use crate::ops::Tile;
use crate::ops::support::put::{begin_sum, put, put_rounded};
use crate::ops::{Case, Checked, Input, Needs, Op, ShapeError, apply1};
use crate::random::Random;
use crate::tensor::{Accum, Float, GradSink, Shape, Tensor, Upstream, Var, parallel, pool::Buffer, regime};

/// Guards the division by the projected depth, as published.
const EPSILON: f64 = 1e-7;

/// View synthesis: `source [batch, height, width, channels]` seen from the target camera, given the target's `depth
/// [batch, height, width, 1]` and the rigid `transform [batch, 3, 4]` from target to source camera.
///
/// Pixel (u, v, 1) -> K^-1 -> times depth -> transform -> K -> divided by (z + 1e-7) -> sampled bilinearly. Outside,
/// the nearest edge pixel; there, and on the centres of the outermost pixels, the gradient by depth and transform is 0.
/// What lies behind the camera is projected through it like the rest. Places may be infinite (they clamp); NaN gives
/// NaN.
#[derive(Clone, Debug)]
pub struct Warp {
    /// Focal lengths and principal point of every sample, in pixels: fx, fy, cx, cy.
    pub intrinsics: Vec<[f64; 4]>,
    /// Whether the projected pixel itself is sampled. If not, the published combination: a grid made for aligned
    /// corners is sampled as one for corners that are not, so that u becomes `u W / (W - 1) - 1/2`.
    pub consistent: bool,
    /// Rows handed to a thread at a time; 8 by default.
    pub tile: Tile,
}

/// Pixels worked on side by side.
const BLOCK: usize = 64;

/// The matrices of one sample: pixel (u, v) at depth d projects to `d M (u, v, 1) + m`, with `M = K R K^-1`, `m = K t`.
struct Projection<T> {
    matrix: [[T; 3]; 3],
    offset: [T; 3],
    /// From projected pixels to places in the image, x and y: factor and summand.
    scale: [T; 2],
    shift: T,
    /// The last column and row.
    last: [T; 2],
}

/// Where a block of pixels projects to.
struct Places<T> {
    /// Projected, in pixels: u and v.
    pixel: [[T; BLOCK]; 2],
    /// 1 / (z + epsilon).
    inverse: [T; BLOCK],
    /// The fraction of the way to the next column and row.
    fraction: [[T; BLOCK]; 2],
    /// Whether the place moves along x and y: it lies inside.
    free: [[bool; BLOCK]; 2],
    /// The element at the upper left of each place.
    first: [usize; BLOCK],
}

impl<T: Float> Places<T> {
    fn new() -> Self {
        Places {
            pixel: [[T::ZERO; BLOCK]; 2],
            inverse: [T::ZERO; BLOCK],
            fraction: [[T::ZERO; BLOCK]; 2],
            free: [[false; BLOCK]; 2],
            first: [0; BLOCK],
        }
    }
}

/// A whole number of this type as an index, at most `limit` whatever it is (NaN included). Adding 1 / epsilon leaves it
/// in the low bits of the mantissa: unlike a cast, that vectorises.
#[inline(always)]
fn index<T: Float>(x: T, limit: usize) -> usize {
    let magic = T::ONE / T::EPSILON;
    ((x + magic).bits().wrapping_sub(magic.bits()) as usize).min(limit)
}

impl<T: Float> Projection<T> {
    /// Projects the pixels `u0..` of row `v`, as many as there are depths, at most [`BLOCK`].
    #[inline(always)]
    fn project(&self, depth: &[T], u0: usize, v: usize, size: [usize; 2], channels: usize, to: &mut Places<T>) {
        let n = depth.len().min(BLOCK);
        let [height, width] = size;
        let v = T::of(v as f64);
        let base = |k: usize| self.matrix[k][1].mul_add(v, self.matrix[k][2]);
        let (base0, base1, base2) = (base(0), base(1), base(2));
        let epsilon = T::of(EPSILON);
        let before = [T::of((width - 2) as f64), T::of((height - 2) as f64)];
        for (i, &d) in depth[..n].iter().enumerate() {
            let u = T::of((u0 + i) as f64);
            let a = d.mul_add(u.mul_add(self.matrix[0][0], base0), self.offset[0]);
            let b = d.mul_add(u.mul_add(self.matrix[1][0], base1), self.offset[1]);
            let z = d.mul_add(u.mul_add(self.matrix[2][0], base2), self.offset[2]);
            let inverse = T::ONE / (z + epsilon);
            to.inverse[i] = inverse;
            let mut cell = [T::ZERO; 2];
            for (axis, projected) in [a, b].into_iter().enumerate() {
                let pixel = projected * inverse;
                to.pixel[axis][i] = pixel;
                let place = pixel.mul_add(self.scale[axis], self.shift);
                to.free[axis][i] = !(place <= T::ZERO || place >= self.last[axis]);
                let place = place.max(T::ZERO).min(self.last[axis]);
                cell[axis] = place.floor().min(before[axis]);
                to.fraction[axis][i] = place - cell[axis];
            }
            to.first[i] = (index(cell[1], height - 2) * width + index(cell[0], width - 2)) * channels;
        }
    }
}

/// From a to b.
#[inline(always)]
fn lerp<T: Float>(a: T, b: T, fraction: T) -> T {
    (b - a).mul_add(fraction, a)
}

/// The two pixels at the upper left of a place and the two below, side by side in memory.
#[inline(always)]
fn quad<T>(image: &[T], first: usize, row: usize, channels: usize) -> [&[T]; 4] {
    let (top, bottom) = (&image[first..][..2 * channels], &image[first + row..][..2 * channels]);
    let ((a, b), (c, d)) = (top.split_at(channels), bottom.split_at(channels));
    [a, b, c, d]
}

impl Warp {
    fn tile(&self) -> usize {
        self.tile.or(8)
    }

    /// Folds intrinsics and transform of one sample into a projection.
    fn projection<T: Float>(&self, sample: usize, transform: &[T], height: usize, width: usize) -> Projection<T> {
        let [fx, fy, cx, cy] = self.intrinsics[sample];
        let t = |row: usize, col: usize| transform[sample * 12 + row * 4 + col].f64();
        // K [R | t], column by column, then from the right K^-1.
        let left = |col: usize| [fx * t(0, col) + cx * t(2, col), fy * t(1, col) + cy * t(2, col), t(2, col)];
        let (p0, p1, p2, offset) = (left(0), left(1), left(2), left(3));
        let matrix = std::array::from_fn(|k| {
            let (a, b) = (p0[k] / fx, p1[k] / fy);
            [T::of(a), T::of(b), T::of(p2[k] - cx * a - cy * b)]
        });
        let size = [width as f64, height as f64];
        let scale = if self.consistent { [1.0; 2] } else { size.map(|n| n / (n - 1.0)) };
        Projection {
            matrix,
            offset: offset.map(T::of),
            scale: scale.map(T::of),
            shift: T::of(if self.consistent { 0.0 } else { -0.5 }),
            last: size.map(|n| T::of(n - 1.0)),
        }
    }

    /// From the gradient by M (three columns) and m of one sample to that by its transform.
    fn unfold(&self, sample: usize, by: [[f64; 4]; 3]) -> [f64; 12] {
        let [fx, fy, cx, cy] = self.intrinsics[sample];
        // d(K R) = dM K^-T, then K^T from the left; the translation's column needs the latter alone.
        let by = by.map(|[a, b, c, m]| [(a - cx * c) / fx, (b - cy * c) / fy, c, m]);
        let mut out = [0.0; 12];
        for col in 0..4 {
            out[col] = fx * by[0][col];
            out[4 + col] = fy * by[1][col];
            out[8 + col] = cx * by[0][col] + cy * by[1][col] + by[2][col];
        }
        out
    }
}

/// The extents of one call.
#[derive(Clone, Copy)]
struct Extents {
    batch: usize,
    height: usize,
    width: usize,
    channels: usize,
}

impl Extents {
    fn of<T: Float>(source: &Tensor<T>) -> Self {
        let [batch, height, width, channels] = source.shape().nhwc().expect("checked by the shape rule");
        Extents { batch, height, width, channels }
    }
    fn image(self) -> usize {
        self.height * self.width * self.channels
    }
    fn row(self) -> usize {
        self.width * self.channels
    }
    fn size(self) -> [usize; 2] {
        [self.height, self.width]
    }
}

/// One row of the warped image.
#[inline(always)]
fn warp_row<T: Float>(
    p: &Projection<T>,
    e: Extents,
    channels: usize,
    v: usize,
    image: &[T],
    depth: &[T],
    out: &mut [T],
) {
    let mut places = Places::new();
    for block in regime::blocks(0..depth.len(), BLOCK) {
        let (u0, out, depth) = (block.start, &mut out[block.start * channels..block.end * channels], &depth[block]);
        p.project(depth, u0, v, e.size(), channels, &mut places);
        let [fx, fy] = &places.fraction;
        for (((out, &first), &fx), &fy) in out.chunks_exact_mut(channels).zip(&places.first).zip(fx).zip(fy) {
            let [a, b, c, d] = quad(image, first, e.width * channels, channels);
            for k in 0..channels {
                out[k] = lerp(lerp(a[k], b[k], fx), lerp(c[k], d[k], fx), fy);
            }
        }
    }
}

/// The sums over one column of a tile, for each of the three numbers (u z', v z', z') that M and m make: of `d g`,
/// `v d g`, and `g`, where g is the gradient by that number and d the depth.
const SUMS: usize = 9;

/// One row of the gradient by depth, and its share of the sums for the transform. `g` is the upstream row.
#[inline(always)]
fn gradient_row<T: Float>(
    p: &Projection<T>,
    e: Extents,
    channels: usize,
    v: usize,
    [image, depth, g]: [&[T]; 3],
    by_depth: &mut [T],
    sums: &mut [T],
) {
    let mut places = Places::new();
    let mut by_place = [[T::ZERO; BLOCK]; 2];
    let vt = T::of(v as f64);
    let base: [T; 3] = std::array::from_fn(|k| p.matrix[k][1].mul_add(vt, p.matrix[k][2]));
    for block in regime::blocks(0..depth.len(), BLOCK) {
        let (u0, g) = (block.start, &g[block.start * channels..block.end * channels]);
        let (by_depth, depth) = (&mut by_depth[block.clone()], &depth[block]);
        p.project(depth, u0, v, e.size(), channels, &mut places);
        let [fx, fy] = &places.fraction;
        let [gx, gy] = &mut by_place;
        let pixels = g.chunks_exact(channels).zip(&places.first).zip(fx.iter().zip(fy));
        for (((g, &first), (&fx, &fy)), (gx, gy)) in pixels.zip(gx.iter_mut().zip(gy)) {
            let [a, b, c, d] = quad(image, first, e.width * channels, channels);
            let (mut x, mut y) = (T::ZERO, T::ZERO);
            for k in 0..channels {
                let (top, bottom) = (b[k] - a[k], d[k] - c[k]);
                x = g[k].mul_add(lerp(top, bottom, fy), x);
                y = g[k].mul_add(bottom.mul_add(fx, c[k]) - top.mul_add(fx, a[k]), y);
            }
            (*gx, *gy) = (x, y);
        }
        let n = depth.len().min(by_depth.len());
        let mut parts = sums.chunks_exact_mut(e.width);
        let sums: [&mut [T]; SUMS] = std::array::from_fn(|_| &mut parts.next().expect("nine rows")[u0..][..n]);
        let [d0, v0, g0, d1, v1, g1, d2, v2, g2] = sums;
        for i in 0..n {
            // Outside, the place is clamped: no gradient, even where the projection is infinite.
            let (free_x, free_y, inverse) = (places.free[0][i], places.free[1][i], places.inverse[i]);
            let a = by_place[0][i] * p.scale[0] * inverse;
            let a = if free_x { a } else { T::ZERO };
            let b = by_place[1][i] * p.scale[1] * inverse;
            let b = if free_y { b } else { T::ZERO };
            let along_x = a * places.pixel[0][i];
            let along_y = b * places.pixel[1][i];
            let z = -(if free_x { along_x } else { T::ZERO }) - (if free_y { along_y } else { T::ZERO });
            let u = T::of((u0 + i) as f64);
            let d = depth[i];
            let q0 = u.mul_add(p.matrix[0][0], base[0]);
            let q1 = u.mul_add(p.matrix[1][0], base[1]);
            let q2 = u.mul_add(p.matrix[2][0], base[2]);
            by_depth[i] = a.mul_add(q0, b.mul_add(q1, z * q2));
            let (da, db, dz) = (a * d, b * d, z * d);
            d0[i] += da;
            v0[i] = da.mul_add(vt, v0[i]);
            g0[i] += a;
            d1[i] += db;
            v1[i] = db.mul_add(vt, v1[i]);
            g1[i] += b;
            d2[i] += dz;
            v2[i] = dz.mul_add(vt, v2[i]);
            g2[i] += z;
        }
    }
}

/// Runs a kernel with the number of channels as a constant where there are three.
macro_rules! with_channels {
    ($channels:expr, |$c:ident| $body:expr) => {
        T::dispatch(
            #[inline(always)]
            || match $channels {
                3 => {
                    let $c = 3;
                    $body
                }
                $c => $body,
            },
        )
    };
}

impl Warp {
    /// The gradients by depth (written or added, if wanted) and by transform. Tiles of rows sum their share of the
    /// latter column by column; the tiles are then added in order, in f64.
    fn geometry_gradient<T: Float>(
        &self,
        [source, depth, transform, g]: [&Tensor<T>; 4],
        by_depth: Option<(&mut [T], Accum)>,
    ) -> Vec<[f64; 12]> {
        let e = Extents::of(source);
        let tile = self.tile().min(e.height);
        let tiles = e.height.div_ceil(tile);
        let accum = by_depth.as_ref().map_or(Accum::Replace, |(_, accum)| *accum);
        let mut out: Vec<Option<&mut [T]>> = match by_depth {
            None => (0..e.batch * tiles).map(|_| None).collect(),
            Some((out, _)) => out
                .chunks_mut(e.height * e.width)
                .flat_map(|sample| sample.chunks_mut(tile * e.width))
                .map(Some)
                .collect(),
        };
        let mut partial = vec![[[0.0; 4]; 3]; e.batch * tiles];
        let pieces = out.drain(..).zip(&mut partial).enumerate();
        parallel::for_each_piece(pieces, 64 * g.len(), |(i, (mut out, partial))| {
            let (b, first) = (i / tiles, i % tiles * tile);
            let p = self.projection(b, transform.data(), e.height, e.width);
            let image = &source.data()[b * e.image()..][..e.image()];
            let mut sums = Buffer::filled(SUMS * e.width, T::ZERO);
            let mut row = Buffer::stale(e.width);
            for v in first..(first + tile).min(e.height) {
                let at = b * e.height + v;
                let depth = &depth.data()[at * e.width..][..e.width];
                let g = &g.data()[at * e.row()..][..e.row()];
                with_channels!(e.channels, |c| gradient_row(&p, e, c, v, [image, depth, g], &mut row, &mut sums));
                if let Some(out) = &mut out {
                    let out = out[(v - first) * e.width..][..e.width].iter_mut().zip(row.iter());
                    put(accum, out.map(|(o, &d)| (o, d)));
                }
            }
            for (by, sums) in partial.iter_mut().zip(sums.chunks_exact(3 * e.width)) {
                for (u, d) in sums[..e.width].iter().enumerate() {
                    by[0] += u as f64 * d.f64();
                    by[2] += d.f64();
                }
                by[1] = sums[e.width..2 * e.width].iter().map(|x| x.f64()).sum();
                by[3] = sums[2 * e.width..].iter().map(|x| x.f64()).sum();
            }
        });
        let samples = partial.chunks_exact(tiles).enumerate();
        samples
            .map(|(b, parts)| {
                let mut sum = [[0.0; 4]; 3];
                for part in parts {
                    sum.iter_mut().flatten().zip(part.iter().flatten()).for_each(|(s, p)| *s += p);
                }
                self.unfold(b, sum)
            })
            .collect()
    }

    /// The gradient by the source: every pixel of the result hands its own back to the four it came from. Samples are
    /// independent of each other; within one, in order.
    fn source_gradient<T: Float>(
        &self,
        [depth, transform, g]: [&Tensor<T>; 3],
        e: Extents,
        out: &mut [T],
        accum: Accum,
    ) {
        parallel::for_each_unit(out, e.image(), 32 * g.len(), |b, out| {
            begin_sum(out, accum);
            let p = self.projection(b, transform.data(), e.height, e.width);
            let mut places = Places::new();
            for v in 0..e.height {
                let at = b * e.height + v;
                let depth = &depth.data()[at * e.width..][..e.width];
                let g = &g.data()[at * e.row()..][..e.row()];
                for block in regime::blocks(0..depth.len(), BLOCK) {
                    let g = &g[block.start * e.channels..block.end * e.channels];
                    let (u0, depth) = (block.start, &depth[block]);
                    p.project(depth, u0, v, e.size(), e.channels, &mut places);
                    let [fx, fy] = &places.fraction;
                    for (((g, &first), &fx), &fy) in g.chunks_exact(e.channels).zip(&places.first).zip(fx).zip(fy) {
                        for (row, weight) in [(first, T::ONE - fy), (first + e.row(), fy)] {
                            let (left, right) = out[row..][..2 * e.channels].split_at_mut(e.channels);
                            let (l, r) = (weight * (T::ONE - fx), weight * fx);
                            left.iter_mut().zip(g).for_each(|(x, &g)| *x = g.mul_add(l, *x));
                            right.iter_mut().zip(g).for_each(|(x, &g)| *x = g.mul_add(r, *x));
                        }
                    }
                }
            }
        });
    }
}

impl<T: Float> Op<T> for Warp {
    /// The three inputs.
    type Saved = [Tensor<T>; 3];

    fn shape(&self, inputs: &[Shape]) -> Result<Vec<Shape>, ShapeError> {
        let Some([batch, height, width, channels]) = inputs[0].nhwc() else {
            return Err(ShapeError::new("expected a source [batch, height, width, channels]"));
        };
        if height < 2 || width < 2 || channels == 0 {
            return Err(ShapeError::new("expected a source of 2x2 pixels at least"));
        }
        if inputs[1].dims() != [batch, height, width, 1] {
            return Err(ShapeError::new("expected depth [batch, height, width, 1], of the source's size"));
        }
        if inputs[2].dims() != [batch, 3, 4] {
            return Err(ShapeError::new("expected transforms [batch, 3, 4]"));
        }
        if self.intrinsics.len() != batch {
            return Err(ShapeError::new(format!("{} intrinsics for a batch of {batch}", self.intrinsics.len())));
        }
        Ok(vec![inputs[0]])
    }

    fn algo(&self, inputs: &[Shape]) -> &'static str {
        match (inputs[0].last(), self.consistent) {
            (3, false) => "rgb",
            (3, true) => "rgb_consistent",
            (_, false) => "channels",
            (_, true) => "channels_consistent",
        }
    }

    fn flops(&self, inputs: &[Shape]) -> u64 {
        (inputs[1].len() * (28 + 6 * inputs[0].last())) as u64
    }

    fn forward(&self, inputs: &[&Tensor<T>], _: &Needs) -> (Vec<Tensor<T>>, Self::Saved) {
        let [source, depth, transform] = [inputs[0], inputs[1], inputs[2]];
        let e = Extents::of(source);
        let tile = self.tile();
        let y = Tensor::build(*source.shape(), |out| {
            parallel::for_each_chunk(out, tile * e.row(), 16 * source.len(), |i, out| {
                for (k, out) in out.chunks_exact_mut(e.row()).enumerate() {
                    let at = i * tile + k;
                    let (b, v) = (at / e.height, at % e.height);
                    let p = self.projection(b, transform.data(), e.height, e.width);
                    let image = &source.data()[b * e.image()..][..e.image()];
                    let depth = &depth.data()[at * e.width..][..e.width];
                    with_channels!(e.channels, |c| warp_row(&p, e, c, v, image, depth, out));
                }
            });
        });
        (vec![y], [source.clone(), depth.clone(), transform.clone()])
    }

    /// With (a, b, z) = d M (u, v, 1) + m and the place (a, b) / (z + epsilon): the image's slopes give the gradient by
    /// the place; da = dx / z', db = dy / z', dz = -(a da + b db) / z'. Then dd = (da, db, dz) . M (u, v, 1),
    /// dM = sum d (da, db, dz) (u, v, 1)^T, dm = sum (da, db, dz), and M = K R K^-1, m = K t are linear.
    fn backward(&self, [source, depth, transform]: Self::Saved, upstream: Upstream<T>, sink: &mut GradSink<T>) {
        let g = upstream.only();
        let all = [&source, &depth, &transform, &g];
        sink.accumulate(0, |out, accum| {
            self.source_gradient([&depth, &transform, &g], Extents::of(&source), out, accum);
        });
        let mut by_transform = None;
        sink.accumulate(1, |out, accum| by_transform = Some(self.geometry_gradient(all, Some((out, accum)))));
        sink.accumulate(2, |out, accum| {
            let by_transform = by_transform.unwrap_or_else(|| self.geometry_gradient(all, None));
            put_rounded(out, accum, by_transform.into_iter().flatten());
        });
    }
}

impl Checked for Warp {
    fn cases() -> Vec<Case<Self>> {
        // The camera of a small image, and two more with other focal lengths and centres.
        let intrinsics = |height: usize, width: usize| {
            let (w, h) = (width as f64, height as f64);
            let [first, second] = [[0.58 * w, 1.92 * h, 0.5 * w, 0.5 * h], [0.7 * w, 1.5 * h, 0.45 * w, 0.6 * h]];
            vec![first, second, [0.9 * w, 1.1 * h, 0.55 * w, 0.4 * h]]
        };
        let pose = [
            [0.999, -0.02, 0.04, 0.3, 0.021, 0.9995, -0.015, -0.1, -0.039, 0.016, 0.999, 0.25],
            [0.998, 0.03, -0.05, -0.4, -0.031, 0.9993, 0.02, 0.05, 0.051, -0.018, 0.9985, -0.3],
            [0.9985, 0.01, 0.05, 0.2, -0.012, 0.9992, 0.036, 0.2, -0.05, -0.037, 0.998, 0.1],
        ];
        // The depth decides which pixels a place lies between: it is fixed, so that none is on the edge of two.
        let of = |name, consistent, tile, [batch, height, width, channels]: [usize; 4]| {
            let intrinsics = intrinsics(height, width)[..batch].to_vec();
            let op = Warp { intrinsics, consistent, tile: Tile::of(tile) };
            let source = Input::random("source", [batch, height, width, channels]);
            let depth = Input::fixed("depth", [batch, height, width, 1], 3.0, 6.0);
            Case::new(name, op, [source, depth, Input::values("transform", [batch, 3, 4], pose[..batch].concat())])
        };
        let case = |name, consistent, tile, [height, width, channels]: [usize; 3]| {
            of(name, consistent, tile, [2, height, width, channels])
        };
        let mut far = case("far outside", false, 0, [4, 5, 3]);
        far.terms.inputs[1] = Input::fixed("depth", [2, 4, 5, 1], 0.2, 1.0);
        vec![
            case("published grid", false, 0, [5, 8, 3]),
            case("consistent grid", true, 0, [5, 8, 3]),
            case("one channel", false, 0, [4, 7, 1]),
            case("many channels", true, 0, [3, 4, 17]),
            case("tile less one", false, 6, [5, 4, 3]),
            case("a whole tile", false, 5, [5, 4, 3]),
            case("tile and one", false, 4, [5, 4, 3]),
            case("wider than a block", false, 0, [2, 67, 3]),
            of("three cameras", true, 0, [3, 4, 5, 3]),
            far,
        ]
    }

    fn draw(random: &mut Random) -> Option<Case<Self>> {
        let [b, h, w] = [random.extreme(1, 4), random.extreme(2, 6), random.extreme(2, 9)];
        let mut camera = |n: usize| [random.uniform(0.5, 1.5) * n as f64, random.uniform(0.3, 0.7) * n as f64];
        let intrinsics = (0..b).map(|_| (camera(w), camera(h))).map(|([fx, cx], [fy, cy])| [fx, fy, cx, cy]).collect();
        let op = Warp { intrinsics, consistent: random.coin(), tile: Tile::of(random.extreme(0, 6)) };
        let unit = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        let transform: Vec<f64> = (0..b).flat_map(|_| unit).map(|x| x + random.uniform(-0.05, 0.05)).collect();
        let source = Input::random("source", [b, h, w, random.pick(&[1, 2, 3, 5])]);
        let depth = Input::uniform("depth", [b, h, w, 1], 2.0, 6.0);
        Some(Case::drawn(op, [source, depth, Input::values("transform", [b, 3, 4], transform)]))
    }
}

impl<T: Float> Var<T> {
    /// This source image `[batch, height, width, channels]` as the target camera would see it: target `depth [batch,
    /// height, width, 1]`, `transform [batch, 3, 4]` from target to source camera, `intrinsics` in pixels (fx, fy, cx,
    /// cy), one for each sample. `consistent` samples the projected pixel itself; the published combination does not.
    /// See [`Warp`].
    #[track_caller]
    pub fn warp(&self, depth: &Self, transform: &Self, intrinsics: &[[f64; 4]], consistent: bool) -> Self {
        let op = Warp { intrinsics: intrinsics.to_vec(), consistent, tile: Tile::AUTO };
        apply1(op, &[self, depth, transform])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::image::grid_sample::GridPadding;
    use crate::random::Random;
    use crate::tensor::Tape;

    fn uniform(random: &mut Random, shape: impl Into<Shape>, low: f64, high: f64) -> Tensor<f64> {
        let shape = shape.into();
        Tensor::from_vec(shape, (0..shape.len()).map(|_| random.uniform(low, high)).collect())
    }

    /// The same, step by step, of ops that know nothing of cameras.
    fn composed(v: &[Var<f64>], [fx, fy, cx, cy]: [f64; 4]) -> Var<f64> {
        let constant = |shape: &[usize], x: Vec<f64>| Var::constant(Tensor::from_vec(shape, x));
        let [batch, height, width, _] = v[0].shape().nhwc().unwrap();
        let pixels = (0..height * width).map(|i| ((i % width) as f64, (i / width) as f64));
        let rays = pixels.flat_map(|(x, y)| [(x - cx) / fx, (y - cy) / fy, 1.0, 0.0]).collect();
        let rays = constant(&[1, height, width, 4], rays);
        let points = &(&v[1] * &rays) + &constant(&[4], vec![0.0, 0.0, 0.0, 1.0]);
        let seen = points.reshape([batch, height * width, 4]).matmul(&v[2].permute(&[0, 2, 1]));
        let seen = seen.reshape([batch * height * width, 3]);
        let numerators = seen.matmul(&constant(&[3, 2], vec![fx, 0.0, 0.0, fy, cx, cy]));
        let z = seen.matmul(&constant(&[3, 1], vec![0.0, 0.0, 1.0])).affine(1.0, EPSILON);
        let last = constant(&[2], vec![(width - 1) as f64, (height - 1) as f64]);
        let grid = (&(&numerators / &z) / &last).affine(2.0, -1.0).reshape([batch, height, width, 2]);
        v[0].grid_sample(&grid, GridPadding::Border, false)
    }

    #[test]
    fn it_agrees_with_the_composition_of_plain_ops() {
        let camera = [10.0, 9.0, 8.3, 3.9];
        let mut random = Random::new(3, 1);
        let mut transform = uniform(&mut random, [2, 3, 4], -0.3, 0.3);
        for b in 0..2 {
            (0..3).for_each(|i| transform.data_mut()[b * 12 + i * 5] += 1.0);
        }
        let source = uniform(&mut random, [2, 8, 17, 3], 0.0, 1.0);
        let inputs = [source, uniform(&mut random, [2, 8, 17, 1], 1.0, 9.0), transform];
        let cotangent = uniform(&mut random, [2, 8, 17, 3], -1.0, 1.0);
        let run = |f: &dyn Fn(&[Var<f64>]) -> Var<f64>| {
            let tape = Tape::new();
            let v: Vec<_> = inputs.iter().map(|x| tape.leaf(x.clone())).collect();
            let y = f(&v);
            let mut gradients = tape.backward(&[(&y, cotangent.clone())]);
            let mut all: Vec<_> = v.iter().map(|v| gradients.take(v).unwrap()).collect();
            all.push(y.into_value());
            all
        };
        let fused = run(&|v| v[0].warp(&v[1], &v[2], &[camera; 2], false));
        for (a, b) in fused.iter().zip(run(&|v| composed(v, camera))) {
            let scale = b.data().iter().fold(0.0, |m: f64, x| m.max(x.abs()));
            assert!(a.data().iter().zip(b.data()).all(|(a, b)| (a - b).abs() < 1e-11 * scale));
        }
    }

    #[test]
    fn standing_still_gives_the_source_back_on_the_consistent_grid() {
        let mut random = Random::new(4, 1);
        let source = Var::constant(uniform(&mut random, [1, 5, 7, 3], 0.0, 1.0));
        let depth = Var::constant(uniform(&mut random, [1, 5, 7, 1], 1.0, 9.0));
        let still = vec![1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        let still = Var::constant(Tensor::from_vec([1, 3, 4], still));
        let y = source.warp(&depth, &still, &[[5.0, 6.0, 3.5, 2.5]], true);
        assert!(y.value().data().iter().zip(source.value().data()).all(|(a, b)| (a - b).abs() < 1e-6));
    }

    #[test]
    fn any_depth_and_any_transform_are_safe() {
        let wild = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300, -1e300, 0.0, -0.0, -1e-7, 1e-300];
        for &t in &wild {
            for &d in &wild {
                let tape = Tape::new();
                let depth = tape.leaf(Tensor::full([1, 3, 4, 1], d));
                let mut transform = Tensor::full([1, 3, 4], t);
                transform.data_mut()[0] = 1.0;
                let transform = tape.leaf(transform);
                let source = tape.leaf(Tensor::full([1, 3, 4, 3], 1.0));
                let y = source.warp(&depth, &transform, &[[2.0, 2.0, 1.5, 1.0]], false);
                assert!(y.value().data().iter().all(|y| y.is_nan() || (y - 1.0).abs() < 1e-12));
                y.sum_all().backward();
            }
        }
    }
}
