//! The three products of a convolution, tile by tile: outputs, the gradient of the input, the gradient of the weights.

use std::ops::Range;

use super::direct;
use super::geometry::{Beyond, Geometry, Path};
use super::parts::{Part, in_one_piece, whole};
use crate::ops::support::epilogue::Finish;
use crate::ops::support::put::{begin_sum, put};
use crate::ops::support::sums::sum_into;
use crate::tensor::gemm::{Rows, RowsMut, gemm};
use crate::tensor::pool::Buffer;
use crate::tensor::simd::copy_run;
use crate::tensor::{Accum, Float, Precision, Tensor, parallel, regime};

/// Fills the im2col rows of the output pixels of row `oy`, for one group: `[out width, patch]`.
fn im2col<T: Float>(g: &Geometry, image: &[T], oy: usize, group: usize, patches: &mut [T]) {
    let (c, cg, kw, patch) = (g.channels, g.group_in(), g.kernel[1], g.patch());
    let run = kw * cg;
    // Where runs are whole: no dilation along the row, and all channels.
    let whole = if g.dilation[1] == 1 && g.groups == 1 { g.inside() } else { 0..0 };
    T::dispatch(
        #[inline(always)]
        || {
            for ky in 0..g.kernel[0] {
                let Some(iy) = g.source(0, oy, ky) else {
                    patches.chunks_exact_mut(patch).for_each(|p| p[ky * run..(ky + 1) * run].fill(T::ZERO));
                    continue;
                };
                let row = &image[iy * g.size[1] * c..(iy + 1) * g.size[1] * c];
                for (ox, p) in patches.chunks_exact_mut(patch).enumerate() {
                    let p = &mut p[ky * run..(ky + 1) * run];
                    if whole.contains(&ox) {
                        let first = (ox * g.stride[1] - g.padding[1]) * c;
                        copy_run(p, &row[first..first + run]);
                        continue;
                    }
                    for (kx, p) in p.chunks_exact_mut(cg).enumerate() {
                        match g.source(1, ox, kx) {
                            Some(ix) => copy_run(p, &row[ix * c + group * cg..ix * c + (group + 1) * cg]),
                            None => p.fill(T::ZERO),
                        }
                    }
                }
            }
        },
    );
}

/// The im2col matrix of the output rows `first..first + rows` (over the whole batch), for one group.
fn im2col_tile<T: Float>(g: &Geometry, x: &[T], first: usize, rows: usize, group: usize, patches: &mut [T]) {
    let (row, image) = (g.out[1] * g.patch(), g.size[0] * g.size[1] * g.channels);
    for (r, patches) in (first..first + rows).zip(patches.chunks_exact_mut(row)) {
        let b = r / g.out[0];
        im2col(g, &x[b * image..(b + 1) * image], r % g.out[0], group, patches);
    }
}

/// `out = conv(x, w)`, or added to what is there; and finished.
pub(in crate::ops) fn convolve<T: Float>(
    out: &mut [T],
    accum: Accum,
    g: &Geometry,
    x: &[Part<T>],
    w: &[T],
    finish: &Finish<T>,
    precision: Precision,
) {
    match g.path() {
        Path::Im2col => product(out, accum, g, in_one_piece(g, x, &mut None), w, finish),
        // As part of another convolution; by itself it is a product of matrices.
        Path::Pointwise | Path::Direct => direct::convolve(out, accum, g, x, w, finish, precision),
        Path::SideBySide(s) => direct::convolve(out, accum, &g.widened(s), x, &widened(g, s, w), finish, precision),
    }
}

/// The weights of `s` outputs side by side, `[kh, kw + (s - 1) stride, in, s out]`: each output's own, as many strides
/// along as it stands, and zeros around.
fn widened<T: Float>(g: &Geometry, s: usize, w: &[T]) -> Buffer<T> {
    let (c, n, kw) = (g.channels, g.out_channels, g.kernel[1]);
    let wide = g.widened(s).kernel[1];
    let mut out = Buffer::filled(g.kernel[0] * wide * c * s * n, T::ZERO);
    let rows = w.chunks_exact((kw * c * n).max(1)).zip(out.chunks_exact_mut((wide * c * s * n).max(1)));
    for (row, out) in rows {
        for (i, w) in row.chunks_exact(n).enumerate() {
            let (kx, channel) = (i / c, i % c);
            for j in 0..s {
                out[(((kx + j * g.stride[1]) * c + channel) * s + j) * n..][..n].copy_from_slice(w);
            }
        }
    }
    out
}

/// im2col and products, tile by tile.
fn product<T: Float>(out: &mut [T], accum: Accum, g: &Geometry, x: &[T], w: &[T], finish: &Finish<T>) {
    let (n, patch, width, tile) = (g.out_channels, g.patch(), g.out[1], g.tile());
    let work = 2 * g.rows() * width * patch * n;
    parallel::for_each_chunk(out, tile * width * n, work, |i, out| {
        let rows = out.len() / (width * n);
        let pixels = rows * width;
        let mut patches = Buffer::stale(pixels * patch);
        for group in 0..g.groups {
            im2col_tile(g, x, i * tile, rows, group, &mut patches);
            let (first, ng) = (group * g.group_out(), g.group_out());
            let weights = Rows::columns(w, patch, n, first, ng);
            gemm(
                RowsMut::columns(out, pixels, n, first, ng),
                accum,
                Rows::dense(&patches, pixels, patch),
                weights,
                T::ONE,
            );
        }
        finish.run(out);
    });
}

/// The window turned by half a circle, with inputs and outputs exchanged: `[kh, kw, out / groups, in]`.
fn turned<T: Float>(g: &Geometry, w: &[T]) -> Buffer<T> {
    let (cg, ng, taps) = (g.group_in(), g.group_out(), g.kernel[0] * g.kernel[1]);
    let mut out = Buffer::stale(w.len());
    let work = w.len();
    parallel::for_each_unit(&mut out, ng * g.channels, work, |tap, block| {
        let from = &w[(taps - 1 - tap) * cg * g.out_channels..][..cg * g.out_channels];
        for group in 0..g.groups {
            // Some channels at a time, which stay in the cache for all the outputs.
            for channels in regime::blocks(0..cg, TURNED) {
                let first = channels.start;
                for (j, row) in block.chunks_exact_mut(g.channels).enumerate() {
                    let row = &mut row[group * cg + first..(group + 1) * cg];
                    let column = from[first * g.out_channels..][group * ng + j..].iter().step_by(g.out_channels);
                    row.iter_mut().take(channels.len()).zip(column).for_each(|(v, &w)| *v = w);
                }
            }
        }
    });
    out
}

/// Channels of a window turned at a time.
const TURNED: usize = 16;

/// dx from dy.
pub(in crate::ops) fn input_gradient<T: Float>(out: &mut [T], accum: Accum, g: &Geometry, dy: &[T], w: &[T]) {
    match g.transposed() {
        Some(t) => {
            let turned = turned(g, w);
            convolve(out, accum, &t, &whole(&t, dy), &turned, &Finish::nothing(), Precision::F32);
            if g.beyond != Beyond::Zero {
                border_gradient(out, g, &t, dy, &turned);
            }
        }
        None => scatter(out, accum, g, dy, w),
    }
}

/// What the padding adds to dx: the gradient at every padded position goes to the pixel that is seen there. dx is the
/// convolution `t` of dy with the weights `turned`.
pub(in crate::ops) fn border_gradient<T: Float>(out: &mut [T], g: &Geometry, t: &Geometry, dy: &[T], turned: &[T]) {
    // The same convolution of dy over the padded extent; of its rows and columns only the border is computed.
    let [ph, pw] = g.padding;
    let padded = Geometry {
        out: [g.size[0] + 2 * ph, g.size[1] + 2 * pw],
        padding: [t.padding[0] + ph * t.stride[0], t.padding[1] + pw * t.stride[1]],
        ..*t
    };
    let is_border = |y: usize, x: usize| y < ph || y >= ph + g.size[0] || x < pw || x >= pw + g.size[1];
    let positions: Vec<(usize, usize)> = (0..padded.out[0])
        .flat_map(|y| (0..padded.out[1]).map(move |x| (y, x)))
        .filter(|&(y, x)| is_border(y, x))
        .collect();
    let (patch, c, image) = (padded.patch(), g.channels, t.size[0] * t.size[1] * t.channels);
    if c == 0 || positions.is_empty() {
        return;
    }
    // Sums of all positions of all images, some at a time: many pieces, however few images there are.
    let count = positions.len();
    let mut sums = Buffer::stale(g.batch * count * c);
    let (block, work) = (g.tile.or(BORDER), 2 * sums.len() * patch);
    parallel::for_each_chunk(&mut sums, block * c, work, |i, sums| {
        let rows = sums.len() / c;
        let mut patches = Buffer::stale(rows * patch);
        for group in 0..g.groups {
            for (at, p) in (i * block..).zip(patches.chunks_exact_mut(patch)) {
                let (b, (y, x)) = (at / count, positions[at % count]);
                gather_patch(&padded, &dy[b * image..(b + 1) * image], y, x, group, p);
            }
            let (first, cg) = (group * g.group_in(), g.group_in());
            let weights = Rows::columns(turned, patch, c, first, cg);
            let patches = Rows::dense(&patches, rows, patch);
            gemm(RowsMut::columns(sums, rows, c, first, cg), Accum::Replace, patches, weights, T::ONE);
        }
    });
    let work = sums.len();
    parallel::for_each_unit(out, g.size[0] * g.size[1] * c, work, |b, out| {
        for (&(y, x), sum) in positions.iter().zip(sums[b * count * c..].chunks_exact(c)) {
            let (Some(y), Some(x)) = (g.padded(0, y), g.padded(1, x)) else { continue };
            let to = (y * g.size[1] + x) * c;
            out[to..to + c].iter_mut().zip(sum).for_each(|(d, &s)| *d += s);
        }
    });
}

/// Positions of the border that are computed together.
const BORDER: usize = 64;

/// The patch of one output pixel, for one group.
fn gather_patch<T: Float>(g: &Geometry, image: &[T], oy: usize, ox: usize, group: usize, patch: &mut [T]) {
    let (c, cg) = (g.channels, g.group_in());
    for (k, p) in patch.chunks_exact_mut(cg).enumerate() {
        match (g.source(0, oy, k / g.kernel[1]), g.source(1, ox, k % g.kernel[1])) {
            (Some(iy), Some(ix)) => {
                p.copy_from_slice(&image[(iy * g.size[1] + ix) * c + group * cg..][..cg]);
            }
            _ => p.fill(T::ZERO),
        }
    }
}

/// The weights that see some of the channels, from `first` on as many as `g` has: `[kh, kw, channels, out]`.
pub(in crate::ops) fn weights_of<T: Float>(g: &Geometry, first: usize, channels: usize, w: &[T]) -> Buffer<T> {
    let mut out = Buffer::stale(g.kernel[0] * g.kernel[1] * g.channels * g.out_channels);
    let taps = w.chunks_exact((channels * g.out_channels).max(1));
    for (out, w) in out.chunks_exact_mut((g.channels * g.out_channels).max(1)).zip(taps) {
        out.copy_from_slice(&w[first * g.out_channels..][..out.len()]);
    }
    out
}

/// dx where it is no convolution (strided): the gradients of patches, added to the pixels they were copied from. A
/// chunk owns some rows of dx, and computes of the patches what lies in them.
fn scatter<T: Float>(out: &mut [T], accum: Accum, g: &Geometry, dy: &[T], w: &[T]) {
    let (n, width, line) = (g.out_channels, g.out[1], g.size[1] * g.channels);
    if out.is_empty() || dy.is_empty() {
        return begin_sum(out, accum);
    }
    let work = 2 * g.rows() * width * g.patch() * n;
    // About as many numbers as a tile of the output has; few rows where there are few in all.
    let usual = ((1 << 14) / line).clamp(1, (g.batch * g.size[0]).div_ceil(64)).next_multiple_of(g.stride[0]);
    let tile = g.tile.or(usual);
    parallel::for_each_chunk(out, tile * line, work, |i, out| {
        begin_sum(out, accum);
        let mut first = i * tile;
        // Image by image.
        let mut rest = out;
        while !rest.is_empty() {
            let (b, y) = (first / g.size[0], first % g.size[0]);
            let rows = (rest.len() / line).min(g.size[0] - y);
            let (mine, others) = rest.split_at_mut(rows * line);
            let image = g.out[0] * width * n;
            scatter_rows(mine, g, y..y + rows, &dy[b * image..(b + 1) * image], w);
            (rest, first) = (others, first + rows);
        }
    });
}

/// Adds to some rows of dx of one image what the patches of its dy have there.
fn scatter_rows<T: Float>(out: &mut [T], g: &Geometry, rows: Range<usize>, dy: &[T], w: &[T]) {
    let (c, cg, n, ng, width) = (g.channels, g.group_in(), g.out_channels, g.group_out(), g.out[1]);
    let (run, line) = (g.kernel[1] * cg, g.size[1] * c);
    let seen = |oy: usize, ky: usize| g.source(0, oy, ky).filter(|y| rows.contains(y));
    for ky in 0..g.kernel[0] {
        let mut oy = 0;
        while oy < g.out[0] {
            let count = (oy..g.out[0]).take_while(|&oy| seen(oy, ky).is_some()).count();
            if count == 0 {
                oy += 1;
                continue;
            }
            let pixels = count * width;
            let mut products = Buffer::stale(pixels * run);
            for group in 0..g.groups {
                let weights = Rows::columns(&w[ky * run * n..][..run * n], run, n, group * ng, ng).t();
                let dy = Rows::columns(&dy[oy * width * n..][..pixels * n], pixels, n, group * ng, ng);
                gemm(RowsMut::dense(&mut products, pixels, run), Accum::Replace, dy, weights, T::ONE);
                T::dispatch(
                    #[inline(always)]
                    || {
                        for (oy, products) in (oy..).zip(products.chunks_exact(width * run)) {
                            let Some(y) = seen(oy, ky) else { continue };
                            let out = &mut out[(y - rows.start) * line..][..line];
                            for (ox, p) in products.chunks_exact(run).enumerate() {
                                for (kx, p) in p.chunks_exact(cg).enumerate() {
                                    let Some(x) = g.source(1, ox, kx) else { continue };
                                    put(Accum::Add, out[x * c + group * cg..][..cg].iter_mut().zip(p.iter().copied()));
                                }
                            }
                        }
                    },
                );
            }
            oy += count;
        }
    }
}

/// dw: the sum over pixels of patch^T dy.
pub(in crate::ops) fn weight_gradient<T: Float>(out: &mut [T], accum: Accum, g: &Geometry, x: &[Part<T>], dy: &[T]) {
    if g.is_direct() {
        return direct::weight_gradient(out, accum, g, x, dy);
    }
    // Of im2col matrices, in a fixed number of partial sums.
    let (n, patch, tile) = (g.out_channels, g.patch(), g.tile());
    let tiles = g.rows().div_ceil(tile);
    let parts = tiles.clamp(1, PARTS);
    let mut room = None;
    let image = in_one_piece(g, x, &mut room);
    let partial = |part: usize, sum: &mut [T]| {
        sum.fill(T::ZERO);
        for first in (part * tiles / parts..(part + 1) * tiles / parts).map(|t| t * tile) {
            add_weight_gradient(sum, g, image, dy, first, tile.min(g.rows() - first));
        }
    };
    let work = 2 * g.rows() * g.out[1] * patch * n;
    let sums = parallel::map(parts, work, |part| Tensor::build([patch * n], |sum| partial(part, sum)));
    sum_into(out, accum, &sums);
}

/// What some output rows add to dw: products of their im2col matrix.
fn add_weight_gradient<T: Float>(sum: &mut [T], g: &Geometry, x: &[T], dy: &[T], first: usize, rows: usize) {
    let (n, ng, patch, width) = (g.out_channels, g.group_out(), g.patch(), g.out[1]);
    let pixels = rows * width;
    let mut patches = Buffer::stale(pixels * patch);
    for group in 0..g.groups {
        im2col_tile(g, x, first, rows, group, &mut patches);
        let dy = Rows::columns(&dy[first * width * n..][..pixels * n], pixels, n, group * ng, ng);
        let patches = Rows::dense(&patches, pixels, patch);
        gemm(RowsMut::columns(sum, patch, n, group * ng, ng), Accum::Add, patches.t(), dy, T::ONE);
    }
}

/// Partial sums of a weight gradient by im2col.
const PARTS: usize = 4;
